"""The cache of compiled code is never out of date, and a first compilation is logged once."""

import ast
import importlib
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import robot_ik
from robot_ik.kernels import jit

PACKAGE = Path(robot_ik.__file__).parent

PRINT_FOLDER = """
from robot_ik.kernels.jit import cache_folder
print(cache_folder("robot_ik.kernels.kinematics"))
"""

# A caller in one file and its callee in another, for which numba's own cache is out of date.
CALLER = """
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.callee import twice
@kernel
def caller(x):
    return twice(x) + 1.0
"""
CALLEE = """
from robot_ik.kernels.jit import outlined
@outlined
def twice(x):
    return FACTOR * x
"""

MINE = """
from robot_ik.kernels.jit import cache_folder, kernel, outlined
@outlined
def twice(x):
    return 2.0 * x
@kernel
def doubled(x):
    return twice(x)
@kernel
def again(x):
    return twice(twice(x))
"""


LITERALS = """
import numpy as np
from robot_ik.kernels.jit import inlined, kernel
@inlined
def entry(x, i, negative):
    return -x[i] if negative else x[i]
@kernel
def mixed(x, i):
    return entry(x, 0, True) + 10 * entry(x, 1, False) + 100 * entry(x, i, i > 1)
"""


# An editable install has a finder of its own, which comes before sys.path.
USE_COPY = """
import os, sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
sys.path.insert(0, os.environ["COPY"])
"""


def run(code: str, **environment: str | Path) -> subprocess.CompletedProcess[str]:
    env = os.environ | {name: str(value) for name, value in environment.items()}
    if "COPY" in environment:
        code = USE_COPY + code
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the compiled part of the package, which a test can change."""
    for part in ("kernels", "solvers"):
        shutil.copytree(
            PACKAGE / part,
            tmp_path / "lib" / "robot_ik" / part,
            ignore=shutil.ignore_patterns("__pycache__"),
        )
    for file in ("__init__.py", "errors.py"):
        shutil.copy(PACKAGE / file, tmp_path / "lib" / "robot_ik")
    return tmp_path / "lib"


def test_an_edit_starts_a_new_cache_for_dependent_modules_only(
    copied: Path, tmp_path: Path
) -> None:
    modules = [
        "robot_ik.solvers.ccd",
        "robot_ik.solvers.fabrik",
        "robot_ik.kernels.linalg",
        "of_a_user",
    ]

    def folders() -> list[str]:
        code = (
            f"from robot_ik.kernels.jit import cache_folder; print(*map(cache_folder, {modules}))"
        )
        return run(code, COPY=copied, XDG_CACHE_HOME=tmp_path / "cache").stdout.split()

    before = folders()
    assert all(Path(folder).is_relative_to(tmp_path / "cache" / "robot-ik") for folder in before)
    for name, touched in {
        "kernels/priorities.py": [False, False, False, True],
        "kernels/linalg.py": [True, True, True, True],
        "kernels/search.py": [True, True, False, True],
        "solvers/ccd.py": [True, False, False, False],
    }.items():
        source = copied / "robot_ik" / name
        source.write_text(source.read_text() + "\n# changed\n")
        after = folders()
        assert [a != b for a, b in zip(before, after, strict=True)] == touched, name
        before = after


def test_compiled_code_takes_constants_only_from_sources_that_its_cache_is_named_after() -> None:
    """A constant from another folder would be compiled in, and an edit would have no effect."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(("robot_ik", *path.relative_to(PACKAGE).with_suffix("").parts))
        if not re.search(r"^@(kernel|pure|literal|outlined)$", path.read_text(), re.MULTILINE):
            continue
        module = importlib.import_module(name)
        named = {source.resolve() for source in jit.sources(name)}
        assert path.resolve() in named, f"an edit of {name} keeps its cache"
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith(
                "robot_ik."
            ):
                continue
            for alias in node.names:
                value = getattr(module, alias.asname or alias.name)
                if isinstance(value, bool | int | float | tuple) or hasattr(value, "py_func"):
                    origin = importlib.import_module(node.module).__file__
                    assert Path(origin).resolve() in named, (
                        f"{name} takes {alias.name} from {node.module}"
                    )


