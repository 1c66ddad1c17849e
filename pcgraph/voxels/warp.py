# SPDX-License-Identifier: Apache-2.0
"""Warps between the points' space and the space in which voxels are cubes of one size."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.voxels.cells import Lattice

_MEDIAN_SAMPLE = 2048
"""Count of values off which bounds of the median are read, about; chosen by eye, for speed."""
_MIN_LENGTH = 1e-150
"""Metres, least range: squares of lesser ones are zero, and powers of it are still finite."""
FORWARDS = (0.0, 0.0, 1.0)
"""Direction in which a camera looks in its own frame, of length 1: +z, as in OpenCV."""


class NormalTransform(NamedTuple):
    """Transform of normals to the warped space: a normal n becomes m = n + ray (n . r) r + depth (n . w) a.

    Here a is an axis, r the direction of the warped place, and w the part of that place across the axis. A step dX in
    the warped space leaves the plane by m . dX, in metres of the warped space: scale(p) m = J^-T n, where J is the
    derivative of `Warp.forward` at p.

    Attributes
    ----------
    ray : float
        0 unless voxels grow with range.
    depth : float, 1 / metres
        0 unless voxels grow with depth.
    axis : three floats
        Of unit length.
    """

    ray: float = 0.0
    depth: float = 0.0
    axis: tuple[float, float, float] = FORWARDS


@dataclass(frozen=True)
class Warp:
    """The identity: voxels of one size everywhere, counted from the origin.

    Attributes
    ----------
    max_gap : float, voxel edges
        Distance between the means of two voxels on either side of a gap, at most.
    """

    max_gap: ClassVar[float] = 3.0

    def check(self, points: NDArray[np.float64]) -> None:
        """ValueError if a point has no place in the warped space."""

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Warped positions, (n, 3) float64, metres, of points (n, 3) in metres."""
        return points

    def on_lattice(self, points: NDArray[np.float64], size: float) -> tuple[NDArray[np.float64], Lattice]:
        """Places, (n, 3) float64, metres, and the lattice of voxels of a size, metres, in which they lie."""
        return self.forward(points), Lattice(np.zeros(3), size)

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of warped positions."""
        return warped

    def scale(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres in space per metre of the warped space at each point, (n,) float64."""
        return np.ones(len(points))

    @property
    def slant(self) -> NormalTransform:
        """Transform of normals to the warped space."""
        return NormalTransform()

    def from_corner(self, corner: NDArray[np.float64]) -> Warp:
        """Voxels of one size counted from a corner, (3,) metres; where voxels grow about a place, the warp itself."""
        return Shift(corner)


@dataclass(frozen=True, eq=False)
class Shift(Warp):
    """Voxels of one size everywhere, counted from a corner, so that a cloud that is moved has the same.

    Attributes
    ----------
    corner : (3,) float64, metres
    """

    corner: NDArray[np.float64]

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions, (n, 3) float64, metres, from the corner."""
        return points - self.corner

    def on_lattice(self, points: NDArray[np.float64], size: float) -> tuple[NDArray[np.float64], Lattice]:
        """The points themselves, and a lattice that starts at the corner."""
        return points, Lattice(self.corner, size)

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of positions from the corner."""
        return warped + self.corner


