"""Effects of every action and key of the page, and the messages that the page gets of a view."""

from __future__ import annotations

import base64
import csv
import dataclasses
import io
import queue
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.geometry import Pose
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.reachability.reachability_map import map_reachability
from robot_ik.robot import load_robot
from robot_ik.testbed.arrangement import FIELD_OF_VIEW
from robot_ik.testbed.commands import (
    AddMesh,
    Command,
    CommandLog,
    MoveGoal,
    RecordPose,
    SetJoint,
    SetMotion,
    SetRobot,
    Start,
)
from robot_ik.testbed.convex_hull import ConvexHull
from robot_ik.testbed.frontends.actions import ACTIONS
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.contact_scene import thickened
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.reach_scene import shell_faces, shell_glb
from robot_ik.testbed.frontends.view_rows import joint_addresses, program_row, view_row
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.reach_maps import ReachMaps, ReachState
from robot_ik.testbed.session import Session
from tests.doc_pages import script
from tests.testbed.channel_client import ChannelClient
from tests.waiting import LONG, wait_for

PageClient = script("measure_page").PageClient

ONE_JOINT = """<robot name="mine"><link name="base"/><link name="arm">
<visual><geometry><mesh filename="package://mine/upper&lt;1&gt;.stl"/></geometry></visual>
<visual><geometry><mesh filename="fore.dae"/></geometry></visual>
<collision><geometry><mesh filename="fore.dae"/></geometry></collision>
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link>
<joint name="a" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture
def session() -> Iterator[Session]:
    with Session(Start(methods=("lm",)), beside=False) as made:
        yield made


def pair(page: Page, client: ChannelClient) -> None:
    """Give the channel of a client the key of its connection to viser."""
    key = wait_for(lambda: set(page.gate.pages)).pop()
    wait_for(lambda: page.page_server.client_of(key))
    client.send({"page": key})


@pytest.fixture(scope="module")
def opened() -> Iterator[tuple[Page, ChannelClient, queue.SimpleQueue[Command]]]:
    """A page with two key poses, its driving client, and its commands, which are not executed."""
    sent: queue.SimpleQueue[Command] = queue.SimpleQueue()
    with Session(Start("tabletop_puma"), beside=False) as session:
        for command in (RecordPose(), SetJoint("joint1", 0.3), RecordPose()):
            session.send(command)
        for _ in range(3):
            session.tick()
        session.send = sent.put  # type: ignore[method-assign]
        server = PageServer(port=8730, shadows=False)
        page = Page(session, server, camera=lambda: lambda: None, film=lambda log: b"a film")
        with page, PageClient(page.url), ChannelClient(page.url) as client:
            pair(page, client)
            page.draw(session.view())
            client.until(lambda one: {"settings", "view", "role"} <= set(one.latest))
            yield page, client, sent


SWITCHES = {
    "set_theme": "dark",
    "show_overlay": "overlay",
    "show_handles": "handles",
    "show_turn_handles": "turn_handles",
    "show_tool_frames": "tool_frames",
    "show_wire": "wire",
    "show_camera": "camera",
}
FILES = {
    "save_log": ({}, "testbed.jsonl"),
    "save_poses": ({}, "poses.toml"),
    "save_motion": ({"format": "csv"}, "motion.csv"),
    "share_motion": ({}, "motion.html"),
    "film_session": ({}, "testbed.mp4"),
}
OTHERS = {
    "press_key",
    "hand_over",
    "fit_camera",
    "report_graphics",
    "save_recording",
    "load_mesh",
}
AR = {
    "begin_preset",
    "drag_ar_ball",
    "place_ar",
    "set_ar_ball",
    "set_ar_camera",
    "set_ar_delay",
    "show_ar",
}
"""These actions and those of ``OTHERS`` have separate tests."""

SURFACES = {
    "show_reach": ("reach", {"/regions/reach/shell"}),
    "show_regions": (
        "regions",
        {"/regions/figure/reach", "/regions/figure/bend", "/regions/figure/jump"},
    ),
    "show_cube": ("cube", {"/cube/edges", "/cube/axes", "/cube/marks"}),
}
"""Settings and nodes of what is drawn with the next view."""

BENCH = {"pick_part", "pin_frame", "run_cases"}
"""These are tried by test_theses.py."""


def test_every_action_is_tried_by_a_test() -> None:
    assert {*SWITCHES, *FILES, *OTHERS, *SURFACES, *BENCH, *AR} == set(ACTIONS)


@pytest.mark.parametrize(("action", "setting"), SWITCHES.items())
def test_a_switch_changes_the_page_and_is_shown_on_it(
    opened: tuple[Page, ChannelClient, Any], action: str, setting: str
) -> None:
    page, client, _ = opened
    field = "dark" if action == "set_theme" else "on"
    before = client.latest["settings"][setting]
    for wanted in (not before, before):
        sent = page.server._websock_server._broadcast_buffer.message_counter
        client.action(action, **{field: wanted})
        client.until(lambda one, wanted=wanted: one.latest["settings"][setting] is wanted)
        after = page.server._websock_server._broadcast_buffer.message_counter
        assert action == "show_camera" or after > sent, "the 3D view did not change"


def show_surfaces(client: ChannelClient, action: str, setting: str, on: bool) -> None:
    if action == "show_reach":
        picture = "space" if on else "none"
        client.action(action, picture=picture)
        client.until(lambda one: one.latest["settings"].get(setting) == picture)
    else:
        client.action(action, on=on)
        client.until(lambda one: one.latest["settings"].get(setting) is on)


def wait_for_nodes(nodes: Mapping[str, Any], names: set[str], on: bool) -> None:
    wait_for(lambda: all((name in nodes) is on for name in names))


def test_surfaces_and_the_cube_come_and_go() -> None:
    with (
        Session(Start("humanoid"), beside=False) as session,
        Page(session, PageServer(port=8732, shadows=False)) as page,
        PageClient(page.url),
        ChannelClient(page.url) as client,
    ):
        pair(page, client)
        session.tick()
        nodes = page.server.scene._handle_from_node_name
        for action, (setting, names) in SURFACES.items():
            for on in (True, False):
                show_surfaces(client, action, setting, on)
                page.draw(session.view())
                wait_for_nodes(nodes, names, on)


@pytest.mark.parametrize(("action", "row"), FILES.items())
def test_a_file_comes_to_the_browser(
    opened: tuple[Page, ChannelClient, Any], action: str, row: tuple[dict[str, str], str]
) -> None:
    page, client, _ = opened
    values, name = row
    client.action(action, **values)
    client.until(lambda one: name in one.files, f"no {name}")
    content = base64.b64decode(client.files[name])
    robot = page.session.robot
    if name == "testbed.mp4":
        assert content == b"a film"
        return
    text = content.decode()
    if name == "testbed.jsonl":
        assert len(CommandLog.parse(text.splitlines(), name).commands) == 3
    elif name == "poses.toml":
        assert list(KeyPoses.parse(text, robot, name).poses) == ["pose 1", "pose 2"]
    elif name == "motion.csv":
        rows = list(csv.reader(io.StringIO(text)))
        assert len(rows) == 1 + 61 and rows[0][1] == "commanded.joint1"
        assert float(rows[-1][1]) == pytest.approx(0.3)
    else:
        assert text.count("2 key poses, 1.0 s") == 1 and text.rstrip().endswith("</html>")
        assert "http://127.0.0.1" not in text


def test_a_motion_with_a_tree_of_hinges_is_saved_as_bvh(
    opened: tuple[Page, ChannelClient, Any],
) -> None:
    _, client, _ = opened
    client.action("save_motion", format="bvh")
    client.until(lambda one: "motion.bvh" in one.files or "slide" in "".join(one.notices))
    if "motion.bvh" in client.files:
        assert base64.b64decode(client.files["motion.bvh"]).startswith(b"HIERARCHY")


def test_without_a_recording_the_page_says_how_to_make_one(
    opened: tuple[Page, ChannelClient, Any],
) -> None:
    _, client, _ = opened
    client.action("save_recording")
    client.until(lambda one: any("press Teach" in notice for notice in one.notices))


def test_the_reach_is_shown_as_a_map(
    opened: tuple[Page, ChannelClient, Any],
) -> None:
    page, client, _ = opened
    sizes = {}
    for picture in ("cloud", "shell", "none"):
        client.action("show_reach", picture=picture)
        client.until(lambda one, picture=picture: one.latest["settings"]["reach"] == picture)
        if picture in ("cloud", "shell"):
            client.until(lambda one: one.latest["reach"]["largest_index"] > 0.0, "no map")
            assert "without obstacles" in client.latest["reach"]["text"]
        counter = page.server._websock_server._broadcast_buffer.message_counter
        page.draw(page.session.view())
        sizes[picture] = page.server._websock_server._broadcast_buffer.message_counter - counter
    assert min(sizes.values()) > 0, "a picture did not change the 3D view"
    client.until(lambda one: one.latest["reach"]["text"] == "")


def test_an_arm_without_a_bounded_reach_has_no_map() -> None:
    states: list[ReachState] = []
    humanoid = load_robot("humanoid")
    ReachMaps(states.append).ask(humanoid, ())
    wait_for(lambda: states and states[-1].text.startswith("no map:"))
    assert states[-1].reach_map is None


def test_only_the_last_map_that_was_asked_for_is_shown() -> None:
    states: list[ReachState] = []
    maps = ReachMaps(states.append)
    maps.ask(load_robot("puma560"), ())
    maps.ask(load_robot("tabletop_puma"), ())
    wait_for(lambda: [state for state in states if state.reach_map is not None])
    last = states[-1].reach_map
    assert last is not None and last.robot.name == "tabletop_puma"
    assert sum(state.reach_map is not None for state in states) == 1


def test_the_shell_is_the_closed_surface_of_the_reached_cells_behind_the_middle() -> None:
    reach_map = map_reachability(load_robot("puma560"), cell=0.3, directions=6, rolls=1)
    away = np.array((0.0, 1.0, 0.0))
    positions, normals, values = shell_faces(reach_map, away)
    cell = reach_map.grid.cell
    assert np.array_equal(normals.sum(axis=0), (0, 0, 0)), "the surface has a hole"
    for position, normal, value in zip(positions, normals, values, strict=True):
        inside = position - 0.5 * cell * normal
        outside = position + 0.5 * cell * normal
        assert value == pytest.approx(reach_map.index_at(inside)) and value > 0.0
        middle = reach_map.grid.corner[1] + 0.5 * cell * reach_map.grid.shape[1]
        assert inside[1] >= middle - 1e-9
        assert reach_map.index_at(outside) == 0.0 or outside[1] < middle
    centres = [round(value, 6) for value in np.unique(positions.round(6), axis=0).ravel()]
    assert len(centres) == 3 * len(positions), "a face is there twice"
    assert shell_glb(reach_map, away, np.zeros(3)).startswith(b"glTF")


TETRAHEDRON = "".join(
    f"v {x} {y} {z}\n"
    for x, y, z in ((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.2), (0.01, 0.01, 0.01))
)
"""A mesh file of five points, one of them inside the others."""


def test_a_mesh_file_becomes_the_command_of_its_hull(
    opened: tuple[Page, ChannelClient, queue.SimpleQueue[Command]],
) -> None:
    _, client, sent = opened
    file = (TETRAHEDRON + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\nf 5 2 3\n").encode()
    client.action("load_mesh", file="cup.obj", base64=base64.b64encode(file).decode())
    command = sent.get(timeout=LONG)
    assert isinstance(command, AddMesh) and command.name == "cup"
    corners = {(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.2)}
    assert {tuple(np.round(point, 6) + 0.0) for point in command.vertices} == corners
    for name, content, problem in (
        ("cup.dae", "", "not a mesh file"),
        ("cup.stl", "AAAA", "cannot be an obstacle"),
        ("cup.stl", "?", "was not uploaded completely"),
    ):
        client.action("load_mesh", file=name, base64=content)
        client.until(lambda one, problem=problem: any(problem in text for text in one.notices))
    assert sent.empty()


def test_a_part_that_touches_gets_a_cover_around_it() -> None:
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1]), np.float32).reshape(3, -1).T
    hull = ConvexHull.of_points(corners)
    # As a drawn mesh has it: each face has corners of its own.
    vertices = hull.vertices[hull.faces].reshape(-1, 3).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    cover = thickened(vertices, faces, 0.01)
    outside = np.maximum(-cover, cover - 1.0).max(axis=1)
    assert (outside > 0.001).all() and (outside < 0.0101).all()
    places = {tuple(row) for row in cover.round(5).tolist()}
    assert len(places) == 8, "the corners of neighbouring faces are at different places"


def test_every_key_with_a_command_makes_one(
    opened: tuple[Page, ChannelClient, queue.SimpleQueue[Command]],
) -> None:
    page, client, sent = opened
    keys = [key for key in KEYMAP if key.code and key.command is not None]
    for key in keys:
        client.action("press_key", code=key.code)
        wanted = key.command(page._view)  # type: ignore[misc]
        assert sent.get(timeout=LONG) == wanted
    assert len(keys) > 10


def test_a_model_is_loaded_by_its_path(session: Session) -> None:
    session.send(SetRobot("arms/mine.xml"))
    session.tick()
    assert session.view().message == "there is no file arms/mine.xml"


def test_a_page_that_is_loaded_again_shows_a_ball_that_was_moved_away(
    opened: tuple[Page, ChannelClient, Any],
) -> None:
    page, client, _ = opened
    viser_client = next(iter(page.server.get_clients().values()))
    before = page._view
    ball = np.array((3.0, 2.0, 1.0))
    page._view = dataclasses.replace(before, ball=Pose(ball))
    old = np.array(viser_client.camera.position)
    try:
        client.action("fit_camera")
        wait_for(lambda: not np.allclose(viser_client.camera.position, old))
    finally:
        page._view = before
    forward = viser_client.camera.look_at - viser_client.camera.position
    to_ball = ball - viser_client.camera.position
    cosine = forward @ to_ball / np.linalg.norm(forward) / np.linalg.norm(to_ball)
    limit = 0.5 * FIELD_OF_VIEW * max(1.0, viser_client.camera.aspect)
    assert np.arccos(cosine) < limit


def row_of(session: Session) -> dict[str, Any]:
    """What the page gets of the session's view."""
    robot = session.robot
    return view_row(session.view(), robot, joint_addresses(robot))


