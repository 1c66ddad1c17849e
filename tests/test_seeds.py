# SPDX-License-Identifier: Apache-2.0
"""Every seed of 64 bits has noise of its own, wherever a seed enters; what is no such seed is refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import GLASS, matte, scene_of, sheets_of, wall

import rangesim
from rangesim import AmcwToF, Detector, DirectToF, Lens, Scene, SpadDetector, expose, transport
from rangesim.experiment import Experiment, experiment_from_dict, experiment_to_dict
from rangesim.light_transport.glint import trace_glint
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
from rangesim.pipeline.experiment_run import noise_seed

SEEDS = tuple(
    dict.fromkeys(
        chain(
            (0, 1, 2, 3, 1 << 31, (1 << 32) - 1, 1 << 63, (1 << 63) + 1, (1 << 64) - 1),
            *((s << 32, (s << 32) | s, (s << 32) | (1 << 31), (s << 32) | 0xFFFFFFFF) for s in (1, 2, 3, 0x9E3779B9)),
        )
    )
)
"""Some that differ in one half alone, some whose halves are equal, and some that are the others shifted."""
FEW_SEEDS = (0, 1, (1 << 32) - 1, 1 << 32, (1 << 32) | 1, (2 << 32) | 2, 1 << 63, (1 << 63) + 1, (1 << 64) - 1)
"""One pair of each kind, for what takes a tenth of a second a seed."""
NO_SEEDS = [-1, -(1 << 63), 1 << 64, 10**30, 1.0, 1.5, float("nan"), True, np.bool_(False), "1", None, [1]]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A glass ball before a wall."""
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.8], "radius": 0.12, "bsdf": GLASS}
    return scene_of(wall=wall(1.2, matte()), ball=ball)


@pytest.fixture(scope="module")
def signals(scene: Scene) -> rangesim.Signals:
    return transport(scene, scene.rig(width=16, height=12), [AmcwToF(), DirectToF(bins=32)], spp=2, caustics=False)


def digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


# ---- Each seed its own noise ------------------------------------------------------------------------


def path_loop(scene: Scene, seed: int) -> list[np.ndarray]:
    rig = scene.rig(width=16, height=12)
    return [transport(scene, rig, [], spp=2, caustics=False, glint=False, seed=seed).energy.direct]


def sheets(scene: Scene, seed: int) -> list[np.ndarray]:
    """Photons along the silhouette of the ball are drawn by the seed."""
    found = sheets_of(scene, scene.rig(), seed)
    assert found is not None
    return [found.position, found.flux]


def caustics(scene: Scene, seed: int) -> list[np.ndarray]:
    rig = scene.rig(width=16, height=12)
    return [transport(scene, rig, [], spp=2, glint=False, seed=seed).energy.caustic]


def glint(scene: Scene, seed: int) -> list[np.ndarray]:
    rig = replace(scene.rig(width=48, height=36), projector_lens=Lens(0.02))
    found = trace_glint(TracedScene.of(scene.mitsuba, rig), rig, [], seed, 64)
    assert found.radiance.any()
    return [found.radiance]


def a_moving_scan(scene: Scene, seed: int) -> list[np.ndarray]:
    """Every band of a scan has a seed derived from the one given."""
    sensor, motion = AmcwToF(), Motion({"ball": ConstantTwist((1.0, 0.0, 0.0))})
    timing = Timing(line_period_s=1e-4, bands=2)
    rig = scene.rig(width=8, height=8)
    options: dict[str, Any] = {"spp": 2, "caustics": False, "glint": False}
    return [transport_moving(scene, rig, {sensor: timing}, motion, seed=seed, **options)[sensor].lit[:, 4:]]


@pytest.mark.parametrize(
    ("trace", "seeds"),
    [
        (path_loop, SEEDS),
        (sheets, FEW_SEEDS),
        (caustics, FEW_SEEDS),
        (glint, FEW_SEEDS),
        (a_moving_scan, FEW_SEEDS),
    ],
)
def test_every_seed_traces_its_own_light(
    trace: Callable[[Scene, int], list[np.ndarray]], seeds: tuple[int, ...], scene: Scene
) -> None:
    digests = [digest(*trace(scene, seed)) for seed in seeds]
    assert len(set(digests)) == len(seeds)
    assert digest(*trace(scene, np.uint64(seeds[-1]))) == digests[-1]


