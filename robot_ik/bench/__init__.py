"""Benchmarks: seeded problem sets, times of single calls, and success measured by MuJoCo."""
