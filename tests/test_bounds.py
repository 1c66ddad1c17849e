# SPDX-License-Identifier: Apache-2.0
"""Every field of every setting, against values that are none: what is accepted works, the rest is one sentence."""

from __future__ import annotations

import dataclasses
import inspect
import math
import pkgutil
import time
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

import rangesim
from rangesim import decode, explain, expose
from rangesim.campaign import Workers
from rangesim.codes import AxisCode, Code, FringeConvention, GrayPhase, GrayThresholds
from rangesim.codes.fringe_gamma import FringeGamma
from rangesim.codes.fringe_stack import FringeStack
from rangesim.dataset import DatasetSpec, ObjectGroup, RoomLight, spec_from_dict, spec_to_dict
from rangesim.dataset.supports import Bin, Floor, Table
from rangesim.dataset.view_poses import Path, Shell
from rangesim.decoding.disparities import Disparities, ImageNoise
from rangesim.decoding.phase_shift import Phase, PhaseThresholds
from rangesim.decoding.triangulation import ProjectorCoordinates, TriangulationLimits
from rangesim.electronics.ambient import Ambient, Tungsten
from rangesim.electronics.detector import Detector
from rangesim.electronics.spad import SpadDetector
from rangesim.errors import RangesimWarning
from rangesim.experiment import Experiment, Turntable, experiment_from_dict, experiment_to_dict
from rangesim.geometry.dense_stereo import DenseMatching
from rangesim.motion import ConstantTwist, Motion, PoseTrack, Timing
from rangesim.presets import instrument
from rangesim.response import (
    Correlation,
    Dots,
    FirstReturn,
    Fringes,
    GrayBits,
    Images,
    LengthSplit,
    LightPath,
    NumpyMath,
    Phasor,
    Stripes,
    TransientHistogram,
)
from rangesim.rig import Intrinsics, Lens, Rig, translation
from rangesim.sensors import (
    ActiveStereo,
    AmcwDecoder,
    AmcwToF,
    Decoder,
    DirectToF,
    DirectToFDecoder,
    IdealToF,
    IdealToFDecoder,
    ReferencePatternDecoder,
    ReferencePatternStereo,
    Sensor,
    StereoDecoder,
    StructuredLight,
    StructuredLightDecoder,
    ZnccDecoder,
)
from rangesim.settings.config import has_defaults
from rangesim.settings.draws import Of
from rangesim.signals import SignalSet

NONSENSE = (
    *(math.nan, math.inf, -math.inf, -1, 0, True, 1e300, 1e-300, -1e300, 10**30, 10**400, 1 << 63, 1j),
    *("", "x", "é" * 10**6, b"x", [], (), {}, None, object(), [[]], (1, 2, 3), ["x"], [True]),
    *([math.nan], (math.inf,), [10**400], np.float32("inf"), np.int64(3), np.zeros(3), np.full((4, 4), math.nan)),
)

CAMERA = Intrinsics.from_fov(24, 18, 45)
STEREO, DOTS = ActiveStereo(Dots(1280, 800)), ReferencePatternStereo(Dots(1280, 800))
RIG = stereo_rig(24, 18)


def expose_and_decode(sensor: Sensor, rig: Rig = RIG, detector: Any = None, ambient: Any = None) -> None:
    signals = plane_signals(rig, sensor, ambient=0.1)
    capture = rangesim.expose(signals, sensor, detector, ambient=ambient)
    image = rangesim.decode(capture)
    assert np.isfinite(image.range_m[image.valid]).all()


def signals_of(sensor: Sensor, rig: Rig = RIG) -> Any:
    """Signals of a plane; of a sensor with several cameras a set."""
    found = [plane_signals(one, sensor, ambient=0.1) for one in sensor.rigs(rig)]
    return found[0] if sensor.n_cameras == 1 else SignalSet.of(found)


def use_sensor(sensor: Any) -> None:
    hash(sensor)
    if isinstance(sensor, (ActiveStereo, ReferencePatternStereo)):
        signals = signals_of(sensor)
        assert rangesim.decode(rangesim.expose(signals, sensor)).status.shape == (18, 24)
        return
    rig = RIG
    if isinstance(sensor, StructuredLight):
        rig = stereo_rig(24, 18, projector=Intrinsics.from_fov(sensor.projector_width, sensor.projector_height, 60))
    if isinstance(sensor, DirectToF) and sensor.bins > 2000:
        sensor = dataclasses.replace(sensor, bins=2000)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the fringes along .* contradict white and black", RangesimWarning)  # a gamma
        warnings.filterwarnings("ignore", "the stripes along .* contradict", RangesimWarning)  # finer than the camera
        expose_and_decode(sensor, rig)
    assert len(sensor.frame_names()) == sensor.n_frames


