"""Robot models: one folder a robot, data only.  Read through ``importlib.resources``."""
