"""The robot drawn into a camera's picture."""
