"""What a camera is calibrated and located with: boards of markers, ChArUco boards, chessboards.

``board`` reads what a board is called on the command line and sees it, ``view`` is one look at one;
``patterns`` are found to a fraction of a pixel (``chess_corner``), ``pattern_kinds`` names the usual
ones, ``pattern_guess`` tells which one a picture shows after all.
"""
