"""The 3D view: robots as batched meshes, ball, trails, ghosts.

A body of all instances is one node. Everything that moves together is drawn as batched nodes: poses
of single nodes arrive separately and would run ahead of them in a slow browser.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import NDArray
from viser import _messages as vm

from robot_ik.camera.drawing.meshes import ModelMesh, cached_mesh, geom_rgba, sphere, visible_geoms
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import (
    BALL_RADIUS,
    GOAL_COLOUR,
    INSTANCE_COLOURS,
    Colour,
    arranged,
    linear,
)
from robot_ik.testbed.frontends.wire import Wire
from robot_ik.testbed.view import View

Floats = NDArray[np.float32]

SEGMENTS = 58
"""Pieces of a trail."""

GHOSTS = 8
"""Most branches that are drawn."""

_BRANCH_COLOUR: Colour = (110, 130, 155)
_ARM_COLOUR: Colour = (250, 204, 21)

_GHOST_OPACITY = 0.28

_PLATE_RADIUS = 0.21
"""Of the model's extent."""

_PLATE_HEIGHT = 0.004
"""Metres."""

_PLATE_CENTRE = 0.003
"""Metres above the ground, so that the plate and the ground do not flicker."""

_PLATE_OPACITY = 0.4
_BALL_FACES = 36
"""Faces around the ball."""

_SAME_ANGLE = math.radians(1.0)
"""Of a joint, between arm and robot. A smaller difference is not drawn as a ghost."""

_SAME_LENGTH = 1e-3
"""Metres, likewise of a slide."""

_TRAIL_WIDTH = 3.0
"""Pixels."""

_PULL_COLOUR: Colour = (250, 204, 21)
"""Yellow, as the pull of TrueSpace."""

_PULL_WIDTH = 4.0
"""Pixels."""

_NOWHERE = -1e3
"""Metres. Position of hidden parts."""


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """The mesh of a body, in its frame.

    Attributes:
        vertices: (v, 3) m.
        faces: (f, 3) indices of vertices, counter-clockwise from outside.
        glb: The same with normals and colours, or textures, as a glTF file.
    """

    vertices: Floats
    faces: NDArray[np.uint32]
    glb: bytes


def body_meshes(model: mujoco.MjModel) -> Iterator[tuple[int, BodyMesh]]:
    """Yield body and mesh of what MuJoCo shows by default: a mesh a body, and one a texture."""
    whole = cached_mesh(model)
    visible = visible_geoms(model)
    for body in range(model.nbody):
        geoms = [g for g in visible if model.geom_bodyid[g] == body]
        plain = [g for g in geoms if not _is_patterned(model, g)]
        if others := [g for g in geoms if g not in plain]:
            yield from ((body, mesh) for mesh in _patterned_meshes(model, others))
        if plain:
            yield body, _smooth_mesh(model, whole, plain)