def test_a_changed_callee_in_another_file_recompiles_its_callers(copied: Path, tmp_path: Path):
    kernels = copied / "robot_ik" / "kernels"
    (kernels / "caller.py").write_text(CALLER)
    outputs = []
    for factor in ("2.0", "2.0", "5.0"):
        (kernels / "callee.py").write_text(CALLEE.replace("FACTOR", factor))
        code = (
            "from robot_ik.kernels.caller import caller\n"
            "print(caller(10.0), dict(caller.stats.cache_hits))"
        )
        # Without bytecode: Python would load it for a file of the same length and second.
        done = run(
            code, COPY=copied, XDG_CACHE_HOME=tmp_path / "cache", PYTHONDONTWRITEBYTECODE="1"
        )
        assert done.returncode == 0, done.stderr
        outputs.append(done.stdout.split(maxsplit=1))
    assert [value for value, _ in outputs] == ["21.0", "21.0", "51.0"]
    assert [hits.strip() != "{}" for _, hits in outputs] == [False, True, False]


def test_a_cache_that_cannot_be_written_is_replaced_by_a_temporary_one(tmp_path: Path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder can be created below a file")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    (tmp_path / "mine.py").write_text(MINE)
    code = (
        "from mine import doubled, cache_folder; print(cache_folder('mine')); print(doubled(21.0))"
    )
    done = run(code, XDG_CACHE_HOME=blocked, TMPDIR=temporary, PYTHONPATH=tmp_path)
    assert done.returncode == 0, done.stderr
    folder, value = done.stdout.split()
    assert Path(folder).is_relative_to(temporary) and float(value) == 42.0
    assert any(Path(folder).rglob("*.nbi"))


def test_inner_code_is_cached_without_machine_code_for_several_entry_points(
    tmp_path: Path,
):
    (tmp_path / "mine.py").write_text(MINE)
    code = """
import mine
print(mine.ENTRY(10.0), dict(mine.twice.stats.cache_hits) != {})
try:
    mine.twice(1.0)
except TypeError:
    print("TypeError")
"""
    cache = tmp_path / "cache"
    for entry, output, cached in (("doubled", "20.0", "False"), ("again", "40.0", "True")):
        done = run(code.replace("ENTRY", entry), XDG_CACHE_HOME=cache, PYTHONPATH=tmp_path)
        assert done.stdout.split() == [output, cached, "TypeError"], done.stderr
    machine_code = {
        name: [b"\x7fELF" in file.read_bytes() for file in cache.rglob(f"mine.{name}-*.nbc")]
        for name in ("twice", "doubled", "again")
    }
    assert machine_code == {
        "twice": [False],
        "doubled": [sys.platform == "linux"],
        "again": [sys.platform == "linux"],
    }


def test_a_first_compilation_is_logged_once(tmp_path: Path, monkeypatch, caplog):
    monkeypatch.setattr(jit, "_announced", set())
    monkeypatch.setattr(jit, "cache_folder", lambda module: tmp_path)
    caplog.set_level(logging.INFO, logger="robot_ik.kernels")

    def fresh() -> None: ...

    def known() -> None: ...

    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "module.known-12.py311.nbi").touch()
    for _ in range(3):
        jit.announce(fresh, "solver 'fresh'")
        jit.announce(known, "solver 'known'")
    assert [record.getMessage() for record in caplog.records] == [
        "compiling solver 'fresh': up to a minute, once on this machine"
    ]


