"""Recordings: CSV tables and MCAP files, also when the disk is full."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, OutputError
from robot_ik.geometry import Pose
from robot_ik.motion.joint_table import Moment
from robot_ik.motion.recording import open_recording
from robot_ik.robot import load_robot
from robot_ik.testbed.commands import CommandLog, Start
from robot_ik.testbed.filming import film
from tests.testbed.test_frontends import SCRIPT

JOINTS = ("a", "b")


def test_a_table_has_one_row_per_moment_with_empty_cells_for_unknown_values(tmp_path: Path) -> None:
    with open_recording(tmp_path / "a.csv", JOINTS) as rows:
        rows.write(Moment(0.0, commanded=np.array([0.1, 0.2])))
        goal = Pose((1.0, 2.0, 3.0))
        rows.write(Moment(0.5, measured=np.array([0.3, -0.4]), goal=goal, text='a "b", c'))
    with (tmp_path / "a.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["commanded.b"]) == 0.2
    assert first["measured.a"] == ""
    assert first["goal_x"] == ""
    assert float(second["time_s"]) == 0.5
    assert float(second["measured.b"]) == -0.4
    assert float(second["goal_z"]) == 3.0
    assert second["text"] == 'a "b", c'


def test_the_mcap_reader_reads_back_an_mcap_file(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs the extra record")
    file = tmp_path / "a.mcap"
    with open_recording(file, JOINTS) as rows:
        for k in range(5):
            commanded = np.array([0.1 * k, 0.2])
            measured = np.array([0.1 * k, 0.0])
            rows.write(Moment(0.1 * k, commanded=commanded, measured=measured))
        goal = Pose((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))
        rows.write(Moment(0.5, goal=goal, text="arrived", robot=2))

    messages: dict[str, list[Any]] = {}
    times = []
    for message in reader.read_ros2_messages(str(file)):
        messages.setdefault(message.channel.topic, []).append(message.ros_msg)
        times.append(message.log_time_ns)
    assert set(messages) == {"/joint_commands", "/joint_states", "/robot_2/goal", "/rosout"}
    states = messages["/joint_commands"]
    assert len(states) == 5
    assert list(states[3].name) == list(JOINTS)
    assert states[3].position == pytest.approx([0.3, 0.2])
    pose = messages["/robot_2/goal"][0].pose
    assert (pose.position.z, pose.orientation.x, pose.orientation.w) == (3.0, 1.0, 0.0)
    assert max(times) - min(times) == pytest.approx(5e8, abs=2)


def test_an_unknown_suffix_is_rejected(tmp_path: Path) -> None:
    message = r"the name 'a\.txt' has no known suffix; allowed: \.csv"
    with pytest.raises(ConfigError, match=message):
        open_recording(tmp_path / "a.txt", JOINTS).__enter__()


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as table:
        return list(csv.DictReader(table))


def test_run_and_reach_record_commanded_and_measured_positions(tmp_path: Path) -> None:
    script = tmp_path / "go.toml"
    script.write_text(
        'schema = 1\nname = "go"\nrobot = "tabletop_puma"\n[[steps]]\n'
        'do = "joints"\njoints_deg = {joint1 = 20.0}\n'
    )
    run = tmp_path / "run.csv"
    reach = tmp_path / "reach.csv"
    assert main(["run", str(script), "--record", str(run)]) == 0
    goal = ["--goal", "0.2", "0.05", "0.1", "--robot", "tabletop_puma", "--bus", "sim"]
    assert main(["reach", *goal, "--out", str(tmp_path / "out"), "--record", str(reach)]) in (0, 1)
    for file in (run, reach):
        rows = rows_of(file)
        last = rows[-1]
        joints = [name.removeprefix("measured.") for name in last if name.startswith("measured.")]
        assert len(rows) > 20
        assert len(joints) == 6
        for joint in joints:
            commanded = float(last[f"commanded.{joint}"])
            assert abs(commanded - float(last[f"measured.{joint}"])) < 0.02
        times = [float(row["time_s"]) for row in rows]
        assert times == sorted(times)


def test_an_unknown_suffix_of_the_recording_is_rejected_before_the_film_begins(
    tmp_path: Path,
) -> None:
    film_file = tmp_path / "a.mp4"
    with pytest.raises(ConfigError, match="has no known suffix"):
        film(CommandLog(Start("puma560"), ()), film_file, record=tmp_path / "a.txt", seconds=1.0)
    assert not film_file.exists()


def test_video_writes_a_recording_beside_the_film(tmp_path: Path) -> None:
    SCRIPT.save(tmp_path / "a.jsonl")
    options = {"replay": "a.jsonl", "video": "a.png", "record": "a.csv"}
    words = [word for name, file in options.items() for word in (f"--{name}", str(tmp_path / file))]
    assert main(["view", *words, "--size", "96", "64"]) == 0
    rows = rows_of(tmp_path / "a.csv")
    assert {row["robot"] for row in rows} == {"0", "1", "2"}
    assert float(rows[-1]["goal_x"]) == 0.2


def test_every_coordinate_of_a_free_joint_has_its_own_column(tmp_path: Path) -> None:
    """A joint has up to seven coordinates, so joint names alone do not name the columns."""
    table = tmp_path / "a.csv"
    film(CommandLog(Start("humanoid"), ()), None, record=table, seconds=0.05)
    last = rows_of(table)[-1]
    home = load_robot("humanoid").home
    assert float(last["commanded.root_qw"]) == pytest.approx(home[3], abs=0.1)
    assert float(last["commanded.root_z"]) == pytest.approx(home[2], abs=0.1)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("moments", [1, 10_000])
@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_on_a_full_disk_the_error_names_the_file_and_the_file_is_removed(
    tmp_path: Path, suffix: str, moments: int
) -> None:
    """One moment fails when the file is closed, many moments fail earlier."""
    if suffix == ".mcap":
        pytest.importorskip("mcap_ros2", reason="needs the extra record")
    file = tmp_path / f"a{suffix}"
    file.symlink_to("/dev/full")
    with (
        pytest.raises(OutputError, match=rf"a\{suffix} cannot be written: No space left"),
        open_recording(file, JOINTS) as rows,
    ):
        for k in range(moments):
            rows.write(Moment(0.1 * k, commanded=np.array([0.1, 0.2]), text="here"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_run_on_a_full_disk_reports_the_file_and_turns_the_torque_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "a.csv"
    file.symlink_to("/dev/full")
    assert main(["run", "pick_and_place", "--record", str(file), "--overwrite"]) == 2
    output = capsys.readouterr()
    assert "a.csv cannot be written: No space left" in output.err.replace("\n", "")
    assert "torque_off, confirmed by" in output.out
    assert list(tmp_path.iterdir()) == []
