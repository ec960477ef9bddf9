"""One small run of the benchmark, shared by the tests of its results."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_ik.bench.methods.results import Results
from robot_ik.commands.main import main


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`bench` with two methods, of which one supports no poses, on two robots."""
    out = tmp_path_factory.mktemp("bench") / "new"
    arguments = (
        f"bench --solver analytic lm triangulation --robot puma560 panda --count 12 --out {out}"
    )
    assert main([*arguments.split(), "--problems", "cold", "warm", "unreachable", "--plot"]) == 0
    return out


@pytest.fixture(scope="session")
def results(folder: Path) -> Results:
    """The results of this run."""
    return Results.model_validate_json((folder / "bench.json").read_bytes())
