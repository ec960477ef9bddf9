"""``python -m robot_ik``: the same as ``robot-ik``."""

import sys

from robot_ik.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
