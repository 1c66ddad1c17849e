# SPDX-License-Identifier: Apache-2.0
"""Terrain: the ground as it is seen from far above, in pieces that what stands on it parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.kinds import Acquisition
from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.bounding_planes import MIN_HIDDEN, Plane, borders_of, facing_ways, joining
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.grid import voxel_grid
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.warp import Warp

_SOME = 20_000  # voxels that are asked whether all was seen from far above:
_LEVEL, _MOSTLY = 0.5, 0.93  # cosine of normals to one axis, and of so many at least; and
_STEEP, _HARDLY = 0.3, 0.05  # of what is across that, hardly any is seen from far above
_MIN_VOXELS = 20  # of a piece, some supervoxel,
_ON_AVERAGE = 0.7  # whose normals have such a cosine to that axis
_COLUMN = 1.5  # voxel edges: of columns that are compared with those beside them
_STEP = 2.0  # voxel edges by which one lies below another, at least
_UPWARD_STEPS = 5  # at the border of the ground, at least;
_DOWNWARDS = 0.1  # and of all there, at most, lead downwards
_THINNED = 3.0  # voxel edges: of cells that have one place on the border of each piece
_WIDE, _HIGH = 6.0, 2.5  # voxel edges, at least, is what stands between two pieces,
_LEVELS = 0.25  # and so many times as far as it rises above both may one lie above the other
_NEAR = 8  # supervoxels beside a way that are looked at


def terrain(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32], acquisition: Acquisition) -> Continuations:
    """Supervoxels on the borders that pieces of the ground turn to each other, under what stands between.

    From far above, as from an aircraft, roofs are seen, and streets, but no walls: the ground of a courtyard touches
    nothing, and may lie lower than the street. A face is ground if it is about level, and from its border it goes up
    and hardly ever down; and so does the largest face of all, else the cloud stands on its head, or is a plateau. Two
    pieces are one if they touch, as at a bank; or if on at least half of the ways between their borders something
    stands that rises above the higher of them by four times as much as that lies above the other. As with bounding
    planes, between them lies at most three quarters of the width of the larger one.

    What is walled in on all sides, and low beside what walls it in, as a roof in a court, looks as the ground there
    does, and is taken for it.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Which of them lie on one face.
    acquisition : Acquisition

    Returns
    -------
    Continuations
        None coplanar; some may touch. There are none unless nearly all normals lie along one axis, and no single
        scanner took the cloud: then what is hidden is known from its place.
    """
    if acquisition.is_one_scan:
        return continuations_of(surface, nodes, np.empty((0, 2), np.int64))
    found = _ground_from_far_above(surface, faces)
    if found is None:
        return continuations_of(surface, nodes, np.empty((0, 2), np.int64))
    upwards, ground = found
    of_supervoxel = np.where(ground, np.cumsum(ground) - 1, -1)[faces]
    border = borders_of(surface, of_supervoxel, [np.arange(np.count_nonzero(ground))])[0]
    occluded_spans = np.concatenate(
        (_touching(surface, of_supervoxel, border), _under(surface, nodes, of_supervoxel, border, upwards))
    )
    terrain = continuations_of(surface, nodes, occluded_spans)
    return replace(terrain, coplanar=np.zeros(len(terrain.pairs), np.bool_))


def _ground_from_far_above(
    surface: Surface, faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """The direction from which all was seen, (3,) of length 1, and which faces are ground from there, (f,); None if it
    was not seen from far off on one side, or two pieces of ground are not there.

    Nothing that touches nothing tells the others' sides, so normals may point either way.
    """
    some = surface.normals[:: max(1, surface.grid.n_voxels // _SOME)]
    axis = np.linalg.eigh(np.einsum("ij,ik->jk", some, some))[1][:, 2]
    cosines = np.einsum("ij,j->i", some, axis)
    if np.mean(np.abs(cosines) > _LEVEL) < _MOSTLY or np.mean(np.abs(cosines) < _STEEP) > _HARDLY:
        return None
    cosines = np.einsum("ij,j->i", surface.normals, axis)
    axis = axis * (1.0 if cosines.sum() >= 0.0 else -1.0)
    face, n_faces = faces[surface.supervoxels], int(faces.max()) + 1
    voxels = np.bincount(face, minlength=n_faces)
    level = np.bincount(face, np.abs(cosines), n_faces) >= _ON_AVERAGE * voxels
    down, up = _steps(surface, face, axis)  # the other way along it but for columns of several layers
    for upwards, to_lower, to_higher in ((axis, down, up), (-axis, up, down)):
        ground = level & (to_higher >= _UPWARD_STEPS) & (to_lower <= _DOWNWARDS * (to_lower + to_higher))
        if ground[np.argmax(voxels)]:
            ground &= voxels >= _MIN_VOXELS
            return (upwards, ground) if np.count_nonzero(ground) > 1 else None
    return None


def _steps(
    surface: Surface, face: NDArray[np.int32], axis: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many steps at the border of each face, between tops of columns beside each other along an axis, lead down
    and up, (f,) each."""
    plane, edge = Plane(surface.grid.centroids[0], axis, plane_basis(axis)), surface.grid.size
    heights, flat = plane.heights(surface.grid.centroids), np.zeros((surface.grid.n_voxels, 3))
    flat[:, :2] = plane.project(surface.grid.centroids)
    columns = voxel_grid(flat, _COLUMN * edge, Warp())
    order = np.lexsort((heights, columns.voxel_of_point))
    tops = order[np.cumsum(np.bincount(columns.voxel_of_point)) - 1]
    above, below = tops[columns.touching_pairs()].T
    steps = (heights[above] - heights[below] > _STEP * edge) & (face[above] != face[below])
    down, up = (np.bincount(face[ends[steps]], minlength=int(face.max()) + 1) for ends in (above, below))
    return down, up


