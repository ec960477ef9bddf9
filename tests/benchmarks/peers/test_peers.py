"""The comparison with other libraries: one robot for all, MuJoCo judges, a wrong library fails."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from benchmarks.peers import worker
from benchmarks.peers.__main__ import compare, install_commands, main
from benchmarks.peers.closed_forms import standard_dh
from benchmarks.peers.descriptions import frames_of, roll_pitch_yaw, urdf_of
from benchmarks.peers.differential import Descent
from benchmarks.peers.judge import merged
from benchmarks.peers.library import Task, nearest_branch, wxyz_of
from benchmarks.peers.tasks import ARMS, write_task

COUNT = 20
PEERS = """
import numpy as np


class Library:
    needs = ("numpy",)
    sources = {}
    settings = "made for a test"

    def setup(self, task):
        self.task = task
        return True

    def forward(self, q):
        return None


class Idle(Library):
    def solve(self, target, start):
        return start


class Broken(Library):
    def solve(self, target, start):
        raise ArithmeticError("it broke")


class Beyond(Library):
    def setup(self, task):
        from benchmarks.peers.ours import Numeric
        self.good = Numeric()
        return self.good.setup(task)

    def solve(self, target, start):
        return self.good.solve(target, start) + 2.0 * np.pi


class OtherRobot(Idle):
    def forward(self, q):
        return np.eye(4)


class NotHere(Library):
    needs = ("nobody-has-this", "numpy<2")

    def setup(self, task):
        import nobody_has_this


class Picky(Library):
    def setup(self, task):
        return False


class Dead(Library):
    def setup(self, task):
        raise SystemExit(3)
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_task("puma560", tmp_path_factory.mktemp("tasks") / "puma560", COUNT, seed=1)


