"""Pictures of a reach that are quickly made."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest

from robot_ik.jobs import vision


@pytest.fixture(scope="module", autouse=True)
def _coarse_robots() -> Iterator[None]:
    """The markers are as exact as in a full picture, only the robot is coarse."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "SyntheticSource", partial(vision.SyntheticSource, quality="fast"))
        yield
