"""Jobs that need an arm and a camera: hand-eye calibration, and the camera that checks the arm."""