def test_streams_of_different_seeds_have_nothing_in_common() -> None:
    """No state twice, and first numbers without correlation: also of seeds whose halves are swapped, or one is set."""
    import mitsuba as mi

    from rangesim.light_transport.sampling import Seed, Stream, random_stream

    pixel = mi.UInt32(np.arange(4096, dtype=np.uint32))
    states, numbers = [], []
    for seed in SEEDS:
        for stream in (Stream.FIRST, Stream.SECOND):
            rng = random_stream(Seed.of(seed), pixel, stream)
            states.append(np.column_stack([np.array(rng.state), np.array(rng.inc)]))
            numbers.append(np.array(rng.next_float32()))
    together = np.concatenate(states)
    assert len(np.unique(together, axis=0)) == len(together)
    correlation = np.corrcoef(numbers) - np.eye(len(numbers))
    assert np.abs(correlation).max() < 6 / np.sqrt(4096)


@pytest.mark.parametrize(("number", "detector"), [(0, Detector()), (1, SpadDetector())])
def test_every_seed_makes_its_own_noise_at_the_detector(
    signals: rangesim.Signals, number: int, detector: Detector | SpadDetector
) -> None:
    sensor = (AmcwToF(), DirectToF(bins=32))[number]
    digests = [digest(expose(signals, sensor, detector, seed=seed).frames) for seed in FEW_SEEDS]
    assert len(set(digests)) == len(FEW_SEEDS)


def test_no_instrument_of_any_experiment_has_the_noise_of_another() -> None:
    """Also not where one experiment's seed and the other's position of an instrument have the same numbers."""
    experiments = [Experiment("scene.xml", seed=seed) for seed in SEEDS]
    seeds = [noise_seed(one, instrument) for one in experiments for instrument in one.instruments]
    assert len(set(seeds)) == len(seeds)


def test_seeds_of_32_bits_give_the_noise_they_always_gave(scene: Scene) -> None:
    assert noise_seed(Experiment("a.xml", seed=7), Experiment("a.xml").instruments[1]) == int(
        np.random.SeedSequence([7, 1]).generate_state(1)[0]
    )
    import drjit as dr
    import mitsuba as mi

    from rangesim.light_transport.sampling import Seed, random_stream

    number = dr.arange(mi.UInt32, 64)
    for seed in (0, 5, (1 << 32) - 1):
        states = [mi.UInt64(x) for x in mi.sample_tea_32(mi.UInt32(seed), number)]
        expected = mi.PCG32(1, *states)
        np.testing.assert_array_equal(random_stream(Seed.of(seed), number).state, expected.state)


def test_no_seed_makes_a_new_kernel(scene: Scene) -> None:
    """The path loop's, the caustics', the probes': three kernels for each seed, were it a literal in them.

    Dr.Jit now and then compiles a kernel anew without any reason, also for one and the same seed.
    """
    import drjit as dr

    rig = scene.rig(width=16, height=12)
    transport(scene, rig, [], spp=2, seed=0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for seed in SEEDS[-8:]:
            transport(scene, rig, [], spp=2, seed=seed)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) >= 24
    assert sum(not k["cache_hit"] for k in kernels) < 8


# ---- What is no seed --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", NO_SEEDS, ids=repr)
def test_what_is_no_seed_is_refused_everywhere(scene: Scene, signals: rangesim.Signals, seed: Any) -> None:
    rig = scene.rig(width=16, height=12)
    moving = {AmcwToF(): Timing()}
    for call in (
        lambda: transport(scene, rig, [], seed=seed),
        lambda: transport_moving(scene, rig, moving, Motion({}), seed=seed),
        lambda: expose(signals, AmcwToF(), Detector(), seed=seed),
        lambda: expose(signals, AmcwToF(), seed=seed),  # noise-free, and yet
        lambda: Experiment("scene.xml", seed=seed),
    ):
        with pytest.raises(ValueError, match=r"^expected seed to be a whole number.*, got .*\.$"):
            call()


def test_the_largest_seed_reads_back(tmp_path: Path) -> None:
    experiment = Experiment("scene.xml", seed=np.uint64((1 << 64) - 1))  # type: ignore[arg-type]
    text = json.dumps(experiment_to_dict(experiment))
    assert experiment_from_dict(json.loads(text)) == experiment
    file = tmp_path / "one.toml"
    file.write_text(f'scene = "a.xml"\nseed = {(1 << 64) - 1}\n', encoding="utf-8")
    assert rangesim.experiment.load_experiment(file).seed == (1 << 64) - 1
