# SPDX-License-Identifier: Apache-2.0
"""Histograms of a real multi-zone sensor (TMF8820), a wall before it moved by a robot: distances and the cover glass.

The data (80 records of 9 zones x 128 bins, with the reference SPAD's histogram and the robot's distance) are of the
SPAD-ICCP-Summer-School repository of cpsiff, MIT licence.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rangesim import Capture, DirectToF, Pulse, RangeImage, Status, decode
from rangesim.sensors import DirectToFDecoder

BIN_S = 91e-12
"""Nominal width of a bin. The robot's distances say 2 % more; the slope is fitted."""
REFERENCE_PATH_M = 0.05
"""Length from the emitter to the reference SPAD, with the delays of the two kinds of pixels: fitted, to a centimetre,
so that a wall that touches the device is read in front of it. The remaining offset is fitted, too."""
CAREFUL = DirectToFDecoder(max_returns=2, pulse_tolerance=0.5, min_range_m=0.025)
"""The tail of a wall's pulse is a fifth of that of the reference pulse, hence the tolerance."""


class Record(NamedTuple):
    """A measurement: true distance in metres, counts (128, 3, 3) of the zones and (128,) of the reference SPAD."""

    distance_m: float
    counts: np.ndarray
    reference: np.ndarray

    def capture(self, pulse: Pulse) -> Capture:
        sensor = DirectToF(bins=128, bin_s=BIN_S, laser="single-shot", pulse=pulse)
        return Capture(self.counts, sensor.zeroed(self.reference, REFERENCE_PATH_M))


@pytest.fixture(scope="module")
def records(real_data: Path) -> list[Record]:
    def record(entry: dict[str, Any]) -> Record:
        counts = np.array(entry["hists"], dtype=np.uint32).T.reshape(128, 3, 3)
        return Record(entry["dist_to_plane"], counts, np.array(entry["reference_hist"]))

    return [record(entry) for entry in json.loads((real_data / "tof" / "tmf8820_distance.json").read_text())]


@pytest.fixture(scope="module")
def pulse(records: list[Record]) -> Pulse:
    """The pulse of the reference SPAD, over all records."""
    return Pulse(tuple(np.mean([r.reference for r in records], axis=0)), BIN_S)


@pytest.fixture(scope="module")
def images(records: list[Record], pulse: Pulse) -> list[RangeImage]:
    return [decode(r.capture(pulse), CAREFUL) for r in records]


def scatter_mm(distance_m: np.ndarray, range_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Standard deviation from the best straight line, in millimetres of distance, and the line's slope and offset."""
    design = np.c_[distance_m, np.ones_like(distance_m)]
    line, *_ = np.linalg.lstsq(design, range_m, rcond=None)
    return float(1e3 * ((range_m - design @ line) / line[0]).std(ddof=2)), line


def test_a_wall_is_measured_to_a_millimetre(records: list[Record], images: list[RangeImage]) -> None:
    """Centre zone, beyond 3 cm: 1.0 mm. The bins are 14 mm wide."""
    distance = np.array([r.distance_m for r in records])
    beyond = distance > 0.0301
    range_m = np.array([image.range_m[1, 1] for image in images])
    assert np.isfinite(range_m[beyond]).all()
    sd_mm, (slope, offset_m) = scatter_mm(distance[beyond], range_m[beyond])
    assert sd_mm < 1.5
    assert slope == pytest.approx(1, abs=0.03)
    assert abs(offset_m) < 0.01


def test_the_cover_glass_is_told_from_the_wall(records: list[Record], images: list[RangeImage], pulse: Pulse) -> None:
    """Its peak has 200 counts on a background of 180 a bin, before a wall with half a million."""
    far = [i for i, r in enumerate(records) if r.distance_m > 0.15]
    for i in far:
        assert images[i].valid.all()
        assert (images[i].range_m > 0.13).all()
    seen = [images[i].returns.status == Status.OUT_OF_RANGE for i in far]  # type: ignore[union-attr]
    assert np.mean([s.any(axis=0) for s in seen]) > 0.3
    lengths = [CAREFUL.coordinates(records[i].capture(pulse)).returns.length_m for i in far]  # type: ignore[union-attr]
    near = np.concatenate([length[s] / 2 for length, s in zip(lengths, seen, strict=True)])
    assert abs(np.median(near)) < 0.02
    assert np.mean(np.abs(near) < 0.03) > 0.9


def test_all_counts_together_show_the_glass_in_every_zone(records: list[Record], pulse: Pulse) -> None:
    far = [r for r in records if r.distance_m > 0.25]
    both = Record(0.0, sum(r.counts for r in far), np.sum([r.reference for r in far], axis=0))  # type: ignore[arg-type]
    capture = both.capture(pulse)
    nearest = decode(capture, DirectToFDecoder(reading="first", max_returns=4, pulse_tolerance=0.5))
    assert (nearest.range_m < 0.02).all()
    wall = decode(capture, DirectToFDecoder(reading="first", max_returns=4, pulse_tolerance=0.5, min_range_m=0.025))
    assert (wall.range_m > 0.25).all()
