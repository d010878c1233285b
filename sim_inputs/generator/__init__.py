"""What makes every file of ``sim_inputs`` anew from its seed: a kinematic walker and the sensors that it wears."""
