"""The experiments of the two theses on inverse kinematics, repeated."""
