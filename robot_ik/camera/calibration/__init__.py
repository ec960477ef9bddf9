"""Calibration from pictures: lens, pose of a camera, joint zeros of an arm."""
