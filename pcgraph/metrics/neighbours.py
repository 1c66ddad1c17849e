# SPDX-License-Identifier: Apache-2.0
"""The k-nearest-neighbour graph of a cloud, on which boundaries and areas are measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from pcgraph.metrics.table import decimals, whole_numbers
from pcgraph.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class NeighbourGraph(ShortRepr):
    """The k nearest neighbours of each point of a cloud: computed once, good for any number of labellings.

    The graph is directed: each point looks at its own k nearest neighbours, so that a boundary is equally thick
    everywhere. Of neighbours at exactly equal distance any may be taken.

    Attributes
    ----------
    shape : tuple of int
        Shape of labellings: (n,) or (h, w).
    members : (m,) int64
        Flat indices of the points in the graph, ascending.
    points : (m, 3) float64
        Their positions, in the unit and frame they came in.
    neighbours : (m, k) int32
        Rows of `members`: the nearest neighbours of each, itself left out; k is m - 1 in clouds that small.
    """

    shape: tuple[int, ...]
    members: NDArray[np.int64]
    points: NDArray[np.float64]
    neighbours: NDArray[np.int32]

    @classmethod
    def of(cls, points: ArrayLike, valid: ArrayLike | None = None, k: int = 8) -> NeighbourGraph:
        """The graph of the valid points.

        Parameters
        ----------
        points : (n, 3) or (h, w, 3) float
            Any unit and frame.
        valid : (n,) or (h, w) bool, optional
            Points that take part, for example ``truth >= 0``; by default all finite points.
        k : int, >= 1

        Raises
        ------
        ValueError
            The shapes differ, k is below 1, no point is valid, or a valid point is not finite.
        """
        positions = decimals(points)
        if positions.ndim not in (2, 3) or positions.shape[-1] != 3:
            raise ValueError(f"expected points (n, 3) or (h, w, 3), got {positions.shape}")
        if not _is_whole(k) or k < 1:
            raise ValueError(f"expected k as a whole number of at least 1 neighbour, got {k!r}")
        finite = np.isfinite(positions).all(axis=-1)
        chosen = finite if valid is None else np.asarray(np.ma.filled(valid, False), bool)
        if chosen.shape != finite.shape:
            raise ValueError(f"expected one value of valid per point, {finite.shape}, got {chosen.shape}")
        if not chosen.any():
            raise ValueError("expected at least one point that takes part, got none")
        if (chosen & ~finite).any():
            raise ValueError("expected finite points, got NaN or infinity at a labelled one; give it the label -1")
        inside = positions[chosen]
        return cls(finite.shape, np.flatnonzero(chosen), inside, _nearest(inside, min(k, len(inside) - 1)))

    def boundary(self, labels: ArrayLike) -> NDArray[np.bool_]:
        """Points with a neighbour of another label, bool in the shape of the labels; False outside the graph.

        Raises
        ------
        ValueError
            The shape is not the graph's, labels are not whole numbers, or a point of the graph has a negative label.
        """
        marked = np.zeros(self.shape, bool)
        marked.flat[self.members] = self.rim(labels)
        return marked

    def recall(self, labels: ArrayLike, truth: ArrayLike, *, hops: int = 1, tolerance: float | None = None) -> float:
        """Boundary recall BR, 0..1; parameters as for `boundary_recall`."""
        return self._share_near(self.rim(truth), self.rim(labels), hops, tolerance)

    def precision(self, labels: ArrayLike, truth: ArrayLike, *, hops: int = 1, tolerance: float | None = None) -> float:
        """Boundary precision BP, 0..1; parameters as for `boundary_precision`."""
        return self._share_near(self.rim(labels), self.rim(truth), hops, tolerance)

    def areas(self) -> NDArray[np.float64]:
        """Area of surface that each point of the graph stands for, (m,), the points' unit squared.

        12 sqrt(l1 l2) / (k (k + 1)), with l1, l2 the two larger eigenvalues of the sum of d d^T over the steps d to
        the neighbours: noise across the surface drops out, and a slanted view changes nothing. Exact on a square
        grid with k = 8 or 24; for points strewn at random 13 % too small with k = 8, 7 % with k = 24. Noise that
        decides who is near makes it larger: on a Kinect cloud by 6 % with k = 8, and 1 % smaller with k = 24.
        """
        k = self.neighbours.shape[1]
        spread = np.zeros((len(self.points), 3, 3))
        for neighbour in self.neighbours.T:
            step = self.points[neighbour] - self.points
            spread += step[:, :, None] * step[:, None, :]
        larger = np.maximum(np.linalg.eigvalsh(spread)[:, 1:], 0.0)
        return 12 * np.sqrt(larger.prod(axis=1)) / max(k * (k + 1), 1)

    def of_members(self, labels: ArrayLike) -> NDArray[np.int64]:
        """Labels of the points in the graph, (m,) int64; raises as `boundary` does."""
        given = whole_numbers(labels)
        if given.shape != self.shape:
            raise ValueError(f"expected labels of the points' shape {self.shape}, got {given.shape}")
        own = given.reshape(-1)[self.members]
        if (own < 0).any():
            raise ValueError("expected labels >= 0 for all points of the graph; build it with valid=labels >= 0")
        return own

    def rim(self, labels: ArrayLike) -> NDArray[np.bool_]:
        """As `boundary`, but (m,) and of the points in the graph only."""
        own = self.of_members(labels)
        return (own[self.neighbours] != own[:, None]).any(axis=1)

    def within_hops(self, marked: NDArray[np.bool_], hops: int) -> NDArray[np.bool_]:
        """Points of the graph that reach a marked one, (m,) bool both, in so many steps to a neighbour."""
        check_reach(hops)
        for _ in range(hops):
            marked = marked | marked[self.neighbours].any(axis=1)
        return marked

    def _share_near(self, of: NDArray[np.bool_], to: NDArray[np.bool_], hops: int, tolerance: float | None) -> float:
        """Share of the points `of` near a point of `to`; 1 if there are none, as then none is missed."""
        check_reach(hops, tolerance)
        if not of.any():
            return 1.0
        near = self.within_hops(to, hops)[of] if tolerance is None else self._within_reach(of, to, tolerance)
        return float(near.mean())

    def _within_reach(self, of: NDArray[np.bool_], to: NDArray[np.bool_], tolerance: float) -> NDArray[np.bool_]:
        if not to.any():
            return np.zeros(np.count_nonzero(of), bool)
        reach = np.nextafter(tolerance, np.inf)  # the tree finds what is nearer than the bound, not at it
        distances, _ = cKDTree(self.points[to]).query(self.points[of], distance_upper_bound=reach, workers=2)
        return np.isfinite(distances)


def check_reach(hops: int, tolerance: float | None = None) -> None:
    """Nothing; raises ValueError unless hops is a whole number, and tolerance a number if any, of at least 0."""
    if not _is_whole(hops) or hops < 0:
        raise ValueError(f"expected hops as a whole number of at least 0, got {hops!r}")
    if tolerance is not None and not (isinstance(tolerance, (float, int, np.number)) and tolerance >= 0):
        raise ValueError(f"expected a tolerance of at least 0 in the points' unit, got {tolerance!r}")


def _is_whole(number: object) -> bool:
    return isinstance(number, (int, np.integer)) and not isinstance(number, bool)


def _nearest(points: NDArray[np.float64], k: int) -> NDArray[np.int32]:
    """Rows of the k nearest other points of each point, (m, k)."""
    rows = np.arange(len(points))
    if k == 0:
        return np.empty((len(points), 0), np.int32)
    _, found = cKDTree(points).query(points, k=k + 1, workers=2)
    itself = found == rows[:, None]
    itself[~itself.any(axis=1), -1] = True  # among many duplicates a point need not be among its own nearest
    return found[~itself].reshape(len(points), k).astype(np.int32)
