"""Drive arms in processes that are killed: one process starts another for every line.

A line is ``ROBOT PORT ON_ORPHAN ON_EXIT``. The answers are a line ``pid NUMBER``, then ``torque``
once torque is on, or ``failed`` and the reason. An empty line waits for the program and answers
``ended``.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from dataclasses import replace

from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

FAR = 1.2
"""rad; the command of the first joint. The limiter sends goals at the joint's speed limit."""


def drive(robot: str, port: str, on_orphan: str, on_exit: str) -> None:
    """Drive the first joint there and back until the process is killed."""
    config = replace(ArmConfig.load(robot), uncalibrated=False, file=None, on_orphan=on_orphan)
    with open_arm(config, port, on_exit=on_exit) as arm:
        arm.enable()
        print("torque", flush=True)
        start = arm.read().q.copy()
        target = start.copy()
        sign = 1.0
        while True:
            begin = arm.clock.now()
            target[0] = start[0] + sign * FAR
            arm.send(target, begin)
            if abs(arm.read().q[0] - target[0]) < 0.1:
                sign = -sign
            time.sleep(max(0.0, 0.01 - (arm.clock.now() - begin)))


def main() -> None:
    child = 0
    for line in sys.stdin:
        words = line.split()
        if not words:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(child, 0)
            print("ended", flush=True)
            continue
        child = os.fork()
        if not child:
            try:
                drive(*words)
            except BaseException as error:
                print("failed", " ".join(str(error).split()), flush=True)
            os._exit(1)
        print(f"pid {child}", flush=True)


if __name__ == "__main__":
    main()
