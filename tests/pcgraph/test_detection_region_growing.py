# SPDX-License-Identifier: Apache-2.0
"""Regions of supervoxels in one plane: their moments, turning angles, joining and the unassigned, written plainly."""

from __future__ import annotations

from functools import cache
from resource import RUSAGE_SELF, getrusage

import numpy as np
import pytest

from pcgraph.detection.region_growing import (
    JOINING,
    PlanarPatches,
    assign_unassigned,
    join_coplanar,
    moments_of_regions,
    plane_normals,
    turning_angles,
)
from pcgraph.features.moments import Moments, grouped_moments, moments_of_groups

ANGLE = np.radians(15.0)
TOLERANCE = 0.01 / JOINING  # so that regions join within 0.01


def scattered_patches(n, planes, seed, reach=0.1):
    """Flat supervoxels at random places of planes within a reach of the origin, a little off; neighbours at random."""
    rng = np.random.default_rng(seed)
    normals = np.linalg.qr(rng.normal(size=(planes, 3, 3)))[0]
    which = rng.integers(0, planes, n)
    local = rng.uniform(-0.05, 0.05, (n, 20, 3)) * [1, 1, 0.05]
    local += np.concatenate((rng.uniform(-0.5, 0.5, (n, 2)), rng.normal(0, 0.006, (n, 1))), axis=1)[:, None]
    local[..., 2] += rng.uniform(-reach, reach, planes)[which][:, None]
    points = np.einsum("nqa,nab->nqb", local, normals[which]).reshape(-1, 3)
    moments = moments_of_groups(points, None, np.repeat(np.arange(n, dtype=np.int32), 20), n)
    edges = np.unique(np.sort(rng.integers(0, n, (3 * n, 2)), axis=1), axis=0).astype(np.int32)
    edges = edges[edges[:, 0] != edges[:, 1]]
    free = np.zeros(n, bool)
    tolerances = np.full(n, TOLERANCE) * rng.uniform(0.8, 1.2, n)
    return PlanarPatches(
        moments, plane_normals(moments), tolerances, free, float(np.cos(ANGLE)), edges, np.ones(len(edges), bool)
    )


def misfit(patches, first, second):
    """Distance of two sets of supervoxels to their common plane, in tolerances, which hold their own noise."""
    first, second = np.array(first), np.array(second)
    both = np.concatenate((first, second))
    joint = grouped_moments(patches.moments[both], np.zeros(len(both), int), 1)
    normal, worst = plane_normals(joint)[0], 0.0
    for part in (first, second):
        own = grouped_moments(patches.moments[part], np.zeros(len(part), int), 1)
        if abs(plane_normals(own)[0] @ normal) < patches.cos_angle:
            return np.inf
        square = ((own.centroids[0] - joint.centroids[0]) @ normal) ** 2 + normal @ own.covariances[0] @ normal
        noise = np.linalg.eigvalsh(patches.moments.covariances[part])[:, 0]
        allowed = np.square(JOINING * patches.tolerances[part]) + noise
        worst = max(worst, np.sqrt(square / np.average(allowed, weights=patches.moments.counts[part])))
    return worst


def touch(patches, first, second):
    a, b = patches.edges.T
    return bool((np.isin(a, first) & np.isin(b, second) | np.isin(b, first) & np.isin(a, second)).any())


@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_fitting_pair_joins_first(apart, seed):
    patches = scattered_patches(24, 3, seed)
    sets = [(i,) for i in range(24)]

    @cache
    def fit(first, second):
        return misfit(patches, first, second) if apart or touch(patches, first, second) else np.inf

    while True:
        pairs = [(i, j) for i in range(len(sets)) for j in range(i + 1, len(sets))]
        fits = [fit(sets[i], sets[j]) for i, j in pairs]
        if not fits or min(fits) > 1.0:
            break
        i, j = pairs[int(np.argmin(fits))]
        sets[i] += sets.pop(j)
    assert 3 <= len(sets) < 24
    expected = np.empty(24, np.int32)
    for number, members in enumerate(sets):
        expected[list(members)] = number
    assert np.array_equal(join_coplanar(patches, np.arange(24, dtype=np.int32), apart), expected)


