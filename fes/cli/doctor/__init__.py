"""``fes doctor``: is this machine, and are these devices, ready for a session?"""
