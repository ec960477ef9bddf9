"""From the lens to the goal: pictures, markers, poses, goals.

A module imports only from those below it; the map is in ``docs/architecture.md``.

Frames: the camera looks along +z with x right and y down (OpenCV); a marker has x right, y up and z out
of its printed face towards the viewer.  Import from the modules; nothing is loaded here, for OpenCV is
slow to load.
"""
