"""Compile kernels in other processes, while this process continues.

Compilation in this process would block its other threads for half a minute. This process later
loads the compiled code from the cache. If a process fails, this process compiles.

    python -m robot_ik.kernels.precompile NICENESS MODULE:FUNCTION [ARGUMENT ...]

calls a function that uses the kernels. It writes a line for every function that is compiled.
"""

from __future__ import annotations

import contextlib
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import IO, Any

from numba.core import event

from robot_ik.ports import Closing


class Precompilation(Closing):
    """A process that calls a function, so that the kernels of the function are compiled.

    Args:
        function: ``module:function``. None starts no process, for kernels that are in the cache.
        *arguments: Arguments of the function, as text.
        niceness: Niceness of the process.
    """

    def __init__(self, function: str | None, *arguments: str, niceness: int = 0) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        if function is None or not sys.executable:
            return
        command = [sys.executable, "-m", __name__, str(niceness), function, *arguments]
        quiet = subprocess.DEVNULL
        with contextlib.suppress(OSError):  # without a process this process compiles
            self.process = subprocess.Popen(
                command, stdin=quiet, stdout=subprocess.PIPE, stderr=quiet
            )

    def compiled_functions(self) -> Iterator[str]:
        """Yield the name of each function that the process has compiled, until it ends."""
        if self.process is None or self.process.stdout is None:
            return
        with contextlib.suppress(ValueError):  # ``close`` has closed the pipe
            for line in self.process.stdout:
                yield line.decode(errors="replace").strip()

    def wait(self) -> None:
        """Wait until the process has ended. It may have failed."""
        for _ in self.compiled_functions():
            pass
        if self.process is not None:
            self.process.wait()

    def close(self) -> None:
        """End the process if it still runs."""
        if self.process is None:
            return
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class _Reporter(event.Listener):
    """Writes a line for every function that is compiled."""

    def __init__(self, out: IO[str]) -> None:
        self._out = out

    def on_start(self, event: Any) -> None: ...

    def on_end(self, event: Any) -> None:
        with contextlib.suppress(OSError):  # the other process has closed the pipe
            self._out.write(event.data["dispatcher"].py_func.__name__ + "\n")
            self._out.flush()


def main(arguments: Sequence[str]) -> None:
    """Run the process, see the module."""
    niceness, function, *rest = arguments
    if hasattr(os, "nice"):
        os.nice(int(niceness))
    event.register("numba:compile", _Reporter(sys.stdout))
    pkgutil.resolve_name(function)(*rest)


if __name__ == "__main__":
    main(sys.argv[1:])