@pytest.mark.parametrize("name", [*ARMS, "humanoid"])
def test_every_form_of_a_robot_is_the_same_robot(name: str, tmp_path: Path) -> None:
    folder = write_task(name, tmp_path, COUNT, seed=1)
    task = Task.load(folder)
    robot = rik.load_robot(folder / "model.xml")
    plain = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    text = (folder / "model.urdf").read_text(encoding="utf-8")
    text = text.replace(
        'name="plain">', 'name="plain"><mujoco><compiler fusestatic="false"/></mujoco>'
    )
    read = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(read)
    rng = np.random.default_rng(3)
    base = 7 if task.free_base else 0
    for _ in range(5):
        q = np.array(task.home)
        q[base:] = rng.uniform(task.lower, task.upper)
        for joint, angle in zip(task.joints, q[base:], strict=True):
            data.joint(joint).qpos[:] = angle
        mujoco.mj_kinematics(read, data)
        expected = [robot.measure(q, site).matrix for site in task.sites]
        if task.free_base:  # a URDF has no floating base, so poses are relative to that body
            root = mujoco.MjData(plain)
            root.qpos[:] = q
            mujoco.mj_kinematics(plain, root)
            rotation = root.xmat[1].reshape(3, 3)
            position = root.xpos[1]
            expected = [
                np.block([[rotation.T @ t[:3, :3], rotation.T @ (t[:3, 3:] - position[:, None])]])
                for t in expected
            ]
        for site, pose in zip(task.sites, expected, strict=True):
            np.testing.assert_allclose(data.body(site).xpos, np.asarray(pose)[:3, 3], atol=1e-9)
        if not task.free_base:
            pose = task.frames[0]
            for angle, frame in zip(q, task.frames[1:], strict=True):
                rotation = np.eye(4)
                rotation[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
                pose = pose @ rotation @ frame
            np.testing.assert_allclose(pose, expected[0], atol=1e-12)
    if not task.free_base:
        np.testing.assert_allclose(frames_of(plain), task.frames)
        assert urdf_of(plain) == (folder / "model.urdf").read_text(encoding="utf-8")


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2])
def test_roll_pitch_yaw_follows_the_urdf_convention(pitch: float) -> None:
    def about(axis: int, angle: float) -> np.ndarray:
        quat = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quat, np.eye(3)[axis], angle)
        return quat

    def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        made = np.zeros(4)
        mujoco.mju_mulQuat(made, a, b)
        return made

    wanted = times(about(2, -1.1), times(about(1, pitch), about(0, 0.7)))
    r, p, y = roll_pitch_yaw(wanted)
    again = times(about(2, y), times(about(1, p), about(0, r)))
    assert abs(again @ wanted) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "robots", [["puma560"], pytest.param(["puma560", "humanoid"], marks=pytest.mark.soak)]
)
def test_robot_ik_solves_all_and_the_results_contain_the_versions(
    robots: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "results"
    arguments = ["--out", str(out), "--count", str(COUNT), "--rounds", "2", "--seed", "5"]
    names = ["robot_ik_analytic"] + ["robot_ik", "robot_ik_lm"] * ("humanoid" in robots)
    assert main(["run", *arguments, "--libraries", *names, "--robots", *robots]) == 0
    results = json.loads((out / "peers.json").read_text(encoding="utf-8"))
    assert results["seed"] == 5 and results["rounds"] == 2 and results["machine"]["when"]
    assert (
        set(results["libraries"]) == set(names) and not results["missing"] and not results["failed"]
    )
    for name in names:
        library = results["libraries"][name]
        assert set(library["versions"]) == {"robot-ik-testbed", "mujoco", "numba"}
        assert len(library["calibration_us"]) >= 2
        for kind in ("cold", "warm", "wrist", "elbow"):
            cell = library["robots"]["puma560"][kind]
            assert cell["exact"] == 1.0 and cell["n"] == 2 * COUNT and cell["median_us"] > 0.0, (
                name,
                kind,
            )
        assert library["robots"]["puma560"]["unreachable"]["success"] == 0.0
    assert set(results["libraries"]["robot_ik_analytic"]["robots"]) == {"puma560"}, (
        "no closed form for four goals"
    )
    if "humanoid" in robots:
        assert results["libraries"]["robot_ik_lm"]["robots"]["humanoid"]["cold"]["success"] == 1.0


def test_a_poor_peer_fails_and_one_that_is_missing_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "peers.py"
    file.write_text(PEERS, encoding="utf-8")
    kinds = ("Idle", "Broken", "Beyond", "OtherRobot", "NotHere", "Picky", "Dead")
    names = [f"{file}:{kind}" for kind in kinds]
    out = tmp_path / "results"
    arguments = ["--out", str(out), "--count", str(COUNT), "--rounds", "1", "--robots", "puma560"]
    assert main(["run", *arguments, "--libraries", *names, f"{tmp_path}/none.py:Gone"]) == 1
    reported = capsys.readouterr().err
    assert f"raised: {COUNT} of ArithmeticError: it broke" in reported
    results = json.loads((out / "peers.json").read_text(encoding="utf-8"))

    def cold(kind: str) -> Any:
        return results["libraries"][f"{file}:{kind}"]["robots"]["puma560"]["cold"]

    assert [cold(kind)["success"] for kind in ("Idle", "Broken", "Beyond")] == [0.0, 0.0, 0.0]
    assert results["libraries"][f"{file}:Picky"]["robots"] == {}
    assert "reads another robot" in results["failed"][f"{file}:OtherRobot"]
    assert (
        f"{file}:Dead" in results["failed"]
        and "there is no file" in results["failed"][f"{tmp_path}/none.py:Gone"]
    )
    assert "pip install 'nobody-has-this' 'numpy<2'" in results["missing"][f"{file}:NotHere"]
    assert (
        "missing: " in reported
        and "pip install 'nobody-has-this'" in reported
        and "failed: " in reported
    )


def test_an_unknown_library_is_reported_with_the_known_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["run", "--out", str(tmp_path), "--libraries", "eaikk"])
    assert end.value.code == 2 and "eaikk" in capsys.readouterr().err


def test_libraries_name_their_pip_packages() -> None:
    for name in worker.LIBRARIES:
        assert worker.library_of(name).needs, name


def test_the_environment_of_pyroki_has_its_sources_at_fixed_commits(tmp_path: Path) -> None:
    kind = worker.library_of("pyroki")
    commands = install_commands(kind, tmp_path / "pyroki")
    for source in kind.sources.values():
        assert any("clone" in command and source.url in command for command in commands)
        assert any("checkout" in command and source.commit in command for command in commands)
    lacking = [command for command in commands if "--no-deps" not in command and "pip" in command]
    assert len(lacking) == 1 and set(kind.needs) <= set(lacking[0])


