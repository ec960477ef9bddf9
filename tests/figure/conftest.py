"""One figure and its abilities for all tests of a process."""

import pytest

from robot_ik.figure.abilities import Abilities, load_abilities
from robot_ik.figure.decide import Decider
from robot_ik.figure.figure import Figure, load_figure


@pytest.fixture(scope="session")
def figure() -> Figure:
    return load_figure()


@pytest.fixture(scope="session")
def abilities(figure: Figure) -> Abilities:
    return load_abilities(figure)


@pytest.fixture(scope="session")
def decider(abilities: Abilities) -> Decider:
    return Decider(abilities)
