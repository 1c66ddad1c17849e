# SPDX-License-Identifier: Apache-2.0
"""What an experiment will cost: light paths, memory and time, before the work starts.

Memory is counted: arrays of the light transport, of the signals, of the frames as they are exposed, of the report.
Time is light paths over a rate. The rate is one constant per core, good within a factor of three on opaque scenes and
tables with some glass; where that makes a run long, two small passes of the scene itself are timed instead, after one
that compiles (glass on glass takes longer, mostly to compile). They are timed by the processor time of this process, so
that other work on the machine does not count: the estimate is of a machine whose cores are idle.
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
from rangesim.settings import limits

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

LONG_S = 30.0
"""A run that takes longer is announced."""
LARGE_BYTES = 1e9
"""A run that takes more is announced."""
TYPICAL_SPP = 24
"""Of light paths per pixel, if their number is not given: 16 to 64, by the surface."""
PATHS_PER_CORE_S = 1.1e6
"""Camera paths per second and core: tabletop and matte scenes, 5 segments, LLVM."""
PATHS_PER_GPU_S = 5e7
"""Camera paths per second: tabletop scene, from 5 to 50 million paths, an H100, which has no ray-tracing cores."""
PHOTON_S = 3e-6
PASS_S, START_S = 1.0, 4.0
"""Seconds to compile a pass, and to import, load the scene and write the report."""
REPEATED_PASS_S = 0.3
"""Seconds of a pass from another place, besides its paths and photons: nothing is compiled. 0.02 of `matte`, 0.5 of
`tabletop`."""
FRAME_S, PIXEL_S = 100e-9, 6e-6
"""Seconds per pixel of each frame (noise, files), and per pixel of each instrument (decoding, segments, report)."""
BASE_BYTES = 4e8
"""Of the process with its libraries and a scene."""
TRANSPORT_BYTES = 2 << 30
"""Tiles of the light transport stay below, see `transport`."""
LANE_BYTES = 512
"""Per pixel of a tile, besides 4 for each channel."""
TRUTH_BYTES, RESULT_BYTES = 64, 200
"""Per pixel of a pass, and of each instrument in the report."""
PHOTON_BYTES = 200
TRIAL_S = 60.0
"""A run that takes longer by the constants is worth a trial."""
TRIAL_WIDTH, TRIAL_SPP = 96, (4, 256)
"""Camera pixels across a trial pass, and the samples of the two that are timed: with 64 in place of 256, the time per
path of `tabletop` was between 1.7 and 3.2e-7 s from trial to trial."""


@dataclass(frozen=True)
class Cost:
    """An estimate.

    light_paths : camera paths of all passes. segments : at most so many in each. photons : of all passes.
    passes : of the light transport. memory_bytes : at the peak. seconds : on this machine if it is idle. machine : what
    of it was counted on, in words. disk_bytes : of the results; 0: not counted.
    """

    light_paths: int
    segments: int
    photons: int
    passes: int
    memory_bytes: int
    seconds: float
    machine: str = ""
    disk_bytes: int = 0

    @property
    def is_large(self) -> bool:
        """Whether a user should know before the work starts."""
        return self.seconds > LONG_S or self.memory_bytes > LARGE_BYTES

    def __str__(self) -> str:
        photons = f" and {_count(self.photons)} photons" if self.photons else ""
        disk = f" of memory, {_bytes(self.disk_bytes)} on disk" if self.disk_bytes else ""
        return (
            f"about {_count(self.light_paths)} light paths of up to {self.segments} segments{photons} in "
            f"{self.passes} pass{'es' if self.passes > 1 else ''}, {self.memory_bytes / 1e9:.1f} GB{disk}, "
            f"{_duration(self.seconds)}{f' on {self.machine}' if self.machine else ''}"
        )

    def check_memory(self) -> None:
        """Raise ValueError if the machine has not the memory; where that cannot be known, nothing is refused."""
        chosen = limits.current().memory
        most = available_memory_bytes() if chosen == limits.Limits().memory else chosen
        if most is not None and self.memory_bytes > most:
            raise ValueError(
                f"expected a run within the {most / 1e9:.1f} GB of memory that are available, this one takes "
                f"{self}; take fewer pixels, frames or bins, or raise the limit with {limits.VARIABLE}=memory=N."
            )


class Rest(NamedTuple):
    """Cost of what comes with the light transport.

    seconds : of all that is done with its signals. held_bytes : of results that are held while light is traced.
    peak_bytes : of all arrays at once, while no light is traced. disk_bytes : of the results.
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
    rest: Rest | None = None,
) -> Cost:
    """Cost of an experiment.

    Parameters
    ----------
    passes : as `rangesim.pipeline.shared_passes.group_by_rig` returns.
    trial : whether small passes may be timed where the run is long.
    places : that each pass is traced from. rest : what is done with the signals; None: what a run does.
    """
    from rangesim.light_transport.photons import has_delta

    photons = experiment.transport_settings(()).photons if has_delta(scene.mitsuba) else 0
    pixels, count = 0, 0
    for rig, instruments in passes:
        size = rig.camera.width * rig.camera.height * TRUTH_BYTES  # read back for the report
        limits.check("bytes", size, "bytes in the results of one pass")
        traced, n = _traced_pixels(experiment, rig, instruments)
        pixels, count = pixels + traced, count + n
    paths, all_photons = places * pixels * (experiment.spp or TYPICAL_SPP), places * photons * count
    rest = rest or _rest_of_run(passes)
    rest_s, again = START_S + rest.seconds, (places - 1) * count
    seconds = rest_s + count * PASS_S + again * REPEATED_PASS_S + all_photons * PHOTON_S + paths / _paths_per_s()
    memory = int(BASE_BYTES + max(_tracing_bytes(passes, photons) + rest.held_bytes, rest.peak_bytes))
    cost = Cost(paths, experiment.max_depth, all_photons, places * count, memory, seconds, _machine(), rest.disk_bytes)
    if trial and seconds > TRIAL_S:
        compile_s, fixed_s, path_s = _timed_trial(experiment, scene, passes[0])
        traced_s = (len(passes) - 1) * compile_s + places * count * fixed_s + paths * path_s
        cost = replace(cost, seconds=rest_s + traced_s)
    return cost


