# SPDX-License-Identifier: Apache-2.0
"""Labelled clouds of many kinds, for `domains.py`: depth images, fused rooms, meshes, streets, airborne lidar, noise.

Real ones come from ../shared/data and are left out where they are missing. The others are made here: exact truth, the
same for the same seed, kept under build/ until the code that makes them changes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import meshed_rooms
import numpy as np
import scanned_elsewhere
import scanned_rooms
import scanned_scenes
import scanned_streets
from meshed_rooms import meshed
from mosd import load_clouds
from numpy.typing import NDArray
from scanned_rooms import flat, office, stations
from scanned_scenes import Scan, Scene
from scanned_streets import CAR, PERSON, POLE, drive, street, sweep
from scipy.spatial.transform import Rotation

import pcgraph

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
CACHE = Path(__file__).resolve().parent.parent / "build" / "domain_clouds"  # git ignores it
NOISE = -2
MIN_THING = 30  # points; cars, poles and people with fewer are not judged


class MissingDataError(Exception):
    """A file of ../shared/data is not there."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One cloud with its truth.

    Attributes
    ----------
    points : (n, 3) or (h, w, 3) float or int
        Metres, unless the domain is in millimetres.
    truth : same leading shape, int32
        True segment of each point, -1 where it is not judged, -2 for noise.
    colors : same leading shape + (3,), uint8, or None
    viewpoint : (3,) or points' shape float, or None
        Where the sensor stood; told to `best` only.
    parts : same leading shape, int32, or None
        A finer truth.
    things : (t,) int64
        True segments that are judged one by one.
    clean : Sample, optional
        The same without noise points.
    superpoints : same leading shape, int, or None
        Another's partition.
    ground : int
        True segment that is the ground, -1 if none is judged.
    camera : bool
        Whether a depth camera at the viewpoint looks along z.
    """

    points: NDArray[np.number]
    truth: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None
    viewpoint: NDArray[np.float64] | None = None
    parts: NDArray[np.int32] | None = None
    things: NDArray[np.int64] | None = None
    clean: Sample | None = None
    superpoints: NDArray[np.int64] | None = None
    ground: int = -1
    camera: bool = False

    @property
    def organised(self) -> bool:
        """Whether the points lie on an image lattice."""
        return self.points.ndim == 3

    def turned(self, turns: int) -> list[Sample]:
        """This cloud and, if it is a list of points, copies of it turned about z and shifted; so many in all."""
        turned = [self]
        for seed in range(1, 1 if self.organised else turns):
            random = np.random.default_rng(seed)
            turn = Rotation.from_euler("z", random.uniform(0.0, 360.0), degrees=True).as_matrix()
            shift = random.uniform(0.0, 0.1, 3)
            viewpoint = None if self.viewpoint is None else self.viewpoint @ turn.T + shift
            turned.append(replace(self, points=self.points @ turn.T + shift, viewpoint=viewpoint))
        return turned


@dataclass(frozen=True)
class Domain:
    """Clouds of one kind, and how a segmentation of them is judged.

    Attributes
    ----------
    name : str
    scores : tuple of str
        What counts, larger is better; scores are those of `domains.py`.
    load : function of no arguments
        Its clouds.
    segments : int
        Number of segments at which purity and oracle mIoU are measured.
    radii : tuple of float, the points' unit
        Of DBSCAN, from which the best is taken.
    ground : float, the points' unit
        Distance from the plane that RANSAC takes away before.
    large : bool
        Left out by --quick.
    """

    name: str
    scores: tuple[str, ...]
    load: Callable[[], list[Sample]]
    segments: int
    radii: tuple[float, ...]
    ground: float
    large: bool = False

    def samples(self) -> list[Sample]:
        """The clouds.

        Raises
        ------
        MissingDataError
            They are not there.
        """
        return self.load()


def domains(superpoints: Path | None = None) -> list[Domain]:
    """All domains; with those of a folder of superpoints, if given."""
    table, room, road, air = (0.01, 0.02, 0.04), (0.02, 0.04, 0.08, 0.15), (0.3, 0.5, 0.7, 1.0), (1.0, 2.0, 4.0)
    levels, things = ("wov", "oracle"), ("things", "wov", "oracle")
    rooms, aerial = ("wov", "oracle", "purity", "mIoU"), ("purity", "ground")
    found = [
        Domain("mosd organised", levels, mosd_organised, 100, table, 0.01),
        Domain("mosd points", levels, mosd_points, 100, table, 0.01),
        Domain("mosd turned", levels, mosd_turned, 100, table, 0.01),
        Domain("mosd mm", levels, mosd_millimetres, 100, (10.0, 20.0, 40.0), 10.0),
        Domain("tables + 10 % noise", ("wov",), lambda: tables_with_noise(0.1), 100, table, 0.01),
        Domain("tables + 50 % noise", ("wov",), lambda: tables_with_noise(0.5), 100, table, 0.01),
        Domain("room1", rooms, room1, 300, room, 0.03),
        Domain("simulated room A", rooms, lambda: simulated_room("A"), 300, room, 0.02),
        Domain("simulated room B", rooms, lambda: simulated_room("B"), 300, room, 0.02),
        Domain("room1 thinned", rooms, lambda: thinned_room("room1", 0.03), 300, room, 0.03),
        Domain("room A thinned", rooms, lambda: thinned_room("A", 0.05), 300, room, 0.02),
        Domain("room B thinned", rooms, lambda: thinned_room("B", 0.03), 300, room, 0.02),
        Domain("room A as mesh", rooms, lambda: meshed_room("A"), 300, room, 0.02),
        Domain("room B as mesh", rooms, lambda: meshed_room("B"), 300, room, 0.02),
        Domain("street sweep A", things, lambda: street_sweep(1), 300, road, 0.2),
        Domain("street sweep B", things, lambda: street_sweep(7), 300, road, 0.2),
        Domain("street mobile", levels, lambda: street_mobile(3), 300, road, 0.2, large=True),
        Domain("airborne tile", aerial, airborne_tile, 100, air, 0.3),
        *(Domain(f"isprs samp{k}", aerial, partial(isprs, k), 100, air, 0.5) for k in (11, 12, 21, 23, 31, 41)),
        Domain("bins A", levels, partial(bins, "A"), 100, (0.02, 0.04, 0.08), 0.03),
        Domain("bins C", levels, partial(bins, "C"), 100, (0.02, 0.04, 0.08), 0.03),
        *(Domain(name, things, partial(elsewhere, name), 100, *units) for name, units in ELSEWHERE.items()),
        Domain("plane 2 mm", ("one",), planes, 1, (0.01, 0.03), 0.01),
        Domain("plane in mm", ("one",), planes_in_millimetres, 1, (10.0, 30.0), 10.0),
    ]
    files = sorted(superpoints.glob("*.npz")) if superpoints else []
    cuts = ("purity", "mIoU")
    brought = {f"superpoints {file.stem}": partial(with_superpoints, file) for file in files}
    return found + [Domain(name, cuts, load, 0, room, 0.03) for name, load in brought.items()]


# --- Depth images of tables ---------------------------------------------------------------------------------------


@cache
def mosd_organised() -> list[Sample]:
    """Labelled Kinect clouds as images."""
    folder = _found(DATA / "mosd")
    return [Sample(cloud.points, cloud.objects, cloud.colors) for cloud in load_clouds(folder)]


def mosd_points() -> list[Sample]:
    """The same as lists of their finite points in any order."""
    return [_listed(sample, seed) for seed, sample in enumerate(mosd_organised())]


def mosd_turned() -> list[Sample]:
    """The lists turned any way and moved by 100 m."""
    return [turned(sample, seed) for seed, sample in enumerate(mosd_points())]


def mosd_millimetres() -> list[Sample]:
    """The lists in whole millimetres."""
    return [_in_millimetres(sample) for sample in mosd_points()]


def tables_with_noise(fraction: float) -> list[Sample]:
    """Every third list, with that fraction of its points again as uniform noise in its bounding box."""
    return [_with_noise(sample, fraction, seed) for seed, sample in enumerate(mosd_points()[::3])]


def _with_noise(sample: Sample, fraction: float, seed: int) -> Sample:
    assert sample.colors is not None
    rng, n = np.random.default_rng(seed), len(sample.points)
    more = round(fraction * n)
    outliers = rng.uniform(sample.points.min(axis=0), sample.points.max(axis=0), (more, 3))
    order = rng.permutation(n + more)
    return replace(
        sample,
        points=np.concatenate((sample.points, outliers.astype(sample.points.dtype)))[order],
        colors=np.concatenate((sample.colors, rng.integers(0, 256, (more, 3), np.uint8)))[order],
        truth=np.concatenate((sample.truth, np.full(more, NOISE, np.int32)))[order],
        clean=sample,
    )


def _listed(sample: Sample, seed: int) -> Sample:
    finite = np.flatnonzero(np.isfinite(sample.points).all(axis=-1).ravel())
    order = np.random.default_rng(seed).permutation(finite)
    colors = None if sample.colors is None else sample.colors.reshape(-1, 3)[order]
    return Sample(sample.points.reshape(-1, 3)[order], sample.truth.ravel()[order], colors, np.zeros(3), camera=True)


def turned(sample: Sample, seed: int) -> Sample:
    """The cloud turned at random and moved by 100 m; a camera's frame is none any more."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    way = rng.standard_normal(3)
    shift = 100.0 * way / np.linalg.norm(way)
    viewpoint = None if sample.viewpoint is None else sample.viewpoint @ turn.T + shift
    return replace(sample, points=sample.points @ turn.T + shift, viewpoint=viewpoint, camera=False)


