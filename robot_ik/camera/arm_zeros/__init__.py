"""The zeros of the joints, found by a camera that looks at a board: kinematic self-calibration.

``fit`` is what others call; ``model`` predicts what is seen with the zeros as unknowns, ``noise`` weighs
joints that are not exact either, ``words`` says which zeros the views cannot tell apart, ``errors`` maps
how far the arm is off.
"""
