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
from rangesim.light_transport.sheet_scene import SheetScene

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
    return Sheets(*columns, triangles, flux, *np.zeros((1, len(triangles)), np.uint32), key, 0 * key, 0.0, 1.0)


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


@pytest.mark.parametrize("level", [1.0, 1e-2, 2e-3])
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
    light = SheetScene(sheets_over_a_square(level), PROJECTOR_AT, 1.0, samples=32, seed=seed)
    n, period = 1 << 16, int(light.groups[0]) * int(light.every[0])
    x, y = np.random.default_rng(0).random((2, n)).astype(np.float32)
    point = mi.Point3f(mi.Float(x - 0.3), mi.Float(y + 0.1), mi.Float(1.0))
    faint = level < 0.02
    turn = mi.UInt32((np.arange(n) % (period // int(light.every[0])) * int(light.every[0])).astype(np.uint32))
    irradiance = total(light, point, turn, dr.full(mi.UInt32, int(faint), n)).numpy() / (
        int(light.every[0]) if faint else 1
    )
    return irradiance, faint


def test_points_outside_the_lit_part_get_no_light_of_its_copies() -> None:
    """Copies for groups of faint triangles lie side by side, in the plane of the square as well."""
    light = SheetScene(sheets_over_a_square(2e-3), PROJECTOR_AT, 1.0, samples=32)
    x, y = (mi.Float(c.ravel()) for c in np.meshgrid(*[np.linspace(-9, 9, 181, dtype=np.float32)] * 2))
    point, n = mi.Point3f(x, y, mi.Float(1.0)), 181**2
    looks = light.may_light(point, dr.zeros(mi.UInt32, n), mi.Bool(True)).numpy()
    found = [total(light, point, dr.zeros(mi.UInt32, n), dr.full(mi.UInt32, which, n)).numpy() > 0 for which in (0, 1)]
    on_square = (np.abs(x.numpy() - 0.2) < 0.51) & (np.abs(y.numpy() - 0.6) < 0.51)
    assert (found[1] & ~on_square).any()
    assert looks[on_square & found[1]].all()
    assert not looks[~on_square].any()


def test_heights_do_not_depend_on_other_triangles() -> None:
    """One triangle more, which a rounding brings, changes no other."""
    all_of_them = sheets_over_a_square(2e-3)
    of_triangles = ("triangles", "flux", "shape", "key", "lobe")
    some = all_of_them._replace(**{name: getattr(all_of_them, name)[7:] for name in of_triangles})
    scenes = [SheetScene(one, PROJECTOR_AT, 1.0, 32).scene for one in (all_of_them, some)]
    corners = [mi.traverse(one)["light.vertex_positions"].numpy() for one in scenes]
    assert len(np.unique(corners[0][2::3])) > 0.99 * len(corners[0]) // 9  # a height for each
    np.testing.assert_array_equal(corners[0][63:], corners[1])
