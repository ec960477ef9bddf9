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
_PARTS = {"": NUMBER, ":lean_x": LEAN_X, ":lean_y": LEAN_Y, ":x": VECTOR_X, ":y": VECTOR_Y, ":z": VECTOR_Z}
_PARTS_OF = {FREE: (":lean_x", ":lean_y"), BALL: (":x", ":y", ":z")}
# Rounds of the fixed-point iteration that climbs from each mean to a mode, and how still it must be.
_MODE_ROUNDS, _MODE_STILL = 500, 1e-10
# Subtracted from the least energy found: the kernel's root must not fall below zero by rounding.
_LEAST_MARGIN = 1e-9


def feature_names(robot: Robot) -> tuple[str, ...]:
    """All features of a prior: hinges and slides, the lean of a free base, rotation vectors of balls.

    A base's position and heading are left out: the same pose elsewhere is as likely.
    """
    names: list[str] = []
    for joint, kind in zip(robot.joints, robot.tree.kind, strict=True):
        names += [joint + part for part in _PARTS_OF.get(int(kind), ("",))]
    return tuple(names)


@dataclass(frozen=True, eq=False, repr=False)
class PosePrior:
    """A Gaussian mixture over poses: E(x) = −log Σ w_k N(x; μ_k, Σ_k), x = (feature − middle) / spread.

    Attributes:
        names: (n,) features by name: see ``feature_names``.
        middle, spread: (n,) of the features: rad, m; lean: sine.
        weights: (k,) of the parts; they add up to one.
        means: (k, n) of x.
        covariances: (k, n, n) of x.
        contour: Energy within which 99 % of what it learned from lies; inf where it is not given.
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
    least: float = field(init=False)

    def __post_init__(self) -> None:
        n, k = len(self.names), len(self.weights)
        shapes = {"middle": (n,), "spread": (n,), "weights": (k,), "means": (k, n), "covariances": (k, n, n)}
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
            raise InvalidGoalError("a pose prior's covariances must be positive definite") from error
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        weights = self.weights / self.weights.sum()
        object.__setattr__(self, "precisions", np.linalg.inv(self.covariances))
        object.__setattr__(self, "logs", np.log(weights) - logs - 0.5 * n * np.log(2.0 * np.pi))
        object.__setattr__(self, "least", self._least())

    def __repr__(self) -> str:
        return f"PosePrior({len(self.names)} features, {len(self.weights)} parts)"

    def features(self, robot: Robot, q: ArrayLike) -> Array:
        """(m, n) features x of poses (m, nq), or (n,) of one.

        Raises:
            UnknownJointError: The robot lacks a joint of the prior.
        """
        rows = np.atleast_2d(np.asarray(q, dtype=float))
        columns = []
        for what, a, _ in self.indices(robot).tolist():
            if what == NUMBER:
                columns.append(rows[:, a])
            elif what in (LEAN_X, LEAN_Y):
                w, x, y, z = rows[:, a : a + 4].T
                columns.append(2.0 * (x * z - w * y) if what == LEAN_X else 2.0 * (y * z + w * x))
            else:
                columns.append(np.array([rotation_log(row[a : a + 4])[what - VECTOR_X] for row in rows]))
        found = (np.stack(columns, axis=1) - self.middle) / self.spread
        return np.asarray(found[0] if np.ndim(q) == 1 else found)

    def energy(self, robot: Robot, q: ArrayLike) -> Array:
        """−log density of x at poses (m, nq), or of one: the less, the likelier."""
        x = self.features(robot, q)
        return self.energy_of(np.atleast_2d(x))[0 if np.ndim(q) == 1 else slice(None)]

    def indices(self, robot: Robot) -> NDArray[np.int64]:
        """(n, 3) the kernel's code of each feature, where it begins in q, and its node.

        Raises:
            UnknownJointError: The robot lacks a joint, or it is of another kind.
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
                    f"the prior has {name!r}, but joint {joint!r} of {robot.name!r} is of another kind",
                    hint=f"learn one from motions of {robot.name!r}: robot_ik.figure.motion.pose_prior",
                )
            rows.append((_PARTS[colon + part], int(robot.tree.qadr[k]) + (3 if kind == FREE else 0), k))
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
        block["min_energy"] = self.least
        return block

    def save(self, path: Path | str) -> None:
        """Writes an .npz file.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        stream = io.BytesIO()
        np.savez_compressed(
            stream, schema=1, names=np.array(self.names), middle=self.middle, spread=self.spread,
            weights=self.weights, means=self.means, covariances=self.covariances.astype(np.float32),
            contour=self.contour,
        )  # fmt: skip
        write_atomically(Path(path), stream.getvalue())

    @classmethod
    def load(cls, path: Path | str) -> PosePrior:
        """Reads what ``save`` wrote.

        Raises:
            ConfigError: It is not there, or no pose prior.
        """
        file = Path(path)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                if int(arrays["schema"]) != 1:
                    raise ConfigError("another version", file=file, key="schema", allowed="1")
                return cls(
                    tuple(arrays["names"].tolist()), arrays["middle"], arrays["spread"], arrays["weights"],
                    arrays["means"], arrays["covariances"].astype(float), float(arrays["contour"]),
                )  # fmt: skip
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, InvalidGoalError) as error:
            raise ConfigError(f"is no pose prior: {error}", file=file) from error

    @classmethod
    def of(cls, robot: Robot) -> PosePrior:
        """The prior that ships with a robot.

        Raises:
            ModelError: None does.
        """
        file = robot.folder / "assets" / "pose_prior.npz"
        if not file.is_file():
            raise ModelError(
                f"no pose prior ships with {robot.name!r}", path=robot.path,
                hint="learn one from its motions: robot_ik.figure.motion.pose_prior.fit_pose_prior",
            )  # fmt: skip
        return cls.load(file)

    def energy_of(self, x: Array) -> Array:
        """(m,) of features (m, n)."""
        logs = self._part_logs(x)
        best = logs.max(axis=1)
        return -(best + np.log(np.exp(logs - best[:, None]).sum(axis=1)))

    def _part_logs(self, x: Array) -> Array:
        """(m, k) log w_k N(x; …)."""
        off = x[:, None, :] - self.means
        return np.asarray(self.logs - 0.5 * np.einsum("mki,kij,mkj->mk", off, self.precisions, off))

    def _least(self) -> float:
        """The least energy: the lowest mode that climbing from the means finds (Carreira-Perpiñán 2000)."""
        x = np.array(self.means)
        for _ in range(_MODE_ROUNDS):
            logs = self._part_logs(x)
            shares = np.exp(logs - logs.max(axis=1, keepdims=True))
            matrix = np.einsum("mk,kij->mij", shares, self.precisions)
            right = np.einsum("mk,kij,kj->mi", shares, self.precisions, self.means)
            moved = np.linalg.solve(matrix, right[..., None])[..., 0]
            still = float(np.abs(moved - x).max())
            x = moved
            if still < _MODE_STILL:
                break
        return float(self.energy_of(x).min()) - _LEAST_MARGIN


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
