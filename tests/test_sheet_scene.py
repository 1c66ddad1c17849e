# SPDX-License-Identifier: Apache-2.0
"""The search for triangles of light that cover a point: none is passed by, and none depends on the others."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from delta_scenes import matte, scene_of, wall

from rangesim.light_transport.caustic_sheets import Sheets
from rangesim.light_transport.sheet_scene import EVERY, FAINT, GROUPS, SheetScene

CELLS, WAYS = 12, 20
PROJECTOR_AT = np.array([0.2, 0.6, 0.0])


def sheets_over_a_square(level: float) -> Sheets:
    """Light that comes by `WAYS` chains to the square of 1 m at z = 1, all of it in the same triangles."""
    v, u = (c.ravel() for c in np.indices((CELLS + 1, CELLS + 1)).astype(np.float32))
    n = len(u)
    first = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).ravel()
    cell = np.concatenate([first[:, None] + [0, 1, CELLS + 2], first[:, None] + [0, CELLS + 2, CELLS + 1]])
    triangles = np.concatenate([cell + way * n for way in range(WAYS)])
    position = np.column_stack([u / CELLS - 0.3, v / CELLS + 0.1, np.ones(n)]).astype(np.float32)
    vertices = (position, [[0, 0, 1]] * n, [-1] * n, [1] * n, u, v, [[0, 0, -1]] * n)
    columns: list[Any] = [np.concatenate([np.asarray(c, np.float32)] * WAYS) for c in vertices]
    key = np.repeat(np.arange(WAYS, dtype=np.uint32) << 8, len(cell))
    flux = np.full(len(triangles), level / len(cell))
    distance = np.linalg.norm(columns[0][triangles[:, 0]] - PROJECTOR_AT, axis=1)
    return Sheets(
        *columns, triangles, flux, distance**-2, *np.zeros((1, len(triangles)), np.uint32), key, 0 * key, 0.0, 1.0
    )


@pytest.fixture(autouse=True)
def renderer() -> None:
    """Mitsuba is ready after a scene is loaded."""
    scene_of(wall=wall(1.0, matte()))


@dr.syntax
def total(light: SheetScene, point: mi.Point3f, turn: mi.UInt32, which: mi.UInt32) -> mi.Float:
    """Irradiance of all triangles that a sample finds."""
    n = dr.width(point)
    way, found_w, last = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), dr.full(mi.UInt32, 0xFFFFFFFF, n)
    looks = dr.full(mi.Bool, True, n)
    while looks:
        ray, step, above = light.ray(point, mi.Normal3f(0, 0, -1), turn, turn, which, way)
        found = light.next(ray, looks)
        looks &= found.is_valid()
        irradiance, _ = light.irradiance(
            found,
            ray.maxt - found.t - above,
            above,
            dr.zeros(mi.UInt32, n),
            mi.Normal3f(0, 0, -1),
            looks & (found.prim_index != last),
        )
        found_w += irradiance
        last, way = found.prim_index, way + found.t + step
    return found_w


@pytest.mark.parametrize("level", [1.0, 0.03, 1e-2, 2e-3])
def test_a_point_gets_the_light_of_all_triangles_that_cover_it(level: float) -> None:
    """Bright ones are all found in every sample, and faint ones in turn."""
    irradiance, is_faint = irradiance_of_level(level, seed=0)
    assert irradiance.mean() == pytest.approx(WAYS * level, rel=2e-3)
    if not is_faint:
        assert (np.abs(irradiance / (WAYS * level) - 1) > 1e-3).mean() < 0.01


def test_the_faintest_triangles_are_drawn_by_lot_and_right_on_average() -> None:
    means = [irradiance_of_level(1e-4, seed)[0].mean() / (WAYS * 1e-4) for seed in range(12)]
    assert np.mean(means) == pytest.approx(1.0, abs=4 * np.std(means) / np.sqrt(12))
    assert 0 < np.std(means) < 0.2


def irradiance_of_level(level: float, seed: int) -> tuple[np.ndarray, bool]:
    """Irradiance of points of the square that triangles of a level light, and whether these are faint."""
    light = SheetScene(sheets_over_a_square(level), PROJECTOR_AT, seed)
    n = 1 << 16
    x, y = np.random.default_rng(0).random((2, n)).astype(np.float32)
    point = mi.Point3f(mi.Float(x - 0.3), mi.Float(y + 0.1), mi.Float(1.0))
    faint = level < FAINT
    turn = mi.UInt32((np.arange(n) % GROUPS * EVERY).astype(np.uint32))
    irradiance = total(light, point, turn, dr.full(mi.UInt32, int(faint), n)).numpy()
    return irradiance / (EVERY if faint else 1), faint


def test_heights_do_not_depend_on_other_triangles() -> None:
    """One triangle more, which a rounding brings, changes no other."""
    all_of_them = sheets_over_a_square(2e-3)
    per_triangle = ("triangles", "flux", "direct", "shape", "key", "lobe")
    some = all_of_them._replace(**{name: getattr(all_of_them, name)[7:] for name in per_triangle})
    scenes = [SheetScene(one, PROJECTOR_AT).scene for one in (all_of_them, some)]
    corners = [mi.traverse(one)["light.vertex_positions"].numpy() for one in scenes]
    assert len(np.unique(corners[0][2::3])) > 0.99 * len(corners[0]) // 9  # a height for each
    np.testing.assert_array_equal(corners[0][63:], corners[1])


@pytest.mark.parametrize("at", [[0.0, 0.0, 0.0], [0.2, 0.6, 0.0], [-5.0, 0.3, 0.9], [0.21, 0.6, 0.8]])
@pytest.mark.parametrize(("level", "is_faint"), [(1.0, False), (2e-3, True)])
def test_light_is_looked_for_wherever_there_is_some(at: list[float], level: float, is_faint: bool) -> None:
    """Directions from any place of the projector, far from the triangles or close to them."""
    light = SheetScene(sheets_over_a_square(level), np.array(at))
    x, y = np.random.default_rng(0).random((2, 1 << 14)).astype(np.float32)
    point = mi.Point3f(mi.Float(x - 0.3), mi.Float(y + 0.1), mi.Float(1.0))
    found = light.may_light(point, mi.Bool(True))
    assert found[is_faint].numpy().all()
    assert not found[not is_faint].numpy().any()
    behind = light.may_light(2 * mi.Point3f(*at) - mi.Vector3f(point), mi.Bool(True))
    assert (behind[0] | behind[1]).numpy().mean() < 0.05
