"""Track targets from frame to frame.

A flat target has two poses that fit nearly equally well. The tracker keeps both and chooses with
the evidence of the last frames, so that noise in one frame does not flip the pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from robot_ik.camera.detection import Detection
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose import PoseFit
from robot_ik.camera.sources import Frame
from robot_ik.camera.targets import (
    MarkerFits,
    MarkerTarget,
    Observation,
    Target,
    find_corners,
    unique,
)
from robot_ik.geometry import Pose

# Largest number of markers that are fitted in a frame, and of pixels for all of them together. With
# these a frame of 640 x 480 takes less than the 33 ms of a camera of 30 Hz. Up to nine markers the
# number of pixels is no limit.
MAX_FITS = 20
MAX_PIXELS = 20000

# Part of the evidence of a frame that remains in the next one: about ten frames count.
_MEMORY = 0.85
# Standard deviation of the rotation rate of a hand-held target, rad/s.
_ROTATION_RATE = 2.0
# Largest evidence of one rotation and of one frame, log odds. Either may be an outlier.
_MAX_ROTATION_EVIDENCE = 4.0
_MAX_FRAME_EVIDENCE = 8.0
# The other pose is chosen if it is better by this, log odds.
_HYSTERESIS = 0.5
# A target that was not visible for this long is a new one, s.
_MAX_GAP = 0.5
# Time between frames without a time, s.
_DEFAULT_GAP = 1.0 / 30.0


class Tracker:
    """Find targets in the frames of one camera, in their order.

    Targets of one dictionary share the detection. At most ``MAX_FITS`` markers of a dictionary are
    fitted in a frame, so that large boards do not slow the camera down; every target keeps at least
    one.

    Args:
        intrinsics: Intrinsics of the frames.
        targets: Targets to find.
    """

    def __init__(self, intrinsics: CameraIntrinsics, targets: Sequence[Target]) -> None:
        self.intrinsics = intrinsics
        self.targets = tuple(targets)
        self._memories = [PoseMemory() for _ in self.targets]
        self._ids: dict[str, frozenset[int]] = {}
        for target in self.targets:
            if isinstance(target, MarkerTarget):
                known = self._ids.get(target.dictionary, frozenset())
                self._ids[target.dictionary] = known | target.ids
        self._frame: Frame | None = None
        self._observations: list[Observation] = []

    def observe(self, frame: Frame) -> list[Observation]:
        """Return the observations of the visible targets.

        Raises:
            CalibrationError: The frame does not have the size of the intrinsics.
            CameraError: ``frame`` is not a ``Frame``.
        """
        if self._frame is not None and frame is self._frame:
            return self._observations
        corners = {
            dictionary: unique(
                find_corners(
                    frame,
                    self.intrinsics,
                    dictionary,
                    ids,
                    select=self._select,
                    max_pixels=MAX_PIXELS,
                )
            )
            for dictionary, ids in self._ids.items()
        }
        observations = []
        for target, memory in zip(self.targets, self._memories, strict=True):
            if isinstance(target, MarkerTarget):
                fits = target.fit(corners[target.dictionary], self.intrinsics, frame.time)
                observation = None if fits is None else memory.choose(fits)
            else:
                observation = target.find(frame, self.intrinsics)
            if observation is not None:
                observations.append(observation)
        self._frame = frame
        self._observations = observations
        return observations

    def _select(self, detections: Sequence[Detection]) -> list[Detection]:
        """Return the detections to refine: at most ``MAX_FITS``, but one of each target."""
        if len(detections) <= MAX_FITS:
            return list(detections)
        chosen: dict[int, Detection] = {}
        for target in self.targets:
            if not isinstance(target, MarkerTarget):
                continue
            detected = [d for d in detections if d.id in target.ids]
            count = min(len(detected), max(1, MAX_FITS * len(detected) // len(detections)))
            for k in range(count):
                detection = detected[k * len(detected) // count]
                chosen[id(detection)] = detection
        return list(chosen.values())


class PoseMemory:
    """Chooses between the two poses of a target.

    The poses are the states of a hidden Markov model (Rabiner 1989, forward pass).
    """

    def __init__(self) -> None:
        self._fits: Sequence[PoseFit] = ()
        self._odds: list[float] = []
        self._chosen = 0
        self._time = math.nan

    def choose(self, found: MarkerFits) -> Observation:
        """Return the observation of the more plausible pose, and remember it for the next frame."""
        fits = found.fits
        best = fits[0]
        # Errors that the covariance of the corners does not explain are in both poses. The evidence
        # is then weaker.
        scale = max(1.0, best.cost / best.redundancy)
        evidence = [-0.5 * (fit.cost - best.cost) / scale for fit in fits]
        odds = [max(value, -_MAX_FRAME_EVIDENCE) for value in evidence]
        gap = found.time - self._time
        if not math.isfinite(gap) or gap == 0.0:
            gap = _DEFAULT_GAP
        chosen = 0
        if self._fits and 0.0 < gap <= _MAX_GAP:
            moves = [[_move_evidence(old, new, gap) for new in fits] for old in self._fits]
            for k in range(len(fits)):
                paths = [_MEMORY * old + row[k] for old, row in zip(self._odds, moves, strict=True)]
                odds[k] += max(paths) + math.log(sum(math.exp(path - max(paths)) for path in paths))
            continuation = max(range(len(fits)), key=lambda k: moves[self._chosen][k])
            likeliest = max(range(len(fits)), key=lambda k: odds[k])
            chosen = (
                likeliest if odds[likeliest] > odds[continuation] + _HYSTERESIS else continuation
            )

        self._fits = fits
        self._odds = [value - max(odds) for value in odds]
        self._chosen = chosen
        self._time = found.time
        if len(fits) < 2:
            return found.observation()
        now = evidence[chosen] - evidence[1 - chosen]
        # Successive frames share errors: the evidence of all frames counts half.
        total = max(now, 0.5 * (now + self._odds[chosen] - self._odds[1 - chosen]), 0.0)
        ambiguity = 1.0 / math.sqrt(1.0 + 2.0 * scale * total / (best.cost + best.redundancy))
        return found.observation(chosen, ambiguity)


def _move_evidence(old: PoseFit, new: PoseFit, gap: float) -> float:
    """Return how well the rotation between two frames fits the expected one, log odds."""
    variance = (_ROTATION_RATE * gap) ** 2
    variance += sum(float(fit.covariance[k, k]) for fit in (old, new) for k in (3, 4, 5))
    angle = _angle(old.pose, new.pose)
    return max(-0.5 * angle * angle / variance, -_MAX_ROTATION_EVIDENCE)


def _angle(first: Pose, second: Pose) -> float:
    return 2.0 * math.acos(min(1.0, abs(float(first.wxyz @ second.wxyz))))
