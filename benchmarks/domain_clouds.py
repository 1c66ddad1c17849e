# SPDX-License-Identifier: Apache-2.0
"""Labelled clouds of many kinds, for `domains.py`: depth images, fused rooms, streets, airborne lidar, bins, noise.

Real ones come from ../shared/data and are left out where they are missing. The others are made here: exact truth, the
same for the same seed, kept under build/ until the code that makes them changes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import scanned_scenes
from mosd import load_clouds
from numpy.typing import NDArray
from scanned_scenes import CAR, PERSON, POLE, drive, street, sweep
from scipy.spatial.transform import Rotation

import pcgraph

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
CACHE = Path(__file__).resolve().parent.parent / "build" / "domain_clouds"  # git ignores it
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
        True segment of each point, -1 where it is not judged.
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
    camera: bool = False

    @property
    def organised(self) -> bool:
        """Whether the points lie on an image lattice."""
        return self.points.ndim == 3


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
    table, room, road = (0.01, 0.02, 0.04), (0.02, 0.04, 0.08, 0.15), (0.3, 0.5, 0.7, 1.0)
    things, levels = ("things", "wov", "oracle"), ("wov", "oracle")
    return [
        Domain("mosd organised", levels, mosd_organised, 100, table, 0.01),
        Domain("mosd points", levels, mosd_points, 100, table, 0.01),
        Domain("mosd turned", levels, mosd_turned, 100, table, 0.01),
        Domain("mosd mm", levels, mosd_millimetres, 100, (10.0, 20.0, 40.0), 10.0),
        Domain("room1", levels, room1, 300, room, 0.03),
        Domain("street sweep A", things, lambda: street_sweep(1), 300, road, 0.2),
        Domain("street sweep B", things, lambda: street_sweep(2), 300, road, 0.2),
        Domain("plane 2 mm", ("one",), plane, 1, (0.01, 0.03), 0.01),
        Domain("plane 2 mm, mm", ("one",), plane_millimetres, 1, (10.0, 30.0), 10.0),
    ]


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
    return [_turned(sample, seed) for seed, sample in enumerate(mosd_points())]


def mosd_millimetres() -> list[Sample]:
    """The lists in whole millimetres."""
    return [_in_millimetres(sample) for sample in mosd_points()]


def _listed(sample: Sample, seed: int) -> Sample:
    finite = np.flatnonzero(np.isfinite(sample.points).all(axis=-1).ravel())
    order = np.random.default_rng(seed).permutation(finite)
    colors = None if sample.colors is None else sample.colors.reshape(-1, 3)[order]
    return Sample(sample.points.reshape(-1, 3)[order], sample.truth.ravel()[order], colors, np.zeros(3), camera=True)


def _turned(sample: Sample, seed: int) -> Sample:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    way = rng.standard_normal(3)
    shift = 100.0 * way / np.linalg.norm(way)
    return replace(sample, points=sample.points @ turn.T + shift, viewpoint=shift, camera=False)


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


# --- Streets ------------------------------------------------------------------------------------------------------


def street_sweep(seed: int) -> list[Sample]:
    """One revolution of a 64-beam LiDAR in a street."""
    return [_kept(f"sweep {seed}", lambda: _street_sample(seed, moving=False))]


def _street_sample(seed: int, *, moving: bool) -> Sample:
    made = street(seed)
    found = drive(made, seed) if moving else sweep(made, seed)
    judged = made.scene.numbers(CAR, POLE, PERSON)
    counts = np.bincount(found.things, minlength=len(made.scene.kinds))
    viewpoint = found.origins if moving else np.zeros(3)
    return Sample(found.points, found.things, None, viewpoint, things=judged[counts[judged] >= MIN_THING])


# --- Planes -------------------------------------------------------------------------------------------------------


def plane() -> list[Sample]:
    """One square metre with 2 mm of noise; its corner is the origin, so that no viewpoint can be guessed from it."""
    rng = np.random.default_rng(0)
    points = np.concatenate((rng.random((100_000, 2)), 0.002 * rng.standard_normal((100_000, 1))), axis=1)
    points -= points.min(axis=0)
    return [Sample(points, np.zeros(len(points), np.int32), None, np.array([0.5, 0.5, 3.0]))]


def plane_millimetres() -> list[Sample]:
    """The same in whole millimetres."""
    return [_in_millimetres(sample) for sample in plane()]


# --- Files --------------------------------------------------------------------------------------------------------


def _found(path: Path) -> Path:
    if not path.exists():
        raise MissingDataError(f"{path} is not there")
    return path


def _kept(name: str, make: Callable[[], Sample]) -> Sample:
    """A sample from build/, made if it is not there or the code of clouds and scenes has changed since."""
    code = b"".join(Path(file).read_bytes() for file in (__file__, scanned_scenes.__file__))
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
