# SPDX-License-Identifier: Apache-2.0
"""Joining coplanar regions and absorbing loose supervoxels, against the plainest way to write them."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from pcgraph.detection.coplanar import join_planes
from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.loose import absorb
from pcgraph.detection.regions import plane_normals
from pcgraph.features.moments import grouped_moments, moments_of_groups

ANGLE = np.radians(15.0)
TOLERANCE = 0.01


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
    return FlatLeaves(
        moments, plane_normals(moments), tolerances, free, float(np.cos(ANGLE)), edges, np.ones(len(edges), bool)
    )


def misfit(leaves, first, second):
    """Of two sets of supervoxels to their common plane, in tolerances."""
    both = np.concatenate((first, second))
    joint = grouped_moments(leaves.moments[both], np.zeros(len(both), int), 1)
    normal, worst = plane_normals(joint)[0], 0.0
    for part in (first, second):
        own = grouped_moments(leaves.moments[part], np.zeros(len(part), int), 1)
        if abs(plane_normals(own)[0] @ normal) < leaves.cos_angle:
            return np.inf
        square = ((own.centroids[0] - joint.centroids[0]) @ normal) ** 2 + normal @ own.covariances[0] @ normal
        weights = leaves.moments.counts[part]
        worst = max(worst, np.sqrt(square / np.average(leaves.tolerances[part] ** 2, weights=weights)))
    return worst


def touch(leaves, first, second):
    a, b = leaves.edges.T
    return bool((np.isin(a, first) & np.isin(b, second) | np.isin(b, first) & np.isin(a, second)).any())


@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_fitting_pair_joins_first(apart, seed):
    leaves = scattered_patches(24, 3, seed)
    sets = [np.array([i]) for i in range(24)]
    while True:
        pairs = [(i, j) for i in range(len(sets)) for j in range(i + 1, len(sets))]
        allowed = [(i, j) for i, j in pairs if apart or touch(leaves, sets[i], sets[j])]
        fits = [misfit(leaves, sets[i], sets[j]) for i, j in allowed]
        if not fits or min(fits) > 1.0:
            break
        i, j = allowed[int(np.argmin(fits))]
        sets[i] = np.concatenate((sets[i], sets.pop(j)))
    assert 3 <= len(sets) < 24
    expected = np.empty(24, np.int32)
    for number, members in enumerate(sets):
        expected[members] = number
    assert np.array_equal(join_planes(leaves, np.arange(24, dtype=np.int32), apart), expected)


@pytest.mark.parametrize("apart", [True, False])
def test_loose_supervoxels_go_where_they_lie_best(apart):
    leaves = scattered_patches(200, 3, 0)
    regions = join_planes(leaves, np.arange(200, dtype=np.int32), True)
    large = np.flatnonzero(np.bincount(regions) > 20)
    kept = np.where(np.isin(regions, large) & (np.arange(200) % 2 == 0), np.searchsorted(large, regions), -1)
    found = absorb(leaves, kept.astype(np.int32), apart)
    gained = 0
    for leaf in np.flatnonzero(kept < 0):
        best, least = -1, 1.0
        for plane in range(len(large)):
            members = np.flatnonzero(kept == plane)
            own = grouped_moments(leaves.moments[members], np.zeros(len(members), int), 1)
            normal = plane_normals(own)[0]
            square = ((leaves.moments.centroids[leaf] - own.centroids[0]) @ normal) ** 2
            square += normal @ leaves.moments.covariances[leaf] @ normal
            near = apart or touch(leaves, [leaf], members)
            if near and abs(leaves.normals[leaf] @ normal) >= leaves.cos_angle:
                best, least = min((best, least), (plane, np.sqrt(square) / leaves.tolerances[leaf]), key=lambda x: x[1])
        assert found[leaf] == best
        gained += best >= 0
    assert gained > 20
    assert np.array_equal(found[kept >= 0], kept[kept >= 0])


def test_thousands_of_pieces_need_no_table_of_pairs():
    n = 3000
    leaves = scattered_patches(n, n, 0, reach=10.0)  # hardly any two in one plane
    join_planes(leaves, np.append([0, 1], np.full(n - 2, -1)).astype(np.int32), True)  # compiled
    tracemalloc.start()
    joined = join_planes(leaves, np.arange(n, dtype=np.int32), True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert joined.max() < n - 1
    assert peak < 8 * n * n / 3  # bytes; the table has 8 n^2
