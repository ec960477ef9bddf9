"""Link the packages of this checkout into one folder, laid out as they are when installed.

``robot_ik.hardware`` and ``robot_ik.models`` are beside ``robot_ik/``. setuptools maps them, but
tools that read the source (import-linter, pyright) do not. The mapping is that of pyproject.toml.

Usage: python .ci/link_typed.py FOLDER
"""

import shutil
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main(folder: Path) -> None:
    """Replace ``folder``, with one link for each source and each mapped package."""
    mapping = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-dir"
    ]
    shutil.rmtree(folder, ignore_errors=True)
    for package, source in sorted(mapping.items()):
        place = folder.joinpath(*package.split("."))
        if "." in package:
            place.symlink_to(ROOT / source)
            continue
        place.mkdir(parents=True)
        for entry in (ROOT / source).iterdir():
            if entry.name != "__pycache__":
                (place / entry.name).symlink_to(entry)


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