@dataclass(frozen=True, eq=False)
class CameraWarp(Warp):
    """Voxels that grow in proportion to depth, as a camera's pixels do on what it sees.

    With p = point - viewpoint, z = p . a along the axis a and the reference depth z0, the warped position is
    z0 ((p - z a)/z + ln(z/z0) a); of one that looks along z: z0 (x/z, y/z, ln(z/z0)).

    Attributes
    ----------
    viewpoint : (3,) float64, metres
        Centre of projection.
    reference_depth : float, metres
        Depth at which the warp keeps lengths.
    axis : (3,) float64
        Optical axis, forwards, of unit length.

    Notes
    -----
    Source: the single-camera transform of PCL's VCCS (x/z, y/z, ln z), here with a scale that keeps metres.
    """

    viewpoint: NDArray[np.float64]
    reference_depth: float
    axis: NDArray[np.float64] = field(default_factory=lambda: np.array(FORWARDS))

    @classmethod
    def about(
        cls, points: NDArray[np.float64], viewpoint: NDArray[np.float64], axis: NDArray[np.float64] | None = None
    ) -> CameraWarp:
        """The warp that keeps lengths at the median depth of points, (n, 3); the axis is +z unless it is given.

        Raises
        ------
        ValueError
            A point does not lie in front of the camera.
        """
        axis = np.array(FORWARDS) if axis is None else axis
        warp = cls(viewpoint, _median(along_axis(points, axis)) - float(viewpoint @ axis), axis)
        warp.check(points)
        return warp

    def check(self, points: NDArray[np.float64]) -> None:
        """ValueError if a point does not lie in front of the camera."""
        least, place = float(along_axis(points, self.axis).min()), float(self.viewpoint @ self.axis)
        if least <= place:
            raise ValueError(
                f"expected all points in front of the camera (z > {place:g} m), as voxels grow with depth, "
                f"got z down to {least:g} m; segment (the first scan, for update) with camera=False"
            )

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Warped positions, (n, 3) float64; points must lie in front of the viewpoint."""
        warped = np.empty((len(points), 3))
        in_blocks(_project, len(points), points, self.viewpoint, self.axis, self.reference_depth, warped)
        return warped

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of warped positions."""
        along = along_axis(warped, self.axis)
        depth = self.reference_depth * np.exp(along / self.reference_depth)
        lateral = (warped - along[:, None] * self.axis) * (depth / self.reference_depth)[:, None]
        return lateral + depth[:, None] * self.axis + self.viewpoint

    def scale(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth over reference depth, (n,) float64."""
        return (along_axis(points, self.axis) - self.viewpoint @ self.axis) / self.reference_depth

    def from_corner(self, corner: NDArray[np.float64]) -> Warp:
        return self

    @property
    def slant(self) -> NormalTransform:
        """The transform of a camera: a step along the axis of the warped space moves along the ray of a pixel."""
        x, y, z = self.axis.tolist()
        return NormalTransform(depth=1.0 / self.reference_depth, axis=(x, y, z))


@dataclass(frozen=True, eq=False)
class RangeWarp(Warp):
    """Voxels that grow with a power of the range, in all directions around a scanner.

    A point at range r goes, along its ray, to r0 (r / r0)^(1 - growth). So voxels are as wide as their size times
    (r / r0)^growth across the ray, and wider by 1 / (1 - growth) along it. There is no seam and no pole.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
        Where the scanner stood.
    reference_range : float, metres
        Range at which the warp keeps lengths across the ray.
    growth : float, 0..1, without 1
    """

    # A scanner's rows lie farther apart than the points along them.
    max_gap: ClassVar[float] = 6.0

    viewpoint: NDArray[np.float64]
    reference_range: float
    growth: float

    @classmethod
    def about(cls, points: NDArray[np.float64], viewpoint: NDArray[np.float64], growth: float) -> Warp:
        """The warp that keeps lengths at the median range of points, (n, 3).

        It is the identity for a growth of 0, or if the median range is 0.
        """
        median_range = _median(_ranges(points, viewpoint)) if growth else 0.0
        return cls(viewpoint, median_range, growth) if median_range > _MIN_LENGTH else Warp()

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Warped positions, (n, 3) float64, about the viewpoint."""
        warped = np.empty((len(points), 3))
        in_blocks(_draw_near, len(points), points, self.viewpoint, self.reference_range, self.growth, warped)
        return warped

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of warped positions."""
        stretch = (_ranges(warped, np.zeros(3)) / self.reference_range) ** (self.growth / (1.0 - self.growth))
        return warped * stretch[:, None] + self.viewpoint

    def scale(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(r / r0)^growth, (n,) float64."""
        return (_ranges(points, self.viewpoint) / self.reference_range) ** self.growth

    def from_corner(self, corner: NDArray[np.float64]) -> Warp:
        return self

    @property
    def slant(self) -> NormalTransform:
        """The transform of a scanner: a step along the ray is shorter than one across it."""
        return NormalTransform(ray=self.growth / (1.0 - self.growth))


def _median(values: NDArray[np.float64]) -> float:
    """Median of values, (n,). Of many values only those near it are put in order, which takes a third of the time."""
    n = len(values)
    some = np.sort(values[:: n // _MEDIAN_SAMPLE + 1])
    low, high = some[[int(0.45 * len(some)), int(0.55 * len(some))]]
    near, at = values[(values >= low) & (values <= high)], n // 2 - np.count_nonzero(values < low)
    if n < 4 * _MEDIAN_SAMPLE or not 1 <= at < len(near):
        return float(np.median(values))
    near.partition((at - 1, at))
    return float(near[at] if n % 2 else near[at - 1 : at + 1].mean())


def along_axis(points: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates of points, (n, 3), along an axis, (n,)."""
    along = np.empty(len(points))
    in_blocks(_multiply, len(points), points, axis, along)
    return along


def _ranges(points: NDArray[np.float64], viewpoint: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranges of points from a viewpoint, (n,) float64, metres; at least `_MIN_LENGTH`."""
    ranges = np.empty(len(points))
    in_blocks(_measure, len(points), points, viewpoint, ranges)
    return ranges


@routine
def _ray(points: NDArray[np.float64], p: int, viewpoint: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Vector from a viewpoint to point p, x, y, z, and its length, at least `_MIN_LENGTH`, metres."""
    x, y, z = points[p, 0] - viewpoint[0], points[p, 1] - viewpoint[1], points[p, 2] - viewpoint[2]
    return x, y, z, max(math.sqrt(x * x + y * y + z * z), _MIN_LENGTH)


@routine
def warped_normal(
    slant: NormalTransform, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Transform of the normal (a, b, c) of a plane at the warped place (x, y, z); see `NormalTransform`."""
    if slant.ray > 0.0:
        square = max(x * x + y * y + z * z, _MIN_LENGTH)
        along = slant.ray * (a * x + b * y + c * z) / square
        return a + along * x, b + along * y, c + along * z
    u, v, w = slant.axis
    along = x * u + y * v + z * w
    turn = slant.depth * (a * (x - along * u) + b * (y - along * v) + c * (z - along * w))
    return a + turn * u, b + turn * v, c + turn * w


@kernel
def _multiply(
    start: int, stop: int, points: NDArray[np.float64], axis: NDArray[np.float64], along: NDArray[np.float64]
) -> None:
    """Set the coordinates of points along an axis."""
    for p in range(start, stop):
        along[p] = points[p, 0] * axis[0] + points[p, 2] * axis[2] + points[p, 1] * axis[1]  # as NumPy adds them


@kernel
def _measure(
    start: int, stop: int, points: NDArray[np.float64], viewpoint: NDArray[np.float64], ranges: NDArray[np.float64]
) -> None:
    """Set the ranges of points from a viewpoint."""
    for p in range(start, stop):
        _, _, _, ranges[p] = _ray(points, p, viewpoint)


@kernel
def _draw_near(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    viewpoint: NDArray[np.float64],
    reference_range: float,
    growth: float,
    warped: NDArray[np.float64],
) -> None:
    """Set the warped positions of points about the viewpoint, as `RangeWarp` says."""
    for p in range(start, stop):
        x, y, z, distance = _ray(points, p, viewpoint)
        scale = (distance / reference_range) ** -growth
        warped[p, 0], warped[p, 1], warped[p, 2] = scale * x, scale * y, scale * z


@kernel
def _project(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    viewpoint: NDArray[np.float64],
    axis: NDArray[np.float64],
    reference_depth: float,
    warped: NDArray[np.float64],
) -> None:
    """Set the warped positions of points as `CameraWarp` says."""
    for p in range(start, stop):
        x, y, z = points[p, 0] - viewpoint[0], points[p, 1] - viewpoint[1], points[p, 2] - viewpoint[2]
        depth = x * axis[0] + y * axis[1] + z * axis[2]
        scale = reference_depth / depth
        along = -np.log(scale) * reference_depth
        warped[p, 0] = (x - depth * axis[0]) * scale + along * axis[0]
        warped[p, 1] = (y - depth * axis[1]) * scale + along * axis[1]
        warped[p, 2] = (z - depth * axis[2]) * scale + along * axis[2]
