"""Arrays by name for compiled code: what is read is what was packed, and what cannot be read is refused."""

import numpy as np
import pytest

from robot_ik.goals import PositionGoal
from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.workspace import WORK
from robot_ik.problem import Problem

PAIR = Layout("Pair", numbers="floats", places="ints", grid="table")
open_pair = PAIR.open


def arrays(**changed):
    made = {
        "numbers": np.array([1.5, 2.5]),
        "places": np.array([3, 4, 5]),
        "grid": np.arange(6.0).reshape(2, 3),
    }
    return made | changed


def test_compiled_code_reads_and_writes_the_same_memory():
    import numba

    @numba.njit
    def double(table):
        pair = open_pair(table)
        for i in range(pair.grid.shape[0]):
            for j in range(pair.grid.shape[1]):
                pair.grid[i, j] *= pair.places[i] * pair.numbers[0]
        return pair.numbers.shape[0], pair.places.sum(), pair.grid.shape

    mine = arrays()
    assert double(PAIR.pack(mine)) == (2, 12, (2, 3))
    np.testing.assert_array_equal(mine["grid"], np.arange(6.0).reshape(2, 3) * 1.5 * np.array([[3], [4]]))


@pytest.mark.parametrize(
    "changed",
    [
        {"numbers": np.zeros(2, dtype=np.float32)},
        {"numbers": np.zeros((2, 2))},
        {"places": np.zeros(2)},
        {"grid": np.zeros((4, 4)).T[:, ::2]},
        {"grid": np.zeros((3, 2)).T},
    ],
)
def test_memory_of_another_shape_is_refused(changed):
    with pytest.raises(TypeError, match=next(iter(changed))):
        PAIR.pack(arrays(**changed))


def test_every_field_of_the_work_space_is_made(load_xml):
    robot = load_xml(
        "<mujoco><worldbody><body name='b'><joint name='j'/><geom size='1'/></body></worldbody></mujoco>"
    )
    problem = Problem(robot, PositionGoal(None, (1, 0, 0)))
    assert set(problem.arrays) == set(WORK.fields)