def test_importing_the_package_loads_no_large_module():
    done = run(
        "import sys, robot_ik\n"
        "print([m for m in ('numba', 'cv2', 'mujoco', 'numpy') if m in sys.modules])"
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_ctrl_c_during_compilation_is_raised_and_the_next_call_works(
    tmp_path: Path,
) -> None:
    """At that time numba runs in a callback of ctypes, which drops the exception of a handler."""
    (tmp_path / "mine.py").write_text(MINE)
    code = """
import os, signal
from numba.core.codegen import CPUCodeLibrary
notified, sent = CPUCodeLibrary._object_compiled_hook.__func__, []
def compiled(cls, module, code):
    if module.name == "doubled" and not sent:
        sent.append(os.kill(os.getpid(), signal.SIGINT))
        [None for _ in range(1000)]
    return notified(cls, module, code)
CPUCodeLibrary._object_compiled_hook = classmethod(compiled)
from mine import doubled
from robot_ik.kernels.jit import entry
for _ in range(2):
    try:
        print(entry(doubled, 2.0)(2.0))
    except KeyboardInterrupt:
        print("interrupted")
"""
    done = run(code, XDG_CACHE_HOME=tmp_path / "cache", PYTHONPATH=tmp_path)
    assert done.stdout.split() == ["interrupted", "4.0"], done.stderr


def test_a_program_stops_a_compiling_thread_before_its_end(tmp_path: Path) -> None:
    """Without the guard LLVM ended during the compilation, and one process in fourteen crashed."""
    code = """
import atexit, threading
from numba.core import event
from numba.core.compiler_lock import global_compiler_lock
begun, compiled = threading.Event(), []
class Listener(event.Listener):
    def on_start(self, event):
        begun.set()
    def on_end(self, event):
        compiled.append(event)
event.register("numba:compile", Listener())
def at_last():
    print(global_compiler_lock.is_locked(), len(compiled) < 60)
atexit.register(at_last)
def solve():
    import robot_ik as rik
    rik.solve(rik.load_robot("puma560"), rik.PositionGoal(None, (0.3, 0.2, 0.4)), solver="lm")
threading.Thread(target=solve, daemon=True).start()
begun.wait()
"""
    done = run(code, XDG_CACHE_HOME=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "True True\n", "")


def test_a_callee_is_compiled_once_for_all_literal_arguments(tmp_path: Path) -> None:
    (tmp_path / "literals.py").write_text(LITERALS)
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import literals, numpy;"
        "print(literals.mixed(numpy.array([1.0, 2.0, 3.0]), 2), len(literals.entry.signatures))"
    )
    done = run(script, XDG_CACHE_HOME=tmp_path / "cache")
    assert done.stdout.split() == ["-281.0", "1"], done.stderr


POWERS = """
from robot_ik.kernels.jit import kernel

@kernel
def square(values):
    for i in range(values.shape[0]):
        values[i] = values[i] ** 2
"""


def test_the_first_kernel_of_a_process_can_take_powers(tmp_path: Path) -> None:
    """numba implements a power in Python code, in which a variable holds a function."""
    (tmp_path / "powers.py").write_text(POWERS)
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import powers, numpy;"
        "values = numpy.array([3.0]); powers.square(values); print(values[0])"
    )
    done = run(script, XDG_CACHE_HOME=tmp_path / "cache")
    assert done.stdout.split() == ["9.0"], done.stderr


WATCH_NUMBA = """
import sys, types
import numba

changes = []
class Watched(types.ModuleType):
    def __setattr__(self, name, value):
        # The import of a submodule sets it on its package.
        if not isinstance(value, types.ModuleType):
            changes.append(f"{self.__name__}.{name}")
        super().__setattr__(name, value)

for name, module in list(sys.modules.items()):
    if name.partition(".")[0] == "numba" and type(module) is types.ModuleType:
        module.__class__ = Watched
import mine, robot_ik.kernels.search
print(mine.again(10.0), changes)
"""


def test_kernels_change_nothing_in_numba(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    done = run(WATCH_NUMBA, XDG_CACHE_HOME=tmp_path / "cache", PYTHONPATH=tmp_path)
    assert done.stdout.split(maxsplit=1) == ["40.0", "[]\n"], done.stdout + done.stderr
