# SPDX-License-Identifier: Apache-2.0
"""How long does pcgraph take, and how much memory: against PCL's VCCS, at a million points, and up to 20 million?

1. Labelled Kinect clouds (../shared/data/mosd; without them this part is left out): the whole call `pcgraph.segment`
   (supervoxels, graph and tree) against PCL's VCCS alone (setters, setInputCloud, extract; Debian's libpcl-dev, built
   with -O3; PCL uses one thread here), with the same points, voxels and seed size, after warm-up, in turns; medians
   over all clouds and rounds. With the camera transform PCL's voxels have the size given at a depth of 1 m and ours at
   the median depth: ours are scaled so that both are equally large. `nominal` leaves that out (the same numbers to
   both; ours are larger where the scene is nearer than 1 m). Ours may use all threads given, theirs cannot, so
   processor times are printed too.
2. A million points of a synthetic row of rooms (`room.py`), unorganised and with colours, default settings, from
   points to objects, once in a fresh process after compiling on small clouds; median over as many processes as
   rounds. Memory is the peak of that whole process.
3. The same for growing rooms, one process each above a million. `scaling_exponent` is the slope of
   log(time / log n) over log n: 1 is n log n.

The last line printed is JSON:

    speedup_vs_vccs     PCL's time over ours, the least of the settings; one per setting in speedups
    nominal_speedups    the same with the nominal voxel size
    cpu_ratio           PCL's processor time over ours, the least of the settings
    million_points_s, million_points_gb, and million_points_cpu_s: processor time, on busy machines the steadier figure
    base_gb             peak of the same process before it loads the points: interpreter, modules, kernels
    scaling_exponent (clock), scaling_exponent_cpu (processor time), largest_points, largest_s, largest_gb

Usage: python benchmarks/supervoxels_vs_pcl.py [--data FOLDER] [--rounds 3] [--largest 20e6] [--threads 2]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from mosd import DATA, LabelledCloud, load_clouds
from peers import PclSetting, run_pcl
from room import rooms

SETTINGS = (
    PclSetting(0.005, 0.02, color=0.2, spatial=0.4, normal=1.0, camera=True),
    PclSetting(0.005, 0.02, color=0.0, spatial=1.0, normal=4.0, camera=False),
    PclSetting(0.0075, 0.03, color=0.0, spatial=1.0, normal=4.0, camera=True),
    PclSetting(0.008, 0.06, color=0.1, spatial=0.4, normal=1.0, camera=True),
)
MILLION = 1_000_000
SMALLEST = 250_000
GIGA = 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=str(DATA), help="folder of labelled clouds")
    parser.add_argument("--rounds", type=int, default=3, help="timed runs of each cloud, setting and library")
    parser.add_argument("--largest", type=float, default=20e6, help="points of the largest room")
    parser.add_argument("--threads", type=int, default=2, help="threads of pcgraph")
    parser.add_argument("--child", metavar="NPZ", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(_segment_file(Path(args.child))))
        return

    os.environ["NUMBA_NUM_THREADS"] = str(args.threads)  # before Numba is loaded, here and in the children
    print(f"load of the machine: {os.getloadavg()[0]:.1f} (1 minute), {os.cpu_count()} cores, {args.threads} threads")
    result: dict[str, Any] = {}
    if any(Path(args.data).glob("*.pcd")):
        result |= against_vccs(load_clouds(args.data), args.rounds)
    else:
        print(f"no .pcd file in {args.data}: the comparison with PCL is left out")
    result |= of_rooms(int(args.largest), args.rounds)
    print(json.dumps(result))


def against_vccs(clouds: list[LabelledCloud], rounds: int) -> dict[str, Any]:
    """Ratios of times on the clouds."""
    from pcgraph.all_kernels import compile_kernels

    compile_kernels()
    speedups, nominal, cpu_ratios = {}, {}, []
    for setting in SETTINGS:
        _ours(clouds[0], setting, 1.0)  # the first call of this size
        runs = np.array([_in_turns(cloud, setting) for cloud in clouds for _ in range(rounds)])
        vccs, ours, plain = np.median(runs, axis=0)
        speedups[str(setting)] = round(float(vccs[0] / ours[0]), 2)
        nominal[str(setting)] = round(float(vccs[0] / plain[0]), 2)
        cpu_ratios.append(float(vccs[1] / ours[1]))
        for name, (seconds, cpu, voxels, count) in (("VCCS", vccs), ("segment", ours), ("segment, nominal", plain)):
            ratio = vccs[0] / seconds
            print(
                f"{setting}: {name:<17}{seconds:.3f} s, processor {cpu:.3f} s, {voxels:6.0f} voxels, "
                f"{count:5.0f} supervoxels, {ratio:.2f} times",
                flush=True,
            )
    return {
        "speedup_vs_vccs": min(speedups.values()),
        "speedups": speedups,
        "nominal_speedups": nominal,
        "cpu_ratio": round(min(cpu_ratios), 2),
    }


Run = tuple[float, float, int, int]  # seconds on the clock and of the processor, voxels, supervoxels


def _in_turns(cloud: LabelledCloud, setting: PclSetting) -> tuple[Run, Run, Run]:
    depth = float(np.median(cloud.points[..., 2][cloud.finite])) if setting.camera else 1.0
    return _theirs(cloud, setting), _ours(cloud, setting, depth), _ours(cloud, setting, 1.0)


def _ours(cloud: LabelledCloud, setting: PclSetting, scale: float) -> Run:
    import pcgraph

    voxel, seed = scale * setting.voxel, setting.seed
    start, cpu = time.perf_counter(), time.process_time()
    found = pcgraph.segment(cloud.points, cloud.colors, voxel_size=voxel, seed_size=seed, camera=setting.camera)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu
    return seconds, cpu_seconds, len(found.surface.supervoxels), found.graph.n_nodes


def _theirs(cloud: LabelledCloud, setting: PclSetting) -> Run:
    found = run_pcl(cloud.points, cloud.colors, setting)
    return found.vccs_s[0], found.vccs_cpu_s[0], int(found.voxels[0]), len(np.unique(found.supervoxels)) - 1


def of_rooms(largest: int, rounds: int) -> dict[str, Any]:
    """Times and memory of rooms, each in a process of its own."""
    sizes = [SMALLEST * 2**k for k in range(20) if SMALLEST * 2**k < largest]
    runs = {}
    for n in [*sizes, largest]:
        runs[n] = run = _room_in_children(n, rounds if n <= MILLION else 1)
        print(
            f"{n:>9} points: {run['seconds']:6.2f} s (processor {run['cpu_seconds']:.2f} s), "
            f"peak {run['peak_gb']:.2f} GB (before the points {run['base_gb']:.2f} GB), {run['voxels']:.0f} voxels, "
            f"{run['supervoxels']:.0f} supervoxels, "
            f"{run['seconds'] / (n * np.log(n)) * 1e9:.1f} ns per point and log n",
            flush=True,
        )
    result: dict[str, Any] = {}
    if MILLION in runs:
        result["million_points_s"] = round(runs[MILLION]["seconds"], 3)
        result["million_points_cpu_s"] = round(runs[MILLION]["cpu_seconds"], 3)
        result["million_points_gb"] = round(runs[MILLION]["peak_gb"], 3)
        result["base_gb"] = round(runs[MILLION]["base_gb"], 3)
    n = np.array(list(runs), float)
    if len(n) > 1:
        for key, column in (("scaling_exponent", "seconds"), ("scaling_exponent_cpu", "cpu_seconds")):
            seconds = np.array([run[column] for run in runs.values()])
            result[key] = round(float(np.polyfit(np.log(n), np.log(seconds / np.log(n)), 1)[0]), 3)
    last = runs[largest]
    result |= {"largest_points": largest, "largest_s": round(last["seconds"], 2)}
    return result | {"largest_gb": round(last["peak_gb"], 2)}


def _room_in_children(n: int, rounds: int) -> dict[str, float]:
    """Medians over as many fresh processes."""
    points, colors = rooms(n)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "room.npz")
        np.savez(path, points=points, colors=colors)
        del points, colors
        command = [sys.executable, __file__, "--child", str(path)]
        outputs = [subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True) for _ in range(rounds)]
    runs = [json.loads(done.stdout.splitlines()[-1]) for done in outputs]
    return {key: float(np.median([run[key] for run in runs])) for key in runs[0]}


def _segment_file(path: Path) -> dict[str, Any]:
    """What the child does: points of a file, segmented once."""
    import pcgraph
    from pcgraph.all_kernels import compile_kernels

    compile_kernels()
    base_gb = _peak_gb()
    with np.load(path) as room:
        points, colors = room["points"], room["colors"]
    start, cpu = time.perf_counter(), time.process_time()
    found = pcgraph.segment(points, colors)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu
    if (found.labels < 0).any():
        raise RuntimeError("expected a label for each point")
    return {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "base_gb": base_gb,
        "peak_gb": _peak_gb(),
        "voxels": len(found.surface.supervoxels),
        "supervoxels": found.graph.n_nodes,
    }


def _peak_gb() -> float:
    """Most memory this process held so far, GB. Not getrusage's, which a child inherits from its parent."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0]) / GIGA


if __name__ == "__main__":
    main()
