"""Collisions: scenes, distances and the condition that a posture must be free."""
