"""What a camera is calibrated and located with: boards of markers, ChArUco boards, chessboards.

``board`` reads what a board is called on the command line and sees it; ``patterns`` are found to a fraction
of a pixel (``chess_corner``).
"""
