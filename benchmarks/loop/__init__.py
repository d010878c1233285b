"""The closed loop: who is stimulated when, what a tuner makes of a day, and the virtual patient that it walks on."""
