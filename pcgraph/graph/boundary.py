# SPDX-License-Identifier: Apache-2.0
"""Evidence of an edge of the graph for an object's boundary: what merging over it costs, and how probable one is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import check_non_negative

if TYPE_CHECKING:
    from pcgraph.graph.adjacency import EdgeFeatures

COST_STEPS = float(1 << 20)
"""Steps per radian of cost or altitude, and per unit of probability: 2^20, so that sums up to 2^33 are exact in
float64, and the same in any order."""


def in_whole_steps(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values, rounded to whole multiples of 1 / `COST_STEPS`, so that sums of them are exact."""
    return np.rint(values * COST_STEPS) / COST_STEPS


@dataclass(frozen=True)
class ValleyThresholds:
    """Cost of valleys into which hardly anything looks, since they are narrower than 45 degrees.

    Where normals differ by more than 135 degrees, a sheet was seen from both sides, or one normal is turned round. So
    the sign of the angle says less, the nearer the angle is to pi. If there is room between the sides, as between the
    ground and a car's underside, the valley counts again.

    Attributes
    ----------
    per_opening : float, radians per radian
        Cost per radian between the two sides. 3 (pi - a) is less than a from 135 degrees on. With it 34 kinds of cloud
        with a viewpoint for each point cover 0.851 for 0.827; the 36 domains change by 0.0005.
    per_room : float, radians per voxel edge
        Cost per voxel edge of room. Chosen on bodies a voxel or two above the ground, which merged with it else.
    noise : float, voxel edges
        Step that noise may be, and is no room. Chosen with `per_room`.
    """

    per_opening: float = 3.0
    per_room: float = 3.0
    noise: float = 0.7


_NARROW = ValleyThresholds()


@dataclass(frozen=True)
class BoundaryCost:
    """Cost of merging over an edge, in radians of concavity.

    With h the step in voxel edges, at most `step_limit`::

        cost = (1 - contact) V(convexity) + contact V(contact_convexity) + step h
        V    = min(a, 3 (pi - a) + 3 max(h - 0.7, 0))  of an edge that is concave by a, see `ValleyThresholds`
        V    = convex a                                of an edge that is convex by a

    Attributes
    ----------
    contact : float, 0..1
        Weight of the convexity at the contact. The rest is the weight of the convexity of the whole supervoxels.
    convex : float, >= 0
        Cost of a convex radian: small, so that faces of a box merge late, but before the box and its table.
    step : float, radians per voxel edge, >= 0
        Cost of an offset between the surfaces.
    step_limit : float, voxel edges, >= 0
        Offset beyond which the cost rises no further.

    Raises
    ------
    ValueError
        A number is not finite or out of range.

    Notes
    -----
    Convexity as evidence for objects: LCCP, Stein et al. 2014. Here it is a mean over the contact instead of a yes or
    no per edge, so one noisy normal cannot open or close a boundary.
    """

    contact: float = 0.5
    convex: float = 0.03
    step: float = 0.05
    step_limit: float = 3.0

    def __post_init__(self) -> None:
        check_non_negative(self)
        if self.contact > 1.0:
            raise ValueError(f"expected contact as a fraction of 0..1, got {self.contact!r}")

    def __call__(self, features: EdgeFeatures) -> NDArray[np.float64]:
        """Costs, (m,) float64, radians, in whole steps (`in_whole_steps`).

        Parameters
        ----------
        features : EdgeFeatures of m edges
        """
        offset = np.minimum(features.step / features.voxel_edge, self.step_limit)
        room = _NARROW.per_room * np.maximum(offset - _NARROW.noise, 0.0)
        bend = (1.0 - self.contact) * self._valley(features.convexity, room)
        bend += self.contact * self._valley(features.contact_convexity, room)
        return in_whole_steps(bend + self.step * offset)

    def _valley(self, convexity: NDArray[np.float64], room: NDArray[np.float64]) -> NDArray[np.float64]:
        valley = np.minimum(-convexity, _NARROW.per_opening * np.maximum(np.pi + convexity, 0.0) + room)
        return np.where(convexity < 0.0, valley, self.convex * convexity)


@dataclass(frozen=True)
class BoundaryStrength:
    """Strength of an edge as an object's boundary, 0..1, from all of its features.

    strength = 1 - 2^-(z^3) with z = concavity v + step s + normal a + color c. Here v is the mean of the concavities of
    nodes and at contacts, max(0, -convexity) and max(0, -contact_convexity); s is the step in voxel edges, a the angle
    between normals, and c the contrast of colours. The strength rises with each of them. It is 0 where all are 0, and
    1/2 at z = 1.

    Attributes
    ----------
    concavity : float, per radian, >= 0
    step : float, per voxel edge, >= 0
    normal : float, per radian, >= 0
    color : float, >= 0
        Per unit of contrast.

    Raises
    ------
    ValueError
        A number is not finite or negative.

    Notes
    -----
    The defaults are rounded from the maximum likelihood on 35 849 contacts in 12 clouds of a Kinect with true objects.
    One contact in 90 is a boundary.
    """

    concavity: float = 0.85
    step: float = 0.25
    normal: float = 0.1
    color: float = 0.05

    def __post_init__(self) -> None:
        check_non_negative(self)

    def __call__(self, features: EdgeFeatures) -> NDArray[np.float64]:
        """Strengths, (m,) float64, 0..1.

        Parameters
        ----------
        features : EdgeFeatures of m edges
        """
        valley = np.maximum(-features.convexity, 0.0) + np.maximum(-features.contact_convexity, 0.0)
        evidence = 0.5 * self.concavity * valley + self.step * (features.step / features.voxel_edge)
        evidence += self.normal * features.normal_angle + self.color * features.color_contrast
        # The strength is 1, to the last bit, long before 100, and cubes stay finite.
        strength: NDArray[np.float64] = -np.expm1(-np.log(2.0) * np.minimum(evidence, 100.0) ** 3)
        return strength