def available_memory_bytes() -> int | None:
    """Memory that this process may still take: of the machine, and of its control group; None where unknown."""
    found = [_meminfo(), *_cgroup()]
    known = [n for n in found if n is not None]
    return min(known) if known else None


def _traced_pixels(experiment: Experiment, rig: Rig, instruments: Sequence[Instrument]) -> tuple[int, int]:
    """Pixels that are rendered for a rig, over all light-transport passes, and the number of these."""
    if experiment.motion is None:
        return rig.camera.width * rig.camera.height, 1
    from rangesim.motion.passes import plan

    planned = [
        p for instrument in instruments for p in plan(rig, {instrument.sensor: instrument.timing}, experiment.motion)
    ]
    windows = [p.window for p in planned]
    return sum((w.bottom - w.top) * (w.right - w.left) for w in windows), len(planned)


def _rest_of_run(passes: Sequence[tuple[Rig, list[Instrument]]]) -> Rest:
    """Cost of what a run does with its signals; the results of a pass are held while the next ones are traced."""
    seconds, result_bytes = 0.0, []
    for rig, instruments in passes:
        pixels = rig.camera.width * rig.camera.height
        seconds += sum(pixels * (PIXEL_S + FRAME_S * i.sensor.n_frames) for i in instruments)
        result_bytes.append(sum(pixels * (2 * i.sensor.n_frames + RESULT_BYTES) for i in instruments))
    return Rest(seconds, sum(result_bytes[:-1]), sum(result_bytes), 0)


def _tracing_bytes(passes: Sequence[tuple[Rig, list[Instrument]]], photons: int) -> float:
    """The largest of what is held at once: while light is traced, and while frames are exposed."""
    at_once = 0.0
    for rig, instruments in passes:
        pixels = rig.camera.width * rig.camera.height
        responses = dict.fromkeys(r for instrument in instruments for r in instrument.sensor.responses())
        channels = sum(r.channels for r in responses)
        tiles = min(TRANSPORT_BYTES, pixels * (LANE_BYTES + 2 * 4 * channels))  # indirect light apart
        largest = max(sum(r.channels for r in instrument.sensor.responses()) for instrument in instruments)
        frames = max(instrument.sensor.n_frames for instrument in instruments)
        exposed = pixels * 14 * frames  # three times float32, and the digital numbers
        judged = pixels * 2 * 4 * largest + exposed  # means and their error
        tracing = max(tiles, judged) + pixels * (4 * 4 * channels + TRUTH_BYTES) + photons * PHOTON_BYTES
        exposing = pixels * (2 * 4 * channels + 4 * largest + TRUTH_BYTES) + exposed  # signals and their error
        at_once = max(at_once, tracing, exposing)
    return at_once