def use_response(response: Any) -> None:
    u, v, length = np.meshgrid([0.0, 3.5, 8.0], [0.0, 2.5, 6.0], [0.0, 1.0, 50.0])
    for blur in (None, np.full(u.shape, 0.5)):
        path = LightPath(u, v, length, True, np.zeros(u.shape, np.uint32), blur)
        if hasattr(response, "bin"):
            values = np.asarray(response.bin(path, NumpyMath()))
        else:
            values = np.stack(np.broadcast_arrays(*response.weights(path, NumpyMath())))
        assert np.isfinite(values).all()


def use_decoder(decoder: Decoder) -> None:
    sensor = {
        StructuredLightDecoder: StructuredLight(axes=("columns", "rows")),
        ZnccDecoder: StructuredLight(axes=("columns", "rows")),
        AmcwDecoder: AmcwToF(waveform="square"),
        DirectToFDecoder: DirectToF(bins=32),
        IdealToFDecoder: IdealToF(),
        StereoDecoder: STEREO,
        ReferencePatternDecoder: DOTS,
    }[type(decoder)]
    for detector in (None, sensor.default_detector):
        signals = signals_of(sensor)
        capture = expose(signals, sensor, detector)
        image = decode(capture, decoder)
        assert image.decoder == decoder
        explain(image, capture, signals)


def use_rig(rig: Any) -> None:
    assert np.isfinite(rig.camera_illumination).all()
    assert math.isfinite(rig.projector_irradiance)
    assert rig.projector_irradiance > 0
    hash(rig)
    expose_and_decode(IdealToF(), rig)
    expose_and_decode(AmcwToF(), rig, Detector.time_of_flight())


def use_camera(camera: Any) -> None:
    hash(camera)
    if camera.width * camera.height > 10_000:
        return
    pixels = camera.pixel_centres()
    with np.errstate(all="raise", under="ignore", invalid="ignore"):
        rays = camera.directions(pixels)
        camera.project(rays)
    use_rig(Rig(camera, RIG.projector))


def use_detector(detector: Any) -> None:
    counts_photons = isinstance(detector, SpadDetector)
    sensor: Sensor = DirectToF(bins=32) if counts_photons else AmcwToF()
    rig = stereo_rig(8, 6) if counts_photons else RIG  # dead times and afterpulses are followed from photon to photon
    expose_and_decode(sensor, rig, detector)
    expose_and_decode(sensor, rig, detector, Ambient("led", illuminance_lux=500.0))


def use_instrument(one: Any) -> None:
    lenses = {"camera_lens": one.camera_lens, "projector_lens": one.projector_lens}
    use_rig(dataclasses.replace(RIG, **lenses, projector_power_w=one.power_w))
    if one.detector is not None and isinstance(one.detector, Detector):
        use_detector(one.detector)


def use_timing(timing: Any) -> None:
    assert np.isfinite(timing.exposure_times_s(AmcwToF())).all()
    assert math.isfinite(timing.reference_s(AmcwToF(), CAMERA))
    assert sum(
        i.fraction * i.window.of(np.ones((18, 24))).sum() for i in timing.instants(0.0, CAMERA)
    ) == pytest.approx(24 * 18)


def use_track(track: Any) -> None:
    hash(track)
    for time_s in (-1.0, 0.0, 100.0):
        assert np.isfinite(track.at(time_s)).all()


def use_ambient(ambient: Any) -> None:
    assert math.isfinite(ambient.scale)
    assert math.isfinite(ambient.in_band(850e-9, 50e-9))
    expose_and_decode(AmcwToF(), RIG, Detector.time_of_flight(), ambient)


def use_experiment(experiment: Any) -> None:
    experiment_from_dict(experiment_to_dict(experiment))


def use_spec(spec: DatasetSpec) -> None:
    assert spec_from_dict(spec_to_dict(spec)) == spec


