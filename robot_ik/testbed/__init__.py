"""The testbed: an interactive session that solves for a moving ball, and the front ends that show it."""
