"""Compiling a method or the painter in another process: only if it is not in the cache."""

from __future__ import annotations

import pytest

from robot_ik.kernels import jit
from robot_ik.solvers import levenberg_marquardt
from robot_ik.workcell.precompile import precompile_overlay, precompile_solver


@pytest.fixture
def empty_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing has been compiled on this machine."""
    monkeypatch.setattr(jit, "compiled", lambda function: False)


@pytest.mark.parametrize("solver", ["lm", "auto"])
def test_a_method_is_compiled_by_a_solve(empty_cache: None, solver: str) -> None:
    with precompile_solver("puma560", solver) as compilation:
        compilation.wait()
        assert compilation.process is not None
        assert compilation.process.returncode == 0


def test_the_overlay_is_compiled_by_drawing(empty_cache: None) -> None:
    with precompile_overlay() as compilation:
        compilation.wait()
        assert compilation.process is not None
        assert compilation.process.returncode == 0


def test_compiled_kernels_start_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "compiled", lambda function: True)
    assert precompile_solver("puma560", "lm").process is None
    assert precompile_overlay().process is None
    # ``auto`` may come to several methods. One compiled method is enough.
    lm = levenberg_marquardt.solve
    monkeypatch.setattr(jit, "compiled", lambda function: function is lm)
    assert precompile_solver("puma560", "auto").process is None
