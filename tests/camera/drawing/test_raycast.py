"""Rays in bulk against MuJoCo's single ones."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_ik.camera.drawing.meshes import VISIBLE_GROUPS
from robot_ik.camera.drawing.raycast import Caster
from robot_ik.robot import load_robot

ROBOTS = ["puma560", "humanoid", "lion", "panda", "tabletop_puma"]


@pytest.mark.parametrize("name", ROBOTS)
def test_every_ray_meets_what_a_single_ray_meets(name: str) -> None:
    """Geoms that are only to be seen as well: the lion's tuft, shells around what collides."""
    model = load_robot(name).model
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    data.qpos[:] = model.qpos0 + random.uniform(-0.3, 0.3, model.nq)
    mujoco.mj_forward(model, data)
    caster = Caster(model)
    caster.place(data.qpos)
    groups, met = np.array(VISIBLE_GROUPS, dtype=np.uint8), np.zeros(1, np.int32)
    seen = set()
    for _ in range(4):
        origin = data.geom_xpos.mean(axis=0) + 2.0 * random.normal(size=3)
        aims = data.geom_xpos[random.integers(0, model.ngeom, 400)] + 0.03 * random.normal(size=(400, 3))
        ways = aims - origin
        hits = caster.cast(origin, ways, normals=False)
        for way, geom, depth in zip(ways, hits.geom, hits.depth, strict=True):
            reach = mujoco.mj_ray(model, data, origin, way, groups, True, -1, met, None)
            assert (geom < 0) == (met[0] < 0)  # which one is a toss-up where two surfaces meet
            assert geom < 0 or depth == pytest.approx(reach, abs=1e-9)
            seen.add(int(geom))
    assert len(seen) > 0.4 * sum(groups[model.geom_group] > 0)


def test_a_floor_is_met_although_its_body_has_what_is_only_to_be_seen() -> None:
    shown = '<geom type="box" size=".1 .1 .1" pos="0 0 .5" contype="0" conaffinity="0"/>'
    floor = '<geom type="plane" size="3 3 .1"/>'
    caster = Caster(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{shown}</worldbody></mujoco>"))
    caster.place([])
    down = np.array([[0.0, 0.0, -1.0], [2.0, 0.0, -1.0], [5.0, 0.0, -1.0]])
    assert caster.cast(np.array([0.0, 0.0, 1.0]), down).geom.tolist() == [1, 0, -1]


def test_the_model_given_is_left_as_it_is() -> None:
    model = load_robot("lion").model
    before = model.bvh_aabb.copy()
    assert not np.array_equal(Caster(model).model.bvh_aabb, before)
    assert np.array_equal(model.bvh_aabb, before)
