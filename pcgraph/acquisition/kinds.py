# SPDX-License-Identifier: Apache-2.0
"""Kinds of acquisition: what took a cloud, from where, and which evidence says so.

`acquisition_of` looks at what the caller gave and at the pixels; `Acquisition.with_spacing` at how the spacing of
points grows with range; `Acquisition.confirmed` at what is visible. After that nothing asks again. Each kind of
acquisition is a class that owns what follows from it: how voxels grow, where the outside of a surface is, and what a
gap between surfaces means. A new kind of sensor is a new class here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.acquisition.depth_image import DepthImage, axis_at, image_view, is_camera_image
from pcgraph.acquisition.spacing_law import SpacingLaw, law_on_rings, spacing_law
from pcgraph.inputs import CleanCloud, clean_viewpoint, fraction
from pcgraph.parallel import side_by_side
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.grid import VoxelGrid, voxel_means
from pcgraph.voxels.sampling import farthest_points
from pcgraph.voxels.spacing import spacing_and_rows
from pcgraph.voxels.surface import LocalPlanes
from pcgraph.voxels.virtual_viewpoints import virtual_viewpoints
from pcgraph.voxels.visibility import (
    likelier_viewpoint,
    shown_fraction,
    sides_towards,
    sides_towards_each,
    visible_sides,
)
from pcgraph.voxels.warp import FORWARDS, CameraWarp, RangeWarp, Warp

RANGE_GROWTH = 0.5
"""Power of the range with which voxels of one scan grow by default, dimensionless. Near detail and far surfaces stay in
one piece. Without the growth, scores lose 0.008 in the mean (docs/pcgraph_experiments.md)."""
_MIN_SHOWN = 0.8
"""Fraction of the surface that a scanner's estimated position must see. What a moving scanner passed has sides that the
middle of its way does not see. Without this check a mobile scan with one point per 30 cm loses 0.18 of its facing."""
_MAX_PLACES = 3
"""Count of places from which continuations are sought, where the cloud was not seen from one: chosen by eye; one place
scores as well (docs/pcgraph_experiments.md)."""
_SAMPLED_VOXELS = 64
"""Count of voxels whose points' viewpoints are candidates for these places: chosen by eye, not varied."""
_FAR_AWAY = 1e3
"""Distance, in voxel edges, of the points that fix the sign of a plane's normal: far enough, so that rays are nearly
parallel."""
_UPWARDS = np.array([0.0, 0.0, 1.0])

PlanesFrom = Callable[[VoxelGrid, NDArray[np.float64]], LocalPlanes]
"""`SupervoxelMethod.planes`: planes of v voxels, with normals towards viewpoints, (3,) or (v, 3) float64, metres."""


class Evidence(Enum):
    """Evidence of the place from which a cloud was seen."""

    GIVEN = "sure: it was given"
    PIXELS = "sure: the order of its pixels tells"
    RINGS = "likely: rings of its points lie about that place"
    SPACING = "likely: the spacing of the points grows with range from there"
    NOTHING = "nothing tells where from"

    @property
    def is_sure(self) -> bool:
        """True if the evidence leaves no doubt."""
        return self in (Evidence.GIVEN, Evidence.PIXELS)


class OrientedPlanes(NamedTuple):
    """Planes of v voxels with outward normals.

    Attributes
    ----------
    planes : LocalPlanes
    places : (p, 3) float64, metres
        Places that see the outside: sensor positions, or virtual viewpoints.
    """

    planes: LocalPlanes
    places: NDArray[np.float64]


