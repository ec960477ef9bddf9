"""What was commanded and measured, in files that other programs read."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, OutputError
from robot_ik.geometry import Pose
from robot_ik.jobs.recording import Moment, open_recording
from robot_ik.jobs.testbed import film
from robot_ik.robot import load_robot
from robot_ik.testbed.commands import CommandLog, Start
from tests.testbed.test_frontends import SCRIPT

JOINTS = ("a", "b")


def test_a_table_has_a_row_a_moment_and_leaves_empty_what_is_not_known(tmp_path: Path) -> None:
    with open_recording(tmp_path / "a.csv", JOINTS) as rows:
        rows.write(Moment(0.0, commanded=np.array([0.1, 0.2])))
        rows.write(Moment(0.5, measured=np.array([0.3, -0.4]), goal=Pose((1.0, 2.0, 3.0)), text='a "b", c'))
    with (tmp_path / "a.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["commanded.b"]) == 0.2 and first["measured.a"] == "" and first["goal_x"] == ""
    assert float(second["measured.b"]) == -0.4 and float(second["goal_z"]) == 3.0
    assert second["text"] == 'a "b", c' and float(second["time_s"]) == 0.5


def test_an_mcap_file_is_read_back_by_its_own_reader(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs the extra record")
    file = tmp_path / "a.mcap"
    with open_recording(file, JOINTS) as rows:
        for k in range(5):
            rows.write(Moment(0.1 * k, commanded=np.array([0.1 * k, 0.2]), measured=np.array([0.1 * k, 0.0])))
        rows.write(Moment(0.5, goal=Pose((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0)), text="arrived", robot=2))
    found: dict[str, list[object]] = {}
    times = []
    for message in reader.read_ros2_messages(str(file)):
        found.setdefault(message.channel.topic, []).append(message.ros_msg)
        times.append(message.log_time_ns)
    assert set(found) == {"/joint_commands", "/joint_states", "/robot_2/goal", "/rosout"}
    states = found["/joint_commands"]
    assert len(states) == 5 and list(states[3].name) == list(JOINTS)  # type: ignore[attr-defined]
    assert states[3].position == pytest.approx([0.3, 0.2])  # type: ignore[attr-defined]
    goal = found["/robot_2/goal"][0].pose  # type: ignore[attr-defined]
    assert (goal.position.z, goal.orientation.x, goal.orientation.w) == (3.0, 1.0, 0.0)
    assert max(times) - min(times) == pytest.approx(5e8, abs=2)


def test_another_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"format is not clear from the name 'a\.txt'; allowed: \.csv"):
        open_recording(tmp_path / "a.txt", JOINTS).__enter__()


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as table:
        return list(csv.DictReader(table))


def test_a_script_and_a_reach_write_what_was_commanded_and_measured(tmp_path: Path) -> None:
    script = tmp_path / "go.toml"
    script.write_text(
        'schema = 1\nname = "go"\nrobot = "tabletop_puma"\n[[steps]]\n'
        'do = "joints"\njoints_deg = {joint1 = 20.0}\n'
    )
    run, reach = tmp_path / "run.csv", tmp_path / "reach.csv"
    assert main(["run", str(script), "--record", str(run)]) == 0
    goal = ["--goal", "0.2", "0.05", "0.1", "--robot", "tabletop_puma", "--bus", "sim"]
    assert main(["reach", *goal, "--out", str(tmp_path / "out"), "--record", str(reach)]) in (0, 1)
    for file in (run, reach):
        found = rows_of(file)
        last = found[-1]
        joints = [name.removeprefix("measured.") for name in last if name.startswith("measured.")]
        assert len(found) > 20 and len(joints) == 6
        assert all(abs(float(last[f"commanded.{j}"]) - float(last[f"measured.{j}"])) < 0.02 for j in joints)
        assert [float(row["time_s"]) for row in found] == sorted(float(row["time_s"]) for row in found)


def test_a_recording_of_no_kind_is_refused_before_a_film_begins(tmp_path: Path) -> None:
    film_file = tmp_path / "a.mp4"
    with pytest.raises(ConfigError, match="the format is not clear"):
        film(CommandLog(Start("puma560"), ()), film_file, record=tmp_path / "a.txt", seconds=1.0)
    assert not film_file.exists()


def test_a_film_has_a_recording_beside_it(tmp_path: Path) -> None:
    SCRIPT.save(tmp_path / "a.jsonl")
    out = [str(tmp_path / "a.jsonl"), str(tmp_path / "a.png"), "--record", str(tmp_path / "a.csv")]
    assert main(["video", *out, "--size", "96", "64"]) == 0
    found = rows_of(tmp_path / "a.csv")
    assert {row["robot"] for row in found} == {"0", "1", "2"} and float(found[-1]["goal_x"]) == 0.2


def test_every_number_of_a_free_base_has_its_own_name(tmp_path: Path) -> None:
    """A joint is one name and up to seven numbers: names were given out to numbers one by one."""
    table, numbers = tmp_path / "a.csv", tmp_path / "numbers.csv"
    film(CommandLog(Start("humanoid"), ()), None, record=table, numbers=numbers, seconds=0.05)
    with table.open() as file:
        head, *rows = csv.reader(file)
    found = dict(zip(head, rows[-1], strict=True))
    said = dict(item.split("=") for item in rows_of(numbers)[-1]["q"].split())
    home = load_robot("humanoid").home
    assert float(found["commanded.root_qw"]) == float(said["root_qw"]) == pytest.approx(home[3], abs=0.1)
    assert float(said["root_z"]) == pytest.approx(home[2], abs=0.1)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("moments", [1, 10_000])
@pytest.mark.parametrize("ending", [".csv", ".mcap"])
def test_a_full_disk_names_the_file_and_leaves_no_torn_one(tmp_path: Path, ending: str, moments: int) -> None:
    """At the end, where little was written, or in the middle."""
    if ending == ".mcap":
        pytest.importorskip("mcap_ros2", reason="needs the extra record")
    file = tmp_path / f"a{ending}"
    file.symlink_to("/dev/full")
    with (
        pytest.raises(OutputError, match=rf"a\{ending} cannot be written: No space left"),
        open_recording(file, JOINTS) as rows,
    ):
        for k in range(moments):
            rows.write(Moment(0.1 * k, commanded=np.array([0.1, 0.2]), text="here"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_run_whose_disk_is_full_ends_with_the_name_of_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "a.csv"
    file.symlink_to("/dev/full")
    assert main(["run", "pick_and_place", "--record", str(file), "--overwrite"]) == 2
    said = capsys.readouterr()
    assert "a.csv cannot be written: No space left" in said.err.replace("\n", "")
    assert "torque_off, confirmed by" in said.out
    assert list(tmp_path.iterdir()) == []
