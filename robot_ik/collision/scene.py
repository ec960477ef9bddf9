"""``Scene``: a robot among obstacles, in one MuJoCo model.

    scene = Scene(robot, [Box("crate", size=(0.4, 0.3, 0.2), pose=Pose((0.5, 0, 0.1)))])
    scene.clearance(q).distance     # m, by MuJoCo; negative: the depth of a contact
    scene.free(Q, margin=0.005)     # (n,) compiled, all cores

MuJoCo measures every reported distance. The compiled check decides only that a posture is free, by
a lower bound of the distance. If the bound does not decide it, MuJoCo does.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik import model as mjcf
from robot_ik.collision.distances import PairTables, ShapeTables, announce, check_memory
from robot_ik.collision.obstacles import Obstacle
from robot_ik.collision.pairs import Ints, compared_pairs, part_name
from robot_ik.errors import (
    CollisionError,
    InvalidObstacleError,
    ModelError,
    OptionError,
    UnknownObstacleError,
)
from robot_ik.geometry import Array, Pose, is_real, numbers
from robot_ik.kernels import collision
from robot_ik.kernels.block import Block
from robot_ik.robot import Robot, load_robot, require_robot

FARTHEST = 1e10
"""m. MuJoCo measures distances up to this."""

SMALLEST_REACH = 1e-9
"""m. MuJoCo measures the depth of a contact only if it measures distances above 0 too."""

TOUCHING_SAMPLES = 64
"""Random postures. Parts that touch in all of them touch by construction."""

_MIN_ROWS_PER_THREAD = 512
"""With fewer postures a thread costs more than it saves."""


@dataclass(frozen=True, eq=False)
class Clearance:
    """The nearest pair of parts at a posture, by MuJoCo.

    Attributes:
        distance: m; negative: the depth of the deepest contact. inf if no parts can touch.
        pair: Names of the bodies, the body farther along the robot first. A geom that is fixed to
            the world has its own name. None if no parts can touch.
        points: (2, 3) nearest points on the two parts, world, m.
        normal: (3,) unit vector from the second part to the first.
    """

    distance: float
    pair: tuple[str, str] | None
    points: Array
    normal: Array

    def __repr__(self) -> str:
        if self.pair is None:
            return "Clearance(inf)"
        return f"Clearance({1e3 * self.distance:.2f} mm between {' and '.join(self.pair)})"


@dataclass(frozen=True)
class Touching:
    """Two parts that touch in every posture that was tried.

    Attributes:
        pair: Names of the two parts.
        depth: Smallest depth of their contact, m. Negative: their largest distance.
        exclude: The line for the ``<contact>`` element of the model, or what to do without it.
    """

    pair: tuple[str, str]
    depth: float
    exclude: str


class Scene:
    """A robot among obstacles.

    Obstacles can be moved at any time. All other properties never change. A scene may be used by
    several threads at the same time; while one moves an obstacle, the others must not check.

    Attributes:
        robot: The robot.
        model: MuJoCo's model of robot and obstacles. Treat it as read-only.
        pairs: (p, 2) ids of the geoms that are compared.
    """

    def __init__(self, robot: Robot, obstacles: Sequence[Obstacle] = ()) -> None:
        """Compile the scene.

        Args:
            robot: From ``load_robot``.
            obstacles: Shapes fixed in the world. Geoms of the robot's model that are fixed to the
                world are obstacles too.

        Raises:
            InvalidObstacleError: A malformed obstacle, or two obstacles of one name.
            UnsupportedGeomError: A geom whose distances are not exact.
            ModelError: The robot was loaded from an ``MjModel``, which cannot take obstacles.
        """
        require_robot(robot)
        self._build(robot, _checked_obstacles(obstacles), {})

    def _build(
        self,
        robot: Robot,
        obstacles: dict[str, Obstacle],
        parts: dict[str, tuple[Obstacle, str]],
    ) -> None:
        self.robot = robot
        self._obstacles = obstacles
        self._parts = parts
        self.model = robot.model
        if obstacles or parts:
            self.model = _compiled(robot, obstacles, parts)
        self._bodies = [(body.node, body.local) for body in robot._bodies]
        self._body_of: dict[str, int] = {}
        for name, obstacle in obstacles.items():
            self._body_of[name] = len(self._bodies)
            self._bodies.append((-1, obstacle.pose))
        # The mocap pose of each moved body: every thread's data follows it.
        self._mocap = np.zeros((self.model.nmocap, 7))
        self._read_mocap()
        self._thread_data = threading.local()
        self.pairs: Ints = compared_pairs(self.model, self._nodes)

    @property
    def _nodes(self) -> Ints:
        return np.array([node for node, _ in self._bodies], dtype=np.int64)

    def _read_mocap(self) -> None:
        for body in range(self.model.nbody):
            mocap = int(self.model.body_mocapid[body])
            if mocap >= 0:
                pose = self._bodies[body][1]
                self._mocap[mocap, :3] = pose.position
                self._mocap[mocap, 3:] = pose.wxyz

    def __repr__(self) -> str:
        names = [*self._obstacles, *self._parts]
        return f"Scene({self.robot.name!r}, obstacles {names}, {len(self.pairs)} pairs)"

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.robot, dict(self._obstacles), dict(self._parts))

    # Obstacles

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles, at their current poses."""
        return tuple(self._obstacles.values())

    @property
    def parts(self) -> tuple[Obstacle, ...]:
        """The attached parts. Their poses are in the frames that carry them."""
        return tuple(part for part, _ in self._parts.values())

    def move(self, name: str, pose: Pose) -> None:
        """Move an obstacle. Nothing is compiled, and every condition on this scene follows.

        Raises:
            UnknownObstacleError: The scene has no such obstacle.
            InvalidObstacleError: ``pose`` is not a ``Pose``.
        """
        if name not in self._obstacles:
            raise UnknownObstacleError(str(name), self._obstacles)
        self._obstacles[name] = replace(self._obstacles[name], pose=pose)
        body = self._body_of[name]
        self._bodies[body] = (-1, pose)
        self._read_mocap()
        if "_tables" in self.__dict__:
            self._tables.move(self.model, self._bodies, body)

    def attached(self, part: Obstacle, frame: str | None = None) -> Scene:
        """Return a scene in which a frame of the robot carries a part, such as a grasped object.

        An obstacle of the same name is taken out of the world. The part may touch the body that
        carries it, and that body's parent and children.

        Args:
            part: The part; its pose is in the frame.
            frame: Name of the frame. None for the tool of the robot.

        Raises:
            UnknownFrameError: The robot has no such frame.
            InvalidObstacleError: The name is used already.
        """
        name = self.robot.frame(frame).name
        if not isinstance(part, Obstacle):
            raise InvalidObstacleError(f"{part!r} is not an obstacle", hint='Box("part", …)')
        if part.name in self._parts:
            raise InvalidObstacleError(f"the part {part.name!r} is attached already")
        obstacles = {key: item for key, item in self._obstacles.items() if key != part.name}
        return _rebuilt(self.robot, obstacles, {**self._parts, part.name: (part, name)})

    def detached(self, name: str, q: ArrayLike | None = None) -> Scene:
        """Return a scene without an attached part.

        Args:
            name: Name of the part.
            q: (nq,) where the part is put down: it stays in the world as an obstacle. None removes
                it.

        Raises:
            UnknownObstacleError: No such part is attached.
        """
        if name not in self._parts:
            raise UnknownObstacleError(str(name), self._parts)
        part, frame = self._parts[name]
        parts = {key: item for key, item in self._parts.items() if key != name}
        obstacles = dict(self._obstacles)
        if q is not None:
            pose = self.robot.forward(q, frame).compose(part.pose)
            obstacles[name] = replace(part, pose=pose)
        return _rebuilt(self.robot, obstacles, parts)

    # Distances by MuJoCo

    def data_at(self, q: ArrayLike) -> mujoco.MjData:
        """Return MuJoCo's data with all bodies at ``q``.

        It is valid until the next call of this thread.
        """
        data = getattr(self._thread_data, "data", None)
        if data is None:
            data = mujoco.MjData(self.model)
            self._thread_data.data = data
        data.qpos[:] = self.robot.qpos(q)
        data.mocap_pos[:] = self._mocap[:, :3]
        data.mocap_quat[:] = self._mocap[:, 3:]
        mujoco.mj_kinematics(self.model, data)
        return data

    def clearance(self, q: ArrayLike, pairs: Ints | None = None) -> Clearance:
        """Return the nearest pair of parts at ``q``, or the deepest contact, by MuJoCo.

        Args:
            q: Joint angles (nq,).
            pairs: (p, 2) ids of geoms. None for all pairs of the scene.

        Raises:
            ModelError: ``q`` has another length, or is not finite.
        """
        data = self.data_at(q)
        pairs = self.pairs if pairs is None else pairs
        nearest_distance = FARTHEST
        nearest = None
        ends = np.zeros(6)
        segment = np.zeros(6)
        for lower, pair in _by_lower_bound(self.model, data, pairs):
            if lower > nearest_distance:
                break
            a, b = self._outer_first(*pairs[pair].tolist())
            distance = mujoco.mj_geomDistance(self.model, data, a, b, nearest_distance, segment)
            if distance < nearest_distance:
                nearest_distance = distance
                nearest = a, b
                ends[:] = segment
        if nearest is None:
            return Clearance(np.inf, None, np.full((2, 3), np.nan), np.full(3, np.nan))
        points = ends.reshape(2, 3)
        normal = (points[0] - points[1]) * (1.0 if nearest_distance > 0.0 else -1.0)
        length = float(np.linalg.norm(normal))
        a, b = nearest
        return Clearance(
            float(nearest_distance),
            (part_name(self.model, a), part_name(self.model, b)),
            points,
            normal / length if length > 0.0 else np.full(3, np.nan),
        )

    def contacts(self, q: ArrayLike, pairs: Ints | None = None) -> tuple[Clearance, ...]:
        """Return the contacts of all parts that touch at ``q``, deepest first, by MuJoCo.

        Two parts have one contact: that of the two geoms with the largest depth.

        Args:
            q: Joint angles (nq,).
            pairs: (p, 2) ids of geoms. None for all pairs of the scene.

        Raises:
            ModelError: ``q`` has another length, or is not finite.
        """
        pairs = self.pairs if pairs is None else pairs
        distances = self.pair_distances(q, pairs, 0.0)
        contacts: dict[frozenset[str], Clearance] = {}
        for k in np.argsort(distances, kind="stable").tolist():
            if distances[k] >= 0.0:
                break
            parts = frozenset(part_name(self.model, geom) for geom in pairs[k].tolist())
            if parts not in contacts:
                contacts[parts] = self.clearance(q, pairs[k : k + 1])
        return tuple(contacts.values())

    def pair_distances(self, q: ArrayLike, pairs: Ints, reach: float) -> Array:
        """Return the distances (p,) of pairs at ``q``, by MuJoCo.

        Args:
            q: Joint angles (nq,).
            pairs: (p, 2) ids of geoms.
            reach: Larger distances are returned as ``reach``, m.
        """
        data = self.data_at(q)
        distances = np.full(len(pairs), reach)
        segment = np.zeros(6)
        for lower, pair in _by_lower_bound(self.model, data, pairs):
            if lower > reach:
                break
            a, b = pairs[pair].tolist()
            farthest = max(reach, SMALLEST_REACH)
            distance = mujoco.mj_geomDistance(self.model, data, a, b, farthest, segment)
            distances[pair] = min(distance, reach)
        return distances

    def _outer_first(self, a: int, b: int) -> tuple[int, int]:
        """Return two geoms with the one that is farther along the robot first."""
        nodes = [self._bodies[self.model.geom_bodyid[geom]][0] for geom in (a, b)]
        return (a, b) if nodes[0] >= nodes[1] else (b, a)

    @cached_property
    def touching(self) -> tuple[Touching, ...]:
        """Parts that touch in all of many random postures, deepest first.

        A model often has such parts: a motor inside its bracket. They make every posture count as a
        collision. Paste the lines ``exclude`` into the ``<contact>`` element of the model, or give
        the pairs as ``ignore`` to ``CollisionAvoidance``.
        """
        return always_near(self, self.pairs, 0.0)

    # Compiled checks

    @cached_property
    def _tables(self) -> ShapeTables:
        return ShapeTables(self.model, self._bodies, np.unique(self.pairs))

    def pair_tables(self, pairs: Ints) -> PairTables:
        """Return the compiled tables of pairs (p, 2) of geoms."""
        return PairTables.of(self._tables, pairs, self.robot.tree)

    def memory(self, pairs: PairTables) -> Block:
        """Return memory for one check at a time (``collision.RUN``)."""
        return check_memory(self.robot.tree, self._tables, pairs)

    @cached_property
    def _all_pairs(self) -> PairTables:
        return self.pair_tables(self.pairs)

    def free(self, q: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether each posture (n, nq) keeps all pairs farther apart than ``margin``.

        Args:
            q: Postures (n, nq), or one (nq,).
            margin: m, 0 or more.

        Returns:
            (n,) bool; for one posture an array without dimension.

        Raises:
            ModelError: Another shape, or a number that is not finite.
            OptionError: The margin is negative or not finite.
        """
        return free_postures(self, self._all_pairs, q, margin)

    def distances(self, q: ArrayLike, reach: float = 0.1) -> Array:
        """Return the distance (n,) of the nearest pair of each posture (n, nq), up to ``reach``.

        The compiled distance is a lower bound, exact to a nanometre except within 0.1 mm of
        contact. For postures that touch it is 0 or less, but not the depth. ``clearance`` measures
        the depth.
        """
        rows = posture_rows(self.robot, q)
        announce()
        distances = np.zeros(len(rows))
        nearest = np.zeros(len(rows), dtype=np.int64)
        memory = self.memory(self._all_pairs)
        collision.smallest_distances(memory.address, rows, float(reach), distances, nearest)
        return distances if np.ndim(q) == 2 else distances[0]


def always_near(scene: Scene, pairs: Ints, margin: float) -> tuple[Touching, ...]:
    """Return the parts that are nearer than a margin in all of many random postures.

    Args:
        scene: The scene.
        pairs: (p, 2) ids of geoms.
        margin: m.

    Returns:
        The deepest first.
    """
    robot = scene.robot
    model = scene.model
    rng = np.random.default_rng(0)
    postures = [robot.home]
    postures += [robot.sample(rng) for _ in range(TOUCHING_SAMPLES)]
    names = [tuple(part_name(model, g) for g in pair) for pair in pairs.tolist()]
    candidates = list(range(len(pairs)))
    depths: dict[tuple[str, ...], float] = {}
    bodies: dict[tuple[str, ...], list[int]] = {}
    segment = np.zeros(6)
    reach = margin + SMALLEST_REACH
    for k, q in enumerate(postures):
        data = scene.data_at(q)
        deepest: dict[tuple[str, ...], float] = {}
        for i in candidates:
            a, b = pairs[i].tolist()
            distance = mujoco.mj_geomDistance(model, data, a, b, reach, segment)
            if distance < margin and (k == 0 or names[i] in depths):
                deepest[names[i]] = max(deepest.get(names[i], -margin), -distance)
                bodies[names[i]] = model.geom_bodyid[[a, b]].tolist()
        depths = {pair: min(d, depths.get(pair, d)) for pair, d in deepest.items()}
        # In the next posture other geoms of the same two parts may touch.
        candidates = [i for i in candidates if names[i] in depths]
    contacts = [
        Touching((pair[0], pair[1]), depth, _exclude_line(model, bodies[pair]))
        for pair, depth in depths.items()
    ]
    return tuple(sorted(contacts, key=lambda item: -item.depth))


def free_postures(
    scene: Scene, pairs: PairTables, q: ArrayLike, margin: float
) -> NDArray[np.bool_]:
    """Return whether each posture (n, nq) is free, see ``Scene.free``."""
    if not is_real(margin, 0.0, FARTHEST):
        raise OptionError("margin", f"{margin!r}", "0 or more, m")
    rows = posture_rows(scene.robot, q)
    verdicts = np.zeros(len(rows), dtype=np.int64)
    announce()

    def check(part: slice) -> None:
        memory = scene.memory(pairs)
        collision.verdicts(memory.address, rows[part], float(margin), verdicts[part])

    threads = min(len(os.sched_getaffinity(0)), len(rows) // _MIN_ROWS_PER_THREAD)
    if threads <= 1:
        check(slice(None))
    else:
        edges = np.linspace(0, len(rows), threads + 1).astype(int)
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(check, map(slice, edges[:-1].tolist(), edges[1:].tolist())))
    free = verdicts == collision.FREE
    for row in np.flatnonzero(verdicts == collision.UNDECIDED):
        free[row] = scene.clearance(rows[row], pairs.geoms).distance >= margin
    return free if np.ndim(q) == 2 else free[0]


def posture_rows(robot: Robot, q: ArrayLike) -> Array:
    """Return postures as a contiguous array (n, nq); raise ``ModelError`` for another shape."""
    rows = numbers(q, "postures", f"(n, {robot.nq}) numbers", ModelError)
    if rows.ndim == 1:
        rows = rows[None]
    if rows.ndim != 2 or rows.shape[1] != robot.nq or not np.isfinite(rows).all():
        raise ModelError(
            f"postures have shape {np.shape(q)}",
            hint=f"give finite numbers (n, {robot.nq}): {', '.join(robot.joints)}",
        )
    return np.ascontiguousarray(rows)


def load_scene(
    path: str | os.PathLike[str],
    *,
    joints: Sequence[str] | str | None = None,
    tool: str | None = None,
) -> Scene:
    """Load a model file that has a robot among obstacles.

    Geoms that are fixed to the world are obstacles, and so are the bodies of joints that are not
    active: they stay at home.

    Args:
        path: An MJCF file, or another source that ``load_robot`` takes.
        joints: Names of the joints that may move, as for ``load_robot``.
        tool: Name of the default frame.
    """
    return Scene(load_robot(path, joints=joints, tool=tool))


def _rebuilt(
    robot: Robot, obstacles: dict[str, Obstacle], parts: dict[str, tuple[Obstacle, str]]
) -> Scene:
    """Return a scene with attached parts."""
    scene = Scene.__new__(Scene)
    scene._build(robot, obstacles, parts)
    return scene


def _checked_obstacles(obstacles: Sequence[Obstacle]) -> dict[str, Obstacle]:
    """Return the obstacles by name, or raise ``InvalidObstacleError``."""
    named: dict[str, Obstacle] = {}
    given: Any = obstacles
    if isinstance(given, Obstacle) or not np.iterable(given):
        raise InvalidObstacleError(f"{given!r} is not a list of obstacles", hint="[Box(…), …]")
    for obstacle in given:
        if not isinstance(obstacle, Obstacle):
            raise InvalidObstacleError(f"{obstacle!r} is not an obstacle", hint='Box("crate", …)')
        if obstacle.name in named:
            raise InvalidObstacleError(f"two obstacles have the name {obstacle.name!r}")
        named[obstacle.name] = obstacle
    return named


def _compiled(
    robot: Robot, obstacles: dict[str, Obstacle], parts: dict[str, tuple[Obstacle, str]]
) -> mujoco.MjModel:
    """Compile the robot's model with the obstacles as bodies that can be moved."""
    if robot.source is None:
        raise ModelError(
            f"robot {robot.name!r} was loaded from an MjModel, which cannot take obstacles",
            hint="load it from a file, a text or an MjSpec",
        )
    file = robot.source if isinstance(robot.source, Path) else robot.path
    spec, _ = mjcf.read_spec(robot.source, file)
    taken = {robot.model.geom(g).name for g in range(robot.model.ngeom)}
    taken |= {robot.model.body(b).name for b in range(robot.model.nbody)}
    for name in [*obstacles, *parts]:
        if name in taken:
            raise InvalidObstacleError(
                f"the model of {robot.name!r} has a body or geom {name!r} already",
                hint="give the obstacle another name",
            )
    # A keyframe does not fit a model with more bodies that move.
    for key in list(spec.keys):
        spec.delete(key)
    if parts:
        mjcf.compiled(spec)  # now each body of the spec has its id
    carriers = {body.id: body for body in spec.bodies} if parts else {}
    for part, frame in parts.values():
        named_frame = robot.frame(frame)
        place = named_frame.local.compose(part.pose)
        _add_part(spec, carriers[named_frame.body], part, place)
    for name, obstacle in obstacles.items():
        body = spec.worldbody.add_body(
            name=name, mocap=True, pos=obstacle.pose.position, quat=obstacle.pose.wxyz
        )
        obstacle.add_to(spec, body)
    try:
        model = mjcf.compiled(spec)
    except ValueError as error:
        raise CollisionError(f"MuJoCo cannot build the scene: {error}") from error
    if model.nbody != robot.model.nbody + len(obstacles) or model.nq != robot.model.nq:
        raise ModelError(
            f"{file} has changed since robot {robot.name!r} was loaded", hint="load it again"
        )
    return model


def _add_part(spec: mujoco.MjSpec, body: Any, part: Obstacle, place: Pose) -> None:
    """Add a part to a body of the robot; ``place`` is its pose in the body."""
    geom = part.add_to(spec, body)
    geom.pos = place.position
    geom.quat = place.wxyz


def _exclude_line(model: mujoco.MjModel, bodies: list[int]) -> str:
    """Return the line of ``<contact>`` that excludes two bodies."""
    first, second = (model.body(b).name for b in bodies)
    if first and second:
        return f'<exclude body1="{first}" body2="{second}"/>'
    return "give both bodies a name, then exclude them"


def _by_lower_bound(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: Ints
) -> list[tuple[float, int]]:
    """Return (lower bound of the distance, index) of each pair (p, 2), nearest first."""
    a, b = pairs.T
    centers = data.geom_xpos
    radius = np.where(model.geom_rbound > 0.0, model.geom_rbound, np.inf)
    lower = np.linalg.norm(centers[a] - centers[b], axis=1) - radius[a] - radius[b]
    order = np.argsort(lower, kind="stable")
    return list(zip(lower[order].tolist(), order.tolist(), strict=True))
