"""Fixtures of workcell and script; runs of ``reach`` are in ``tests/commands``."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from robot_ik.script import ScriptReport, ScriptRequest, parse_script, run_script
from robot_ik.workcell import vision
from tests.commands.reach_runs import arms, full_pictures, healthy, reach, seen_smaller

__all__ = ["arms", "full_pictures", "healthy", "reach"]


@pytest.fixture(scope="module", autouse=True)  # other folders need the pictures of users
def _light_pictures() -> Iterator[None]:
    """Pictures of half the size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "scene_for", seen_smaller)
        yield


@pytest.fixture
def play() -> Callable[..., ScriptReport]:
    """``play(steps in TOML, **request)``."""

    def play(steps: str, head: str = "", **request: object) -> ScriptReport:
        script = parse_script(f'schema = 1\nname = "trial"\n{head}\n{steps}', "trial.toml")
        return run_script(script, ScriptRequest(**request))  # type: ignore[arg-type]

    return play
