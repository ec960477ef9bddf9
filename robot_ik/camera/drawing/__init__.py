"""Drawing without OpenGL: what ``camera/drawing/overlay.py``, ``ar`` and ``made_up`` paint with.

``mesh`` and ``primitives`` make faces of a MuJoCo model, ``painter`` puts them into a picture
(``scanline`` is its compiled half), ``painted_lines`` are their outlines, ``layer`` the result as a
transparent sheet.  ``raycast`` asks MuJoCo what a pixel sees; ``raster`` paints black rectangles exactly,
``text`` writes.
"""
