"""From phases to channel envelopes: what to ask of the stimulator, and when."""
