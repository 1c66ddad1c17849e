# SPDX-License-Identifier: Apache-2.0
"""Phase shift, several periods, and Gray cells of any size: every column decodes to itself, or is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from synthetic import plane_signals, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.codes import (
    Code,
    FringeConvention,
    GrayPhase,
    Heterodyne,
    MultiFrequency,
    NumberTheoretic,
    PhaseShift,
)
from rangesim.codes.fringe_gamma import FringeGamma
from rangesim.conventions import detect_convention
from rangesim.decoding import decode
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.rig import Intrinsics
from rangesim.sensors import StructuredLight, StructuredLightDecoder


def seen_flat(code: Code, size: int, order: tuple[str, ...] = (), **settings: float) -> tuple[np.ndarray, np.ndarray]:
    """Column and status of a camera that sees each projector pixel with one of its own."""
    sensor = StructuredLight(size, 8, code, order=order)
    seen = StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor))
    assert seen.column is not None
    return seen.column, seen.status


CODES = [
    PhaseShift(),
    PhaseShift(steps=3),
    PhaseShift(steps=16),
    PhaseShift(2000.0, 5),
    MultiFrequency(),
    MultiFrequency(steps=3),
    MultiFrequency((18.0, 150.0, 2000.0), steps_each=(5, 3, 4)),
    Heterodyne(),
    Heterodyne(steps=3),
    NumberTheoretic(),
    NumberTheoretic((40.0, 41.0)),
    GrayPhase(cell_px=7),
    GrayPhase(20.0, 3, cell_px=10),
    GrayPhase(200 / 3, 3, cell_px=100, further_periods_px=(100.0,)),
]


@pytest.mark.parametrize("code", CODES, ids=repr)
@pytest.mark.parametrize("size", [64, 333, 1280])
@pytest.mark.parametrize("order", [(), ("columns_*",)])
def test_every_column_decodes_to_itself(code: Code, size: int, order: tuple[str, ...]) -> None:
    column, status = seen_flat(code, size, order)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(column, np.broadcast_to(np.arange(size) + 0.5, column.shape), atol=0.02)


@pytest.mark.parametrize("start", ["cos", "sin", "-cos", "-sin", "cos-120", "cos+120"])
@pytest.mark.parametrize("direction", ["forward", "backward"])
@pytest.mark.parametrize("origin_px", [0.0, 0.5, -3.2])
def test_every_convention_decodes(start: str, direction: str, origin_px: float) -> None:
    convention = FringeConvention(start, direction, origin_px)  # type: ignore[arg-type]
    for code in (PhaseShift(steps=3), MultiFrequency(), Heterodyne(), GrayPhase(convention=convention)):
        column, status = seen_flat(replace(code, convention=convention), 150)  # type: ignore[type-var]
        assert (status == Status.OK).all()
        np.testing.assert_allclose(column[0], np.arange(150) + 0.5, atol=0.02)


@pytest.mark.parametrize(
    ("code", "repeat"),
    [(PhaseShift(500.0), "500"), (MultiFrequency((200 / 3, 100.0)), "200"), (NumberTheoretic((12.0, 15.0)), "60")],
)
def test_periods_that_repeat_within_the_axis_are_refused(code: Code, repeat: str) -> None:
    with pytest.raises(ValueError, match=f"phases repeat after {repeat} pixels: add a period of at least 640"):
        code.check(640)


def test_numbers_of_fringes_stand_for_periods_of_each_axis() -> None:
    sensor = StructuredLight(96, 60, MultiFrequency(fringes=(1, 6)), axes=("columns", "rows"))
    seen = StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor))
    assert seen.column is not None
    assert seen.row is not None
    np.testing.assert_allclose(seen.column[0], np.arange(96) + 0.5, atol=1e-3)
    np.testing.assert_allclose(seen.row[:, 0], np.arange(60) + 0.5, atol=1e-3)
    with pytest.raises(ValueError, match="expected periods_px or fringes, got both"):
        MultiFrequency((64.0,), fringes=(1, 6))


def test_a_period_of_one_pixel_less_than_the_axis_tells_all_but_the_ends() -> None:
    """Programs that divide the axis by np.linspace(0, n, n) show it."""
    column, status = seen_flat(MultiFrequency((95.0, 19.0)), 96)
    np.testing.assert_allclose(column[0, 1:-1], np.arange(1, 95) + 0.5, atol=1e-3)
    assert (status[0, [0, -1]] == Status.CODE_ERROR).all()


def test_cells_that_fringes_repeat_in_are_refused() -> None:
    with pytest.raises(ValueError, match="expected cell_px to be at most the period"):
        GrayPhase(16.0, cell_px=20).check(640)
    with pytest.raises(ValueError, match="phases repeat after 40 pixels"):
        GrayPhase(10.0, cell_px=50, further_periods_px=(40.0,)).check(640)


def test_cells_as_large_as_a_period_are_never_read_a_period_off() -> None:
    """A wrong bit at the edge of a cell is corrected or refused."""
    sensor = StructuredLight(640, 8, GrayPhase(16.0, cell_px=16))
    frames = np.roll(sensor.patterns(), 0)
    shown = [i for i, name in enumerate(sensor.frame_names()) if "bit" in name]
    frames[shown] = np.roll(frames[shown], 1, axis=2)  # the bits come from the neighbouring pixel
    seen = StructuredLightDecoder().coordinates(Capture(frames, sensor))
    assert seen.column is not None
    off = np.abs(seen.column - (np.arange(640) + 0.5))[:, 1:]
    ok = seen.status[:, 1:] == Status.OK
    assert off[ok].max() < 0.02
    assert ok.mean() > 0.7


# ---- Noise ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [3, 4, 8])
@pytest.mark.parametrize("kind", [PhaseShift, MultiFrequency, Heterodyne])
def test_the_noise_of_a_place_follows_its_law(kind: type[Code], steps: int) -> None:
    """sigma_u = P / (2 pi) sqrt(2 / N) sigma_I / B of the finest period."""
    code = kind(steps=steps)  # type: ignore[call-arg]
    size = 320
    sensor = StructuredLight(size, 48, code)
    rig = stereo_rig(160, 120, projector=Intrinsics.from_fov(size, 48, 60))
    clean = expose(plane_signals(rig, sensor), sensor)
    noisy = expose(plane_signals(rig, sensor), sensor, Detector())
    decoder = StructuredLightDecoder()
    expected, seen = decoder.coordinates(clean), decoder.coordinates(noisy)
    assert expected.column is not None
    assert seen.column is not None
    assert seen.column_sigma_px is not None
    ok = (expected.status == Status.OK) & (seen.status == Status.OK)
    assert ok.mean() > 0.2
    pull = (seen.column - expected.column)[ok] / seen.column_sigma_px[ok]
    assert np.abs(pull).max() < 8  # none is a cycle off
    assert float(np.sqrt(np.mean(pull**2))) == pytest.approx(1, abs=0.12)
    if kind is PhaseShift:
        modulation = 0.5 * (seen.confidence * noisy.full_scale)[ok]
        noise = noisy.noise(noisy.frames[:steps].mean(axis=0).astype(np.float32))
        assert noise is not None
        law = size / (2 * math.pi) * math.sqrt(2 / steps) * noise[ok] / modulation
        np.testing.assert_allclose(seen.column_sigma_px[ok], law, rtol=0.15)


@pytest.mark.parametrize("steps", [3, 4])
@pytest.mark.parametrize("kind", [MultiFrequency, Heterodyne])
def test_periods_of_an_unknown_camera_tell_its_noise(kind: type[Code], steps: int) -> None:
    """Weak pixels are refused as far as the noise asks for it; without that, 1 to 6 % of them are wrong."""
    sensor, rng = StructuredLight(640, 8, kind(steps=steps)), np.random.default_rng(0)  # type: ignore[call-arg]
    column = rng.integers(0, 640, (300, 200))
    white = np.linspace(5, 60, 300)[:, None]
    clean = 10 + white * sensor.patterns()[:, 0][:, column]
    decoded = []
    for noise in (0.0, 0.5, 3.0):
        frames = np.rint(clean + rng.normal(0, noise, clean.shape)).clip(0, 255).astype(np.uint8)
        seen = StructuredLightDecoder().coordinates(Capture(frames, sensor))
        assert seen.column is not None
        ok = seen.status == Status.OK
        decoded.append(float(ok.mean()))
        assert (np.abs(seen.column - column - 0.5) > 8)[ok].mean() < 0.005
    assert decoded[0] > 0.98
    assert decoded[1] > 0.95
    assert 0.3 < decoded[2] < 0.7


# ---- Gamma ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "gamma"), [(3, 2.2), (3, 2.8), (4, 2.2)])
def test_a_corrected_phase_has_the_noise_of_its_slope(steps: int, gamma: float) -> None:
    """Where the response compresses phases, the correction stretches them, and their noise."""
    rng, response = np.random.default_rng(0), FringeGamma(gamma)
    true, noise = np.arange(96) / 96, 0.003
    shown = (0.5 + 0.5 * np.cos(2 * np.pi * (true - np.arange(steps)[:, None] / steps))) ** gamma
    measured = phase_of(shown[..., None] + rng.normal(0, noise, (steps, 96, 4000)))
    found = response.corrected(measured, steps).normalised - true[:, None]
    scatter = 2 * np.pi * np.std(found - np.rint(found), axis=1)
    clean = phase_of(shown)
    law = np.sqrt(2 / steps) * noise / clean.modulation * response.slope(clean, steps)
    np.testing.assert_allclose(scatter, law, rtol=0.06)
    assert np.ptp(response.slope(clean, steps)) > 0.05


@pytest.mark.parametrize("gamma", [1.8, 2.2, 2.6])
@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("code", [GrayPhase(), MultiFrequency((16.0, 160.0, 1280.0)), Heterodyne()], ids=repr)
@pytest.mark.parametrize("order", [(), ("columns_*",)])
def test_a_gamma_is_measured_and_corrected(code: Code, steps: int, gamma: float, order: tuple[str, ...]) -> None:
    code = replace(code, steps=steps)  # type: ignore[type-var]
    sensor = StructuredLight(1280, 8, code, order=order)
    fringes = [i for i, name in enumerate(sensor.frame_names()) if "phase" in name]
    x = np.linspace(1, 1279, 4001)
    frames = np.empty((sensor.n_frames, 4, len(x)), dtype=np.float32)
    at = np.minimum(x.astype(int), 1279)
    frames[:] = sensor.patterns()[:, :1, at]
    stack = code.stack if isinstance(code, GrayPhase) else code.stack(1280)  # type: ignore[attr-defined]
    shown = [
        stack.convention.pattern(x, p, s, n)
        for p, n in zip(stack.periods_px, stack.steps, strict=True)
        for s in range(n)
    ]
    frames[fringes] = np.array(shown)[:, None] ** gamma
    seen = StructuredLightDecoder().coordinates(Capture(0.1 + frames, sensor))
    assert seen.column is not None
    ok = seen.status == Status.OK
    assert ok.mean() > 0.98
    off = (seen.column - x)[ok]
    assert float(np.sqrt(np.mean(off**2))) < 0.05
    assert not seen.doubts
    (note,) = seen.notes
    found = re.fullmatch(
        r"the fringes along columns were corrected for a gamma of (\S+) of projector and camera .*", note
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(gamma, abs=0.06)


def test_linear_fringes_are_not_corrected() -> None:
    sensor = StructuredLight(640, 400, GrayPhase(), ("columns", "rows"))
    assert not StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor)).notes


@pytest.mark.parametrize("gamma", [1.4, 2.6])
@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("code", [GrayPhase(), MultiFrequency((16.0, 160.0, 1280.0)), Heterodyne()], ids=repr)
@pytest.mark.parametrize("order", [(), ("columns_*",)])
def test_a_gamma_is_corrected_where_each_pixel_of_the_projector_is_uniform(
    code: Code, steps: int, gamma: float, order: tuple[str, ...]
) -> None:
    """A period of 16 pixels then shows 16 phases, or 4 places of the ripple of four steps."""
    code = replace(code, steps=steps)  # type: ignore[type-var]
    sensor = StructuredLight(code=code, order=order if isinstance(code, MultiFrequency) else (), projector_gamma=gamma)
    signals = plane_signals(stereo_rig(), sensor, ambient=0.01)
    seen = StructuredLightDecoder().coordinates(expose(signals, sensor))
    assert seen.column is not None
    ok = seen.status == Status.OK
    assert ok.mean() > 0.98
    off = (seen.column - signals.truth.projector_uv[..., 0])[ok]
    assert float(np.sqrt(np.mean(off**2))) < 0.3  # 1 / sqrt(12) px are the width of a pixel
    assert not seen.doubts
    assert len(seen.notes) == 1


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("steps", [3, 4, 5])
def test_a_gamma_of_blurred_fringes_is_no_contradiction_to_white_and_black(steps: int, sigma_px: float) -> None:
    """A blur takes the ripple away, and not what the gamma does to the mean of the fringes."""
    sensor = StructuredLight(640, 8, GrayPhase(steps=steps))
    x = (np.arange(6400) + 0.5) / 10
    frames = np.repeat(sensor.patterns()[:, 0].astype(np.float64), 10, axis=1)
    shown = [sensor.code.convention.pattern(x, 16.0, s, steps) for s in range(steps)]  # type: ignore[attr-defined]
    frames[[i for i, name in enumerate(sensor.frame_names()) if "phase" in name]] = np.array(shown) ** 2.2
    blurred = gaussian_filter1d(frames, 10 * sigma_px, axis=1, mode="nearest")
    seen = StructuredLightDecoder().coordinates(Capture((0.1 + blurred[:, None]).astype(np.float32), sensor))
    assert seen.column is not None
    inside = (seen.status == Status.OK) & (np.abs(x - 320) < 300)
    assert inside.mean() > 0.9
    assert float(np.sqrt(np.mean((seen.column - x)[inside] ** 2))) < 0.05
    assert not seen.doubts


def test_a_gamma_that_three_fringes_alone_do_not_tell_is_named() -> None:
    """Without white, black and other periods, the modulation changes alike for gammas of 2.6 and more."""
    sensor = StructuredLight(1280, 8, PhaseShift(steps=3), order=("columns_*",))
    with pytest.warns(RangesimWarning, match="no sinusoids .* tell no gamma that explains their shape"):
        StructuredLightDecoder().coordinates(Capture(0.1 + sensor.patterns() ** 2.6, sensor))


# ---- Frames that contradict themselves ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::rangesim.errors.RangesimWarning")
@pytest.mark.parametrize(
    ("code", "most"), [(Heterodyne(), 0.01), (NumberTheoretic(), 0.03), (MultiFrequency(), 0.0015)]
)
def test_noise_that_could_have_chosen_the_cycle_is_refused(code: Code, most: float) -> None:
    """Of readings with noise of 0.14 radians, 2 %, 10 % and 0.2 % were wrong: a ratio of costs is no evidence."""
    size, rng, detector = 1280, np.random.default_rng(5), Detector(read_noise_e=40.0)
    sensor = StructuredLight(size, 40, code, order=("columns_*",))
    noise_e = math.hypot(detector.read_noise_e, 1 / (math.sqrt(12) * detector.gain_dn_e))
    wrong, read = {}, {}
    for sigma in (0.05, 0.14):
        swing_e = 2 * math.sqrt(2 / 4) * noise_e / sigma
        light_e = swing_e * np.repeat(code.patterns(size)[:, None], 40, axis=1)
        light_e += detector.read_noise_e * rng.standard_normal(light_e.shape) + 1000  # read noise alone
        frames = np.rint(light_e * detector.gain_dn_e + detector.offset_dn).astype(np.uint16)
        seen = StructuredLightDecoder().coordinates(
            Capture(
                frames, sensor, detector=replace(detector, offset_dn=detector.offset_dn + 1000 * detector.gain_dn_e)
            )
        )
        assert seen.column is not None
        off = np.abs(seen.column - np.arange(size) - 0.5)[seen.valid]
        wrong[sigma], read[sigma] = float((off > 5).mean()), float(seen.valid.mean())
    assert wrong[0.14] < most
    assert wrong[0.05] < 1e-4
    assert read[0.05] > 0.98


def warned(code: Code, change: str, order: tuple[str, ...] = ("columns_*",)) -> str:
    sensor = StructuredLight(640, 8, code, order=order)
    frames = sensor.patterns()
    if change == "swapped":
        frames[[0, 1]] = frames[[1, 0]]
    elif change == "repeated":
        frames[1] = frames[0]
    with pytest.warns(RangesimWarning) as caught:
        StructuredLightDecoder().coordinates(Capture(0.1 + frames, sensor))
    return str(caught[0].message)


def test_exchanged_and_repeated_fringes_are_named_without_white_and_black() -> None:
    assert "columns_period0_phase0 and columns_period0_phase1, or" in warned(MultiFrequency(), "swapped")
    assert "period0_phase1 repeats columns_period0_phase0" in warned(MultiFrequency(), "repeated")
    assert "columns_phase1 repeats columns_phase0" in warned(PhaseShift(), "repeated")
    text = warned(MultiFrequency(steps=3), "swapped")
    assert "contradict each other" in text
    assert "those of 640 pixels seem to run the other way" in text


def test_periods_in_another_order_and_other_periods_are_named() -> None:
    sensor = StructuredLight(640, 8, MultiFrequency((640.0, 100.0, 16.0)))
    capture = Capture(0.1 + sensor.patterns(), sensor)
    other = replace(sensor, code=MultiFrequency((16.0, 100.0, 640.0)))
    with pytest.warns(RangesimWarning, match=r"shown in the order 640, 100, 16 pixels"):
        StructuredLightDecoder().coordinates(replace(capture, sensor=other))
    other = replace(sensor, code=MultiFrequency((640.0, 100.0, 17.0)))
    with pytest.warns(RangesimWarning, match=r"check the periods \(640, 100, 17 pixels\)"):
        StructuredLightDecoder().coordinates(replace(capture, sensor=other))


# ---- Conventions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["cos", "sin", "-cos", "-sin"])
@pytest.mark.parametrize("direction", ["forward", "backward"])
@pytest.mark.parametrize("origin_px", [0.0, 0.5])
def test_the_convention_is_found_in_the_frames(start: str, direction: str, origin_px: float) -> None:
    shown = FringeConvention(start, direction, origin_px)  # type: ignore[arg-type]
    sensor = StructuredLight(640, 8, GrayPhase(convention=shown))
    frames = 0.1 + sensor.patterns()
    found = detect_convention(frames, replace(sensor, code=GrayPhase())).sensor.code
    assert isinstance(found, GrayPhase)
    assert found.convention.direction == direction
    off = found.convention.shift_turns(0, 1, 16.0) - shown.shift_turns(0, 1, 16.0)
    assert abs(off - round(off)) < 1e-9
    assert detect_convention(frames, sensor).sensor == sensor
    other_period = replace(sensor, code=GrayPhase(23.0))
    assert detect_convention(frames, other_period).sensor == other_period


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_fringes_alone_that_are_read_mirrored_or_from_elsewhere_are_named(axis: str) -> None:
    """Nothing in the frames contradicts such a reading, so only the way in which places grow tells."""
    for code in (PhaseShift(), MultiFrequency((80.0, 20.0, 5.0)), Heterodyne((8.0, 80 / 9, 80 / 7))):
        sensor = StructuredLight(80, 80, code, axes=(axis,))  # type: ignore[arg-type]
        capture = Capture(sensor.patterns(), sensor)
        assert StructuredLightDecoder().likely_cause(capture, decode(capture)) is None
        for convention, cause in (
            (FringeConvention(direction="backward"), "grow to the left" if axis == "columns" else "grow upwards"),
            (FringeConvention(origin_px=-40.0), f"{axis} jump from one end of the projector to the other"),
        ):
            other = replace(capture, sensor=replace(sensor, code=replace(code, convention=convention)))
            assert cause in str(StructuredLightDecoder().likely_cause(other, decode(other)))


@pytest.mark.parametrize("start", ["cos", "sin", "-sin"])
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_fringes_that_start_nowhere_usual_are_left_to_the_decoder(start: str, direction: str) -> None:
    shown = FringeConvention(start, direction, 2.2)  # type: ignore[arg-type]
    frames = 0.1 + StructuredLight(640, 8, GrayPhase(convention=shown)).patterns()
    given = StructuredLight(640, 8, GrayPhase(convention=replace(shown, origin_px=0.0)))
    assert detect_convention(frames, given).sensor == given
    with pytest.warns(RangesimWarning, match=r"they seem to start 2\.2 projector pixels too late"):
        StructuredLightDecoder().coordinates(Capture(frames, given))
