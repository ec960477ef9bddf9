"""``SOLVERS``: the registry of methods, with one row for each method. ``auto`` is the default.

The command line, the table of the docs, the tests and the benchmarks are generated from it. It
imports a method when the method is first used.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from robot_ik.errors import OptionError, UnknownSolverError, close_matches

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
        module, class_name = row
        solver: type[Solver] = getattr(
            importlib.import_module(f"robot_ik.solvers.{module}"), class_name
        )
        return solver

    def __iter__(self) -> Iterator[str]:
        return iter(_ROWS)

    def __len__(self) -> int:
        return len(_ROWS)

    def __repr__(self) -> str:
        return f"SOLVERS({', '.join(_ROWS)})"

    def __contains__(self, name: object) -> bool:
        # The default of Mapping expects a KeyError, which UnknownSolverError is not.
        return name in _ROWS


SOLVERS: Mapping[str, type[Solver]] = _Solvers()


def make_solver(solver: str | Solver, **options: Any) -> Solver:
    """Return a solver by name, with options. A solver is returned as given.

    Raises:
        UnknownSolverError: There is no such solver. The message lists close names.
        OptionError: An option that the method does not have, or a value out of range.
    """
    if isinstance(solver, type):
        raise OptionError(
            "solver", f"{solver.__name__} is a class", hint=f"create a solver: {solver.__name__}()"
        )
    if not isinstance(solver, str):
        if not hasattr(solver, "prepare"):
            raise UnknownSolverError(solver, _ROWS)  # type: ignore[arg-type]
        if options:
            raise OptionError(
                ", ".join(options),
                "cannot be set on a solver that exists already",
                owner=f"solver {solver.name}",
                hint="give options where the solver is created, or name the solver instead",
            )
        return solver
    kind = SOLVERS[solver]
    known = [item.name for item in fields(kind)]
    for key in options:
        if key not in known:
            close = close_matches(key, known)
            problem = "unknown option" + (f" (did you mean {close[0]!r}?)" if close else "")
            allowed = ", ".join(known) or "none; arguments such as budget are not options"
            raise OptionError(key, problem, allowed, owner=f"solver {solver}")
    return kind(**options)


def solver_name(given: str, file: RobotFile) -> str:
    """Return the name that was given, else that of ``robot.toml``, else ``auto``.

    Raises:
        UnknownSolverError: There is no such solver. The message lists close names, and the file if
            it has the name.
    """
    name = given or file.solver or "auto"
    if name not in SOLVERS:
        raise UnknownSolverError(
            name, SOLVERS, hint="" if given else f"named by solver of {file.path}"
        )
    return name


def able_solvers(problem: Problem) -> tuple[str, ...]:
    """Return the names of the methods that support a problem."""
    return tuple(name for name in SOLVERS if not SOLVERS[name]().unsupported(problem))
