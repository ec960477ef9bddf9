"""From the lens to the goal: pictures, markers, poses, goals.

One folder a room, each with a paragraph on what is in it; a room imports only from rooms below it (the
map is in ``docs/architecture.md``).  Flat lies what every room uses: the optics (``intrinsics``,
``calibration_file``, ``lens``, ``lens_kernels``), ``opencv``, ``filter`` and ``overlay``.

Frames: the camera looks along +z with x right and y down (OpenCV); a marker has x right, y up and z out
of its printed face towards the viewer.  Import from the modules; nothing is loaded here, for OpenCV is
slow to load.
"""