def _in_millimetres(sample: Sample) -> Sample:
    viewpoint = None if sample.viewpoint is None else 1e3 * sample.viewpoint
    return replace(sample, points=np.rint(1e3 * sample.points).astype(np.int32), viewpoint=viewpoint)


# --- Rooms --------------------------------------------------------------------------------------------------------


def room1() -> list[Sample]:
    """An office fused from many places; the best knobs are told its middle."""
    cloud = pcgraph.read_cloud(_found(DATA / "clouds" / "room1_fine.pcd"))
    assert cloud.labels is not None
    truth = np.where(cloud.labels > 0, cloud.labels, -1).astype(np.int32)
    return [Sample(cloud.points, truth, cloud.colors, _middle(cloud.points))]


def _middle(points: NDArray[np.floating]) -> NDArray[np.float64]:
    return (points.min(axis=0).astype(np.float64) + points.max(axis=0)) / 2.0


def simulated_room(name: str) -> list[Sample]:
    """A furnished room scanned from five or six places: A with colours, B without, and laid out in another way."""
    return [_kept(f"room {name}", lambda: _room_sample(*(office() if name == "A" else flat()), colored=name == "A"))]


def meshed_room(name: str) -> list[Sample]:
    """The same room as the vertices of a mesh fused from depth images: A as fused, B simplified."""
    if name == "A":
        return [_kept("mesh A", lambda: _room_sample(*office(), meshed(*office(), 0, 0.04), colored=True))]
    return [_kept("mesh B", lambda: _room_sample(*flat(), meshed(*flat(), 0, 0.025, 80_000), colored=False))]


