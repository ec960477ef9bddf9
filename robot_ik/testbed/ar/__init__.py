"""Augmented reality: robot 1 of a session and its ball, drawn into the pictures of a camera."""
