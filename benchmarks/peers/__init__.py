"""Comparison with other libraries: the same problems, the same inputs, MuJoCo as the judge.

``tasks`` writes a robot and its seeded problems into a folder that every library can read.
``worker`` runs one library in that library's own interpreter. ``judge`` judges the solutions.
``library`` is what a library implements. ``closed_forms``, ``numeric``, ``differential`` and
``jax_based`` hold the libraries.

    python -m benchmarks.peers install ENVIRONMENTS
    python -m benchmarks.peers run --environments ENVIRONMENTS --out RESULTS
"""
