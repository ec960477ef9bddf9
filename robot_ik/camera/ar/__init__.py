"""The virtual robot in the camera's picture, in time.

``registrar`` keeps it on a board from picture to picture, with remedies against delay; ``draw`` draws it
by painter or rays, ``gl_draw`` by OpenGL; ``phantoms`` are real things that hide it; ``registration``
measures in pixels how well it lies.
"""
