"""Computation of maps: equal bits for any number of workers, and after a killed program."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import OutputError, ReachabilityMapError

ARRAYS = ("status", "branches", "manipulability", "clearance")
SETTINGS = {"cell": 0.12, "directions": 3, "rolls": 2}


def condition(robot):
    shelf = rik.Box("shelf", size=(0.3, 0.1, 0.4), pose=rik.Pose((0.5, 0.2, 0.4)))
    return rik.CollisionAvoidance(rik.Scene(robot, [shelf]), margin=0.002)


def make(robot=None, **options):
    robot = rik.load_robot("puma560") if robot is None else robot
    return rik.map_reachability(robot, **({"collisions": condition(robot)} | SETTINGS | options))


@pytest.fixture(scope="module")
def expected():
    return make(threads=1)


def assert_same(first, second):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), strict=True)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_does_not_change_the_result(expected, threads):
    assert len(expected.grid.blocks) >= 8
    assert_same(make(threads=threads), expected)


def test_processes_give_equal_bits(expected):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert_same(make(executor=pool), expected)


def test_a_dask_cluster_gives_equal_bits(expected):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        assert_same(make(executor=client.get_executor()), expected)


def test_a_map_on_disk_equals_the_map_in_memory(expected, tmp_path):
    pytest.importorskip("zarr")
    reach_map = make(out=tmp_path / "map.zarr")
    assert_same(reach_map, expected)
    loaded = rik.ReachabilityMap.load(
        tmp_path / "map.zarr", reach_map.robot, collisions=reach_map.collisions
    )
    assert_same(loaded, expected)
    assert loaded.is_complete
    assert loaded.grid == expected.grid
    # A map of a catalogue robot can be loaded without the robot.
    assert_same(rik.ReachabilityMap.load(tmp_path / "map.zarr"), expected)


def test_ctrl_c_keeps_finished_blocks_and_a_later_call_computes_the_rest(expected, tmp_path):
    pytest.importorskip("zarr")

    def interrupted(done, _count):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(out=tmp_path / "map.zarr", progress=interrupted)
    partial = rik.ReachabilityMap.load(tmp_path / "map.zarr")
    assert not partial.is_complete
    calls = []
    resumed = make(out=tmp_path / "map.zarr", progress=lambda done, _: calls.append(done))
    assert calls[0] >= 3
    assert calls[-1] == len(expected.grid.blocks)
    assert_same(resumed, expected)
    calls.clear()
    again = make(out=tmp_path / "map.zarr", progress=lambda done, _: calls.append(done))
    assert_same(again, expected)
    assert calls == [len(expected.grid.blocks)]


KILLED = """
import sys
sys.path.insert(0, {root!r})
from tests.reachability.test_sweep import make

make(out=sys.argv[1], progress=lambda done, count: print(done, flush=True))
"""


def test_a_killed_program_loses_only_its_unfinished_blocks(expected, tmp_path):
    pytest.importorskip("zarr")
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    out = tmp_path / "map.zarr"
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED.format(root=root), str(out)],
        stdout=subprocess.PIPE,
        text=True,
    )
    with child:
        for line in child.stdout:
            if int(line) >= 2:
                child.send_signal(signal.SIGKILL)
                break
    calls = []
    resumed = make(out=out, progress=lambda done, _: calls.append(done))
    assert calls[0] >= 2
    assert_same(resumed, expected)


def test_a_folder_with_other_content_is_not_changed(tmp_path):
    pytest.importorskip("zarr")
    tmp_path.joinpath("letter.txt").write_text("dear reader")
    with pytest.raises(OutputError, match="not a reachability map"):
        make(out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
    with pytest.raises(ReachabilityMapError):
        rik.ReachabilityMap.load(tmp_path)
    with pytest.raises(ReachabilityMapError):
        rik.ReachabilityMap.load(tmp_path / "nothing")


@pytest.mark.parametrize(
    "changed", ["cell", "robot", "frame", "margin", "limits", "scene", "no condition"]
)
def test_the_map_of_another_robot_scene_or_grid_is_not_continued(changed, tmp_path):
    pytest.importorskip("zarr")
    tiny = {"cell": 0.6, "directions": 1, "rolls": 1}
    robot = rik.load_robot("puma560")
    make(robot, out=tmp_path / "map.zarr", **tiny)
    options = dict(tiny)
    if changed == "cell":
        options["cell"] = 0.7
    elif changed == "robot":
        robot = rik.load_robot("ur5e")
    elif changed == "frame":
        options["frame"] = "flange"
    elif changed == "margin":
        scene = condition(robot).scene
        options["collisions"] = rik.CollisionAvoidance(scene, margin=0.003)
    elif changed == "limits":
        robot = robot.with_limits(0.5 * robot.lower, 0.5 * robot.upper)
    elif changed == "scene":
        collisions = condition(robot)
        collisions.scene.move("shelf", rik.Pose((0.4, 0.2, 0.4)))
        options["collisions"] = collisions
    else:
        options["collisions"] = None
    with pytest.raises(OutputError, match="another robot, scene or grid"):
        make(robot, out=tmp_path / "map.zarr", **options)


def test_the_map_of_another_robot_is_not_loaded(tmp_path):
    pytest.importorskip("zarr")
    robot = rik.load_robot("puma560")
    tiny = {"cell": 0.6, "directions": 1, "rolls": 1, "collisions": None}
    make(robot, out=tmp_path / "map.zarr", **tiny)
    rik.ReachabilityMap.load(tmp_path / "map.zarr", robot)
    narrow = robot.with_limits(0.5 * robot.lower, 0.5 * robot.upper)
    with pytest.raises(ReachabilityMapError, match="another robot"):
        rik.ReachabilityMap.load(tmp_path / "map.zarr", narrow)
