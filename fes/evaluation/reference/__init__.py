"""References that a recording is held against: motion capture, ultrasound, treadmill, step mats, foot switches."""
