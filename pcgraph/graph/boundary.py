# SPDX-License-Identifier: Apache-2.0
"""How strongly an edge of the graph speaks for an object's boundary."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import non_negative

if TYPE_CHECKING:
    from pcgraph.graph.adjacency import EdgeFeatures

_COST_STEPS = float(1 << 20)
_AS_IT_CLOSES = 3.0  # what a valley of nearly no width costs, per radian of its width
_WITH_ROOM = 3.0  # what it costs more per voxel edge between its sides,
_NO_ROOM = 0.7  # beyond so many, which noise may be


@dataclass(frozen=True)
class BoundaryCost:
    """Cost of merging over an edge, in radians of concavity.

    cost = (1 - contact) V(convexity) + contact V(contact_convexity) + step min(step / voxel edge,
    step_limit), where V(angle) is min(a, 3 (pi - a) + 3 max(h - 0.7, 0)) of an edge that is concave by a, with h the
    step in voxel edges up to the limit, and `convex` times the angle of a convex one.

    Attributes
    ----------
    contact : float, 0..1
        Fraction that the convexity at the contact counts; the rest is that of the whole supervoxels.
    convex : float, >= 0
        Cost of a convex radian: small, so that faces of a box merge late but before the box and its table.
    step : float, radians per voxel, >= 0
        Cost of an offset between the surfaces.
    step_limit : float, voxels, >= 0
        Offset above which the cost stays.

    Raises
    ------
    ValueError
        A number is not finite or out of range.

    Notes
    -----
    Convexity as evidence for objects: LCCP, Stein et al. 2014. As a mean over the contact instead of a yes or
    no per edge, one noisy normal cannot open or close a boundary. Hardly anything looks into a valley narrower than
    45 degrees: where normals differ by more than 135, a sheet was seen from both sides, or one of them is turned
    round, and the sign of the angle says less the nearer that is to pi; unless there is room between the sides, as
    between the ground and what stands just above it.
    """

    contact: float = 0.5
    convex: float = 0.03
    step: float = 0.05
    step_limit: float = 3.0

    def __post_init__(self) -> None:
        _check_fields(self)
        if self.contact > 1.0:
            raise ValueError(f"expected contact as a fraction of 0..1, got {self.contact!r}")

    def __call__(self, features: EdgeFeatures) -> NDArray[np.float64]:
        """Costs, (m,) float64, radians, in whole multiples of 2**-20 so that sums of them are exact.

        Parameters
        ----------
        features : EdgeFeatures of m edges
        """
        offset = np.minimum(features.step / features.voxel_edge, self.step_limit)
        room = _WITH_ROOM * np.maximum(offset - _NO_ROOM, 0.0)
        bend = (1.0 - self.contact) * self._valley(features.convexity, room)
        bend += self.contact * self._valley(features.contact_convexity, room)
        return np.rint((bend + self.step * offset) * _COST_STEPS) / _COST_STEPS

    def _valley(self, convexity: NDArray[np.float64], room: NDArray[np.float64]) -> NDArray[np.float64]:
        valley = np.minimum(-convexity, _AS_IT_CLOSES * np.maximum(np.pi + convexity, 0.0) + room)
        return np.where(convexity < 0.0, valley, self.convex * convexity)


@dataclass(frozen=True)
class BoundaryStrength:
    """How probably an edge is an object's boundary, 0..1, read off everything its features know.

    strength = 1 - 2^-(z^3) with z = concavity v + step s + normal a + color c, where v is the mean of the concavities
    of nodes and at contacts, max(0, -convexity) and max(0, -contact_convexity), s the step in voxels, a the angle
    between normals and c the contrast of colours. It rises with each of them, is 0 where all are 0, and 1/2 at z = 1.

    Attributes
    ----------
    concavity : float, per radian, >= 0
    step : float, per voxel, >= 0
    normal : float, per radian, >= 0
    color : float, >= 0
        Per unit of contrast.

    Raises
    ------
    ValueError
        A number is not finite or negative.

    Notes
    -----
    The defaults are rounded from the maximum likelihood on 35 849 contacts in 12 clouds of a Kinect with true objects,
    of which 1 in 90 is a boundary.
    """

    concavity: float = 0.85
    step: float = 0.25
    normal: float = 0.1
    color: float = 0.05

    def __post_init__(self) -> None:
        _check_fields(self)

    def __call__(self, features: EdgeFeatures) -> NDArray[np.float64]:
        """Strengths, (m,) float64, 0..1.

        Parameters
        ----------
        features : EdgeFeatures of m edges
        """
        valley = np.maximum(-features.convexity, 0.0) + np.maximum(-features.contact_convexity, 0.0)
        evidence = 0.5 * self.concavity * valley + self.step * (features.step / features.voxel_edge)
        evidence += self.normal * features.normal_angle + self.color * features.color_contrast
        strength: NDArray[np.float64] = -np.expm1(-np.log(2.0) * np.minimum(evidence, 100.0) ** 3)
        return strength


def _check_fields(numbers: BoundaryCost | BoundaryStrength) -> None:
    for field in fields(numbers):
        non_negative(field.name, getattr(numbers, field.name))