class Told(NamedTuple):
    """Facts about an acquisition that the caller gave or the pixels tell.

    Attributes
    ----------
    evidence : Evidence
        Evidence of the viewpoint.
    image : DepthImage, or None
        What a camera measured, pixel by pixel, if the points are pixels of one.
    normals : bool
        Whether normals came with most of the points.
    growth : float, or None
        Power of the range with which voxels grow, if the caller gave one.
    """

    evidence: Evidence = Evidence.NOTHING
    image: DepthImage | None = None
    normals: bool = False
    growth: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Acquisition(ABC):
    """The acquisition of a cloud: by which sensor it was taken, and from where.

    Attributes
    ----------
    told : Told
        Facts that the caller gave or the pixels tell.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 64), np.linspace(-1.0, 1.0, 64))
    >>> wall = np.stack((x, y, np.full_like(x, 2.0)), axis=-1)
    >>> pcgraph.segment(wall).acquisition
    Acquisition(seen by one camera at (0, 0, 0) m; sure: the order of its pixels tells)
    >>> pcgraph.segment(wall.reshape(-1, 3) + 5.0, viewpoint=(5.0, 5.0, 0.0), camera=False).acquisition
    Acquisition(seen from (5, 5, 0) m; sure: it was given)
    """

    told: Told

    @property
    def viewpoint(self) -> NDArray[np.float64] | None:
        """Position of the sensor, (3,) or for each of n points (n, 3), metres, the points' frame; None if unknown."""
        return None

    def viewpoint_of(self, cloud: CleanCloud) -> NDArray[np.float64] | None:
        """The viewpoint of the points of a cloud, (3,) or (n, 3) metres; None if that is unknown."""
        return self.viewpoint

    @property
    def one_viewpoint(self) -> NDArray[np.float64] | None:
        """The viewpoint, (3,) metres, if all points were seen from it; else None."""
        place = self.viewpoint
        return place if place is not None and place.ndim == 1 else None

    @property
    def is_one_scan(self) -> bool:
        """True if one sensor took all points from about one place, and voxels grow with the distance from it.

        Voxels then follow the spacing of the points, so that a gap between voxels means more than among several scans.
        """
        return False

    @property
    def has_pixels(self) -> bool:
        """True if the points are pixels of a camera, whose spacing along rows and along columns may differ."""
        return False

    @property
    def sides_known(self) -> bool:
        """True if the outer side of surfaces is known, and not guessed."""
        return self.told.normals or self.viewpoint is not None

    def with_spacing(self, cloud: CleanCloud) -> tuple[Acquisition, float | None]:
        """The acquisition after a look at the spacing of the points, and the median spacing, metres, if it was read."""
        return self, None

    def confirmed(self, grid: VoxelGrid) -> Acquisition:
        """The acquisition after a check of its viewpoint against what is visible from there."""
        return self

    def without_image(self) -> Acquisition:
        """The acquisition without its depth image, which takes memory and is used for voxels alone."""
        return replace(self, told=self.told._replace(image=None))

    def warp(self, points: NDArray[np.float64]) -> Warp:
        """The warp by which voxels of points, (n, 3), grow; the identity if they do not."""
        return Warp()

    def oriented(self, cloud: CleanCloud, grid: VoxelGrid, planes_from: PlanesFrom) -> OrientedPlanes:
        """The plane of each voxel, with its normal outwards: towards the one viewpoint, or else where it is visible."""
        place = self.one_viewpoint
        if place is not None:
            return OrientedPlanes(planes_from(grid, place), place[None])
        planes, virtual = side_by_side(
            lambda: planes_from(grid, far_along(grid, _UPWARDS)), lambda: virtual_viewpoints(grid)
        )
        sides = visible_sides(grid, planes.normals, virtual)
        return OrientedPlanes(replace(planes, normals=sides.normals), sides.places[:_MAX_PLACES])

    @property
    def in_words(self) -> str:
        """The acquisition and its evidence in words, as in "seen from (0, 0, 0) m; sure: it was given"."""
        return f"{self}; {self.told.evidence.value}"

    @abstractmethod
    def __str__(self) -> str:
        """The acquisition in words, as in "seen by one camera at (0, 0, 0) m"."""

    def __repr__(self) -> str:
        return f"Acquisition({self.in_words})"


