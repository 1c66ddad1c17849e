# SPDX-License-Identifier: Apache-2.0
"""Is the place from which a scan was taken found from its points alone? Single scans, parts of them and fused ones.

    python benchmarks/scan_places.py [--turns N]

Every cloud is turned and moved by 100 m, N times. Columns:

    told        fraction of the clouds that `spacing_law` says are one scan
    off, worst  distance from the true place to the one that `pcgraph.segment` returns, over the median range: median
                and largest; of single scans
    facing      fraction of the voxels whose normals are turned to the true place, least over the clouds; likewise
    covering    weighted overlap of the objects with the true segments, mean

The last line is JSON: the same by kind.
"""

from __future__ import annotations

import argparse
import itertools
import json
import warnings
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import scanned_elsewhere
from domain_clouds import MissingDataError, mosd_points, room1, simulated_room, street_mobile, street_sweep
from numpy.typing import NDArray
from scanned_rooms import flat, office, stations
from scanned_scenes import Scan
from scipy.spatial.transform import Rotation

import pcgraph
from pcgraph.metrics import weighted_overlap
from pcgraph.voxels.spacing import spacing_law

Points = NDArray[np.float64]
Kept = NDArray[np.int64] | NDArray[np.bool_]
Truth = NDArray[np.int32]
Cloud = tuple[NDArray[np.float64], Truth, NDArray[np.float64] | None]  # points, truth, place


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=4, metavar="N")
    turns = parser.parse_args().turns
    warnings.simplefilter("ignore")  # of viewpoints edge-on and the like: none is given here
    print(f"{'':28s}{'clouds':>8s}{'told':>8s}{'off':>8s}{'worst':>8s}{'facing':>8s}{'covering':>10s}")
    report = {}
    for name, load in KINDS.items():
        try:
            clouds = list(load())
        except MissingDataError as missing:
            print(f"{name}: left out, {missing}")
            continue
        rows = [_measured(cloud, seed) for cloud in clouds for seed in range(turns)]
        told, off, facing, covering = (np.array(column, float) for column in zip(*rows, strict=True))
        row = {"told": told.mean(), "off": np.median(off), "worst": off.max(), "facing": facing.min()}
        row = {key: float(value) for key, value in row.items() if np.isfinite(value)}
        report[name] = {"clouds": len(rows), **row, "covering": float(covering.mean())}
        numbers = "".join(f"{row[key]:8.3f}" if key in row else " " * 8 for key in ("told", "off", "worst", "facing"))
        print(f"{name:28s}{len(rows):8d}{numbers}{covering.mean():10.3f}", flush=True)
    print(json.dumps(report))


def _measured(cloud: Cloud, seed: int) -> tuple[bool, float, float, float]:
    points, truth, place = cloud
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng).as_matrix(), 100.0 * rng.standard_normal(3)
    turned = points @ turn.T + shift
    result = pcgraph.segment(turned)
    told, covering = spacing_law(turned).holds, float(weighted_overlap(result.labels, truth))
    if place is None:
        return told, np.nan, np.nan, covering
    there = place @ turn.T + shift
    far = np.median(np.linalg.norm(turned - there, axis=1))
    rays = there - result.surface.grid.centroids
    facing = float((np.einsum("ij,ij->i", rays, result.surface.normals) > 0.0).mean())
    return told, float(np.linalg.norm(result.viewpoint - there) / far), facing, covering


def _tables() -> Iterator[Cloud]:
    for sample in mosd_points():
        yield sample.points.astype(np.float64), sample.truth, np.zeros(3)


def _sweeps() -> Iterator[Cloud]:
    for seed in (1, 2, 3, 11, 12, 13):
        sample = street_sweep(seed)[0]
        yield sample.points, sample.truth, np.zeros(3)


def _stations() -> Iterator[Cloud]:
    for scene, places in (office(), flat()):
        for i, place in enumerate(places):
            found = stations(scene, places[i : i + 1], i, 0.5)
            yield found.points, found.things, place


def _single(found: Scan) -> Iterator[Cloud]:
    """Of a scan from several places, that of most points."""
    places, place_of = np.unique(found.origins, axis=0, return_inverse=True)
    chosen = int(np.argmax(np.bincount(place_of.ravel())))
    points = place_of.ravel() == chosen
    yield found.points[points], found.things[points], places[chosen]


def _elsewhere(*names: str) -> Iterator[Cloud]:
    for name in names:
        yield from _single(getattr(scanned_elsewhere, name)())


def _fused() -> Iterator[Cloud]:
    for sample in (room1()[0], simulated_room("A")[0], simulated_room("B")[0], street_mobile(2)[0]):
        yield sample.points.astype(np.float64), sample.truth, None
    for name in ("plant", "warehouse", "turntable", "house_front", "drifting_walk", "power_lines", "hay_bales"):
        found = getattr(scanned_elsewhere, name)()
        yield found.points, found.things, None


# --- What people do to scans before they segment them: which points are left ------------------------------------------


def _left(load: Callable[[], Iterator[Cloud]], chosen: Callable[[Points, Truth], Kept]) -> Iterator[Cloud]:
    """Some points of every second cloud."""
    for points, truth, place in itertools.islice(load(), 0, None, 2):
        kept = chosen(points, truth)
        yield points[kept], truth[kept], place


def _one_per_cell(size: float, points: Points, _: Truth) -> Kept:
    return np.unique(np.floor(points / size), axis=0, return_index=True)[1]


def _around_things(points: Points, truth: Truth) -> Kept:
    return np.linalg.norm(points - points[truth >= 2].mean(axis=0), axis=1) < 0.25


def _noisy_tables() -> Iterator[Cloud]:
    rng = np.random.default_rng(0)
    for points, truth, place in itertools.islice(_tables(), 0, None, 2):
        yield points + rng.normal(0.0, 0.002, points.shape), truth, place


KINDS: dict[str, Callable[[], Iterator[Cloud]]] = {
    "tables (mOSD), camera": _tables,
    "streets, 64 beams": _sweeps,
    "rooms, one tripod": _stations,
    "plant, warehouse: one tripod": partial(_elsewhere, "plant", "warehouse"),
    "table, stereo camera": partial(_elsewhere, "stereo_table"),
    "fused, from many places": _fused,
    "tables, a tenth": partial(_left, _tables, lambda points, _: np.arange(0, len(points), 10)),
    "tables, left half": partial(_left, _tables, lambda points, _: points[:, 0] < np.median(points[:, 0])),
    "tables, 2 mm of noise": _noisy_tables,
    "tables, 25 cm around things": partial(_left, _tables, _around_things),
    "tables, one point per 3 mm": partial(_left, _tables, partial(_one_per_cell, 0.003)),
    "tables, one point per 5 mm": partial(_left, _tables, partial(_one_per_cell, 0.005)),
    "streets, 90 degrees": partial(_left, _sweeps, lambda points, _: points[:, 0] > np.abs(points[:, 1])),
    "streets, within 15 m": partial(_left, _sweeps, lambda points, _: np.linalg.norm(points, axis=1) < 15.0),
    "streets, beyond 10 m": partial(_left, _sweeps, lambda points, _: np.linalg.norm(points, axis=1) > 10.0),
    "streets, without ground": partial(_left, _sweeps, lambda points, _: points[:, 2] > -1.5),
    "streets, one per 20 cm": partial(_left, _sweeps, partial(_one_per_cell, 0.2)),
}

if __name__ == "__main__":
    main()
