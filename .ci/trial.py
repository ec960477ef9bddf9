"""Check that an installed robot_ik is complete, in an environment without other packages.

Usage: python -I .ci/trial.py '{"version": "0.1.0", "data": ["puma560/robot.toml", ...]}'
"""

import importlib.metadata
import importlib.resources
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

DISTRIBUTION = "robot-ik-testbed"


def main(version: str, data: list[str]) -> None:
    """Import the package, run the command, look for every data file and load every robot."""
    import robot_ik

    assert Path(robot_ik.__file__).is_relative_to(sys.prefix), f"imported from {robot_ik.__file__}"
    assert importlib.metadata.version(DISTRIBUTION) == version == robot_ik.__version__
    names = {file.name for file in importlib.metadata.files(DISTRIBUTION) or []}
    assert names >= {"LICENSE", "NOTICE"}, "no licence file or no notice"
    for name in ("hardware", "models", "tests"):
        assert importlib.util.find_spec(name) is None, (
            f"`import {name}` works, but belongs to no package"
        )

    models = importlib.resources.files("robot_ik.models")
    missing = [name for name in data if not models.joinpath(name).is_file()]
    assert not missing, f"data files are missing: {missing}"
    for name in sorted({Path(file).parts[0] for file in data if Path(file).name == "robot.toml"}):
        assert robot_ik.load_robot(name).nv > 0

    command = [str(Path(sys.executable).parent / "robot-ik"), "--version"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0 and version in run.stdout, f"{command}: {run}"


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