@dataclass(frozen=True, eq=False, repr=False)
class UnknownAcquisition(Acquisition):
    """A cloud seen from unknown places, such as a mesh or merged scans.

    The outside of a surface is the side that is visible from virtual viewpoints. Voxels have one size.
    """

    def with_spacing(self, cloud: CleanCloud) -> tuple[Acquisition, float | None]:
        law, spacing = _law_and_spacing(cloud, None)
        growth = RANGE_GROWTH if self.told.growth is None else self.told.growth
        if law.holds:
            evidence = Evidence.SPACING if law.axis is None else Evidence.RINGS
            return Scanner(self.told._replace(evidence=evidence), law.viewpoint, growth, law), spacing
        if self.told.growth:
            return MovingScanner(self.told, np.zeros(3), growth), spacing
        return self, spacing

    def __str__(self) -> str:
        return "seen from unknown places"


@dataclass(frozen=True, eq=False, repr=False)
class OnePlace(Acquisition):
    """A cloud seen from one known place, whose spacing does not tell what sensor it was.

    Attributes
    ----------
    place : (3,) float64, metres
    """

    place: NDArray[np.float64]

    @property
    def viewpoint(self) -> NDArray[np.float64]:
        return self.place

    def with_spacing(self, cloud: CleanCloud) -> tuple[Acquisition, float | None]:
        if self.told.growth is not None:
            return self, None
        law, spacing = _law_and_spacing(cloud, self.place)
        return (Scanner(self.told, self.place, RANGE_GROWTH, law) if law.holds else self), spacing

    def __str__(self) -> str:
        return f"seen from {_in_words(self.place)}"


@dataclass(frozen=True, eq=False, repr=False)
class CameraImage(Acquisition):
    """A cloud of pixels of one camera. Voxels grow with depth, as pixels do.

    Attributes
    ----------
    place : (3,) float64, metres
        Centre of projection.
    axis : (3,) float64
        Optical axis, forwards, of unit length.
    """

    place: NDArray[np.float64]
    axis: NDArray[np.float64]

    @property
    def viewpoint(self) -> NDArray[np.float64]:
        return self.place

    @property
    def is_one_scan(self) -> bool:
        return True

    @property
    def has_pixels(self) -> bool:
        return True

    def warp(self, points: NDArray[np.float64]) -> Warp:
        return CameraWarp.about(points, self.place, self.axis)

    def __str__(self) -> str:
        return f"seen by one camera at {_in_words(self.place)}"


@dataclass(frozen=True, eq=False, repr=False)
class Scanner(Acquisition):
    """A cloud of one scanner that stood still. Voxels grow with a power of the range, as the spacing of points does.

    Attributes
    ----------
    place : (3,) float64, metres
    growth : float, 0..1, without 1
        Power of the range with which voxels grow.
    law : SpacingLaw, or None
        The law of spacing that tells the scanner; None if the caller gave place and growth.
    """

    place: NDArray[np.float64]
    growth: float
    law: SpacingLaw | None = None

    @property
    def viewpoint(self) -> NDArray[np.float64]:
        return self.place

    @property
    def is_one_scan(self) -> bool:
        return self.growth > 0.0

    def confirmed(self, grid: VoxelGrid) -> Acquisition:
        """A scanner at the likelier of two mirrored places; a moving scanner, if neither shows most of the surface.

        Spacing grows with range about the middle of a short way, too, along which a scanner moved. But what it passed
        has sides that the middle does not see. The place that rings tell is near enough, and is not checked.
        """
        law = self.law
        if self.told.evidence is not Evidence.SPACING or law is None:
            return self
        place = law.viewpoint if law.mirrored is None else likelier_viewpoint(grid, law.viewpoint, law.mirrored)
        # The frame's origin, which explains as much as the best place, may lie on the ground and see little of it.
        tried = (place,) if law.best_viewpoint is None else (place, law.best_viewpoint)
        if any(shown_fraction(grid, one) >= _MIN_SHOWN for one in tried):
            return replace(self, place=place)
        return MovingScanner(self.told, law.viewpoint, self.growth)

    def warp(self, points: NDArray[np.float64]) -> Warp:
        return RangeWarp.about(points, self.place, self.growth)

    def oriented(self, cloud: CleanCloud, grid: VoxelGrid, planes_from: PlanesFrom) -> OrientedPlanes:
        oriented = super().oriented(cloud, grid, planes_from)
        if self.law is None or self.law.axis is None:
            return oriented
        normals = sides_towards(grid, oriented.planes.normals, self.place, self.law.axis)
        return oriented._replace(planes=replace(oriented.planes, normals=normals))

    def __str__(self) -> str:
        return f"seen by one scanner at {_in_words(self.place)}"


