"""Solvers x robots: accuracy, time, growth."""
