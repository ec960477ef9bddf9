"""Benchmarks: seeded problem sets, a timer that times nothing else, and MuJoCo as the judge."""
