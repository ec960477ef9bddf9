"""Fixtures of the camera tests: the standard marker set, measured once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.camera.pictures import MarkerView, standard_set
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, STANDARD_SIZE
from robot_ik.camera.targets import Observation, marker

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """The observation in one picture of the set, and the truth."""

    view: MarkerView
    seen: Observation

    @property
    def corner_error(self) -> Array:
        return self.seen.pixels - self.view.corners

    @property
    def position_error(self) -> float:
        return self.seen.pose.distance(self.view.pose)[0]

    @property
    def angle_error(self) -> float:
        return self.seen.pose.distance(self.view.pose)[1]

    @property
    def flipped(self) -> bool:
        """The other branch was the right one, and taking the wrong one cost more than 5 degrees.

        Seen squarely the two branches differ by less than the noise, and neither is wrong.
        """
        other = self.seen.alternative
        wrong = other is not None and other.distance(self.view.pose)[1] < self.angle_error
        return wrong and self.angle_error > np.deg2rad(5.0)

    @property
    def pose_error(self) -> Array:
        """(6,) truth minus observation, along the camera's axes."""
        return self.view.pose.minus(self.seen.pose)


def measure(
    distance: float, count: int, dictionary: str = "DICT_4X4_50", seed: int = 1
) -> list[Measured]:
    """Render and observe a standard set. Fail if a marker is not found."""
    target = marker(7, STANDARD_SIZE, dictionary)
    result = []
    for number, view in enumerate(standard_set(distance, count, seed=seed, dictionary=dictionary)):
        image = np.repeat(view.image[:, :, None], 3, axis=2)
        seen = target.find(Frame(image, 0.0, number), STANDARD_CAMERA)
        assert seen is not None, f"picture {number} at {distance} m"
        result.append(Measured(view, seen))
    return result


@pytest.fixture(scope="session", name="measure")
def measure_function() -> Callable[..., list[Measured]]:
    """The function ``measure``: test modules cannot import this file."""
    return measure


@pytest.fixture(scope="session")
def standard() -> dict[float, list[Measured]]:
    """20 pictures at each distance."""
    return {distance: measure(distance, 20) for distance in (0.3, 0.6, 1.0)}


@pytest.fixture(scope="session")
def model_of() -> Callable[..., mujoco.MjModel]:
    """``model_of(body, assets="")`` returns a model with this content of its world body."""

    def model_of(body: str, assets: str = "") -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(
            f"<mujoco><asset>{assets}</asset><worldbody>{body}</worldbody></mujoco>"
        )

    return model_of
