# SPDX-License-Identifier: Apache-2.0
"""How strongly an edge of the graph speaks for an object's boundary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.graph.adjacency import EdgeFeatures

_COST_STEPS = float(1 << 20)


@dataclass(frozen=True)
class BoundaryCost:
    """Cost of merging over an edge, in radians of concavity.

    cost = (1 - contact) V(convexity) + contact V(contact_convexity) + step min(step / voxel edge,
    step_limit), where V(angle) is -angle of a concave edge and `convex` times the angle of a convex one.

    Attributes
    ----------
    contact : float, 0..1
        Share of the convexity at the contact; the rest is that of the whole supervoxels.
    convex : float
        Cost of a convex radian: small, so that faces of a box merge late but before the box and its table.
    step : float, radians per voxel
        Cost of an offset between the surfaces.
    step_limit : float, voxels
        Offset above which the cost stays.

    Notes
    -----
    Convexity as evidence for objects: LCCP, Stein et al. 2014. As a mean over the contact instead of a yes or
    no per edge, one noisy normal cannot open or close a boundary.
    """

    contact: float = 0.5
    convex: float = 0.05
    step: float = 0.1
    step_limit: float = 3.0

    def __call__(self, features: EdgeFeatures) -> NDArray[np.float64]:
        """Costs, (m,) float64, radians, in whole multiples of 2**-20 so that sums of them are exact.

        Parameters
        ----------
        features : EdgeFeatures of m edges
        """
        bend = (1.0 - self.contact) * self._valley(features.convexity)
        bend += self.contact * self._valley(features.contact_convexity)
        offset = np.minimum(features.step / features.voxel_edge, self.step_limit)
        return np.rint((bend + self.step * offset) * _COST_STEPS) / _COST_STEPS

    def _valley(self, convexity: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(convexity < 0.0, -convexity, self.convex * convexity)