@dataclass(frozen=True, eq=False, repr=False)
class MovingScanner(Acquisition):
    """A cloud whose spacing grows with the range from a place that does not see all of it.

    Voxels grow with range from there. The outside is the side that is visible from virtual viewpoints.

    Attributes
    ----------
    middle : (3,) float64, metres
        The middle of the scanner's way.
    growth : float, 0..1, without 1
        Power of the range with which voxels grow.
    """

    middle: NDArray[np.float64]
    growth: float

    @property
    def is_one_scan(self) -> bool:
        return self.growth > 0.0

    def warp(self, points: NDArray[np.float64]) -> Warp:
        return RangeWarp.about(points, self.middle, self.growth)

    def __str__(self) -> str:
        return f"seen by a scanner that moved about {_in_words(self.middle)}"


@dataclass(frozen=True, eq=False, repr=False)
class SeveralPlaces(Acquisition):
    """A cloud with a known viewpoint for each point. Voxels have one size.

    Attributes
    ----------
    places : (n, 3) float64, metres
        The place of each of n points of the input; NaN where nothing was measured.
    """

    places: NDArray[np.float64]

    @property
    def viewpoint(self) -> NDArray[np.float64]:
        return self.places

    def viewpoint_of(self, cloud: CleanCloud) -> NDArray[np.float64]:
        return self.places[cloud.kept]

    def oriented(self, cloud: CleanCloud, grid: VoxelGrid, planes_from: PlanesFrom) -> OrientedPlanes:
        """Planes with normals towards the mean of the places from which the points of a voxel were seen."""
        places = self.viewpoint_of(cloud)
        low, high = bounding_box(places)
        middle, reach = (low + high) / 2.0, max(float((high - low).max()), np.finfo(np.float64).tiny)
        of_voxels = middle + reach * voxel_means((places - middle) / reach, grid)
        planes = planes_from(grid, far_along(grid, _UPWARDS))
        planes = replace(planes, normals=sides_towards_each(grid, planes.normals, of_voxels))
        return OrientedPlanes(planes, _some_places(places, grid))

    def __str__(self) -> str:
        return "seen from several known places"


@dataclass(frozen=True, eq=False, repr=False)
class SeveralScans(Acquisition):
    """Scans of one scene, one after the other.

    Attributes
    ----------
    number : int
        Count of the scans.
    first, last : Acquisition
        The first scan, by which voxels grow, and the last one.
    all_sides_known : bool
        Whether each scan tells the outer side of surfaces.
    """

    number: int
    first: Acquisition
    last: Acquisition
    all_sides_known: bool

    @classmethod
    def of(cls, earlier: Acquisition, last: Acquisition) -> SeveralScans:
        """The scans so far and one more."""
        number, first = (earlier.number, earlier.first) if isinstance(earlier, SeveralScans) else (1, earlier)
        return cls(last.told, number + 1, first, last, earlier.sides_known and last.sides_known)

    @property
    def viewpoint(self) -> NDArray[np.float64] | None:
        """The viewpoint of the last scan."""
        return self.last.viewpoint

    def viewpoint_of(self, cloud: CleanCloud) -> NDArray[np.float64] | None:
        return self.last.viewpoint_of(cloud)

    @property
    def one_viewpoint(self) -> NDArray[np.float64] | None:
        return None

    @property
    def is_one_scan(self) -> bool:
        """True if the voxels, which are those of the first scan, follow the spacing of the points of one scan."""
        return self.first.is_one_scan

    @property
    def sides_known(self) -> bool:
        return self.all_sides_known

    def __str__(self) -> str:
        return f"{self.number} scans, the last {self.last}"


