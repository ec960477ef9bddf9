"""The testbed: an interactive session that solves for a moving ball, and its front ends."""
