"""Compiled numerics on named blocks of memory, without Python objects or allocation in loops."""
