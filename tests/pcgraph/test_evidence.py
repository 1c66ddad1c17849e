# SPDX-License-Identifier: Apache-2.0
"""What colours and other columns say: nothing if they are noise or a pattern, much if each surface has its own."""

from __future__ import annotations

import numpy as np
import pytest
from checks import same_partition
from scenes.surfaces import SPACING, patch

import pcgraph
from pcgraph.metrics import tree_oracle, undersegmentation_error
from pcgraph.voxels.column_evidence import autocorrelation, color_evidence, crease_contrast
from pcgraph.voxels.grid import voxel_grid
from pcgraph.voxels.warp import Warp

RNG = np.random.default_rng(4)
# Steps of a stair, seen from the front: treads at every height, risers between them, with noise.
TREADS = [patch((0, 0.3 * k, 0.2 * k), (1.2, 0, 0), (0, 0.3, 0)) for k in range(4)]
RISERS = [patch((0, 0.3 * k, 0.2 * (k - 1)), (1.2, 0, 0), (0, 0, 0.2)) for k in range(1, 4)]
STAIR = np.vstack(TREADS + RISERS)
STAIR += RNG.normal(0.0, 0.1 * SPACING, STAIR.shape)
FACE = np.repeat(np.arange(7), [len(part) for part in TREADS + RISERS])
VIEW = (0.6, -4.0, 3.0)
MATS = np.where((FACE < 4) & (abs(STAIR[:, 0] - 0.6) < 0.204), FACE + 7, FACE)  # one lies on each tread, flat
OWN = RNG.uniform(0.2, 0.8, (11, 3))
NOISE = RNG.uniform(0.0, 1.0, STAIR.shape)


def checks(edge):
    """A pattern of cubes of two greys that does not care for the stair."""
    return np.repeat(0.25 + 0.5 * (np.floor(STAIR / edge + 0.37).sum(axis=1, keepdims=True) % 2), 3, axis=1)


def evidence(colors):
    """What these colours of the stair say."""
    surface = pcgraph.segment(STAIR, colors, viewpoint=VIEW).surface
    return color_evidence(surface.grid, surface.normals)


def test_colours_count_as_much_as_they_change_where_surfaces_do():
    assert evidence(OWN[FACE]) > 0.9
    assert evidence(NOISE) < 0.1
    patterns = [evidence(checks(edge)) for edge in (0.03, 0.05, 0.07, 0.11, 0.2)]
    assert np.mean(patterns) < 0.25
    assert max(patterns) < 0.5
    assert evidence(np.full(STAIR.shape, 0.5)) == 0.0
    noise = RNG.normal(0.0, 1.0, STAIR.shape)
    some = [evidence(np.clip(OWN[FACE] + sigma * noise, 0.0, 1.0)) for sigma in (0.0, 0.1, 0.3, 0.9)]
    assert some == sorted(some, reverse=True)
    assert 0.3 < some[1] < 0.9


def test_without_colours_there_is_no_evidence():
    surface = pcgraph.segment(STAIR, viewpoint=VIEW).surface
    assert color_evidence(surface.grid, surface.normals) == 0.0


def test_evidence_has_no_unit_and_no_offset():
    surface = pcgraph.segment(STAIR, OWN[FACE] + 0.2 * NOISE, viewpoint=VIEW).surface
    grid, normals, colors = surface.grid, surface.normals, surface.grid.colors
    found = crease_contrast(colors, grid, normals)
    assert crease_contrast(1e-3 * colors + 7.0, grid, normals) == pytest.approx(found, rel=1e-6)
    assert crease_contrast(np.hstack((colors, colors)), grid, normals) == pytest.approx(found)


def test_without_creases_evidence_is_autocorrelation():
    square = patch((0, 0, 1), (0.8, 0, 0), (0, 0.8, 0))
    grid = voxel_grid(square, 0.03, Warp())
    up, x = np.tile((0.0, 0.0, 1.0), (grid.n_voxels, 1)), grid.centroids[:, :1]
    noise = RNG.standard_normal((grid.n_voxels, 1)) * 3.0 / np.sqrt(grid.counts)[:, None]  # 3 per point
    for column, about in ((np.round(x), 1.0), (noise, 0.0), (noise + x, None)):
        found = crease_contrast(column, grid, up)
        assert found == pytest.approx(autocorrelation(column, grid)[0], abs=0.1)
        assert about is None or found == pytest.approx(about, abs=0.1)
    lone = voxel_grid(np.eye(3), 0.01, Warp())
    assert crease_contrast(np.eye(3), lone, np.eye(3)) == 0.0


def test_noise_in_colours_does_no_harm_and_colours_that_tell_help():
    def scores(colors, truth):
        result = pcgraph.segment(STAIR, colors, viewpoint=VIEW)
        best = tree_oracle(result.tree, result.supervoxels, truth)
        return best, undersegmentation_error(result.supervoxels, truth)

    (blind, blind_error), (noisy, noisy_error) = scores(None, FACE), scores(NOISE, FACE)
    assert noisy > blind - 0.005
    assert noisy_error < blind_error + 0.002
    (blind, blind_error), (seeing, error) = scores(None, MATS), scores(OWN[MATS], MATS)
    assert seeing > blind + 0.1
    assert error < blind_error


def test_two_colours_part_a_plane_and_one_does_not():
    square = patch((0, 0, 1), (0.8, 0, 0), (0, 0.8, 0))
    half = square[:, 0] > 0.4133
    options = {"voxel_size": 2 * SPACING, "seed_size": 0.12, "viewpoint": (0.4, 0.4, -1.0)}
    painted = pcgraph.segment(square, np.where(half[:, None], 0.7, 0.3) * np.ones(3), **options)
    assert undersegmentation_error(painted.supervoxels, half.astype(int)) == 0.0
    plain, grey = pcgraph.segment(square, **options), pcgraph.segment(square, np.full(square.shape, 0.5), **options)
    assert same_partition(plain.supervoxels, grey.supervoxels)
    assert np.array_equal(plain.tree.altitudes, grey.tree.altitudes)


def test_autocorrelation_of_noise_and_of_fields():
    grid = voxel_grid(patch((0, 0, 1), (0.8, 0, 0), (0, 0.8, 0)), 0.011, Warp())
    x = grid.centroids[:, 0]
    noise = np.random.default_rng(0).standard_normal(grid.n_voxels)
    columns = np.stack((noise, x, np.round(x), np.zeros_like(x), x + noise * x.std()), axis=1)
    found = autocorrelation(columns, grid)
    assert found == pytest.approx([0.0, 1.0, 1.0, 0.0, 0.5], abs=0.05)
    lone = voxel_grid(np.eye(3), 0.01, Warp())
    assert autocorrelation(np.eye(3), lone).tolist() == [0, 0, 0]
