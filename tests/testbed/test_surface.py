"""Surfaces around grids, and the space that a tool reaches."""

from __future__ import annotations

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.testbed.regions import figure_regions, reach_shell
from robot_ik.testbed.surface import Surface, grid_around, surface_of


def volume(surface: Surface) -> float:
    """The enclosed volume by the divergence theorem: positive if faces point outwards."""
    a, b, c = (surface.vertices[surface.faces[:, k]].astype(float) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_a_ball_has_the_volume_and_the_radius_of_a_ball() -> None:
    points, origin, cell = grid_around(np.array((1.0, 2.0, 3.0)), 1.2, 41)
    distance = np.linalg.norm(points - (1.0, 2.0, 3.0), axis=1)
    surface = surface_of((distance < 1.0).reshape(41, 41, 41), origin, cell)
    assert volume(surface) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.05)
    radius = np.linalg.norm(surface.vertices - (1.0, 2.0, 3.0), axis=1)
    assert np.abs(radius - 1.0).max() < 1.5 * cell
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all(), "not closed"


def test_an_empty_grid_has_no_surface() -> None:
    surface = surface_of(np.zeros((4, 4, 4), bool), np.zeros(3), 0.1)
    assert surface.faces.shape == (0, 3) and surface.vertices.shape == (0, 3)


def test_the_shell_of_an_arm_holds_what_it_reaches() -> None:
    robot = rik.load_robot("puma560")
    (region,) = reach_shell(robot)
    vertices = region.surface.vertices
    rng = np.random.default_rng(0)
    reached = np.array([robot.measure(robot.sample(rng)).position for _ in range(300)])
    cell = 2.0 * robot.reach()[1] / 18.0  # type: ignore[index]
    assert (reached.min(axis=0) > vertices.min(axis=0) - cell).all()
    assert (reached.max(axis=0) < vertices.max(axis=0) + cell).all()
    centre, radius = robot.reach()  # type: ignore[misc]
    assert np.linalg.norm(vertices - centre, axis=1).max() < radius + 2.0 * cell


def test_a_figure_bends_below_and_jumps_above_what_it_reaches() -> None:
    regions = {
        region.name: region.surface.vertices
        for region in figure_regions(rik.load_robot("humanoid"))
    }
    assert list(regions) == ["reach", "bend", "jump"]
    assert regions["jump"][:, 2].max() > regions["reach"][:, 2].max() > regions["bend"][:, 2].max()
    assert regions["bend"][:, 2].min() < regions["reach"][:, 2].min()
