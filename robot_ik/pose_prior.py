"""``PosePrior``: how likely a pose is, by a density over poses learned from motion."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError, InvalidGoalError, ModelError, UnknownJointError
from robot_ik.files import write_atomically
from robot_ik.geometry import rotation_log
from robot_ik.kernels.block import Block
from robot_ik.kernels.pose_prior import (
    LEAN_X,
    LEAN_Y,
    NUMBER,
    PRIOR,
    VECTOR_X,
    VECTOR_Y,
    VECTOR_Z,
)
from robot_ik.kernels.tree import BALL, FREE
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.robot import Robot

# Parts of a joint that are features, and the kernel's code of each.
_PARTS = {
    "": NUMBER,
    ":lean_x": LEAN_X,
    ":lean_y": LEAN_Y,
    ":x": VECTOR_X,
    ":y": VECTOR_Y,
    ":z": VECTOR_Z,
}
_PARTS_OF = {FREE: (":lean_x", ":lean_y"), BALL: (":x", ":y", ":z")}
# Largest number of rounds of the fixed-point iteration from a mean to a mode.
_MODE_ROUNDS = 500
# Largest change in a round at which the iteration ends.
_MODE_CHANGE = 1e-10
# Subtracted from the lowest energy, so that rounding does not make the kernel's radicand negative.
_ENERGY_MARGIN = 1e-9


def feature_names(robot: Robot) -> tuple[str, ...]:
    """Return all features of a prior, by name.

    They are hinges and slides, the lean of a free base, and the rotation vectors of balls.
    Position and heading of a base are no features, because they do not change the pose.
    """
    names: list[str] = []
    for joint, kind in zip(robot.joints, robot.tree.kind, strict=True):
        names += [joint + part for part in _PARTS_OF.get(int(kind), ("",))]
    return tuple(names)


@dataclass(frozen=True, eq=False, repr=False)
class PosePrior:
    """A Gaussian mixture over poses.

    The energy is E(x) = −log Σ w_k N(x; μ_k, Σ_k), where x = (feature − middle) / spread.

    Attributes:
        names: (n,) features by name, see ``feature_names``.
        middle, spread: (n,) scale of the features, in rad and m; a lean is a sine.
        weights: (k,) weights of the parts, whose sum is one.
        means: (k, n) means of x.
        covariances: (k, n, n) covariances of x.
        contour: Energy of the contour around 99 % of the learned poses; inf if unknown.
        min_energy: Lowest energy of the mixture.
    """

    names: tuple[str, ...]
    middle: Array
    spread: Array
    weights: Array
    means: Array
    covariances: Array
    contour: float = np.inf
    precisions: Array = field(init=False)
    logs: Array = field(init=False)
    min_energy: float = field(init=False)

    def __post_init__(self) -> None:
        n = len(self.names)
        k = len(self.weights)
        shapes = {
            "middle": (n,),
            "spread": (n,),
            "weights": (k,),
            "means": (k, n),
            "covariances": (k, n, n),
        }
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape or not np.isfinite(array).all() or not array.size:
                raise InvalidGoalError(f"a pose prior's {name} must be {shape} finite numbers")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if not ((self.spread > 0.0).all() and (self.weights > 0.0).all()):
            raise InvalidGoalError("a pose prior's spreads and weights must be positive")
        try:
            factors = np.linalg.cholesky(self.covariances)
        except np.linalg.LinAlgError as error:
            raise InvalidGoalError(
                "a pose prior's covariances must be positive definite"
            ) from error
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        weights = self.weights / self.weights.sum()
        object.__setattr__(self, "precisions", np.linalg.inv(self.covariances))
        object.__setattr__(self, "logs", np.log(weights) - logs - 0.5 * n * np.log(2.0 * np.pi))
        object.__setattr__(self, "min_energy", self._lowest_energy())

    def __repr__(self) -> str:
        return f"PosePrior({len(self.names)} features, {len(self.weights)} parts)"

    def features(self, robot: Robot, q: ArrayLike) -> Array:
        """Return the features x (m, n) of poses (m, nq), or (n,) of one pose.

        Raises:
            UnknownJointError: The robot lacks a joint of the prior.
        """
        rows = np.atleast_2d(np.asarray(q, dtype=float))
        columns = []
        for code, a, _ in self.indices(robot).tolist():
            if code == NUMBER:
                columns.append(rows[:, a])
            elif code in (LEAN_X, LEAN_Y):
                w, x, y, z = rows[:, a : a + 4].T
                columns.append(2.0 * (x * z - w * y) if code == LEAN_X else 2.0 * (y * z + w * x))
            else:
                columns.append(
                    np.array([rotation_log(row[a : a + 4])[code - VECTOR_X] for row in rows])
                )
        x = (np.stack(columns, axis=1) - self.middle) / self.spread
        return np.asarray(x[0] if np.ndim(q) == 1 else x)

    def energy(self, robot: Robot, q: ArrayLike) -> Array:
        """Return −log of the density at poses (m, nq), or at one pose."""
        x = self.features(robot, q)
        return self.energy_of(np.atleast_2d(x))[0 if np.ndim(q) == 1 else slice(None)]

    def indices(self, robot: Robot) -> NDArray[np.int64]:
        """Return (n, 3) for each feature: its code in kernels, where it starts in q, and its node.

        Raises:
            UnknownJointError: The robot lacks a joint of the prior.
            InvalidGoalError: A joint has another kind.
        """
        rows = []
        for name in self.names:
            joint, colon, part = name.partition(":")
            if joint not in robot.joints:
                raise UnknownJointError(joint, robot.joints)
            k = robot.joints.index(joint)
            kind = int(robot.tree.kind[k])
            if colon + part not in _PARTS_OF.get(kind, ("",)):
                raise InvalidGoalError(
                    f"the prior has {name!r}, but that joint of {robot.name!r} has another kind",
                    hint=f"learn a prior from motions of {robot.name!r} with fit_pose_prior",
                )
            rows.append(
                (_PARTS[colon + part], int(robot.tree.qadr[k]) + (3 if kind == FREE else 0), k)
            )
        return np.array(rows, dtype=np.int64).reshape(len(rows), 3)

    def block(self, robot: Robot) -> Block:
        """Return the prior as the kernels read it.

        Raises:
            UnknownJointError: The robot lacks a joint of the prior.
        """
        given = {
            "features": self.indices(robot),
            "center": self.middle,
            "spread": self.spread,
            "log_weights": self.logs,
            "means": self.means,
            "precisions": self.precisions.reshape(-1, len(self.names)),
        }
        block = PRIOR.allocate(given=given)
        block["min_energy"] = self.min_energy
        return block

    def save(self, path: Path | str) -> None:
        """Write an .npz file.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            schema=1,
            names=np.array(self.names),
            middle=self.middle,
            spread=self.spread,
            weights=self.weights,
            means=self.means,
            covariances=self.covariances.astype(np.float32),
            contour=self.contour,
        )
        write_atomically(Path(path), stream.getvalue())

    @classmethod
    def load(cls, path: Path | str) -> PosePrior:
        """Read a file of ``save``.

        Raises:
            ConfigError: The file does not exist or is not a pose prior.
        """
        file = Path(path)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                if int(arrays["schema"]) != 1:
                    raise ConfigError("another version", file=file, key="schema", allowed="1")
                return cls(
                    tuple(arrays["names"].tolist()),
                    arrays["middle"],
                    arrays["spread"],
                    arrays["weights"],
                    arrays["means"],
                    arrays["covariances"].astype(float),
                    float(arrays["contour"]),
                )
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            zipfile.BadZipFile,
            InvalidGoalError,
        ) as error:
            raise ConfigError(f"is no pose prior: {error}", file=file) from error

    @classmethod
    def of(cls, robot: Robot) -> PosePrior:
        """Return the prior of a bundled robot.

        Raises:
            ModelError: The robot has no prior.
        """
        file = robot.folder / "assets" / "pose_prior.npz"
        if not file.is_file():
            raise ModelError(
                f"no pose prior is bundled with {robot.name!r}",
                path=robot.path,
                hint="learn one from its motions: robot_ik.figure.motion.pose_prior.fit_pose_prior",
            )
        return cls.load(file)

    def energy_of(self, x: Array) -> Array:
        """Return the energies (m,) of features (m, n)."""
        logs = self._part_logs(x)
        best = logs.max(axis=1)
        return -(best + np.log(np.exp(logs - best[:, None]).sum(axis=1)))

    def _part_logs(self, x: Array) -> Array:
        """Return (m, k) log w_k N(x; …)."""
        deviation = x[:, None, :] - self.means
        squares = np.einsum("mki,kij,mkj->mk", deviation, self.precisions, deviation)
        return np.asarray(self.logs - 0.5 * squares)

    def _lowest_energy(self) -> float:
        """Return the energy of the best mode that the means lead to (Carreira-Perpiñán 2000)."""
        x = np.array(self.means)
        for _ in range(_MODE_ROUNDS):
            logs = self._part_logs(x)
            shares = np.exp(logs - logs.max(axis=1, keepdims=True))
            matrix = np.einsum("mk,kij->mij", shares, self.precisions)
            right = np.einsum("mk,kij,kj->mi", shares, self.precisions, self.means)
            moved = np.linalg.solve(matrix, right[..., None])[..., 0]
            change = float(np.abs(moved - x).max())
            x = moved
            if change < _MODE_CHANGE:
                break
        return float(self.energy_of(x).min()) - _ENERGY_MARGIN


NO_PRIOR = PRIOR.allocate(
    given={
        "features": np.zeros((0, 3), dtype=np.int64),
        "center": np.zeros(0),
        "spread": np.zeros(0),
        "log_weights": np.zeros(0),
        "means": np.zeros((0, 0)),
        "precisions": np.zeros((0, 0)),
    }
)
"""The prior of goals without one, as the kernels read it."""
