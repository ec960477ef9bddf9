"""Measures what docs/performance.md says; docs/make_performance.py then makes its tables.

    python docs/measure_performance.py PEERS ENVIRONMENTS RESULTS
    python docs/make_performance.py RESULTS

PEERS is a copy of the side-by-side harness (`run.py`, `multigoal.py`, `envs.py`, `contestants/`) that may be
written to; ENVIRONMENTS is what its `envs.py install --root ENVIRONMENTS --only rtb,eaik,placo` made.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

OURS = ("robot_ik", "robot_ik_lm", "robot_ik_analytic")
#: Environment -> contestants in it.
PEERS = {"rtb": ("rtb_lm",), "eaik": ("eaik",), "placo": ("placo", "placo_restarts")}
#: The harness's names of hands and feet -> ours.
SITES = {
    "left_palm": "left_hand",
    "right_palm": "right_hand",
    "left_foot": "left_foot",
    "right_foot": "right_foot",
}
#: What is run of our own, each into a folder of its own.
BENCHES = {
    "methods": "bench --count 200 --seconds 2",
    "kernels": "bench --sets kernels --solvers lm dls transpose ccd fabrik",
    "batch": "bench --sets batch --solvers auto lm --robots puma560",
}
_FOUR_GOALS_TURN = "four-goals"  # as the first argument: this process is a contestant


def measure(peers: Path, environments: Path, out: Path, rounds: int, count: int) -> None:
    """Runs everything: each round all contestants in turn, then four goals, then our own benchmarks."""
    out.mkdir(parents=True, exist_ok=True)
    shutil.copy(
        ROOT / "robot_ik" / "bench" / "contestant.py", peers / "contestants" / "robot_ik_contestant.py"
    )
    for k in range(1, rounds + 1):
        common = ["--n", str(count), "--budget", "8", "--out", str((out / f"round{k}").resolve())]
        call(sys.executable, peers / "run.py", "--contestants", ",".join(OURS), *common)
        for family, names in PEERS.items():
            call(
                sys.executable, peers / "envs.py", "run", "--root", environments, "--only", family,
                "--pick", ",".join(names), *common,
            )  # fmt: skip
    measure_four_goals(peers, environments, out, rounds)
    for name, words in BENCHES.items():
        call(sys.executable, "-m", "robot_ik", *words.split(), "--out", out / name)


def measure_four_goals(peers: Path, environments: Path, out: Path, rounds: int) -> None:
    """Ours and placo on the humanoid, written out so that placo can read it."""
    import robot_ik as rik
    from robot_ik.bench.plain_model import plain_mjcf

    model, work = out / "humanoid.xml", out / "four_goals"
    model.write_text(plain_mjcf(rik.load_robot("humanoid"), SITES), encoding="utf-8")
    call(sys.executable, peers / "multigoal.py", "prepare", "--mjcf", model, "--work", work)
    placo = environments / "venv_placo" / "bin" / "python"
    lines = ""
    for _ in range(rounds):
        lines += call(sys.executable, __file__, _FOUR_GOALS_TURN, peers, work)
        lines += call(
            placo, peers / "multigoal.py", "run", "--work", work, "--contestants", "placo", "--n", "300"
        )
    (out / "four_goals.txt").write_text(lines, encoding="utf-8")


def four_goals(peers: Path, work: Path) -> None:
    """The harness's own loop, judge and clock of `multigoal.py`, with our contestant in it."""
    from robot_ik.bench.contestant import FourGoals

    script = peers / "multigoal.py"
    scope: dict[str, Any] = {"__name__": "multigoal", "__file__": str(script)}
    sys.path.insert(0, str(peers))
    sys.argv = [str(script), "--help"]  # its command line is its last statement: stop there
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        exec(compile(script.read_text(encoding="utf-8"), str(script), "exec"), scope)
    scope["RefG"] = FourGoals
    scope["run"](argparse.Namespace(work=str(work), contestants=FourGoals.name, n=300))


def call(*words: object) -> str:
    """Runs a command, shows what it prints, and returns it."""
    command = [str(word) for word in words]
    sys.stderr.write("$ " + " ".join(command) + "\n")
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    sys.stderr.write(done.stdout)
    return done.stdout


def main() -> None:
    """All of it, or a contestant's turn."""
    if sys.argv[1:2] == [_FOUR_GOALS_TURN]:
        four_goals(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in ("peers", "environments", "results"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--rounds", type=int, default=3, help="of all contestants in turn")
    parser.add_argument("--count", type=int, default=1000, help="problems of a kind")
    asked = parser.parse_args()
    measure(asked.peers, asked.environments, asked.results, asked.rounds, asked.count)


if __name__ == "__main__":
    main()
