"""Side by side with other libraries: the same problems, the same inputs, MuJoCo as the judge.

``tasks`` writes a robot and its seeded problems into a folder that any library can read; ``worker`` is one
library's run, in that library's own interpreter; ``__main__`` runs it all and judges the solutions:

    python -m robot_ik.bench.peers install ENVIRONMENTS
    python -m robot_ik.bench.peers run --environments ENVIRONMENTS --out RESULTS
"""
