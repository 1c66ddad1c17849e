# SPDX-License-Identifier: Apache-2.0
"""The rings of a turning scanner tell where it stood."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.rooms import furniture, furniture_in_rings
from scenes.streets import ground_and_wall, ground_before_a_ramp, height_before_a_ramp
from scenes.surfaces import random_turn
from scenes.tables import image_of_a_table
from scipy.optimize import approx_fprime
from tiers import draws

import pcgraph
from pcgraph.acquisition.rings import _slopes, scanner_of_rings
from pcgraph.acquisition.spacing_law import law_on_rings, spacing_law
from pcgraph.voxels.spacing import Rows, spacing_and_rows

NOWHERE = np.zeros((1, 3))


def tangents_of_rings(seed, noise=0.0):
    """Rows of 300 points on the cones of a scanner at (1, 2, 3) that turned about z, each along any surface at all."""
    rng = np.random.default_rng(seed)
    azimuths, elevations, ranges = rng.uniform((-np.pi, -0.4, 2.0), (np.pi, 0.4, 9.0), (300, 3)).T
    rays = np.stack(
        (np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations)), axis=1
    )
    level = np.stack((-np.sin(azimuths), np.cos(azimuths), np.zeros(300)), axis=1)
    along = level + rng.normal(0.0, 1.0, (300, 1)) * rays + rng.normal(0.0, noise, (300, 3))
    return Rows(np.array([1.0, 2.0, 3.0]) + ranges[:, None] * rays, along / np.linalg.norm(along, axis=1)[:, None])


def test_rings_do_not_slope_against_the_cones_of_their_scanner():
    rows = tangents_of_rings(0)
    slopes = _slopes(rows, np.eye(3)[:, ::-1], np.array([1.0, 2.0, 3.0, 0.0, 0.0]))[0]
    assert np.abs(slopes).max() < 1e-12


def test_derivatives_of_slopes():
    rng = np.random.default_rng(0)
    rows, frame = tangents_of_rings(0, 0.3), random_turn(0)
    for unknown in rng.normal(0.0, 0.3, (5, 5)):
        numbers = approx_fprime(unknown, lambda other: _slopes(rows, frame, other)[0], 1e-7)
        assert _slopes(rows, frame, unknown)[1] == pytest.approx(numbers, abs=3e-5)


@pytest.mark.parametrize("seed", draws(8))
def test_rings_tell_place_and_axis(seed):
    """However the scanner is tilted, in any unit, and with an eighth of the rows across its rings."""
    rows, turn, unit = tangents_of_rings(seed, 0.003), random_turn(seed), 10.0 ** (20 * seed - 80)
    across = np.random.default_rng(seed).normal(0.0, 1.0, (37, 3))
    directions = rows.directions.copy()
    directions[:37] = across / np.linalg.norm(across, axis=1)[:, None]
    mixed = np.random.default_rng(seed).permutation(300)
    scanner = scanner_of_rings(Rows(unit * (rows.points @ turn.T)[mixed], (directions @ turn.T)[mixed]), NOWHERE)
    assert scanner is not None
    assert scanner.place / unit == pytest.approx(turn @ (1.0, 2.0, 3.0), abs=0.03)
    assert abs(scanner.axis @ turn[:, 2]) == pytest.approx(1.0, abs=1e-5)


def test_what_is_on_no_scanners_rings_tells_nothing():
    rng = np.random.default_rng(0)
    rows = tangents_of_rings(0)
    directions = rng.normal(0.0, 1.0, (300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert scanner_of_rings(rows._replace(directions=directions), NOWHERE) is None
    parallel = np.tile((1.0, 0.0, 0.0), (300, 1))  # wires, or rows of an image: any place along them will do
    assert scanner_of_rings(rows._replace(directions=parallel), NOWHERE) is None
    level = np.column_stack((directions[:, :2], np.zeros(300)))  # any place far above
    level /= np.linalg.norm(level, axis=1)[:, None]
    assert scanner_of_rings(rows._replace(directions=level), NOWHERE) is None
    assert scanner_of_rings(Rows(rows.points[:39], rows.directions[:39]), NOWHERE) is None
    assert scanner_of_rings(Rows(np.full((300, 3), 5.0), directions), NOWHERE) is None
    assert scanner_of_rings(Rows(*np.empty((2, 0, 3))), NOWHERE) is None


@pytest.mark.parametrize("seed", draws(8))
def test_a_scanner_of_few_beams_is_found(seed):
    """Spacing alone puts it off by half the median range."""
    turn = random_turn(seed)
    points, place = furniture_in_rings(seed, 16 if seed % 2 else 32)
    moved = points @ turn.T + 100.0
    result = pcgraph.segment(moved)
    assert np.linalg.norm(result.viewpoint - 100.0 - turn @ place) < 0.02  # m
    rays = 100.0 + turn @ place - result.surface.grid.centroids
    cosines = np.einsum("ij,ij->i", rays, result.surface.normals) / np.linalg.norm(rays, axis=1)
    assert cosines[np.abs(cosines) > 0.1].min() > 0.0


def test_the_law_says_that_it_was_told_by_rings():
    points, place = furniture_in_rings(0, 16)
    _, rows = spacing_and_rows(points)
    law = law_on_rings(points, spacing_law(points), rows)
    assert law.holds
    assert law.viewpoint == pytest.approx(place, abs=0.02)
    assert abs(law.axis[2]) == pytest.approx(1.0, abs=1e-4)


def test_other_scans_are_left_to_their_spacing():
    """Images have rows, too, and a scanner with as many rows as columns has none."""
    for points in (image_of_a_table(0), furniture(0).points, ground_and_wall()):
        law = spacing_law(points)
        assert law_on_rings(points, law, spacing_and_rows(points)[1]) is law


def test_rows_are_free_of_order():
    points, _ = furniture_in_rings(0, 16)
    one, other = (spacing_and_rows(np.random.default_rng(seed).permutation(points)) for seed in (1, 2))
    assert one[0] == other[0]
    assert one[1].points.tobytes() == other[1].points.tobytes()
    assert len(one[1].points) > 400


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize(
    ("beams", "tilt", "slope"),
    [
        (np.linspace(-24.9, 2.0, 64), 0.0, 0.0),
        (np.linspace(-24.9, 2.0, 64), 0.0, 0.08),
        (np.linspace(-15.0, 15.0, 16), 15.0, 0.0),
        (np.linspace(-15.0, 15.0, 16), 0.0, 0.12),
    ],
)
def test_the_ground_is_seen_from_above(beams, tilt, slope, given):
    """Far off, rays meet it at two degrees, of which noise of the normals takes a good part; it may rise above the
    scanner, and that may be tilted."""
    points, place = ground_before_a_ramp(0, beams, tilt, slope)
    turn, shift = random_turn(1), np.array([7.0, -4.0, 30.0])
    result = pcgraph.segment(points @ turn.T + shift, viewpoint=turn @ place + shift if given else None)
    assert np.linalg.norm(result.viewpoint - shift - turn @ place) < 0.05  # m
    where = (result.surface.grid.centroids - shift) @ turn
    upwards = (result.surface.normals @ turn)[:, 2]
    on_ground = (np.abs(where[:, 2] - height_before_a_ramp(where[:, 0], slope)) < 0.25) & (np.abs(where[:, 1]) < 14.5)
    assert (upwards[on_ground & (np.abs(upwards) > 0.9)] > 0.0).mean() > 0.98


def test_circles_about_an_axis_are_no_rings():
    """Of a cone, a bowl or a disc in rings: any place on the axis would do."""
    angles, radii = np.arange(500) * 2.0 * np.pi / 500, np.geomspace(0.02, 1.0, 60)
    circle = np.stack((np.cos(angles), np.sin(angles), np.zeros(500)), axis=1)
    for heights in (2.0 - 2.0 * radii, -np.sqrt(1.0 - radii**2), 0.3 * radii, 0.0 * radii):
        rings = radii[:, None, None] * circle + heights[:, None, None] * (0.0, 0.0, 1.0)
        points = rings.reshape(-1, 3) @ random_turn(0).T + 2.0
        assert law_on_rings(points, spacing_law(points), spacing_and_rows(points)[1]).axis is None
