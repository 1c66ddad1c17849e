# SPDX-License-Identifier: Apache-2.0
"""Fragments of things on a support: which pieces are one object although nothing seen connects them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

OPEN = 0.05  # below which a piece is not convex: about 0.5 for a sphere or a box, 0 for a plane, negative if hollow
WITHIN = 0.5  # share of a piece inside another's box


def joined_fragments(
    places: list[NDArray[np.float64]],
    normals: list[NDArray[np.float64]],
    heights: list[NDArray[np.float64]],
    floating: NDArray[np.bool_],
    inside: NDArray[np.float64],
    reach: NDArray[np.float64],
    level: float,
) -> NDArray[np.int32]:
    """Object of each of q pieces, (q,) int32, numbered from 0 in the order of their first piece.

    Parameters
    ----------
    places : q arrays (n, 3) float64, metres
        Where the pieces are, largest first.
    normals : q arrays (n, 3) float64
        Unit normals there.
    heights : q arrays (n,) float64, metres
        Along the direction away from the support.
    floating : (q,) bool
        Whether the piece nowhere touches the support.
    inside : (q, q) float64, 0..1
        Share of the second piece that lies within the box of the first.
    reach : (q,) float64, metres
        How wide a gap to each piece may be, of two pieces the larger value.
    level : float, metres
        How much the tops of the inside and the outside of a cup may differ.

    Notes
    -----
    What stands on a support reaches down to it. A piece that does not is the inside of a cup (or its outside, if
    the inside is seen to the bottom), or stands on another, or is hidden behind one. Only in the first case the
    two end at one height, the rim, and one of them is hollow or, as a narrow strip of it, flat. So a floating piece
    joins the nearest one for which both hold.
    """
    q = len(places)
    joined = np.zeros((q, q), bool)
    trees = [cKDTree(place) for place in places]
    top = np.array([height.max() for height in heights])
    hollow = np.array([_opening(x, n) < OPEN for x, n in zip(places, normals, strict=True)])
    cup = (hollow[:, None] | hollow) & (floating[:, None] | floating)
    cup &= np.abs(top - top[:, None]) <= level
    limit = np.maximum(reach, reach[:, None])
    contained = np.array([bool((inside[:i, i] > WITHIN).any()) for i in range(q)])
    for i in range(q):
        if contained[i]:
            joined[int(np.argmax(inside[:i, i] > WITHIN)), i] = True
            continue
        others = [j for j in range(q) if j != i and not contained[j] and cup[i, j]]
        gaps = [float(trees[j].query(places[i], distance_upper_bound=limit[i, j])[0].min()) for j in others]
        if gaps and np.isfinite(min(gaps)):
            joined[i, others[int(np.argmin(gaps))]] = True
    return np.asarray(connected_components(csr_array(joined), directed=False)[1], np.int32)


def _opening(places: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """How the normals spread with the places they stand at, per metre of the piece's radius, -1..1."""
    local = places - places.mean(axis=0)
    radius = float(np.sqrt((local**2).sum(axis=1).mean()))
    return float((local * normals).sum(axis=1).mean()) / radius if radius > 0.0 else 0.0
