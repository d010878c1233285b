"""``fes timing``: when transitions and stimulation happen, against a truth and a baseline."""