def _touching(surface: Surface, of_supervoxel: NDArray[np.int64], border: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels of two pieces that touch, (t, 2)."""
    piece = of_supervoxel[surface.supervoxels]
    row, neighbours = surface.grid.around(border)
    others = np.flatnonzero(piece[neighbours] > piece[border][row])
    return np.stack((border[row[others]], neighbours[others]), axis=1)


def _under(
    surface: Surface,
    nodes: NodeFeatures,
    of_supervoxel: NDArray[np.int64],
    border: NDArray[np.int64],
    upwards: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Voxels at both ends of the ways, (c, 2), under what stands between pieces that are one."""
    edge, plane = surface.grid.size, Plane(surface.grid.centroids[0], upwards, plane_basis(upwards))
    piece, projected = of_supervoxel[surface.supervoxels[border]], plane.project(surface.grid.centroids[border])
    cells = voxel_grid(np.column_stack((projected / (_THINNED * edge), piece)), 1.0, Warp())
    some = np.sort(cells.order[cells.starts[:-1]])
    border, projected, piece = border[some], projected[some], piece[some]
    places, others = surface.grid.centroids[border], nodes.centroid[of_supervoxel < 0]
    ways = facing_ways(places, projected / edge, piece)
    ends = plane.heights(places)[ways.ends]
    hidden = np.zeros(len(ways.ends), np.bool_)
    if len(others) and len(ways.ends):
        from scipy.spatial import cKDTree

        some = np.arange(1, min(_NEAR, len(others)) + 1)
        distance, near = cKDTree(plane.project(others)).query(projected[ways.ends].mean(axis=1), k=some)
        over = distance <= np.maximum(0.5 * ways.lengths, _HIGH * edge)[:, None]
        rise = plane.heights(others)[near] - ends.max(axis=1)[:, None]
        hidden = (over & (rise > _HIGH * edge) & (np.ptp(ends, axis=1)[:, None] < _LEVELS * rise)).any(axis=1)
    n_ways, n_hidden = (np.bincount(ways.pair, counts, len(ways.pairs)) for counts in (None, hidden))
    areas = np.bincount(of_supervoxel[surface.supervoxels] + 1, np.square(surface.grid.edge_lengths))[1:]
    may_join = (n_hidden >= MIN_HIDDEN * n_ways) & (ways.widths >= _WIDE * edge)
    return border[ways.ends[joining(ways, may_join, areas.astype(np.float64))[ways.pair]]]
