"""Sheets to print at true scale: markers, boards, cubes, calibration patterns.

``sheet`` lays a wish out on paper with bars to check the scale; ``blocks`` are what may be on it
(``cube``: a net to fold), ``page`` writes PDF and PNG from one list, ``bodies`` writes the file that
tells a tracker what was printed.
"""
