"""``SOLVERS``: one row for each method, the only place of registration; ``auto`` is the default.

CLI, docs table, tests and benchmarks are made from it.  It imports no method, nor their base: both know it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from robot_ik.errors import ConfigError, UnknownSolverError, close_matches

if TYPE_CHECKING:
    from robot_ik.problem import Problem
    from robot_ik.robot_file import RobotFile
    from robot_ik.solvers.base import Solver

# name -> module and class; a method is imported when it is first used.
_ROWS: dict[str, tuple[str, str]] = {
    "auto": ("auto", "Auto"),
    "analytic": ("analytic", "Analytic"),
    "lm": ("levenberg_marquardt", "LevenbergMarquardt"),
    "dls": ("damped_least_squares", "DampedLeastSquares"),
    "sdls": ("selectively_damped", "SelectivelyDamped"),
    "bfgs": ("minimization", "Minimization"),
    "pseudoinverse": ("pseudoinverse", "Pseudoinverse"),
    "transpose": ("jacobian_transpose", "JacobianTranspose"),
    "ccd": ("ccd", "CyclicCoordinateDescent"),
    "fabrik": ("fabrik", "Fabrik"),
    "triangulation": ("triangulation", "Triangulation"),
    "recursive": ("recursive", "Recursive"),
    "combined": ("combined", "Combined"),
}


class _Solvers(Mapping[str, "type[Solver]"]):
    """Name -> solver class, imported on access."""

    def __getitem__(self, name: str) -> type[Solver]:
        row = _ROWS.get(name)
        if row is None:
            raise UnknownSolverError(name, _ROWS)
        found: type[Solver] = getattr(importlib.import_module(f"robot_ik.solvers.{row[0]}"), row[1])
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(_ROWS)

    def __len__(self) -> int:
        return len(_ROWS)

    def __repr__(self) -> str:
        return f"SOLVERS({', '.join(_ROWS)})"

    def __contains__(self, name: object) -> bool:
        return name in _ROWS  # Mapping's own would let UnknownSolverError through, which is no KeyError


SOLVERS: Mapping[str, type[Solver]] = _Solvers()


def make_solver(solver: str | Solver, **options: Any) -> Solver:
    """A solver by name, with options; an instance is returned as it is.

    Raises:
        UnknownSolverError: With the close names.
        ConfigError: An option that the method does not have, or out of range.
    """
    if isinstance(solver, type):
        hint = f"make one of it: {solver.__name__}()"
        raise ConfigError(
            f"{solver.__name__} is a class", file="solver", allowed="a name, or an instance", hint=hint
        )
    if not isinstance(solver, str):
        if not hasattr(solver, "prepare"):
            raise UnknownSolverError(solver, _ROWS)  # type: ignore[arg-type]  # whatever it is
        if options:
            problem = f"{', '.join(options)} cannot be set on a solver that is made already"
            hint = "give them where it is made, or name the solver instead"
            raise ConfigError(problem, file=f"solver {solver.name}", hint=hint)
        return solver
    kind = SOLVERS[solver]
    known = [item.name for item in fields(kind)]
    for key in options:
        if key not in known:
            close = close_matches(key, known)
            problem = "unknown option" + (f" (did you mean {close[0]!r}?)" if close else "")
            raise ConfigError(problem, file=f"solver {solver}", key=key, allowed=", ".join(known))
    return kind(**options)


def solver_name(asked: str, file: RobotFile) -> str:
    """The method that is asked for, else that of ``robot.toml``, else ``auto``.

    Raises:
        UnknownSolverError: With the close names, and with the file if the name is from there.
    """
    name = asked or file.solver or "auto"
    if name not in SOLVERS:
        raise UnknownSolverError(name, SOLVERS, hint="" if asked else f"named by solver of {file.path}")
    return name


def able_solvers(problem: Problem) -> tuple[str, ...]:
    """Names of the methods that can try a problem."""
    return tuple(name for name in SOLVERS if not SOLVERS[name]().unsupported(problem))
