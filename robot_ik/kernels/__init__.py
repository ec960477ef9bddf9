"""Compiled numerics: pure functions on flat arrays, no Python objects, no allocation in loops."""
