"""``python -m robot_ik``: the same as ``robot-ik``."""

import signal
import sys

from robot_ik.commands.main import main

if __name__ == "__main__":
    code = main()
    # A late Ctrl-C, while the interpreter exits, would only print a traceback.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)
