# SPDX-License-Identifier: Apache-2.0
"""How far surfaces turn: what tells a plane from a patch of a sphere or a cylinder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.regions import moments_of_regions


def bends(leaves: FlatLeaves, regions: NDArray[np.int32]) -> NDArray[np.float64]:
    """How far each region's surface turns, radians, (p,): curvature times extent, 0 for a plane.

    The supervoxels' normals are fitted as a linear function of their place in the plane; what noise does to
    single normals cancels, what a sphere or a cylinder does to them does not. A round patch of radius a on a sphere
    of radius R turns by a / (2 R). A surface that turns so also leaves its plane; where the distances show less than
    half of that, the turn is one of the normals only, as slanted noise causes it, and counts as 0.
    """
    n_regions = int(regions.max(initial=-1)) + 1
    planes = moments_of_regions(leaves.moments, regions, n_regions)
    variances, frames = np.linalg.eigh(planes.covariances)
    residuals = np.sqrt(np.maximum(variances[:, 0], 0.0))
    result = np.zeros(n_regions)
    usable = np.flatnonzero((regions >= 0) & ~leaves.shapeless)
    usable = usable[np.argsort(regions[usable], kind="stable")]
    starts = np.searchsorted(regions[usable], np.arange(n_regions + 1))
    for i in np.flatnonzero(np.diff(starts) >= 3):
        member = usable[starts[i] : starts[i + 1]]
        place = (leaves.moments.centroids[member] - planes.centroids[i]) @ frames[i, :, 1:]
        tilt = leaves.normals[member] @ frames[i]
        tilt = tilt[:, 1:] * np.sign(tilt[:, :1])
        root = np.sqrt(leaves.moments.counts[member] / leaves.moments.counts[member].sum())[:, None]
        place, tilt = (place - (root**2 * place).sum(axis=0)) * root, (tilt - (root**2 * tilt).sum(axis=0)) * root
        slope = np.linalg.lstsq(place, tilt, rcond=1e-6)[0]
        share = root[:, 0]
        rise = 0.5 * ((place @ slope) * place).sum(axis=1) / share  # by which the surface would leave its plane
        leaving = float(np.linalg.norm(rise - share * (share @ rise)))
        if residuals[i] >= 0.5 * leaving:
            result[i] = np.linalg.norm(place @ slope, 2)
    return result