BOXES = ObjectGroup("box")  # type: ignore[arg-type]
ONE_BOX = DatasetSpec((BOXES,), instruments=({"sensor": "ideal-tof"},))


def use_in_spec(name: str) -> Callable[[Any], None]:
    return lambda part: use_spec(dataclasses.replace(ONE_BOX, **{name: (part,) if name == "objects" else part}))


def nothing(_: Any) -> None: ...


CASES: list[tuple[Any, Callable[[Any], None]]] = [
    (CAMERA, use_camera),
    (RIG, use_rig),
    (StructuredLight(64, 48, code="gray"), use_sensor),
    (StructuredLight(64, 48), use_sensor),
    *(
        (kind(), lambda code: use_sensor(StructuredLight(64, 48, code)))
        for kind in Code.known.values()
        if kind.__module__.startswith("rangesim.") and has_defaults(kind)
    ),
    (FringeConvention(), lambda c: use_sensor(StructuredLight(64, 48, GrayPhase(convention=c)))),
    (AmcwToF(), use_sensor),
    (AmcwToF(waveform="square"), use_sensor),
    (AmcwToF((20e6, 80e6), taps_per_exposure=2, contrasts=(0.8, 0.6), pixel_delay_s=1e-10), use_sensor),
    (Correlation((0.05, 0.1), (0.0, 0.5)), lambda c: use_sensor(AmcwToF(correlation=c))),
    (DirectToF(), use_sensor),
    (DirectToF(pulse_fwhm_s=400e-12), use_sensor),
    (IdealToF(), use_sensor),
    (StructuredLightDecoder(), use_decoder),
    (ZnccDecoder(), use_decoder),
    (STEREO, use_sensor),
    (DOTS, use_sensor),
    (ReferencePatternDecoder(disparities=8), use_decoder),
    (StereoDecoder(disparities=8), use_decoder),
    (DenseMatching(), lambda matching: use_decoder(StereoDecoder(matching, disparities=8))),
    (ImageNoise(), lambda noise: use_decoder(StereoDecoder(noise=noise, disparities=8))),
    (GrayThresholds(), lambda t: use_decoder(StructuredLightDecoder(gray=t))),
    (PhaseThresholds(), lambda t: use_decoder(StructuredLightDecoder(phase=t))),
    (TriangulationLimits(), lambda t: use_decoder(StructuredLightDecoder(triangulation=t))),
    (AmcwDecoder(), use_decoder),
    (DirectToFDecoder(), use_decoder),
    (IdealToFDecoder(), use_decoder),
    (Detector(), use_detector),
    (SpadDetector(), use_detector),
    (SpadDetector(pile_up=True), use_detector),
    (Ambient("sun", illuminance_lux=1e4), use_ambient),
    (Ambient("tungsten", irradiance_w_m2=10.0), use_ambient),
    (Ambient("led", illuminance_lux=100.0), use_ambient),
    (Tungsten(), lambda t: use_ambient(Ambient("tungsten", 10.0, temperature_k=t.temperature_k))),
    (Lens(1e-3), lambda x: use_rig(dataclasses.replace(RIG, camera_lens=x, projector_lens=x))),
    (instrument("amcw"), use_instrument),
    (instrument("gray"), use_instrument),
    (Experiment("a.xml"), use_experiment),
    (Timing(line_period_s=1e-5, exposure_s=1e-3), use_timing),
    (PoseTrack(np.array([0.0, 1.0]), np.stack([np.eye(4), translation(1, 0, 0)])), use_track),
    (ConstantTwist(), use_track),
    (Motion({"ball": ConstantTwist()}), lambda m: m.at(1.0)),
    (GrayBits(0, 4, 2), use_response),
    (Stripes(0, np.ones((2, 8), np.float32)), use_response),
    (Dots(8, 6), use_response),
    (Fringes(0, 16.0), use_response),
    (Images(np.ones((2, 6, 8), np.float32)), use_response),
    (Phasor(20e6), use_response),
    (Phasor(20e6, True), use_response),
    (FirstReturn(), use_response),
    (TransientHistogram(0.0, 0.03, 16), use_response),
    (LengthSplit(0.0, 0.03, 16), use_response),
    (Workers(), nothing),
    (ONE_BOX, use_spec),
    (BOXES, use_in_spec("objects")),
    (RoomLight(), use_in_spec("light")),
    (Table(), use_in_spec("support")),
    (Floor(), use_in_spec("support")),
    (Bin(), use_in_spec("support")),
    (Shell(), use_in_spec("view")),
    (Path(Turntable(centre_m=(0, 0, 0), distance_m=1.0, elevation_deg=45.0)), use_in_spec("view")),
]  # fmt: skip

