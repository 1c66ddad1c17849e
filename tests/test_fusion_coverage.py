# SPDX-License-Identifier: Apache-2.0
"""What range images saw of solids, in closed form: the near side of a ball, its inside, what is looked through."""

from __future__ import annotations

import numpy as np
import pytest
from fusion_scenes import CAMERA, ball, block, range_image, sphere_depth

from rangesim.fusion import Solid, Space, VoxelGrid, known_space, scan_coverage
from rangesim.rig import Intrinsics, look_at

CENTRE, RADIUS = (0.0, 0.0, 0.0), 0.05
BALL = Solid("ball", ball(RADIUS), 20.0)
CAVITY = Solid("cavity", ball(0.03), 0.0)
GRID = VoxelGrid.around(BALL.mesh.vertices, 0.002, 0.01)


def view(origin, far=False, camera=CAMERA):
    """Depth of the ball from a place, and of a wall behind it; of the wall alone where the ball does not show."""
    T = look_at(origin, CENTRE)
    z = sphere_depth(camera, T, CENTRE, RADIUS)
    return range_image(np.full_like(z, 1.0) if far else np.where(np.isfinite(z), z, 1.0), T, camera)


def test_one_view_sees_the_cap_of_a_ball_that_the_tangents_enclose():
    """Of the area of a ball a place at the distance d sees the fraction (1 - r / d) / 2."""
    distance, camera = 0.3, Intrinsics.from_fov(400, 400, 20.0)
    found = scan_coverage([view((0.0, -distance, 0.0), camera=camera)], [BALL], GRID, tolerance_m=0.001)
    assert found.surface_seen == pytest.approx((1 - RADIUS / distance) / 2, abs=0.01)
    assert found.surface_of == {"ball": found.surface_seen}
    assert found.volume_surface + found.volume_free + found.volume_unseen == pytest.approx(1)


def test_what_lies_inside_is_never_seen():
    """From all around the skin is known, a voxel deep, and nothing else."""
    around = [(0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0), (0, -0.3, 0), (0, 0.05, 0.3), (0, 0.05, -0.3)]
    found = scan_coverage([view(o) for o in around], [BALL, CAVITY], GRID, tolerance_m=0.004)
    assert found.surface_of["ball"] > 0.99
    assert found.surface_of["cavity"] == 0
    areas = RADIUS**2, 0.03**2
    assert found.surface_seen == pytest.approx(found.surface_of["ball"] * areas[0] / sum(areas), rel=1e-3)
    shell = (RADIUS**3 - (RADIUS - GRID.voxel_m) ** 3) / (RADIUS**3 - 0.03**3)
    assert found.volume_surface == pytest.approx(shell, rel=0.35)  # the band is along the axis, deeper at a slant
    assert found.volume_free < 0.02
    assert found.space[tuple(n // 2 for n in GRID.shape)] == Space.UNSEEN


def test_matter_that_is_looked_through_is_called_free():
    found = scan_coverage([view((0.0, -0.3, 0.0), far=True)], [BALL], GRID)
    assert found.volume_free == 1
    assert found.surface_seen == 0


def test_the_side_of_a_plane_that_each_voxel_lies_on():
    wall = range_image(np.full((CAMERA.height, CAMERA.width), 0.5))
    grid = VoxelGrid((1, 1, 10), 0.02, (-0.01, -0.01, 0.4))  # centres at z = 0.41, 0.43, ...
    states = known_space([wall], grid, band_m=0.025)[0, 0]
    assert states.tolist() == [1, 1, 1, 1, 2, 2, 0, 0, 0, 0]
    assert known_space([wall], grid, band_m=0.045)[0, 0].tolist() == [1, 1, 1, 2, 2, 2, 2, 0, 0, 0]


def test_views_decide_by_majority():
    """A ghost of one view in front of the wall is outvoted by two that look through it."""
    grid = VoxelGrid((1, 1, 1), 0.02, (-0.01, -0.01, 0.3))
    size = (CAMERA.height, CAMERA.width)
    ghost, wall = range_image(np.full(size, 0.31)), range_image(np.full(size, 0.5))
    assert known_space([ghost], grid)[0, 0, 0] == Space.SURFACE
    assert known_space([ghost, wall], grid)[0, 0, 0] == Space.SURFACE
    assert known_space([ghost, wall, wall], grid)[0, 0, 0] == Space.FREE
    nothing = range_image(np.full(size, np.nan))
    assert known_space([nothing], grid)[0, 0, 0] == Space.UNSEEN
    assert scan_coverage([nothing], [BALL], GRID).surface_seen == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: known_space([], GRID), "at least one"),
        (lambda: known_space([view((0, -0.3, 0))], GRID, band_m=0), "band_m"),
        (lambda: scan_coverage([view((0, -0.3, 0))], [BALL], GRID, tolerance_m=-1.0), "tolerance_m"),
        (lambda: scan_coverage([view((0, -0.3, 0))], [], GRID), "at least one"),
        (lambda: scan_coverage([view((0, -0.3, 0))], [BALL], VoxelGrid((2, 2, 2), 0.01, (5, 5, 5))), "no centre"),
        (lambda: scan_coverage([view((0, -0.3, 0))], [CAVITY], GRID), "no centre"),
        (lambda: scan_coverage([view((0, -0.3, 0))], [BALL, Solid("b", block((0.1, 0.01, 0.01)), 1)], GRID), "crosses"),
    ],
)
def test_what_cannot_be_counted_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
