"""``robot-ik reachability``: files, numbers, and errors with advice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robot_ik as rik

SMALL = ("--cell", "0.3", "--directions", "4", "--rolls", "1")

SCENE = """<mujoco><worldbody>
<geom name="wall" type="box" size=".05 2 2" pos="-.4 0 .5"/></worldbody></mujoco>"""


def test_the_map_and_its_pictures_are_written(robot_ik: Any, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    pytest.importorskip("matplotlib")
    run = robot_ik("reachability", *SMALL, "--out", tmp_path / "reach", "--json")
    assert run.code == 0, run
    facts = json.loads(run.out)
    names = sorted(path.name for path in (tmp_path / "reach").iterdir())
    assert names == ["cloud.ply", "map.zarr", "slice-x.png", "slice-y.png", "slice-z.png"]
    assert sorted(Path(file).name for file in facts["files"]) == names
    reach_map = rik.ReachabilityMap.load(tmp_path / "reach" / "map.zarr")
    assert sum(facts["counts"].values()) == facts["poses"] == reach_map.grid.poses
    assert facts["counts"]["reached"] == (reach_map.status == rik.ReachStatus.REACHED).sum()
    assert facts["counts"]["touching"] > 0
    again = robot_ik("reachability", *SMALL, "--out", tmp_path / "reach")
    assert again.code == 0 and "reached only with a collision" in again.out


def test_obstacles_of_a_scene_file_count(robot_ik: Any, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    (tmp_path / "scene.xml").write_text(SCENE)
    counts = []
    for out, scene in (("open", ()), ("walled", ("--scene", tmp_path / "scene.xml"))):
        run = robot_ik("reachability", *SMALL, *scene, "--out", tmp_path / out, "--json")
        assert run.code == 0, run
        counts.append(json.loads(run.out)["counts"])
    assert counts[1]["reached"] < counts[0]["reached"]
    assert counts[1]["unreachable"] == counts[0]["unreachable"]
    walled = rik.ReachabilityMap.load(tmp_path / "walled" / "map.zarr")
    assert np.nansum(walled.index) > 0.0


def test_impossible_requests_are_reported(robot_ik: Any, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    out = ("--out", tmp_path / "reach")
    (tmp_path / "letter").mkdir()
    (tmp_path / "letter" / "map.zarr").mkdir()
    (tmp_path / "letter" / "map.zarr" / "letter.txt").write_text("dear reader")
    other = robot_ik("reachability", *SMALL, "--out", tmp_path / "letter")
    assert other.code == 2 and "not a reachability map" in other.err
    cell = robot_ik("reachability", "--cell", "-1", *out)
    assert cell.code == 2 and "--cell" in cell.err


def test_an_unreachable_cluster_is_named(robot_ik: Any, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    pytest.importorskip("distributed")
    address = "tcp://127.0.0.1:9"
    run = robot_ik("reachability", *SMALL, "--out", tmp_path / "reach", "--cluster", address)
    assert run.code == 2 and address in run.err
