"""What makes compiling faster changes nothing that numba finds, and leaves nothing behind."""

import gc
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.compiler import Flags, run_frontend
from numba.core.postproc import PostProcessor
from numba.core.types.functions import BaseFunction

from robot_ik.kernels import numba_tuning


def mixed(numbers, table, codes, count):
    """Operations whose types depend on the types, kinds and literals of what they are given."""
    total, pair, best = 0.0, (1, 2.5), 0
    for i in range(count):
        for j in range(2):
            total += table[i, 1] * numbers[i] - table[i, j] // 2 + pair[0] * 1 + True
        row = table[i]
        row[0], row[1:3] = numbers[i], numbers[:2]
        total += math.sqrt(abs(total)) + np.sqrt(codes[i]) + (codes[i] >> 1) + (codes[i] / 2)
        best = max(best, codes[i], 3)
        if (best > 2 and not total < 1) or i == 1:
            total = min(total, float(best), pair[1])
    return total, int(total), best % 3, -best, table.T[0, 1], table[::2].sum()


numba_tuning.tune()  # what jit does at the first compile
ARGUMENTS = (np.arange(4.0), np.arange(12.0).reshape(4, 3), np.arange(4, dtype=np.uint8), 4)


def test_a_remembered_signature_is_the_one_that_numba_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    tuned, compared = BaseFunction.get_call_type, []

    def both(self: Any, context: Any, args: Any, kws: Any) -> Any:
        given = tuned(self, context, args, kws)
        found = numba_tuning.find_call_type(self, context, args, kws)
        compared.append((self.key, args, given.args, given.return_type, found.args, found.return_type))
        return given

    numba.njit(mixed)(*ARGUMENTS)  # so that most is remembered
    monkeypatch.setattr(BaseFunction, "get_call_type", both)
    options = (np.float32, np.float64)
    for kind in options:
        result = numba.njit(mixed)(ARGUMENTS[0].astype(kind), ARGUMENTS[1].astype(kind), *ARGUMENTS[2:])
        assert result == pytest.approx(mixed(ARGUMENTS[0].copy(), ARGUMENTS[1].copy(), *ARGUMENTS[2:]))
    assert len(compared) > 100
    for key, args, given, gives, found, finds in compared:
        assert (given, gives) == (found, finds), (key, args)


def test_what_is_remembered_under_some_options_is_not_taken_under_others() -> None:
    """A sum that may be reordered comes first; one that may not then still adds from first to last."""
    numbers = 1e8 * np.random.default_rng(0).normal(size=1000)
    numba.njit(fastmath=True)(lambda x: np.sum(x))(numbers)
    total = 0.0
    for number in numbers.tolist():
        total += number
    assert numba.njit(lambda x: np.sum(x))(numbers) == total


def test_where_variables_live_is_what_numba_finds() -> None:
    function = run_frontend(mixed)
    blocks, lazily = function.blocks, function.variable_lifetime
    function.block_entry_vars.clear()
    asked = [function.get_block_entry_vars(block) for block in blocks.values()]
    numba_tuning.run_post_processor(PostProcessor(function))
    eagerly = function.variable_lifetime
    assert asked == [function.block_entry_vars[block] for block in blocks.values()]
    assert max(map(len, asked)) > 5
    for name in ("livemap", "usedefs", "deadmaps"):
        assert getattr(lazily, name) == getattr(eagerly, name)


@pytest.mark.filterwarnings("ignore::numba.NumbaWarning")
def test_python_objects_and_generators_are_compiled_as_before() -> None:
    @numba.jit(forceobj=True)  # its loop is lifted out, and compiled by itself
    def objects(names: Any) -> Any:
        found = []
        for name in names:
            if name == "b":
                found.append(name.upper())
        return found

    @numba.njit
    def generator(n: int) -> Any:
        total = 0
        for i in range(n):
            if i % 2:
                total += i
                yield total

    assert objects(["a", "b", "b"]) == ["B", "B"]
    assert list(generator(6)) == [1, 4, 9]


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_collection_rests_only_while_something_is_compiled(enabled: bool) -> None:
    seen = []

    def interrupting() -> None: ...

    @numba.extending.overload(interrupting)  # called while its caller is compiled
    def _() -> None:
        seen.append(gc.isenabled())
        raise KeyboardInterrupt

    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(numba.TypingError):
            numba.njit(lambda: "a" + 1)()
        assert gc.isenabled() == enabled
        with pytest.raises(KeyboardInterrupt):
            numba.njit(lambda: interrupting())()
        assert gc.isenabled() == enabled
    finally:
        gc.enable()
    assert seen == [False]


def test_equal_options_are_equal_and_different_ones_are_not() -> None:
    one, other = Flags(), Flags()
    assert one == other and hash(one) == hash(other)
    other.nrt = True
    assert one != other
    one.nrt = True
    assert one == other
    one.release_gil = one.release_gil  # given, and the same as where it is not given
    assert one == other


ASSEMBLY = """
import sys
import numpy as np
from robot_ik.kernels import jit, numba_tuning
if sys.argv[1] == "untuned":
    numba_tuning.tune = lambda: None
from robot_ik.camera.print_model import PIXEL, linearise
arrays = (np.zeros(8, dtype=PIXEL), np.ones((6, 6)), np.eye(3), np.zeros(16))
jit.entry(linearise, *arrays, 1.0, 0.0)
print(*linearise.inspect_asm().values())
"""


def test_the_machine_code_is_the_same(tmp_path: Path) -> None:
    """In the order of one hash seed: numba's own order of sets differs from process to process."""
    instructions = []
    for mode in ("tuned", "untuned"):
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / mode), "PYTHONHASHSEED": "0"}
        command = [sys.executable, "-c", ASSEMBLY, mode]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        instructions.append(re.findall(r"^\s+([a-z]\w+)\s", run.stdout, re.MULTILINE))
    assert len(instructions[0]) > 1000
    assert instructions[0] == instructions[1]
