"""Servos: from joint angles to a bus and back, guarded.  Imported as ``robot_ik.hardware``."""
