"""Make the editable install visible to type checkers.

mypy and pyright do not follow the import hook of setuptools. This makes a stub package (PEP 561) of
links to the sources, ``FOLDER/robot_ik-stubs``, and names ``FOLDER`` in a ``.pth`` file of this
environment. Nothing can be imported from there, so running programs do not change.

Usage: python .ci/link_stubs.py FOLDER
"""

import shutil
import sys
import sysconfig
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main(folder: Path) -> None:
    """Replace ``folder``, with one link for each module that has the suffix of stubs."""
    mapping = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-dir"
    ]
    shutil.rmtree(folder, ignore_errors=True)
    for package, source in mapping.items():
        outer, *inner = package.split(".")
        for file in (ROOT / source).rglob("*.py"):
            name = file.relative_to(ROOT / source).with_suffix(".pyi")
            place = folder.joinpath(f"{outer}-stubs", *inner, name)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.symlink_to(file)
    Path(sysconfig.get_path("purelib"), "robot_ik_stubs.pth").write_text(f"{folder}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