def _is_patterned(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom is a height field, or a mesh that may have a texture."""
    kind = model.geom_type[geom]
    mesh = model.geom_dataid[geom]
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        return True
    is_mesh = kind == mujoco.mjtGeom.mjGEOM_MESH
    textured = model.ntex > 0 and model.geom_matid[geom] >= 0
    return bool(textured and is_mesh and model.mesh_texcoordnum[mesh] > 0)


def _patterned_meshes(model: mujoco.MjModel, geoms: list[int]) -> Iterator[BodyMesh]:
    """Yield geoms by mjviser, one mesh a texture."""
    from mjviser import conversions  # imports trimesh and SciPy: a third of a page's start

    for part in conversions.group_geoms_by_visual_compat(model, geoms):
        mesh = conversions.merge_geoms(model, part)
        file = io.BytesIO()
        mesh.export(file, file_type="glb")
        vertices = mesh.vertices.astype(np.float32)
        yield BodyMesh(vertices, mesh.faces.astype(np.uint32), file.getvalue())


def _smooth_mesh(model: mujoco.MjModel, whole: ModelMesh, geoms: list[int]) -> BodyMesh:
    """Return geoms in the frame of their body, with smooth surfaces and sharp edges.

    mjviser's capsules have 4000 faces, and a browser tests each of them for the mouse.
    """
    chosen = np.isin(whole.face_geom_id, geoms)
    quads = whole.faces[chosen]
    owner = whole.face_geom_id[chosen]
    matrices = np.zeros((model.ngeom, 9))
    for g in geoms:
        mujoco.mju_quat2Mat(matrices[g], model.geom_quat[g])
    rotation = matrices.reshape(-1, 3, 3)[owner]
    corners = np.einsum("fij,fkj->fki", rotation, whole.vertices[quads])
    corners += model.geom_pos[owner][:, None]
    normals = np.einsum("fij,fkj->fki", rotation, whole.corner_normals[chosen])
    colours = np.repeat((255.0 * np.clip(geom_rgba(model)[owner], 0.0, 1.0))[:, None], 4, axis=1)
    rows = np.concatenate([corners, normals, colours], axis=2).reshape(-1, 10)
    _, first, number = np.unique(rows.round(6), axis=0, return_index=True, return_inverse=True)
    faces = _triangles(number.reshape(-1, 4))
    unique = rows[first]
    vertices = unique[:, :3].astype(np.float32)
    normals = unique[:, 3:6].astype(np.float32)
    glb = coloured_glb(vertices, normals, unique[:, 6:].astype(np.uint8), faces)
    return BodyMesh(vertices, faces, glb)


def _triangles(quads: NDArray[np.integer[Any]]) -> NDArray[np.uint32]:
    """Return triangles (f, 3) of quads (n, 4). A triangle repeats its last corner."""
    others = quads[quads[:, 2] != quads[:, 3]][:, [0, 2, 3]]
    return np.vstack([quads[:, :3], others]).astype(np.uint32)


# Component types of glTF.
_FLOAT = 5126
_BYTE = 5121
_INDEX = 5125


def coloured_glb(
    vertices: Floats, normals: Floats, colours: NDArray[np.uint8], faces: NDArray[np.uint32]
) -> bytes:
    """Return a mesh with colours as a binary glTF 2.0 file (its specification, 3.6 and 4).

    Args:
        vertices: (v, 3).
        normals: (v, 3).
        colours: (v, 4) RGBA.
        faces: (f, 3).
    """
    bounds = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    columns: tuple[tuple[NDArray[Any], dict[str, Any]], ...] = (
        (vertices, {"type": "VEC3", "componentType": _FLOAT, **bounds}),
        (normals, {"type": "VEC3", "componentType": _FLOAT}),
        (colours, {"type": "VEC4", "componentType": _BYTE, "normalized": True}),
        (faces.reshape(-1), {"type": "SCALAR", "componentType": _INDEX}),
    )
    ends = np.cumsum([array.nbytes for array, _ in columns]).tolist()
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    head = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3}]}],
        "accessors": [
            {"bufferView": k, "count": len(array), **about}
            for k, (array, about) in enumerate(columns)
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": end - array.nbytes, "byteLength": array.nbytes}
            for end, (array, _) in zip(ends, columns, strict=True)
        ],
        "buffers": [{"byteLength": ends[-1]}],
    }
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for array, _ in columns)

    def number(value: int) -> bytes:
        return value.to_bytes(4, "little")

    body = number(len(text)) + b"JSON" + text + number(len(data)) + b"BIN\0" + data
    return b"glTF" + number(2) + number(12 + len(body)) + body


class Ghosts:
    """Up to ``count`` translucent copies of a robot."""

    def __init__(
        self,
        server: viser.ViserServer,
        model: mujoco.MjModel,
        name: str,
        colour: Colour,
        count: int,
    ) -> None:
        self._count = count
        self._root = server.scene.add_frame(f"/robot/{name}", show_axes=False, visible=False)
        wxyzs, positions = _poses(count)
        self._bodies: list[tuple[int, Any]] = []
        for n, (body, mesh) in enumerate(body_meshes(model)):
            handle = server.scene.add_batched_meshes_simple(
                f"/robot/{name}/{n}",
                mesh.vertices,
                mesh.faces,
                wxyzs,
                positions,
                batched_colors=linear(colour),
                opacity=_GHOST_OPACITY,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._bodies.append((body, handle))

    def draw(self, poses: list[tuple[Array, Array]], offset: Array) -> None:
        """Show copies of the robot.

        Args:
            poses: Positions (nbody, 3) and quaternions (nbody, 4) of the bodies of each copy.
            offset: (3,) added to all positions, m.
        """
        self._root.visible = bool(poses)
        if not poses:
            return
        quaternions, positions = _poses(self._count)
        for body, handle in self._bodies:
            for k, (xpos, xquat) in enumerate(poses[: self._count]):
                positions[k] = xpos[body] + offset
                quaternions[k] = xquat[body]
            positions[len(poses) :] = _NOWHERE
            assign(handle, batched_positions=positions.copy(), batched_wxyzs=quaternions.copy())


def assign(handle: Any, **arrays: Floats) -> None:
    """Assign several arrays of a node in one message. viser would send one message each."""
    for name, array in arrays.items():
        setattr(handle._impl.props, name, array)
    message = vm.SceneNodeUpdateMessage(handle._impl.name, dict(arrays))
    handle._impl.api._queue_scene_message(message)


def _poses(count: int) -> tuple[Floats, Floats]:
    """Return quaternions (n, 4) and positions (n, 3) of hidden parts."""
    quaternions = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    return quaternions, np.full((count, 3), _NOWHERE, np.float32)


def slide_numbers(robot: Robot) -> NDArray[np.bool_]:
    """Return which numbers (nq,) of ``q`` are lengths of slides."""
    slides = robot.model.jnt_type[list(robot.tree.joint_ids)] == mujoco.mjtJoint.mjJNT_SLIDE
    is_length = np.zeros(robot.nq, bool)
    is_length[robot.tree.qadr[slides]] = True
    return is_length


class BrowserScene:
    """The drawing of one robot in n instances. Another robot or count needs another scene."""

    def __init__(self, server: viser.ViserServer, robot: Robot, count: int) -> None:
        self._server = server
        self.robot = robot
        self.count = count
        self.arrangement = arranged(robot, count)
        self.offsets = self.arrangement.offsets.astype(np.float32)
        self.bodies: list[tuple[int, Any]] = []
        self._ghosts: dict[str, Ghosts] = {}
        self._slides = slide_numbers(robot)
        self._axes: Any = None
        self._wire: Wire | None = None
        self._trails_shown = True
        self._drawn = np.full((count, robot.model.nbody, 7), np.nan, np.float32)
        with server.atomic():
            self.root = server.scene.add_frame("/robot", show_axes=False)
            self._add_bodies()
            self._add_ball()
            self._trails = self._add_trails()
            self._pull = self._add_pull()
            for k in range(count):
                self._add_place(k)

    def _add_bodies(self) -> None:
        for n, (body, mesh) in enumerate(body_meshes(self.robot.model)):
            handle = self._server.scene.add_batched_glb(
                f"/robot/{body}_{n}", mesh.glb, *_poses(self.count), lod="off", receive_shadow=True
            )
            self.bodies.append((body, handle))

    def _add_ball(self) -> None:
        ball = sphere(np.array([BALL_RADIUS * self.arrangement.extent]), _BALL_FACES)
        self.ball = self._server.scene.add_batched_meshes_simple(
            "/robot/ball",
            ball.vertices,
            _triangles(ball.faces),
            *_poses(self.count),
            batched_colors=linear(GOAL_COLOUR),
            lod="off",
            receive_shadow=False,
        )

    def _add_trails(self) -> Any:
        # One node of a fixed size: viser compares the number of colours and points.
        empty = np.full((self.count * SEGMENTS, 2, 3), _NOWHERE, np.float32)
        tones = [linear(colour) for colour in INSTANCE_COLOURS[: self.count]]
        colours = np.repeat(tones, SEGMENTS, axis=0)
        return self._server.scene.add_line_segments(
            "/robot/trails",
            empty,
            np.stack([colours, colours], axis=1),
            thickness=_TRAIL_WIDTH,
            thickness_units="screen",
        )

    def _add_pull(self) -> Any:
        """Add the line from a grabbed point to the mouse."""
        return self._server.scene.add_line_segments(
            "/robot/pull",
            np.zeros((self.count, 2, 3), np.float32),
            np.full((self.count, 2, 3), _PULL_COLOUR, np.uint8),
            thickness=_PULL_WIDTH,
            thickness_units="screen",
            visible=False,
        )

    def _add_place(self, k: int) -> None:
        """Add the plate under an instance, and an empty frame where the page puts its label."""
        scene = self._server.scene
        scene.add_cylinder(
            f"/robot/plate_{k}",
            radius=_PLATE_RADIUS * self.arrangement.extent,
            height=_PLATE_HEIGHT,
            color=INSTANCE_COLOURS[k],
            opacity=_PLATE_OPACITY,
            visible=self.count > 1,
            cast_shadow=False,
            position=self.arrangement.offsets[k] + np.array((0.0, 0.0, _PLATE_CENTRE)),
        )
        scene.add_frame(f"/robot/label_{k}", show_axes=False, position=self.arrangement.labels[k])

    def take(self, robot: Robot) -> None:
        """Go on with another tool or other joints of the same model."""
        self.robot = robot
        self._slides = slide_numbers(robot)

    def remove(self) -> None:
        """Remove all nodes."""
        self.root.remove()

    def name_of(self, handle: object) -> str | None:
        """Return the body that a handle draws, or None for a handle of an earlier scene."""
        body = next((body for body, one in self.bodies if one is handle), None)
        return None if body is None else str(self.robot.model.body(body).name)

    def on_click(self, part: Callable[[Any], Any]) -> None:
        """Call ``part`` with viser's click events on bodies of the robot."""
        for body, handle in self.bodies:
            if body > 0:
                handle.on_click(part)

    def on_drag(self, ball: Callable[[Any], Any], link: Callable[[Any], Any]) -> None:
        """Call ``ball`` and ``link`` with viser's drag events."""
        self.ball.on_drag("left")(ball)
        for body, handle in self.bodies:
            is_fixed = self.robot.model.body_weldid[body] == 0  # to the world
            if body > 0 and not is_fixed:
                handle.on_drag("left")(link)

    def show_trails(self, on: bool) -> None:
        """Show the trails of the tools, or none."""
        self._trails_shown = on
        self._trails.visible = on

    def show_axes(self, on: bool) -> None:
        """Show the tool's frame of each instance, or none."""
        if on and self._axes is None:
            self._axes = self._server.scene.add_batched_axes(
                "/robot/tools",
                *_poses(self.count),
                axes_length=0.1 * self.arrangement.extent,
                axes_radius=0.004 * self.arrangement.extent,
            )
        if self._axes is not None:
            self._axes.visible = on

    def show_wire(self, on: bool) -> None:
        """Draw the robots as wire, or solid."""
        if self._wire is not None:
            self._wire.remove()
            self._wire = None
        if on:
            self._wire = Wire(self._server, self.robot, self.count)
            self._drawn[:] = np.nan  # all lines are drawn with the next view
        for _, handle in self.bodies:
            handle.visible = not on

    def draw(self, view: View) -> None:
        """Draw one frame. It is sent as one piece, without the bodies that have not moved."""
        now = np.empty_like(self._drawn)
        now[:, :, :3] = [one.xpos for one in view.instances]
        now[:, :, :3] += self.offsets[:, None]
        now[:, :, 3:] = [one.xquat for one in view.instances]
        moved = (now != self._drawn).any(axis=(0, 2)).tolist()
        self._drawn = now
        xpos = now[:, :, :3]
        xquat = now[:, :, 3:]
        with self._server.atomic():
            for body, handle in self.bodies:
                if moved[body]:
                    positions = xpos[:, body].copy()
                    wxyzs = xquat[:, body].copy()
                    assign(handle, batched_positions=positions, batched_wxyzs=wxyzs)
            if self._wire is not None and any(moved):
                self._wire.draw(xpos, xquat)
            self.ball.batched_positions = (self.offsets + view.ball.position).astype(np.float32)
            if self._axes is not None and self._axes.visible:
                self._draw_axes(xpos, xquat)
            # A ball that jumps makes no path.
            self._trails.visible = self._trails_shown and view.motion != "random"
            if self._trails.visible and any(moved):
                self._draw_trails(view)
            self._draw_ghosts(view)
            self._draw_pull(view)

    def _draw_pull(self, view: View) -> None:
        """Draw the pull of the mouse. All instances are dragged by the same point."""
        self._pull.visible = view.pull is not None
        if view.pull is not None:
            self._pull.points = (view.pull + self.offsets[:, None]).astype(np.float32)

    def _draw_trails(self, view: View) -> None:
        """Draw every second position of the tools, newest first. Missing pieces have no length."""
        points = np.full((self.count, SEGMENTS, 2, 3), _NOWHERE, np.float32)
        for k, one in enumerate(view.instances):
            positions = one.trail[::-2][: SEGMENTS + 1] + self.offsets[k]
            if n := max(0, len(positions) - 1):
                points[k, :n, 0] = positions[:-1]
                points[k, :n, 1] = positions[1:]
                points[k, n:] = positions[-1]
        assign(self._trails, points=points.reshape(-1, 2, 3))

    def _draw_axes(self, xpos: Floats, xquat: Floats) -> None:
        frame = self.robot.frame(self.robot.tool)
        bodies = [Pose(xpos[k, frame.body], xquat[k, frame.body]) for k in range(self.count)]
        tools = [body @ frame.local for body in bodies]
        self._axes.batched_positions = np.array([tool.position for tool in tools], np.float32)
        self._axes.batched_wxyzs = np.array([tool.wxyz for tool in tools], np.float32)

    def _draw_ghosts(self, view: View) -> None:
        branches = [(branch.xpos, branch.xquat) for branch in view.branches][:GHOSTS]
        self._draw_copies("branches", self.robot.model, _BRANCH_COLOUR, GHOSTS, branches)
        if view.arm is not None:
            arm = view.arm
            poses = []
            if arm.xpos is not None and arm.xquat is not None and self._is_apart(view):
                poses = [(arm.xpos, arm.xquat)]
            self._draw_copies("arm", arm.robot.model, _ARM_COLOUR, 1, poses)

    def _draw_copies(
        self,
        name: str,
        model: mujoco.MjModel,
        colour: Colour,
        count: int,
        poses: list[tuple[Array, Array]],
    ) -> None:
        """Draw up to ``count`` ghosts of a model. Their meshes are made when needed."""
        if poses and name not in self._ghosts:
            self._ghosts[name] = Ghosts(self._server, model, name, colour, count)
        if name in self._ghosts:
            self._ghosts[name].draw(poses, self.arrangement.offsets[0])

    def _is_apart(self, view: View) -> bool:
        """Return whether the servo arm is visibly apart from the first instance.

        At the same place the two surfaces flicker through each other.
        """
        arm = view.arm
        if arm is None or arm.q is None or not arm.is_shown:
            return False
        same = np.where(self._slides, _SAME_LENGTH, _SAME_ANGLE)
        return bool((np.abs(arm.q - view.instances[0].q) > same).any())
