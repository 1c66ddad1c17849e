# SPDX-License-Identifier: Apache-2.0
"""Estimates the cost of an experiment in light paths, memory and time, before the work starts.

Memory is the sum of the arrays that exist at the same time: those of the light transport, the signals, the exposed
frames and the report. Time is the number of light paths divided by a rate. The rate is one constant per core; it is
right within a factor of three for opaque scenes and for tables with some glass. If the constants predict a long run,
three small passes of the scene are rendered. The first one compiles, and the other two are timed (scenes with much
glass take longer, mostly to compile). They are timed by the processor time of this process, so that other work on the
machine does not count: the estimate is for a machine with idle cores.

The constants below were set by hand so that estimates keep to that factor. A docstring states a measurement where there
is one. With larger constants, more runs are announced as long or large; with smaller ones, fewer runs are refused
because of their memory.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rangesim.errors import TruncationWarning
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.rig import Beam, Intrinsics, RayTable
from rangesim.settings import limits

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

LONG_S = 30.0
"""Seconds; a run that takes longer is announced, so that nobody waits without knowing for how long."""
LARGE_BYTES = 1e9
"""Bytes of memory; a run that needs more is announced, because it may be too much beside other programs."""
TYPICAL_SPP = 24
"""Light paths per pixel that are assumed if their number is not given. Adaptive sampling takes 8 to 64 of them, as many
as the surfaces need; this value lies in the middle, on a logarithmic scale."""
PATHS_PER_CORE_S = 1.1e6
"""Camera paths per second and core, measured with LLVM on `tabletop` and `matte`, 5 segments."""
PATHS_PER_GPU_S = 5e7
"""Camera paths per second on a GPU, measured on `tabletop` with 5 to 50 million paths on an H100, which has no
ray-tracing cores."""
CAUSTICS_S = 0.5
"""Seconds of a pass to make the triangles of caustics and to look them up, in a scene with glass or mirrors. Measured,
from 64 x 48 to 320 x 240 pixels: 0.1 to 0.5 s of processor time on `tabletop`, 0.2 to 1.2 s on `glassware`."""
PASS_S = 1.0
"""Seconds to compile the kernels of a pass, independent of the size of the image. Measured on `tabletop` with 64 x 48
pixels on two busy cores: 2 s for a whole pass."""
START_S = 4.0
"""Seconds per run to import the packages, load the scene and write the report. A rough value is enough, because it only
matters for short runs."""
REPEATED_PASS_S = 0.3
"""Seconds of each further pass from another place, besides its paths and caustics. It compiles nothing again. Measured:
0.02 s on `matte`, 0.5 s on `tabletop`."""
FRAME_S = 100e-9
"""Seconds per pixel of each frame, for its noise and its file."""
PIXEL_S = 6e-6
"""Seconds per pixel of each instrument, for decoding, causes, segmentation and its part of the report."""
BASE_BYTES = 4e8
"""Bytes that the process takes with its libraries, a scene and its kernels, before any image. Measured on `tabletop`:
2.6e8 with everything loaded, 6.1e8 after a run of 64 x 48 pixels."""
TRANSPORT_BYTES = 2 << 30
"""Limit of the bytes that the tiles of the light transport take: the default of `TransportSettings.memory_bytes`."""
LANE_BYTES = 512
"""Bytes of the renderer per pixel of a tile, besides 8 for each channel: the state of the loop over light paths."""
TRUTH_BYTES = 64
"""Bytes per pixel of a pass, from the types of its arrays: 37 for the ground truth and 24 for the energy split."""
RESULT_BYTES = 200
"""Bytes per pixel of the results of each instrument while the report is written: maps, causes, points, segmentation and
their pictures."""
CAUSTICS_BYTES = 2e7
"""Bytes of the triangles of caustics and of the tree in which they are looked up. The triangles of `glassware` take 8e6
in a pass of 320 x 240 pixels; the tree is assumed to take as much."""
TRIAL_S = 60.0
"""Seconds. If the constants predict a longer run, small passes of the scene are timed in a trial, because the constants
may be wrong by a factor of three. A trial takes a few seconds, so with a smaller value short runs would wait for it;
with a larger value more long runs would have a rough estimate."""
TRIAL_WIDTH = 96
"""Width of the images of a trial in pixels. With the samples below, a trial takes a few seconds; a wider image would
measure the time per path more exactly and take longer."""
TRIAL_SPP = (4, 256)
"""Samples per pixel of the two passes of a trial that are timed; their difference gives the time per path. With 64 in
place of 256, this time scattered between 1.7e-7 and 3.2e-7 s on `tabletop`."""


@dataclass(frozen=True)
class Cost:
    """Estimated cost of a run or of a scan.

    Parameters
    ----------
    light_paths : number of camera paths of all passes.
    segments : largest number of segments of a path.
    passes : number of light-transport passes.
    memory_bytes : bytes of memory at the peak.
    seconds : time on this machine if it is idle.
    machine : processors that the time was estimated for, in words, such as "2 idle cores".
    disk_bytes : bytes of the results on the disk; 0: not counted.

    Examples
    --------
    >>> print(Cost(4_900_000, 5, 2, int(8e8), 14.0, "2 idle cores"))
    about 4.9 M light paths of up to 5 segments in 2 passes, 0.8 GB, 14 s on 2 idle cores
    """

    light_paths: int
    segments: int
    passes: int
    memory_bytes: int
    seconds: float
    machine: str = ""
    disk_bytes: int = 0

    @property
    def is_large(self) -> bool:
        """Whether the run takes so long, or so much memory, that it should be announced before the work starts."""
        return self.seconds > LONG_S or self.memory_bytes > LARGE_BYTES

    def __str__(self) -> str:
        disk = f" of memory, {_bytes(self.disk_bytes)} on disk" if self.disk_bytes else ""
        return (
            f"about {_count(self.light_paths)} light paths of up to {self.segments} segments in "
            f"{self.passes} pass{'es' if self.passes > 1 else ''}, {self.memory_bytes / 1e9:.1f} GB{disk}, "
            f"{_duration(self.seconds)}{f' on {self.machine}' if self.machine else ''}"
        )

    def check_memory(self) -> None:
        """Raise ValueError if the run needs more memory than is available.

        If the limit `memory` is set, it takes the place of the available memory. If neither is known, nothing is
        refused.
        """
        limit = limits.current().memory
        most = available_memory_bytes() if limit == limits.Limits().memory else limit
        if most is not None and self.memory_bytes > most:
            raise ValueError(
                f"expected a run within the {most / 1e9:.1f} GB of memory that are available, but this one takes "
                f"{self}; take fewer pixels, frames or bins, or raise the limit with {limits.VARIABLE}=memory=N."
            )


class CostBesideTracing(NamedTuple):
    """Cost of all work with the signals of the light transport: exposure, decoding, results, report.

    seconds : time of this work.
    held_bytes : memory of results that are kept while further light is traced.
    peak_bytes : memory of all arrays at the peak while no light is traced.
    disk_bytes : size of the results on the disk; 0: not counted.
    """

    seconds: float
    held_bytes: int
    peak_bytes: int
    disk_bytes: int


def estimate_cost(
    experiment: Experiment,
    scene: Scene,
    passes: Sequence[tuple[Rig, list[Instrument]]],
    trial: bool = True,
    *,
    places: int = 1,
    beside: CostBesideTracing | None = None,
) -> Cost:
    """Estimated cost of an experiment.

    Parameters
    ----------
    passes : rig and instruments of each pass, as `rangesim.pipeline.shared_passes.group_by_rig` returns.
    trial : whether small passes of the scene may be rendered and timed if the run is long.
    places : number of places that each pass is traced from, such as the views of a scan.
    beside : cost of the work with the signals; None: that of a run.
    """
    from rangesim.light_transport.delta_surfaces import throws_caustics

    has_caustics = experiment.caustics and throws_caustics(scene.mitsuba)
    pixels, count = 0, 0
    for rig, instruments in passes:
        size = rig.camera.width * rig.camera.height * TRUTH_BYTES  # the file of a pass, as it is read for a report
        limits.check("bytes", size, "bytes in the results of one pass")
        traced, n = _traced_pixels(experiment, rig, instruments)
        pixels, count = pixels + traced * instruments[0].sensor.n_cameras, count + n
    paths = places * pixels * (experiment.spp or TYPICAL_SPP)
    beside = beside or _beside_tracing(passes)
    beside_s, again = START_S + beside.seconds, (places - 1) * count
    seconds = beside_s + count * PASS_S + again * REPEATED_PASS_S + paths / _paths_per_s()
    tracing = _tracing_bytes(passes)
    if has_caustics:
        seconds += places * count * CAUSTICS_S
        tracing += CAUSTICS_BYTES
    memory = int(BASE_BYTES + max(tracing + beside.held_bytes, beside.peak_bytes))
    cost = Cost(paths, experiment.max_depth, places * count, memory, seconds, _machine(), beside.disk_bytes)
    if trial and seconds > TRIAL_S:
        compile_s, fixed_s, path_s = _timed_trial(experiment, scene, passes[0])
        traced_s = (len(passes) - 1) * compile_s + places * count * fixed_s + paths * path_s
        cost = replace(cost, seconds=beside_s + traced_s)
    return cost


def available_memory_bytes() -> int | None:
    """Bytes of memory that the machine and the control groups leave to this process; None if unknown."""
    found = [_meminfo(), *_cgroup()]
    known = [n for n in found if n is not None]
    return min(known) if known else None


def _traced_pixels(experiment: Experiment, rig: Rig, instruments: Sequence[Instrument]) -> tuple[int, int]:
    """Number of pixels that are rendered for a rig over all its light-transport passes, and the number of passes.

    If something moves, each frame has a pass, which renders only the window where something changes.
    """
    if experiment.motion is None:
        return rig.traced.camera.width * rig.traced.camera.height, 1
    from rangesim.motion.moving_scanner import on_its_way
    from rangesim.motion.passes import plan

    planned = []
    for instrument in instruments:
        timings = {instrument.sensor: instrument.timing}
        moving, motion = on_its_way(rig, timings, experiment.motion)
        planned += plan(moving, timings, motion)
    windows = [p.window for p in planned]
    return sum((w.bottom - w.top) * (w.right - w.left) for w in windows), len(planned)


def _beside_tracing(passes: Sequence[tuple[Rig, list[Instrument]]]) -> CostBesideTracing:
    """Cost of the work with the signals of a run. The results of a pass are kept while the next ones are traced."""
    seconds, result_bytes = 0.0, []
    for rig, instruments in passes:
        pixels = rig.camera.width * rig.camera.height
        frames = [i.sensor.n_frames * i.sensor.n_cameras for i in instruments]
        seconds += sum(pixels * (PIXEL_S + FRAME_S * n) for n in frames)
        result_bytes.append(sum(pixels * (2 * n + RESULT_BYTES) for n in frames))
    return CostBesideTracing(seconds, sum(result_bytes[:-1]), sum(result_bytes), 0)


def _tracing_bytes(passes: Sequence[tuple[Rig, list[Instrument]]]) -> float:
    """Bytes of the arrays of a pass that exist at once, at the peak: while it is traced or its frames are exposed."""
    at_once = 0.0
    for rig, instruments in passes:
        pixels = rig.traced.camera.width * rig.traced.camera.height * instruments[0].sensor.n_cameras
        responses = dict.fromkeys(r for instrument in instruments for r in instrument.sensor.responses())
        channels = sum(r.channels for r in responses)
        tiles = min(TRANSPORT_BYTES, pixels * (LANE_BYTES + 2 * 4 * channels))  # indirect light has its own channels
        largest = max(sum(r.channels for r in instrument.sensor.responses()) for instrument in instruments)
        frames = max(instrument.sensor.n_frames for instrument in instruments)
        exposed = pixels * 14 * frames  # three arrays of float32, and the digital numbers
        judged = pixels * 2 * 4 * largest + exposed  # means and their error, for adaptive sampling
        tracing = max(tiles, judged) + pixels * (4 * 4 * channels + TRUTH_BYTES)
        exposing = pixels * (2 * 4 * channels + 4 * largest + TRUTH_BYTES) + exposed  # signals with their error
        at_once = max(at_once, tracing, exposing)
    return at_once


def _timed_trial(
    experiment: Experiment, scene: Scene, one_pass: tuple[Rig, Sequence[Instrument]]
) -> tuple[float, float, float]:
    """Three times in seconds, measured on small passes of the scene: to compile a pass, per pass, and per light path.

    They hold for an idle machine, see `_Elapsed`.
    """
    from rangesim.instrument.transport import transport

    rig, instruments = one_pass[0].traced, one_pass[1]
    small = TRIAL_WIDTH, max(1, round(TRIAL_WIDTH * rig.camera.height / rig.camera.width))
    camera = (
        rig.camera.resized(*small) if isinstance(rig.camera, Intrinsics) else RayTable.of(rig.camera).thinned(*small)
    )
    smaller = replace(rig, camera=camera)
    if isinstance(rig.projector, Beam):
        smaller = replace(smaller, projector=replace(rig.projector, directions=None))
    settings = experiment.transport_settings(instruments)
    sensors = [instrument.sensor for instrument in instruments]
    took: list[float] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TruncationWarning)  # the run itself will warn
        for spp in (TRIAL_SPP[0], *TRIAL_SPP):  # the first compiles
            start = _Elapsed.now()
            transport(scene, smaller, sensors, settings, spp=spp)
            took.append((_Elapsed.now() - start).idle_s)
    paths = camera.width * camera.height * (TRIAL_SPP[1] - TRIAL_SPP[0])
    path_s = max((took[2] - took[1]) / paths, 0.1 / _paths_per_s())
    return max(took[0] - took[1], 0.0), took[1], path_s


class _Elapsed(NamedTuple):
    """Readings of three clocks in seconds, or the differences between two readings.

    wall_s : wall clock.
    thread_s : processor time of this thread, which traces paths beside the worker threads.
    process_s : processor time of all threads of this process.
    """

    wall_s: float
    thread_s: float
    process_s: float

    @classmethod
    def now(cls) -> _Elapsed:
        """The readings of the clocks at this moment."""
        return cls(time.monotonic(), time.thread_time(), time.process_time())

    def __sub__(self, other: _Elapsed) -> _Elapsed:
        return _Elapsed(*(a - b for a, b in zip(self, other, strict=True)))

    @property
    def idle_s(self) -> float:
        """Wall-clock seconds that the work would take on an idle machine.

        On the CPU, other work on the machine does not count. On a GPU it does, because the wall clock is all there is.
        """
        return self.wall_s if _on_gpu() else max(self.thread_s, self.process_s / _cores())


def _on_gpu() -> bool:
    """Whether Mitsuba renders on a GPU."""
    import mitsuba as mi

    return (mi.variant() or "").startswith("cuda")


def _machine() -> str:
    """Description of the processors that an estimate assumes."""
    if _on_gpu():
        return "an idle GPU"
    return "1 idle core" if _cores() == 1 else f"{_cores()} idle cores"


def _paths_per_s() -> float:
    """Camera paths per second on this machine, by the constants."""
    return PATHS_PER_GPU_S if _on_gpu() else PATHS_PER_CORE_S * _cores()


def _cores() -> int:
    """Number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # it exists on Linux only
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _meminfo() -> int | None:
    """Bytes that Linux can give without swapping; None on other systems."""
    path = Path("/proc/meminfo")
    if not path.is_file():
        return None
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _cgroup() -> list[int | None]:
    """Bytes left below the limit of each control group of this process, versions 2 and 1; None without a limit."""
    root = Path("/sys/fs/cgroup")
    groups = [root, root / "memory"]
    membership = Path("/proc/self/cgroup")
    if membership.is_file():
        for line in membership.read_text(encoding="utf-8").splitlines():
            _, controllers, name = line.split(":", 2)
            base = root if not controllers else root / "memory"
            if not controllers or "memory" in controllers.split(","):
                groups += [base / Path(*parts) for parts in _prefixes(name)]
    return [_bytes_left(g, *names) for g in dict.fromkeys(groups) for names in _LIMIT_AND_USAGE]


