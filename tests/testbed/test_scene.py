"""What the page draws of a robot."""

from __future__ import annotations

import io

import numpy as np
import pytest

from robot_ik.camera.drawing.meshes import visible_geoms
from robot_ik.robot import load_robot

pytest.importorskip("viser", reason="needs the extra web")
import trimesh
from mjviser import conversions

from robot_ik.testbed.frontends.scene import body_meshes


@pytest.mark.parametrize(("name", "most"), [("humanoid", 60_000), ("panda", 20_000)])
def test_a_robot_has_the_shape_of_its_geoms_in_few_enough_faces_for_a_browser(
    name: str, most: int
) -> None:
    """A browser asks every face whether the mouse is over it: of 240,000 that took seconds."""
    model = load_robot(name).model
    drawn = list(body_meshes(model))
    assert sum(len(mesh.faces) for _, mesh in drawn) < most
    bodies = [body for body, _ in drawn]
    assert sorted(set(bodies)) == sorted(set(model.geom_bodyid[visible_geoms(model)]))
    for body, mesh in drawn if name == "panda" else ():  # of the figure mjviser's own take seconds
        if bodies.count(body) == 1:
            fine = conversions.merge_geoms(
                model, [g for g in visible_geoms(model) if model.geom_bodyid[g] == body]
            )
            seen = trimesh.load(io.BytesIO(mesh.glb), file_type="glb", force="mesh", process=False)
            assert np.abs(seen.bounds - fine.bounds).max() < 0.004
            colours = [set(map(tuple, one.visual.vertex_colors)) for one in (seen, fine)]
            assert colours[0] == colours[1]
            assert seen.volume > 0.0, "its faces look inwards"
            assert np.array_equal(seen.faces, mesh.faces) and np.array_equal(
                seen.vertices, mesh.vertices
            )
            outwards = np.einsum(
                "fi,fi->f", seen.vertex_normals[seen.faces[:, 0]], seen.face_normals
            )
            assert outwards.min() > 0.0, "a normal looks inwards"
