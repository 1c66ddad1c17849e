# SPDX-License-Identifier: Apache-2.0
"""Is the place from which a scan was taken found from its points alone? Scans by several sensors, and fused ones.

    python benchmarks/scan_places.py [--turns N]

Every cloud is turned and moved by 100 m, N times. Columns:

    told, rings fraction of the clouds that are said to be one scan, and of those whose rings told the place
    off, worst  distance from the true place to the one that `pcgraph.segment` returns, over the median range: median
                and largest; of single scans
    facing      fraction of the voxels whose normals are turned to the true place, of those that are not seen edge-on
                (cosine below 0.1), least over the clouds; likewise
    covering    weighted overlap of the objects with the true segments, mean

The last line is JSON: the same by kind.
"""

from __future__ import annotations

import argparse
import itertools
import json
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import scanned_elsewhere
from domain_clouds import (
    MissingDataError,
    Sample,
    mosd_points,
    room1,
    simulated_room,
    street_mobile,
    street_sweep,
    turned,
)
from numpy.typing import NDArray
from scanned_rooms import flat, office, stations
from scanned_scenes import Floats, rays_at, scan, sphere_of_rays
from scanned_streets import place_over_lane, street
from scores import fraction_facing

import pcgraph
from pcgraph.acquisition.spacing_law import law_on_rings, spacing_law
from pcgraph.metrics import weighted_overlap
from pcgraph.voxels.spacing import spacing_and_rows

Kept = NDArray[np.int64] | NDArray[np.bool_]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=4, metavar="N")
    turns = parser.parse_args().turns
    warnings.simplefilter("ignore")  # of viewpoints edge-on and the like: none is given here
    print(f"{'':28s}{'clouds':>8s}{'told':>8s}{'rings':>8s}{'off':>8s}{'worst':>8s}{'facing':>8s}{'covering':>10s}")
    report = {}
    for name, load in KINDS.items():
        try:
            clouds = list(load())
        except MissingDataError as missing:
            print(f"{name}: left out, {missing}")
            continue
        rows = [_measured(turned(cloud, seed)) for cloud in clouds for seed in range(turns)]
        told, rings, off, facing, covering = (np.array(column, float) for column in zip(*rows, strict=True))
        row = {
            "told": told.mean(),
            "rings": rings.mean(),
            "off": np.median(off),
            "worst": off.max(),
            "facing": facing.min(),
        }
        row = {key: float(value) for key, value in row.items() if np.isfinite(value)}
        report[name] = {"clouds": len(rows), **row, "covering": float(covering.mean())}
        numbers = "".join(
            f"{row[key]:8.3f}" if key in row else " " * 8 for key in ("told", "rings", "off", "worst", "facing")
        )
        print(f"{name:28s}{len(rows):8d}{numbers}{covering.mean():10.3f}", flush=True)
    print(json.dumps(report))


def _measured(sample: Sample) -> tuple[bool, bool, float, float, float]:
    result = pcgraph.segment(sample.points)
    points = sample.points.astype(np.float64)
    told = law_on_rings(points, spacing_law(points), spacing_and_rows(points)[1])
    covering = float(weighted_overlap(result.labels, sample.truth))
    if sample.viewpoint is None:
        return told.holds, told.axis is not None, np.nan, np.nan, covering
    far = np.median(np.linalg.norm(sample.points - sample.viewpoint, axis=1))
    facing = fraction_facing(result, sample.viewpoint)
    return (
        told.holds,
        told.axis is not None,
        float(np.linalg.norm(result.viewpoint - sample.viewpoint) / far),
        facing,
        covering,
    )


def _sweeps() -> list[Sample]:
    return [sample for seed in (1, 2, 3, 11, 12, 13) for sample in street_sweep(seed)]


def _stations() -> Iterator[Sample]:
    for scene, places in (office(), flat()):
        for i, place in enumerate(places):
            found = stations(scene, places[i : i + 1], i, 0.5)
            yield Sample(found.points, found.things, viewpoint=place)


def _single(name: str) -> Sample:
    """Of a scan from several places, that of most points."""
    found = getattr(scanned_elsewhere, name)()
    places, place_of = np.unique(found.origins, axis=0, return_inverse=True)
    chosen = int(np.argmax(np.bincount(place_of.ravel())))
    kept = place_of.ravel() == chosen
    return Sample(found.points[kept], found.things[kept], viewpoint=places[chosen])


def _fused() -> Iterator[Sample]:
    for sample in (*room1(), *simulated_room("A"), *simulated_room("B"), *street_mobile(2)):
        yield replace(sample, viewpoint=None)
    for name in ("plant", "warehouse", "turntable", "house_front", "drifting_walk", "power_lines", "hay_bales"):
        found = getattr(scanned_elsewhere, name)()
        yield Sample(found.points, found.things)


# --- Other sensors ----------------------------------------------------------------------------------------------------


def _in_streets(rays: Floats) -> Iterator[Sample]:
    """Three streets from the roof of a car, 2 cm of noise."""
    for seed in (31, 32, 33):
        made = street(seed)
        place = place_over_lane(made)
        found = scan(made.scene, place[None], [rays], 0.02, np.random.default_rng(seed))
        yield Sample(found.points, found.things, viewpoint=place)