def thinned_room(name: str, edge: float) -> list[Sample]:
    """A room as most store it, by the mean of the points in each cube, whose label is that of one of them."""
    (sample,) = room1() if name == "room1" else simulated_room(name)
    _, one, cube = np.unique(np.floor(sample.points / edge), axis=0, return_index=True, return_inverse=True)
    count = np.bincount(cube.ravel())
    points = np.stack([np.bincount(cube.ravel(), axis) / count for axis in sample.points.T], axis=1)
    colors = None if sample.colors is None else sample.colors[one]
    return [Sample(points, sample.truth[one], colors, _middle(points))]


def _room_sample(scene: Scene, places: NDArray[np.float64], found: Scan | None = None, *, colored: bool) -> Sample:
    """A room as terrestrial scanners see it, or as found."""
    found, rng = found or stations(scene, places, 0, 0.9), np.random.default_rng(0)
    shades = np.array(scene.tints, np.int64)[found.things] + rng.integers(-12, 13, (len(found.things), 3))
    colors = shades.clip(0, 255).astype(np.uint8) if colored else None
    counts = np.bincount(found.things[found.things >= 0], minlength=len(scene.kinds))
    things = np.setdiff1d(np.flatnonzero(counts >= MIN_THING), scene.numbers("floor", "wall", "ceiling"))
    return Sample(found.points, found.things, colors, found.origins, found.parts, things)


# --- Streets ------------------------------------------------------------------------------------------------------


def street_sweep(seed: int) -> list[Sample]:
    """One revolution of a 64-beam LiDAR in a street."""
    return [_kept(f"sweep {seed}", lambda: _street_sample(seed, moving=False))]


def street_mobile(seed: int) -> list[Sample]:
    """A street scanned every 4 m from a car, a million points."""
    return [_kept(f"mobile {seed}", lambda: _street_sample(seed, moving=True))]


def _street_sample(seed: int, *, moving: bool) -> Sample:
    made = street(seed)
    found = drive(made, seed) if moving else sweep(made, seed)
    judged = made.scene.numbers(CAR, POLE, PERSON)
    counts = np.bincount(found.things, minlength=len(made.scene.kinds))
    viewpoint = found.origins if moving else np.zeros(3)
    return Sample(found.points, found.things, None, viewpoint, things=judged[counts[judged] >= MIN_THING])


# --- From the air, and heaps of parts -----------------------------------------------------------------------------


def airborne_tile() -> list[Sample]:
    """Streets and houses from the air: ground, buildings, others."""
    return [_from_npz("airborne_tile", above=50.0, ground=2)]


def isprs(number: int) -> list[Sample]:
    """One of the ISPRS filter test: ground and objects.

    Objects are one class there, not segments, so that their covering says nothing. What counts is the purity of a
    fixed number of segments, which is one less the error of a filter that judges whole segments, and the IoU of the
    ground with one object.
    """
    return [_from_npz(f"isprs_samp{number}", above=500.0, ground=2)]


