"""Accuracy and speed of the camera: `make bench-camera`."""
