"""A robot, its arm, its scene and its camera, opened together.

``robot_setup`` opens the robot and its arm, ``scene`` the simulated world around them, and
``vision`` the camera. ``verdict`` judges whether a goal was reached. ``films`` and ``results``
write files.
"""