_LIMIT_AND_USAGE = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""Files of a control group that hold its limit and its usage in bytes, in versions 2 and 1."""


def _prefixes(name: str) -> list[tuple[str, ...]]:
    """The parts of a control group's path and of the paths of all groups around it, such as (a,), (a, b) for /a/b."""
    parts = tuple(part for part in name.split("/") if part not in ("", ".", ".."))
    return [parts[: n + 1] for n in range(len(parts))]


def _bytes_left(group: Path, limit: str, usage: str) -> int | None:
    """Bytes left below the limit of a control group; None if it has no limit, or no such files."""
    if not (group / limit).is_file() or not (group / usage).is_file():
        return None
    most = (group / limit).read_text(encoding="ascii").strip()
    if not most.isdigit():  # "max"
        return None
    return max(0, int(most) - int((group / usage).read_text(encoding="ascii")))


def _count(n: int) -> str:
    """A number with three digits and a prefix, such as 4.9 M."""
    for scale, word in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if n >= scale:
            return f"{n / scale:.3g} {word}"
    return str(n)


def _bytes(n: int) -> str:
    """A size in GB, or in MB where it is small."""
    return f"{n / 1e9:.1f} GB" if n >= 1e8 else f"{max(1, round(n / 1e6))} MB"


def _duration(seconds: float) -> str:
    """A duration in days, hours, minutes or seconds, with two digits."""
    for scale, word in ((86400.0, "d"), (3600.0, "h"), (100.0, "min")):
        if seconds >= scale:
            return f"{seconds / (60.0 if word == 'min' else scale):.2g} {word}"
    return f"{max(seconds, 1):.0f} s"