@pytest.mark.parametrize("name", ["puma560", "ur5e", "panda"])
def test_denavit_hartenberg_parameters_are_those_of_the_chain(name: str, tmp_path: Path) -> None:
    folder = write_task(name, tmp_path, COUNT, seed=1)
    task = Task.load(folder)
    robot = rik.load_robot(folder / "model.xml")
    base, parameters, tool = standard_dh(task.frames)
    rng = np.random.default_rng(2)
    for _ in range(5):
        q = robot.sample(rng)
        pose = base
        for angle, (offset, d, a, alpha) in zip(q, parameters, strict=True):
            c = np.cos(angle + offset)
            s = np.sin(angle + offset)
            ca = np.cos(alpha)
            sa = np.sin(alpha)
            link = np.array(
                [
                    [c, -s * ca, s * sa, a * c],
                    [s, c * ca, -c * sa, a * s],
                    [0.0, sa, ca, d],
                    [0.0, 0.0, 0.0, 1.0],
                ]
            )
            pose = pose @ link
        np.testing.assert_allclose(pose @ tool, robot.measure(q, "ee").matrix, atol=1e-9)


def test_the_nearest_branch_is_inside_the_limits(model: Path) -> None:
    task = Task.load(model)
    start = np.clip(np.zeros(6), task.lower, task.upper)
    inside = 0.5 * (task.lower + task.upper)
    beyond = start.copy()
    beyond[0] = task.upper[0] + 0.1
    several_turns = inside + 2.0 * np.pi
    branch = nearest_branch(np.array([beyond, several_turns]), start, task)
    np.testing.assert_allclose(branch, inside, atol=1e-9)
    assert nearest_branch(np.array([beyond]), start, task) is None
    assert nearest_branch(np.empty((0, 6)), start, task) is None


def test_a_quaternion_of_a_rotation_matrix() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, quaternion)
        assert abs(np.dot(wxyz_of(rotation.reshape(3, 3)), quaternion)) == pytest.approx(1.0)


def test_a_descent_restarts_until_the_goal_is_met(model: Path) -> None:
    class OnlyNear(Descent):
        steps = 3
        restarts = 50

        def setup(self, task: Task) -> bool:
            return self.prepare(task)

        def aim(self, target: Any) -> None:
            self.puts = 0

        def put(self, q: Any) -> None:
            self.q = q
            self.puts += 1

        def get(self) -> Any:
            return self.q

        def is_met(self) -> bool:
            return self.puts == 4

        def step(self) -> bool:
            return True

    library = OnlyNear()
    task = Task.load(model)
    assert library.setup(task)
    q = library.solve(np.eye(4), task.home)
    assert library.puts == 4
    assert (q >= task.lower).all() and (q <= task.upper).all()


def test_rounds_are_merged_by_success_of_all_and_time_of_the_fastest() -> None:
    first = {
        "n": 10,
        "success": 1.0,
        "exact": 0.5,
        "median_us": 5.0,
        "cpu_mean_us": 9.0,
        "cpu_p99_us": 20.0,
    }
    second = first | {
        "n": 30,
        "success": 0.0,
        "exact": 0.5,
        "median_us": 7.0,
        "cpu_mean_us": 8.0,
        "jumps": 2,
    }
    found = merged([first, second])
    assert (
        found["success"] == 0.25
        and found["exact"] == 0.5
        and found["n"] == 40
        and found["jumps"] == 2
    )
    assert (found["median_us"], found["mean_us"], found["p99_us"]) == (5.0, 8.0, 20.0)


@pytest.mark.parametrize(("name", "module"), [("ikpy", "ikpy"), ("rtb_lm", "roboticstoolbox")])
def test_another_library_is_compared(name: str, module: str, tmp_path: Path) -> None:
    if importlib.util.find_spec(module) is None:
        command = "python -m benchmarks.peers install ENVIRONMENTS --libraries"
        pytest.skip(f"needs {module}: {command} {name}")
    results = compare([name], ["puma560"], tmp_path, count=COUNT, rounds=1)
    cell = results["libraries"][name]["robots"]["puma560"]["warm"]
    assert cell["success"] > 0.9 and not results["failed"]
