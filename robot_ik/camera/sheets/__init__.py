"""Sheets to print at true scale: markers, boards, cubes, calibration patterns.

``sheets`` lays a request out on paper with bars to check the scale, and writes the file that describes to a
tracker what was printed; ``cube`` is a net to fold, ``page`` writes PDF and PNG from one list.
"""
