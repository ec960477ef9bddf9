"""Sheets to print at true scale: markers, boards, cubes, calibration patterns.

``sheets`` lays a request out on paper with bars to check the scale, and writes the file that describes to a
tracker what was printed; ``page`` writes PDF and PNG from one list.
"""