def _in_a_flat(rays: Floats) -> Iterator[Sample]:
    """Rooms from four places, 1 cm of noise."""
    scene, places = flat()
    for seed, place in enumerate(places[:4]):
        found = scan(scene, place[None], [rays], 0.01, np.random.default_rng(seed), reach=30.0)
        yield Sample(found.points, found.things, viewpoint=place)


def _beams(number: int, lowest: float, highest: float, azimuths: tuple[float, float] = (0.0, 360.0)) -> Floats:
    """Rays of a turning LiDAR, 0.2 degrees apart along its rings; angles in degrees."""
    return sphere_of_rays(np.arange(*azimuths, 0.2), np.linspace(lowest, highest, number))


def _rows(lowest: float, highest: float) -> Floats:
    """Rays of a terrestrial scanner, every half degree in azimuth and elevation."""
    return sphere_of_rays(np.arange(0.0, 360.0, 0.5), np.arange(lowest, highest, 0.5))


def _rosette() -> Floats:
    """Rays at random within 70 by 37 degrees ahead, as of a rosette scanner."""
    return rays_at(*np.random.default_rng(0).uniform((-35.0, -25.0), (35.0, 12.0), (60_000, 2)).T)


# --- What people do to scans before they segment them: which points are left ------------------------------------------


def _left(load: Callable[[], Iterable[Sample]], chosen: Callable[[Sample], Kept]) -> Iterator[Sample]:
    """Some points of every second cloud."""
    for sample in itertools.islice(load(), 0, None, 2):
        kept = chosen(sample)
        yield replace(sample, points=sample.points[kept], truth=sample.truth[kept])


def _one_per_cell(size: float, sample: Sample) -> Kept:
    return np.unique(np.floor(sample.points / size), axis=0, return_index=True)[1]


def _around_things(sample: Sample) -> Kept:
    return np.linalg.norm(sample.points - sample.points[sample.truth >= 2].mean(axis=0), axis=1) < 0.25


def _within(reach: float, sample: Sample) -> Kept:
    return np.linalg.norm(sample.points, axis=1) < reach


def _noisy_tables() -> Iterator[Sample]:
    rng = np.random.default_rng(0)
    for sample in mosd_points()[::2]:
        yield replace(sample, points=sample.points + rng.normal(0.0, 0.002, sample.points.shape))


KINDS: dict[str, Callable[[], Iterable[Sample]]] = {
    "tables (mOSD), camera": mosd_points,
    "streets, 64 beams": _sweeps,
    "rooms, one tripod": _stations,
    "plant, warehouse: one tripod": lambda: [_single("plant"), _single("warehouse")],
    "table, stereo camera": lambda: [_single("stereo_table")],
    "fused, from many places": _fused,
    "streets, 16 beams": lambda: _in_streets(_beams(16, -15.0, 15.0)),
    "streets, 32 beams": lambda: _in_streets(_beams(32, -30.0, 10.0)),
    "streets, 128 beams ahead": lambda: _in_streets(_beams(128, -12.0, 12.0, (-60.0, 60.0))),
    "streets, rosette ahead": lambda: _in_streets(_rosette()),
    "rooms, 16 beams": lambda: _in_a_flat(_beams(16, -15.0, 15.0)),
    "rooms, 32 beams": lambda: _in_a_flat(_beams(32, -30.0, 10.0)),
    "rooms, 128 beams, 90 degrees": lambda: _in_a_flat(_beams(128, -45.0, 45.0, (0.0, 90.0))),
    "rooms, up to the zenith": lambda: _in_a_flat(_rows(-60.0, 90.1)),
    "tables, a tenth": partial(_left, mosd_points, lambda sample: np.arange(0, len(sample.points), 10)),
    "tables, left half": partial(
        _left, mosd_points, lambda sample: sample.points[:, 0] < np.median(sample.points[:, 0])
    ),
    "tables, 2 mm of noise": _noisy_tables,
    "tables, 25 cm around things": partial(_left, mosd_points, _around_things),
    "tables, one point per 3 mm": partial(_left, mosd_points, partial(_one_per_cell, 0.003)),
    "tables, one point per 5 mm": partial(_left, mosd_points, partial(_one_per_cell, 0.005)),
    "streets, 90 degrees": partial(_left, _sweeps, lambda sample: sample.points[:, 0] > np.abs(sample.points[:, 1])),
    "streets, within 15 m": partial(_left, _sweeps, partial(_within, 15.0)),
    "streets, beyond 10 m": partial(_left, _sweeps, lambda sample: ~_within(10.0, sample)),
    "streets, without ground": partial(_left, _sweeps, lambda sample: sample.points[:, 2] > -1.5),
    "streets, one per 15 cm": partial(_left, _sweeps, partial(_one_per_cell, 0.15)),
    "streets, one per 20 cm": partial(_left, _sweeps, partial(_one_per_cell, 0.2)),
    "streets, one per 30 cm": partial(_left, _sweeps, partial(_one_per_cell, 0.3)),
}

if __name__ == "__main__":
    main()
