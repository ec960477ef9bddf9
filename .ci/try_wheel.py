"""Install the wheel, then the sdist, into one empty environment and check both there.

Usage: python .ci/try_wheel.py DIST
"""

import json
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main(dist: Path) -> None:
    """Check the only wheel and the only sdist in ``dist``. Exit if one does not work."""
    (wheel,) = dist.glob("*.whl")
    (sdist,) = dist.glob("*.tar.gz")
    source = (ROOT / "robot_ik" / "__init__.py").read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.*)"$', source, re.MULTILINE)
    models = ROOT / "models"
    files = [p.relative_to(models) for p in sorted(models.rglob("[!.]*")) if p.is_file()]
    data = [str(p) for p in files if "__pycache__" not in p.parts]
    expected = json.dumps({"version": version, "data": data})
    with tempfile.TemporaryDirectory() as folder:
        # Resolved, as /tmp is a link on macOS and the trial compares paths.
        place = Path(folder).resolve()
        venv.create(place / "env", with_pip=True)
        python = place / "env" / "bin" / "python"
        pip = [python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
        for artefact, options in (
            (wheel, ["--constraint", ROOT / "constraints.txt"]),
            (sdist, ["--force-reinstall", "--no-deps"]),
        ):
            subprocess.run([*pip, *options, artefact.resolve()], check=True)
            trial = subprocess.run([python, "-I", ROOT / ".ci" / "trial.py", expected], cwd=place)
            if trial.returncode:
                sys.exit(f"{artefact.name}: does not work in an empty environment")
            size = f"{artefact.stat().st_size / 1024:.0f} KiB"
            print(f"{artefact.name}: works in an empty environment ({size})")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
