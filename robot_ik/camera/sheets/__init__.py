"""Sheets to print at true scale: markers, boards, cubes, calibration patterns.

``sheets`` lays a request out on paper with bars to check the scale, and writes the file that
describes the printed body to a tracker. ``cube_net`` is the net of a cube. ``page`` writes PDF.
"""
