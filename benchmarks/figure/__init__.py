"""The motion of the figure, judged by MuJoCo: ``python -m benchmarks.figure``."""