def test_the_page_gets_how_the_last_solve_ended_and_the_error(session: Session) -> None:
    for command in (SetMotion("hand"), MoveGoal((0.0, 0.0, 9.0))):
        session.send(command)
    for _ in range(60):
        session.tick()
    one = row_of(session)["instances"][0]
    assert one["words"] == one["status"] == "unreachable" and not one["met"]
    assert one["off"].endswith(" mm") and one["error_mm"] > 1000.0
    view = session.view().instances[0]
    aimed = dataclasses.replace(view, error=0.0, angle=0.5)
    assert aimed.off == "28.65°"


def test_options_of_a_method_come_with_their_ranges() -> None:
    methods = program_row(has_camera=False, has_film=False, has_arm=False)["methods"]
    rows = {row["name"]: row for row in methods["dls"]}
    damping = rows["damping"]
    assert (damping["lower"], damping["upper"]) == (1e-6, 10.0) and damping["help"]
    assert damping["usual"] == [0.0, 0.2], "the part of the range that is usual"
    for options in methods.values():
        for row in options:
            assert row["switch"] or row["choices"] or row["lower"] < row["upper"]


def test_joint_values_are_those_of_the_joints_that_can_be_turned() -> None:
    with Session(Start("humanoid"), beside=False) as session:
        robot = session.robot
        client_joints = program_row(has_camera=False, has_film=False, has_arm=False)["robots"]
        assert any(row["name"] == "humanoid" and row["about"] for row in client_joints)
        values = row_of(session)["instances"][0]["joints"]
        qpos = robot.qpos(robot.home)
        model = robot.model
        wanted = [
            float(qpos[model.joint(name).qposadr[0]])
            for name in robot.joints
            if model.joint(name).qposadr.size and len(model.joint(name).qpos0) == 1
        ]
        assert values == pytest.approx(wanted, abs=1e-5) and len(values) == 36


def test_meshes_that_are_not_drawn_are_named_on_the_page(tmp_path: Path) -> None:
    model = tmp_path / "mine.urdf"
    model.write_text(ONE_JOINT)
    with (
        Session(Start(), beside=False) as session,
        Page(session, PageServer(port=8731, shadows=False)) as page,
        ChannelClient(page.url) as client,
    ):
        client.until(lambda one: one.latest.get("robot", {}).get("missing_meshes") == [])
        session.send(SetRobot(str(model)))
        session.tick()
        page.draw(session.view())
        client.until(lambda one: one.latest["robot"]["name"] == "mine")
        names = client.latest["robot"]["missing_meshes"]
        assert names == ["package://mine/upper<1>.stl", "fore.dae"]
