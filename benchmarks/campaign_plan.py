# SPDX-License-Identifier: Apache-2.0
"""Plan of a large data set: cores, hours and terabytes for 10^6 scenes, from costs measured here (docs/scale.md).

    python benchmarks/campaign_plan.py [SPEC.toml] > plan.json

Three costs are measured: a scene on a warm worker, a result on its way through Dask to the disk, and a scene on its
way from there into a shard. Workers do the first in parallel; the driver does the other two, one scene after the other.
So the driver is the bottleneck from a certain number of cores on. Seconds are processor time, which other work on the
machine does not change; those of the disk are the fastest of many tries.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pcgraph.plumbing.plain_files import write_file
from rangesim.campaign import ItemStore, Outcome, Workers, run_items
from rangesim.dataset import DatasetSpec, load_spec, make_dataset, production, spec_from_dict
from rangesim.dataset.sample import sample_bytes

SCENES = 10**6
WARM_UP = 2
"""Scenes that are measured first and not counted: kernels are compiled."""
MEASURED = 8
"""Scenes that count."""
ITEMS = 400
"""Results that go through Dask and into shards, of the mean size of a scene."""
CORES = (2, 16, 64, 256, 1024)
"""Numbers of cores of the plan, each with a worker of one thread."""
NETWORK_BYTES_S = 1.25e9
"""Bytes per second of a network of 10 Gbit/s, which results take to the driver where workers are on other machines; the
only figure here that is assumed."""
TEN_PARTS = {
    "width": 160,
    "height": 120,
    "objects": [{"model": ["box", "cup", "torus", "cylinder", "bracket"], "count": 10, "material": "satin_plastic"}],
    "instrument": [{"sensor": "gray-phase"}, {"sensor": "amcw"}, {"sensor": "ideal-tof"}],
}
"""The scene of the plan by default: ten parts and three sensors."""


@dataclass(frozen=True)
class Costs:
    """Measured costs of a scene.

    scene_s : processor seconds of a worker. scene_bytes : of its sample. dask_s : processor seconds of the driver for a
    result, until it is in the store. pack_s : for its way into a shard. disk_s : seconds that the disk takes beside.
    """

    scene_s: float
    scene_bytes: float
    dask_s: float
    pack_s: float
    disk_s: float

    @property
    def driver_s(self) -> float:
        """Seconds of the driver for a scene."""
        return self.dask_s + self.pack_s + self.disk_s


def measured(spec: DatasetSpec, folder: Path) -> Costs:
    """Costs of the scenes of a specification on this machine."""
    spec = replace(spec, scenes=WARM_UP + MEASURED)
    samples = []
    for number in range(spec.scenes):
        start = time.process_time()
        samples.append((sample_bytes(spec, number), time.process_time() - start))
    size = sum(len(content) for content, _ in samples[WARM_UP:]) / MEASURED
    _driver_s(int(size), 1, folder / "1")  # loads Dask
    many, few = (_driver_s(int(size), count, folder / f"{count}") for count in (ITEMS, ITEMS // 4))
    dask_s = (many - few) / (ITEMS - ITEMS // 4)  # the start of the cluster takes as long for few
    pack_s = _packing_s(spec, [content for content, _ in samples], folder / "set")
    disk_s = _disk_s(samples[-1][0], folder / "disk")
    return Costs(sum(seconds for _, seconds in samples[WARM_UP:]) / MEASURED, size, dask_s, pack_s, disk_s)


def _driver_s(size: int, count: int, folder: Path) -> float:
    """Processor seconds of the driver for results of some bytes that workers make at once."""
    start = time.process_time()
    items = {f"{number:06d}": number for number in range(count)}
    run_items(partial(_bytes_of_size, size), items, ItemStore(folder), Workers(count=1))
    return time.process_time() - start


def _bytes_of_size(size: int, number: int) -> bytes:
    return number.to_bytes(8, "little") * (size // 8)


def _disk_s(content: bytes, folder: Path) -> float:
    """Seconds to write a scene twice, as an item and in a shard, beside the processor's: the fastest of many tries."""
    store, seconds = ItemStore(folder), []
    for number in range(ITEMS):
        start = time.perf_counter(), time.process_time()
        store.write(f"{number:06d}", content, number)
        seconds.append(time.perf_counter() - start[0] - (time.process_time() - start[1]))
    shard, whole = content * 32, []
    for number in range(8):
        begin = time.perf_counter()
        write_file(folder / f"{number}.tar", shard, OSError)
        whole.append((time.perf_counter() - begin) / 32)
    return max(min(seconds), 0.0) + min(whole)


def _packing_s(spec: DatasetSpec, samples: list[bytes], folder: Path) -> float:
    """Processor seconds for a scene that is packed into a shard."""
    run, bytes_of = production.run_items, production.sample_bytes

    def inline(function: Any, items: Any, store: ItemStore, workers: Any, tell: Any, on_done: Any, *_: Any) -> Outcome:
        for key in items:
            store.write(key, function(items[key]), items[key])
            on_done(key)
        return Outcome(len(items))

    spec = replace(spec, scenes=ITEMS)
    production.run_items, production.sample_bytes = inline, lambda spec, number: samples[number % len(samples)]
    try:
        start = time.process_time()
        make_dataset(spec, folder)
        taken = time.process_time() - start
    finally:
        production.run_items, production.sample_bytes = run, bytes_of
    return taken / ITEMS


def plan(costs: Costs) -> dict[str, Any]:
    """What 10^6 scenes take, by the number of cores."""
    rows = []
    network_s = costs.scene_bytes / NETWORK_BYTES_S
    for cores in CORES:
        limits = {"workers": costs.scene_s / cores, "driver": costs.driver_s, "network": network_s}
        slowest = max(limits, key=lambda name: limits[name])
        hours = SCENES * limits[slowest] / 3600
        rows.append({"cores": cores, "hours": hours, "bottleneck": slowest})
    return {
        "scenes": SCENES,
        "core_hours": SCENES * costs.scene_s / 3600,
        "terabytes": SCENES * costs.scene_bytes / 1e12,
        "cores_that_keep_the_driver_busy": costs.scene_s / costs.driver_s,
        "scenes_per_hour_core": 3600 / costs.scene_s,
        "by_cores": rows,
    }


if __name__ == "__main__":
    wanted = load_spec(sys.argv[1]) if len(sys.argv) > 1 else spec_from_dict({"scenes": 1, **TEN_PARTS})
    with tempfile.TemporaryDirectory() as temporary:
        costs = measured(wanted, Path(temporary))
    print(json.dumps({"costs": {**vars(costs), "driver_s": costs.driver_s}, **plan(costs)}, indent=1))