def bins(name: str) -> list[Sample]:
    """Edge points of parts in a bin, unit unknown."""
    return [_from_npz(f"bins_{name}", above=2.0, ground=-1)]


def _from_npz(name: str, above: float, ground: int) -> Sample:
    with np.load(_found(DATA / "clouds" / f"{name}.npz")) as columns:
        points, labels, colors = columns["points"], columns["labels"], columns["colors"]
    viewpoint = _middle(points) + np.array([0.0, 0.0, above])
    return Sample(points, labels.astype(np.int32), colors if len(colors) else None, viewpoint, ground=ground)


# --- Kinds held back ----------------------------------------------------------------------------------------------


ELSEWHERE = {  # radii of DBSCAN, and distance from RANSAC's plane, metres
    "plant": ((0.05, 0.1, 0.2), 0.02),
    "warehouse": ((0.05, 0.1, 0.2), 0.02),
    "stereo table": ((0.02, 0.04, 0.08), 0.02),
    "hay bales": ((0.4, 0.8, 1.6), 0.15),
    "turntable": ((0.004, 0.008, 0.016), 0.003),
    "house front": ((0.1, 0.2, 0.4), 0.04),
    "drifting walk": ((0.04, 0.08, 0.15), 0.03),
    "power lines": ((1.0, 2.0, 4.0), 0.3),
}


def elsewhere(name: str) -> list[Sample]:
    """A scene of a kind that no constant was chosen on; all of its things are judged."""
    return [_kept(name, lambda: _scene_elsewhere(getattr(scanned_elsewhere, name.replace(" ", "_"))()))]


def _scene_elsewhere(found: Scan) -> Sample:
    counts = np.bincount(found.things)
    return Sample(found.points, found.things, None, found.origins, things=np.flatnonzero(counts >= MIN_THING))


# --- Planes -------------------------------------------------------------------------------------------------------


def planes() -> list[Sample]:
    """One square metre with 2 mm of noise: lying, lying a hair above the origin, standing, tilted.

    Their lowest corner is the origin, so that no sensor stands there; the second's box just leaves the origin out.
    """
    rng = np.random.default_rng(0)
    points = np.concatenate((rng.random((100_000, 2)), 0.002 * rng.standard_normal((100_000, 1))), axis=1)
    tilt = Rotation.from_euler("xyz", (40.0, 20.0, 10.0), degrees=True).as_matrix()
    lying, standing, tilted = (moved - moved.min(axis=0) for moved in (points, points[:, [0, 2, 1]], points @ tilt.T))
    views = ((0.5, 0.5, 3.0), (0.5, 0.5, 3.0), (0.5, 3.0, 0.5), tuple(_middle(tilted) + 3.0 * tilt[:, 2]))
    truth = np.zeros(len(points), np.int32)
    shapes = (lying, lying + 1e-3, standing, tilted)
    return [Sample(shape, truth, None, np.array(view)) for shape, view in zip(shapes, views, strict=True)]


def planes_in_millimetres() -> list[Sample]:
    """The same in whole millimetres."""
    return [_in_millimetres(sample) for sample in planes()]


# --- Files --------------------------------------------------------------------------------------------------------


def with_superpoints(path: Path) -> list[Sample]:
    """A file with the columns points, labels (negative: not judged), superpoints, and at will colors."""
    with np.load(path) as columns:
        colors = columns["colors"] if "colors" in columns else np.empty((0, 3), np.uint8)
        points, labels, superpoints = columns["points"], columns["labels"], columns["superpoints"]
    seen = colors if len(colors) else None
    return [Sample(points, labels.astype(np.int32), seen, _middle(points), superpoints=superpoints.astype(np.int64))]


def _found(path: Path) -> Path:
    if not path.exists():
        raise MissingDataError(f"{path} is not there")
    return path


def _kept(name: str, make: Callable[[], Sample]) -> Sample:
    """A sample from build/, made if it is not there or the code of clouds and scenes has changed since."""
    scenes = (scanned_scenes, scanned_rooms, meshed_rooms, scanned_streets, scanned_elsewhere)
    sources = (__file__, *(str(module.__file__) for module in scenes))
    code = b"".join(Path(file).read_bytes() for file in sources)
    path = CACHE / f"{name.replace(' ', '_')}-{hashlib.sha256(code).hexdigest()[:12]}.npz"
    if path.exists():
        with np.load(path) as columns:
            return Sample(**columns)
    sample = make()
    CACHE.mkdir(parents=True, exist_ok=True)
    for old in CACHE.glob(f"{path.name.rsplit('-', 1)[0]}-*.npz"):
        old.unlink()
    np.savez(path, **{key: column for key, column in vars(sample).items() if isinstance(column, np.ndarray)})
    return sample
