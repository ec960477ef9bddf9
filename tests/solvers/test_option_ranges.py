"""The usual range of an option, which is the range of its slider."""

from __future__ import annotations

import dataclasses

import pytest

from robot_ik import SOLVERS, make_solver

USUAL = [
    (name, field)
    for name, solver in SOLVERS.items()
    for field in dataclasses.fields(solver)
    if field.metadata["usual"] is not None
]


@pytest.mark.parametrize(
    ("name", "field"), USUAL, ids=[f"{name}-{field.name}" for name, field in USUAL]
)
def test_a_usual_range_holds_the_default_and_its_upper_end_is_allowed(
    name: str, field: dataclasses.Field[float]
) -> None:
    first, last = field.metadata["usual"]
    assert first < last and first <= field.default <= last
    make_solver(name, **{field.name: type(field.default)(last)})
    make_solver(name, **{field.name: type(field.default)(max(first, field.metadata["lower"]))})


def test_every_iterative_method_has_a_slider_or_a_choice() -> None:
    for name, solver in SOLVERS.items():
        fields = dataclasses.fields(solver)
        if len(fields) > 1:
            assert any(
                f.metadata["usual"] or f.metadata["choices"] or isinstance(f.default, bool)
                for f in fields
            ), name