def acquisition_of(
    cloud: CleanCloud,
    viewpoint: ArrayLike | None = None,
    camera: bool | None = None,
    range_growth: float | None = None,
) -> Acquisition:
    """The acquisition that the caller and the pixels tell.

    Parameters
    ----------
    cloud : CleanCloud of n points
    viewpoint, camera, range_growth
        As for `pcgraph.segment`. What is given is not guessed.

    Raises
    ------
    ValueError
        An argument is not as documented; two of them contradict each other; or voxels shall grow about one place, and
        viewpoints of all points are given.
    """
    if not (camera is None or isinstance(camera, (bool, np.bool_))):
        raise ValueError(f"expected camera as True, False or None, got {camera!r}")
    growth = None if range_growth is None else fraction("range_growth", range_growth)
    if camera and growth:
        raise ValueError("expected camera=True or a range_growth above 0, got both; voxels grow in one way")
    place, axis, evidence = _place_and_axis(cloud, viewpoint, bool(camera))
    told = Told(evidence, None, _tell_sides(cloud.normals), growth)
    if place is None:
        return UnknownAcquisition(told)
    if place.ndim == 2:
        if camera or growth:
            raise ValueError("expected one viewpoint where voxels grow with depth or range, got one per point")
        places = np.full((math.prod(cloud.shape), 3), np.nan)
        places[cloud.kept] = place
        return SeveralPlaces(told, places)
    grows_with_depth = camera or (camera is None and growth is None)
    if camera is None:
        camera = axis is not None or is_camera_image(cloud, place)
    if camera and cloud.image is not None:
        told = told._replace(image=DepthImage.of(cloud.points, cloud.image, place, axis))
    if camera and grows_with_depth:
        return CameraImage(told, place, np.array(FORWARDS) if axis is None else axis)
    return Scanner(told, place, growth) if growth else OnePlace(told, place)


def _tell_sides(normals: NDArray[np.float64] | None) -> bool:
    """Whether most normals, (n, 3), are given, and not zero."""
    return normals is not None and bool(2 * np.count_nonzero(normals.any(axis=1)) > len(normals))


def _place_and_axis(
    cloud: CleanCloud, viewpoint: ArrayLike | None, camera: bool
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None, Evidence]:
    """Viewpoint, (3,) or (n, 3) metres, and optical axis, (3,), None where unknown; and what tells them."""
    if viewpoint is not None:
        given = clean_viewpoint(viewpoint, cloud)
        return given, axis_at(given, cloud) if given.ndim == 1 else None, Evidence.GIVEN
    view = image_view(cloud)
    if view is not None:
        return view.place, view.axis, Evidence.PIXELS
    return (np.zeros(3), None, Evidence.GIVEN) if camera else (None, None, Evidence.NOTHING)


def _law_and_spacing(cloud: CleanCloud, place: NDArray[np.float64] | None) -> tuple[SpacingLaw, float]:
    """The law of spacing about a place, or about the place that fits best; and the median spacing, metres."""
    (spacing, rows), of_all = side_by_side(
        partial(spacing_and_rows, cloud.points), partial(spacing_law, cloud.points, place, cloud.sample)
    )
    return law_on_rings(cloud.points, of_all, rows, place, cloud.sample), spacing


def _some_places(places: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """A few of the points' viewpoints, (n, 3), far from each other, whatever the points' order."""
    voxels = np.unique(np.linspace(0, grid.n_voxels - 1, _SAMPLED_VOXELS).astype(np.int64))
    of_voxels = [places[grid.order[grid.starts[v] : grid.starts[v + 1]]] for v in voxels]
    found = np.unique(np.concatenate(of_voxels), axis=0)
    return found[farthest_points(found, 0, _MAX_PLACES)]


def far_along(grid: VoxelGrid, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Far points, (v, 3) metres, along directions, (3,) or (v, 3), from each voxel: they fix the sign of its normal."""
    places = directions * (_FAR_AWAY * grid.edge_lengths)[:, None]
    places += grid.centroids
    return places


def _in_words(place: NDArray[np.float64]) -> str:
    """A place as "(1, 0.5, 2) m"."""
    return f"({', '.join(f'{x + 0.0:.4g}' for x in place)}) m"
