# SPDX-License-Identifier: Apache-2.0
"""Terrain: the ground as it is seen from far above, in pieces that what stands on it parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.bounding_planes import HIDDEN, Plane, borders_of, facing_ways, joining
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.surface import Surface

_UPWARDS, _MOSTLY = 0.5, 0.93  # cosine between a normal and their mean, and of so many at least; and
_STEEP, _HARDLY = 0.3, 0.05  # of what is across that, hardly any is seen from far above
_LEAST_VOXELS = 20  # of a piece, some supervoxel
_COLUMN, _BESIDE, _REACH = 1.5, 8, 4  # voxel edges; columns beside one, and how many of them away at most
_STEP = 2.5  # voxel edges by which one lies below another
_UPWARD_STEPS = 10  # at the border of the ground, at least;
_DOWNWARDS = 0.1  # and of all there, at most, lead downwards
_LEVEL = 0.7  # cosine between its normals and upwards, on average
_LEVELS = 0.35  # times as far as what stands between rises above both may one lie above the other
_NEAR = 8  # supervoxels beside a way that are looked at


def terrain(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32]) -> Continuations:
    """Supervoxels on the borders that pieces of the ground turn to each other, under what stands between.

    From far above, as from an aircraft, roofs are seen, and streets, but no walls: the ground of a courtyard touches
    nothing, and may lie lower than the street. A face is ground if it is about level, and from its border it goes up
    and hardly ever down. Two pieces are one if they touch, as at a bank; or if on at least half of the ways between
    their borders something stands that rises above the higher of them by some three times as much as that lies above
    the other. As with bounding planes, between them lies at most three quarters of the width of the larger one.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Which of them lie on one face.

    Returns
    -------
    Continuations
        None coplanar; some may touch. There are none unless nearly all normals point to one side, from which no single
        scanner took the cloud: then what is hidden is known from its place.
    """
    upwards = _seen_from_far_above(surface)
    ground = np.zeros(int(faces.max()) + 1, np.bool_) if upwards is None else _ground(surface, faces, upwards)
    if upwards is None or np.count_nonzero(ground) < 2:
        return continuations_of(surface, nodes, np.empty((0, 2), np.int64))
    of_supervoxel = np.where(ground, np.cumsum(ground) - 1, -1)[faces]
    touching = surface.grid.touching_pairs()
    sides = of_supervoxel[surface.supervoxels[touching]]
    touching = touching[(sides >= 0).all(axis=1) & (sides[:, 0] < sides[:, 1])]
    border = borders_of(surface, of_supervoxel, [np.arange(np.count_nonzero(ground))])[0]
    places, plane = surface.grid.centroids[border], Plane(surface.grid.centroids[0], upwards, plane_basis(upwards))
    ways = facing_ways(places, plane.feet(places) / surface.grid.size, of_supervoxel[surface.supervoxels[border]])
    ends = plane.heights(places)[ways.ends]
    others, edge = nodes.centroid[of_supervoxel < 0], surface.grid.size
    hidden = np.zeros(len(ways.ends), np.bool_)
    if len(others):
        some = np.arange(1, min(_NEAR, len(others)) + 1)
        distance, near = cKDTree(plane.feet(others)).query(plane.feet(places[ways.ends].mean(axis=1)), k=some)
        over = distance <= np.maximum(0.5 * ways.lengths, _STEP * edge)[:, None]
        rise = plane.heights(others)[near] - ends.max(axis=1)[:, None]
        hidden = (over & (rise > _STEP * edge) & (np.ptp(ends, axis=1)[:, None] < _LEVELS * rise)).any(axis=1)
    n_ways, n_hidden = (np.bincount(ways.pair, counts, len(ways.pairs)) for counts in (None, hidden))
    areas = np.bincount(of_supervoxel[surface.supervoxels] + 1, np.square(surface.grid.edge_lengths))[1:]
    joins = joining(ways, n_hidden >= HIDDEN * n_ways, areas.astype(np.float64))
    found = continuations_of(surface, nodes, np.concatenate((touching, border[ways.ends[joins[ways.pair]]])))
    return replace(found, coplanar=np.zeros(len(found.pairs), np.bool_))


def _seen_from_far_above(surface: Surface) -> NDArray[np.float64] | None:
    """The direction from which all was seen, (3,) of length 1; None if it was not from far off on one side."""
    mean = surface.normals.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if surface.grid.warp.of_one_scan or not length > _UPWARDS:
        return None
    cosines = np.einsum("ij,j->i", surface.normals, mean / length)
    is_above = np.mean(cosines > _UPWARDS) >= _MOSTLY and np.mean(np.abs(cosines) < _STEEP) <= _HARDLY
    return mean / length if is_above else None


def _ground(surface: Surface, faces: NDArray[np.int32], upwards: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which faces are ground, (f,) bool: of the steps between the tops of columns beside each other, hardly any lead
    down from one of theirs."""
    edge, face = surface.grid.size, faces[surface.supervoxels]
    n_faces = int(faces.max()) + 1
    plane = Plane(surface.grid.centroids[0], upwards, plane_basis(upwards))
    heights, feet = plane.heights(surface.grid.centroids), plane.feet(surface.grid.centroids)
    columns, of_column = np.unique(np.floor(feet / (_COLUMN * edge)), axis=0, return_inverse=True)
    order = np.lexsort((heights, of_column))
    tops = order[np.flatnonzero(np.diff(of_column[order], append=-1))]
    _, beside = cKDTree(columns).query(columns, np.arange(2, _BESIDE + 2), distance_upper_bound=_REACH + 0.01)
    one, way = np.nonzero(beside < len(columns))
    above, below = tops[one], tops[beside[one, way]]
    steps = (heights[above] - heights[below] > _STEP * edge) & (face[above] != face[below])
    down, up = (np.bincount(face[ends[steps]], minlength=n_faces) for ends in (above, below))
    voxels = np.bincount(face, minlength=n_faces)
    is_level = np.bincount(face, np.einsum("ij,j->i", surface.normals, upwards), n_faces) >= _LEVEL * voxels
    is_lowest = (up >= _UPWARD_STEPS) & (down <= _DOWNWARDS * (down + up))
    return np.asarray(is_level & is_lowest & (voxels >= _LEAST_VOXELS))