def _timed_trial(
    experiment: Experiment, scene: Scene, one_pass: tuple[Rig, Sequence[Instrument]]
) -> tuple[float, float, float]:
    """Seconds to compile a pass, of a pass whatever its size, and per light path, of small passes of the scene.

    All of an idle machine, see `_Took`.
    """
    from rangesim.instrument.transport import transport

    rig, instruments = one_pass
    camera = rig.camera.resized(TRIAL_WIDTH, max(1, round(TRIAL_WIDTH * rig.camera.height / rig.camera.width)))
    settings = experiment.transport_settings(instruments)
    sensors = [instrument.sensor for instrument in instruments]
    took: list[float] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TruncationWarning)  # the run itself will tell
        for spp in (TRIAL_SPP[0], *TRIAL_SPP):  # the first compiles
            start = _Took.now()
            transport(scene, replace(rig, camera=camera), sensors, settings, spp=spp)
            took.append((_Took.now() - start).idle_s)
    paths = camera.width * camera.height * (TRIAL_SPP[1] - TRIAL_SPP[0])
    path_s = max((took[2] - took[1]) / paths, 0.1 / _paths_per_s())
    return max(took[0] - took[1], 0.0), took[1], path_s


class _Took(NamedTuple):
    """Time that some work took, in seconds.

    wall_s : on the clock. thread_s : of a processor, for this thread, which traces paths beside the others. process_s :
    of processors, for all threads of this process.
    """

    wall_s: float
    thread_s: float
    process_s: float

    @classmethod
    def now(cls) -> _Took:
        return cls(time.monotonic(), time.thread_time(), time.process_time())

    def __sub__(self, other: _Took) -> _Took:
        return _Took(*(a - b for a, b in zip(self, other, strict=True)))

    @property
    def idle_s(self) -> float:
        """Seconds on the clock of an idle machine. No other work counts, but the graphics card's waits do."""
        return self.wall_s if _on_gpu() else max(self.thread_s, self.process_s / _cores())


def _on_gpu() -> bool:
    import mitsuba as mi

    return (mi.variant() or "").startswith("cuda")


def _machine() -> str:
    """The machine that an estimate assumes, in words."""
    if _on_gpu():
        return "an idle GPU"
    return "1 idle core" if _cores() == 1 else f"{_cores()} idle cores"


def _paths_per_s() -> float:
    return PATHS_PER_GPU_S if _on_gpu() else PATHS_PER_CORE_S * _cores()


def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)  # Linux alone
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _meminfo() -> int | None:
    """Bytes that Linux can give without swapping."""
    path = Path("/proc/meminfo")
    if not path.is_file():
        return None
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _cgroup() -> list[int | None]:
    """Bytes left of the limits of the control groups that this process is in (version 2, and version 1)."""
    root = Path("/sys/fs/cgroup")
    groups = [root, root / "memory"]
    membership = Path("/proc/self/cgroup")
    if membership.is_file():
        for line in membership.read_text(encoding="utf-8").splitlines():
            _, controllers, name = line.split(":", 2)
            base = root if not controllers else root / "memory"
            if not controllers or "memory" in controllers.split(","):
                groups += [base / Path(*parts) for parts in _prefixes(name)]
    return [_left(g, *names) for g in dict.fromkeys(groups) for names in _NAMES]


_NAMES = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))


def _prefixes(name: str) -> list[tuple[str, ...]]:
    parts = tuple(part for part in name.split("/") if part not in ("", ".", ".."))
    return [parts[: n + 1] for n in range(len(parts))]


def _left(group: Path, limit: str, usage: str) -> int | None:
    if not (group / limit).is_file() or not (group / usage).is_file():
        return None
    most = (group / limit).read_text(encoding="ascii").strip()
    if not most.isdigit():  # "max"
        return None
    return max(0, int(most) - int((group / usage).read_text(encoding="ascii")))


def _count(n: int) -> str:
    for scale, word in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if n >= scale:
            return f"{n / scale:.3g} {word}"
    return str(n)


def _bytes(n: int) -> str:
    return f"{n / 1e9:.1f} GB" if n >= 1e8 else f"{max(1, round(n / 1e6))} MB"


def _duration(seconds: float) -> str:
    for scale, word in ((86400.0, "d"), (3600.0, "h"), (100.0, "min")):
        if seconds >= scale:
            return f"{seconds / (60.0 if word == 'min' else scale):.2g} {word}"
    return f"{max(seconds, 1):.0f} s"