@pytest.mark.parametrize("apart", [True, False])
def test_unassigned_supervoxels_go_where_they_lie_best(apart):
    patches = scattered_patches(200, 3, 0)
    regions = join_coplanar(patches, np.arange(200, dtype=np.int32), True)
    large = np.flatnonzero(np.bincount(regions) > 20)
    kept = np.where(np.isin(regions, large) & (np.arange(200) % 2 == 0), np.searchsorted(large, regions), -1)
    found = assign_unassigned(patches, kept.astype(np.int32), apart)
    gained = 0
    for leaf in np.flatnonzero(kept < 0):
        best, least = -1, 1.0
        for plane in range(len(large)):
            members = np.flatnonzero(kept == plane)
            own = grouped_moments(patches.moments[members], np.zeros(len(members), int), 1)
            normal = plane_normals(own)[0]
            square = ((patches.moments.centroids[leaf] - own.centroids[0]) @ normal) ** 2
            square += normal @ patches.moments.covariances[leaf] @ normal
            near = apart or touch(patches, [leaf], members)
            if near and abs(patches.normals[leaf] @ normal) >= patches.cos_angle:
                best, least = min(
                    (best, least), (plane, np.sqrt(square) / patches.tolerances[leaf]), key=lambda x: x[1]
                )
        assert found[leaf] == best
        gained += best >= 0
    assert gained > 20
    assert np.array_equal(found[kept >= 0], kept[kept >= 0])


def test_thousands_of_regions_need_no_table_of_pairs():
    n = 6_000
    patches = scattered_patches(n, n, 0, reach=10.0)  # hardly any two in one plane
    before = getrusage(RUSAGE_SELF).ru_maxrss
    joined = join_coplanar(patches, np.arange(n, dtype=np.int32), True)
    assert joined.max() < n - 1
    assert 1024 * (getrusage(RUSAGE_SELF).ru_maxrss - before) < 8 * n * n / 3  # the table has 8 n^2 bytes


def test_moments_of_regions_are_those_of_their_points():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) + np.array([1e4, 0, 0])
    leaf = rng.integers(0, 20, 500).astype(np.int32)
    regions = np.array([0, 1, -1, 2] * 5, np.int32)
    pooled = moments_of_regions(moments_of_groups(points, None, leaf, 20), regions, 3)
    for r in range(3):
        mine = points[regions[leaf] == r]
        assert pooled.counts[r] == len(mine)
        assert pooled.centroids[r] == pytest.approx(mine.mean(axis=0))
        assert pooled.covariances[r] == pytest.approx(np.cov(mine.T, bias=True), abs=1e-9)
    none = moments_of_regions(Moments(np.ones(1, int), np.ones((1, 3)), np.zeros((1, 3, 3)), None), np.array([-1]), 0)
    assert len(none) == 0


@pytest.mark.parametrize(("shows", "turn"), [(True, 0.05), (False, 0.0)])
def test_a_turn_that_distances_do_not_show_is_noise_of_the_normals(shows, turn):
    radius, reach = 2.0, 0.2
    place = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 2), axis=-1).reshape(-1, 2)
    place = reach * place[np.linalg.norm(place, axis=1) <= 1]
    height = -(place**2).sum(axis=1) / (2 * radius) if shows else np.zeros(len(place))
    n = len(place)
    moments = moments_of_groups(np.column_stack((place, height)), None, np.arange(n, dtype=np.int32), n)
    normals = np.column_stack((place / radius, np.ones(n)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    free = np.zeros(n, bool)
    patches = PlanarPatches(moments, normals, np.ones(n), free, 0.0, np.empty((0, 2), np.int32), np.empty(0, bool))
    assert turning_angles(patches, np.zeros(n, np.int32))[0] == pytest.approx(turn, rel=0.05)


def test_no_region_has_no_turning_angle():
    patches = scattered_patches(5, 1, 0)
    assert turning_angles(patches, np.full(5, -1, np.int32)).shape == (0,)