FIELDS = [
    pytest.param(base, field.name, use, id=f"{type(base).__name__}.{field.name}-{i}")
    for i, (base, use) in enumerate(CASES)
    for field in dataclasses.fields(base)
    if field.init
]


def refusal(make: Callable[[], Any]) -> str:
    """The message of a ValueError, or an empty one."""
    try:
        make()
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("base", "name", "use"), FIELDS)
def test_every_value_of_a_field_works_or_is_refused_in_one_sentence(
    base: Any, name: str, use: Callable[[Any], None]
) -> None:
    for value in NONSENSE:
        start = time.process_time()
        message = refusal(lambda: use(dataclasses.replace(base, **{name: value})))  # noqa: B023 (called at once)
        assert not message or message.startswith("expected")
        assert len(message) < 500
        assert "\n" not in message
        assert time.process_time() - start < (2 if message else 10)  # hangs, whatever else the machine does


def ends(hint: Any) -> list[Any]:
    """The ends of the bounds that a field's annotation states; of a whole number, its limit or a moderate value."""
    if get_origin(hint) is Annotated:
        kind, bounds = get_args(hint)
        if isinstance(bounds, Of):  # a setting that may be drawn
            return ends(Annotated[bounds.kind, bounds.bounds]) if bounds.bounds else []
        low, high = bounds.low, min(bounds.high, 50)
        return [int(low), int(high)] if kind is int else [bounds.low, bounds.high, *([0.0] if bounds.or_zero else [])]
    if get_origin(hint) is tuple:
        return [(end,) * (3 if len(get_args(hint)) == 3 else 1) for end in ends(get_args(hint)[0])]
    return [end for part in get_args(hint) for end in ends(part)]


@pytest.mark.parametrize(("base", "name", "use"), FIELDS)
def test_the_ends_of_the_bounds_work(base: Any, name: str, use: Callable[[Any], None]) -> None:
    for value in ends(get_type_hints(type(base), include_extras=True)[name]):
        message = refusal(lambda: use(dataclasses.replace(base, **{name: value})))  # noqa: B023 (called at once)
        assert not message or "expected" in message  # two settings that are fine alone may not go together


@pytest.mark.parametrize("name", ["seed"])
def test_numbers_are_no_bools(name: str) -> None:
    with pytest.raises(ValueError, match="whole number"):
        Experiment("a.xml", **{name: True})  # type: ignore[arg-type]


MODULES = (
    *("electronics.ambient", "electronics.detector", "electronics.spad", "experiment.experiment"),
    *(
        "instrument.instrument",
        "motion.timing",
        "motion.pose_tracks",
        "response.path_lengths",
        "response.patterns",
        "rig.rig",
    ),
    *(
        "sensors.structured_light",
        "sensors.amcw",
        "sensors.direct_tof",
        "sensors.ideal_tof",
        "sensors.active_stereo",
        "sensors.reference_pattern",
        "sensors.zncc",
    ),
    *(
        "decoding.phase_shift",
        "decoding.triangulation",
        "decoding.disparities",
    ),
    "campaign.workers",
    *("dataset.dataset_spec", "dataset.supports", "dataset.view_poses"),
    "geometry.dense_stereo",
    "response.correlation",
    *(f"codes.{module.name}" for module in pkgutil.iter_modules(rangesim.codes.__path__)),
)
RESULTS = {Disparities, ProjectorCoordinates, Phase, FringeGamma, FringeStack, AxisCode, *AxisCode.__subclasses__()}


def test_every_setting_has_a_case() -> None:
    covered = {type(base) for base, _ in CASES}
    for module in MODULES:
        for thing in vars(import_module(f"rangesim.{module}")).values():
            is_setting = isinstance(thing, type) and dataclasses.is_dataclass(thing) and not inspect.isabstract(thing)
            if is_setting and thing.__module__ == f"rangesim.{module}":
                assert thing in covered | RESULTS, f"{thing.__name__} needs a case in CASES"
