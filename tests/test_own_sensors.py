# SPDX-License-Identifier: Apache-2.0
"""A sensor and a decoder from outside the package: one file each, and every command and every stage takes them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim import (
    AmcwToF,
    Capture,
    Decoder,
    Detector,
    DirectToF,
    RangeImage,
    Sensor,
    SpadDetector,
    Status,
    StructuredLight,
    decode,
    explain,
    expose,
    save_capture,
)
from rangesim.calibration import Checkerboard, default_rig, render_set
from rangesim.causes import Cause
from rangesim.codes import AxisCode, AxisFrames, CodeThresholds, GrayCode, GrayPhase, GrayThresholds
from rangesim.codes.phase_refinement import refine_by_phase
from rangesim.decoding.coordinates import Coordinates
from rangesim.errors import FileFormatError
from rangesim.experiment import experiment_from_dict, load_experiment
from rangesim.instrument.instrument import Instrument
from rangesim.response import DenseResponse, Response
from rangesim.rig.calibration_files import load_calibration
from rangesim.sensor import Background
from rangesim.sensors import AmcwDecoder, StructuredLightDecoder, presets, sensor_from_dict, sensor_of

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
GATED = f"{EXAMPLES / 'own_sensor.py'}:GatedCamera"
TWIN = "from rangesim.sensors import AmcwDecoder, AmcwToF"
FRINGES = f"{EXAMPLES / 'own_code.py'}:TriangleWaves"


# ---- Every command takes them ---------------------------------------------------------------------------------------


def command(*arguments: object, fails: bool = False) -> str:
    """What `rangesim` says, on stderr if it fails; each call is a process of its own, and knows no other's sensors."""
    line = [sys.executable, "-m", "rangesim", *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300)
    assert done.returncode == int(fails), done.stderr
    return done.stderr if fails else done.stdout


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of a run with both sensors, which an experiment file names."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "both.toml").write_text(
        f"""
        scene = "tabletop"
        width = 80
        height = 60
        spp = 4

        [[instrument]]
        sensor = "{GATED}"

        [[instrument]]
        name = "fringes"
        sensor = {{ type = "{FRINGES}", projector_width = 320, projector_height = 200 }}
        decoder = {{ phase = {{ max_sigma_rad = 0.3 }} }}
        """
    )
    command("run", "--config", folder / "both.toml", "--out", folder / "result")
    return folder / "result"


def test_a_result_holds_every_stage_of_them(result: Path) -> None:
    for name, frames in (("gated-camera", 9), ("fringes", 10)):
        assert len(list((result / name / "capture").glob("*.png"))) == frames
        rows = json.loads((result / name / "comparison.json").read_text())["rows"]
        matte = next(row for row in rows if row["name"] == "matte")
        assert matte["completeness"] > 0.9
        assert matte["median_abs_m"] < 0.01
        assert matte["right"] < 1
        assert sum(matte["causes"].values()) == pytest.approx(matte["wrong"] + matte["missing"])
        assert (result / name / "segmentation.npz").is_file()
    report = (result / "report.html").read_text()
    for shown in ("Range-gated camera", "8 gates of 2 ns", "triangle waves", "ratio 16"):
        assert shown in report
    decoder = json.loads((result / "experiment.json").read_text())["experiment"]["instrument"][1]["decoder"]
    assert decoder["type"] == "structured-light"
    assert decoder["phase"] == {"max_sigma_rad": 0.3, "modulation_of_scale": 2.5 / 255, "relative_modulation": 0.01}


@pytest.mark.validation
def test_other_commands_take_their_results_once_the_file_is_named(result: Path, tmp_path: Path) -> None:
    assert "gated-camera" in command("compare", result, "--markdown")
    assert "as they were written" in command("verify", result)
    before = (result / "report.html").read_bytes()
    assert "--sensor FILE.py:NAME" in command("report", result, fails=True)
    command("report", result, "--sensor", GATED, "--sensor", FRINGES)
    assert (result / "report.html").read_bytes() == before
    capture = result / "gated-camera" / "capture"
    assert "--sensor FILE.py:NAME" in command("decode", capture, "--out", tmp_path / "decoded", fails=True)
    command("decode", capture, "--sensor", GATED, "--out", tmp_path / "decoded")
    with np.load(tmp_path / "decoded" / "range.npz") as again, np.load(capture.parent / "range.npz") as first:
        np.testing.assert_array_equal(again["z"], first["z"])


def test_the_command_line_names_them_too(tmp_path: Path) -> None:
    size = ("--width", 40, "--height", 30, "--spp", 4)
    command("run", "plane", "--sensor", GATED, "--sensor", "amcw", *size, "--out", tmp_path / "run")
    assert (tmp_path / "run" / "gated-camera" / "cloud.ply").is_file()
    assert "did you mean 'amcw'" in command("run", "plane", "--sensor", "amwc", "--out", tmp_path / "no", fails=True)


# ---- A code from outside is calibrated and decoded like those of the package ----------------------------------------


@pytest.mark.validation
def test_images_of_an_own_code_calibrate_a_rig_and_decode_with_it(tmp_path: Path) -> None:
    """Its two classes suffice: no command and no calibration knows it, and the images say nothing of it."""
    sensor = sensor_of(FRINGES).for_projector(400, 300, ("columns", "rows"))
    rig = default_rig(320, 240, (400, 300))
    rendered = render_set(Checkerboard(7, 5, 0.03), rig, sensor, n=4, spp=8)
    folders = [tmp_path / f"pose_{k}" for k in range(4)]
    for folder, capture in zip(folders, rendered.captures, strict=True):
        save_capture(capture, folder)
        (folder / "capture.json").unlink()
        (folder / "manifest.json").unlink()
    images = ("--sensor", FRINGES, "--projector", "400x300", "--bits", 12)
    board = ("--points", "7x5", "--spacing", 0.03, "--coefficients", 0)
    said = command("calibrate", *folders, *images, *board, "--out", tmp_path / "rig.json")
    assert "baseline" in said
    found = load_calibration(tmp_path / "rig.json")
    assert found.projector.width == 400
    assert found.baseline_m == pytest.approx(rig.baseline_m, rel=0.1)
    with_rig = ("--axes", "columns,rows", "--calibration", tmp_path / "rig.json", "--out", tmp_path / "decoded")
    assert "measured, z from" in command("decode", folders[0], *images, *with_rig)
    with np.load(tmp_path / "decoded" / "range.npz") as image:
        at_board = np.linalg.norm(rendered.T_camera_board[0, :3, 3])
        assert np.nanmedian(image["z"]) == pytest.approx(at_board, rel=0.2)


@pytest.mark.validation
def test_options_of_bare_images_that_a_sensor_lacks_are_refused(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for options, message in (
        (("--code", "amcw", "--projector", "64x64"), "expected a sensor whose code has the size of a projector"),
        (("--sensor", FRINGES, "--set", "period_px=8"), "unknown setting 'period_px'"),
        (("--sensor", FRINGES, "--code", "gray"), "expected either --sensor or --code"),
        (("--code", "amcw"), "expected 12 images for amcw-tof"),
    ):
        assert message in command("decode", tmp_path / "images", *options, "--out", tmp_path / "out", fails=True)


# ---- Codes from outside ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwoPeriods(GrayPhase):
    """Gray code and fringes of two periods, the second a quarter of the first."""

    type_name: ClassVar[str] = "two-periods"

    @property
    def fine(self) -> GrayPhase:
        return GrayPhase(self.period_px / 4, 3)

    def names(self, size: int) -> list[str]:
        return [*super().names(size), "fine0", "fine1", "fine2"]

    def patterns(self, size: int) -> np.ndarray:
        return np.concatenate([super().patterns(size), self.fine.patterns(size)[-3:]])

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return (*super().responses(axis, size), self.fine.responses(axis, size)[-1])

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        yield from super().frames(size, channels[:-1], white)
        yield from list(self.fine.frames(size, [channels[0], channels[-1]], white))[-3:]

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        coarse, swing = super().decode(seen, thresholds), 0 * seen.contrast.values
        fine = seen.starting_with("fine")
        return refine_by_phase(fine, coarse, self.fine.period_px, self.convention, swing, thresholds.phase)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        assert code.coarse is not None
        return super().contradiction(seen, code.coarse)


def test_a_code_from_outside_is_framed_named_and_decoded() -> None:
    sensor = StructuredLight(code=TwoPeriods())
    assert sensor.frame_names()[-5:] == ["columns_fine0", "columns_fine1", "columns_fine2", "white", "black"]
    signals = plane_signals(stereo_rig(), sensor, StructuredLight())
    exact = sensor.default_decoder.coordinates(expose(signals, sensor))
    assert np.nanmax(np.abs(exact.column - signals.truth.projector_uv[..., 0])) < 1e-3  # type: ignore[operator]
    scatter = []
    for one in (sensor, StructuredLight()):
        seen = one.default_decoder.coordinates(expose(signals, one, Detector(), 2e-4, seed=1))
        assert seen.valid.mean() > 0.9
        scatter.append(np.nanstd(seen.column - exact.column))  # type: ignore[operator]
    assert scatter[0] < 0.5 * scatter[1]


def test_a_file_may_name_a_code_instead_of_a_sensor(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("from rangesim.codes import GrayCode\nCoarse = GrayCode(cell_px=4)\n")
    assert sensor_of(f"{tmp_path}/own.py:Coarse") == StructuredLight(code=GrayCode(4))
    assert sensor_of(f"{tmp_path}/own.py:GrayCode") == StructuredLight(code="gray")


# ---- The two examples are right -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "tolerance_m"), [(GATED, 1e-5), (FRINGES, 4e-3)])
def test_without_noise_they_read_a_plane_as_it_is(name: str, tolerance_m: float) -> None:
    sensor = sensor_of(name)
    rig = stereo_rig()
    signals = plane_signals(rig, sensor)
    image = decode(expose(signals, sensor))
    lit = signals.truth.projector_visible
    assert image.valid[lit].mean() > 0.999
    assert np.nanmax(np.abs(image.z - signals.truth.z)[lit]) < tolerance_m
    assert image.decoder == sensor.default_decoder


@pytest.mark.parametrize("name", [GATED, FRINGES])
def test_their_least_signal_is_where_they_begin_to_refuse(name: str) -> None:
    """As of the decoders of the package, see tests/test_cause.py."""
    from rangesim.causes.light_budget import light_budget

    sensor, detector, exposure_s = sensor_of(name), Detector(full_well_e=30_000.0, read_noise_e=10.0), 2e-3
    rig = stereo_rig()
    signals = plane_signals(rig, sensor, ambient=0.3)
    budget = light_budget(signals, expose(signals, sensor, detector, exposure_s), sensor.default_decoder)
    lit = signals.truth.projector_visible
    power = float(np.median((budget.needed / budget.signal)[lit]))
    refused = {}
    for factor in (0.5, 2.0):
        dim = plane_signals(replace(rig, projector_power_w=factor * power), sensor, ambient=0.3)
        status = decode(expose(dim, sensor, detector, exposure_s, seed=3)).status
        refused[factor] = np.mean(status[lit] == Status.LOW_SIGNAL)
    assert refused[0.5] > 0.9
    assert refused[2.0] < 0.1


# ---- The causes ask the decoder that was used -----------------------------------------------------------------------


def test_what_a_strict_decoder_refuses_is_low_signal_and_not_something_else() -> None:
    sensor = StructuredLight(code="gray")
    signals = plane_signals(stereo_rig(), sensor)
    capture = expose(signals, sensor, Detector(), seed=1)
    strict = decode(capture, StructuredLightDecoder(gray=GrayThresholds(contrast_sigmas=200.0)))
    refused = (strict.status == Status.LOW_SIGNAL) & signals.truth.projector_visible
    assert refused.sum() > 1000
    assert (explain(strict, capture, signals).cause[refused] == Cause.LOW_SIGNAL).all()
    seen = explain(strict, capture, signals, tolerance_m=0.1)
    assert (seen.cause[refused] == Cause.LOW_SIGNAL).all()


@dataclass(frozen=True)
class Smoothed(Decoder):
    """Looks at neighbours: the median of 3 x 3 readings, where all of them are there."""

    inner: AmcwDecoder = field(default_factory=AmcwDecoder)
    type_name: ClassVar[str] = "smoothed"
    shapes: ClassVar[list[tuple[int, ...]]] = []

    def coordinates(self, capture: Capture) -> Coordinates:
        return self.inner.coordinates(capture)

    def decode(self, capture: Capture) -> RangeImage:
        from scipy.ndimage import median_filter

        self.shapes.append(capture.frames.shape)
        image = self.inner.decode(capture)
        z = median_filter(image.z, 3)
        status = np.where(np.isfinite(z), image.status, Status.LOW_SIGNAL).astype(np.uint8)
        z = np.where(status == Status.OK, z, np.nan)
        return replace(image, z=z, range_m=image.range_m * z / image.z, status=status)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        return self.inner.least_signal(sensor, background)


def test_a_decoder_that_looks_at_neighbours_sees_whole_images() -> None:
    """A pin that it smooths away is so without noise too: too coarse, and no noise, as of pixels decoded one by one."""
    sensor, rig = AmcwToF((50e6,)), stereo_rig(baseline_m=0.03)
    z = np.full((120, 160), 1.0)
    z[::12, ::12] = 0.97  # pins a pixel wide
    signals = signals_of_depth(rig, z, [sensor])
    capture = expose(signals, sensor, Detector.time_of_flight(), seed=2)
    Smoothed.shapes.clear()
    image = decode(capture, Smoothed())
    causes = explain(image, capture, signals, tolerance_m=0.02)
    pins = z < 1
    assert set(Smoothed.shapes) == {capture.frames.shape}
    assert (causes.cause[pins] == Cause.RESOLUTION).mean() > 0.9
    assert not causes.failed[~pins].any()


# ---- Files that are no sensors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist; expected a Python file with a sensor"),
        ("1 / 0", "fails: ZeroDivisionError"),
        ("import no_such_module", "fails: ModuleNotFoundError"),
        ("import sys\nsys.exit(0)", "fails: SystemExit: 0"),
        ("class Thing: pass", "expected Thing to be a sensor, a code or a class of them, got <class"),
        ("", "expected Thing to be a sensor, a code or a class of them, got None"),
        ("from rangesim import Sensor\nclass Thing(Sensor): pass", "Thing: TypeError: Can't instantiate abstract"),
        (f"{TWIN}\nclass Thing(AmcwToF): pass", "fails: TypeError: expected Thing to have a type_name of its own"),
        (f"{TWIN}\nclass Thing(AmcwToF): type_name = 'direct-tof'", "of its own; 'direct-tof' is taken"),
        (f"{TWIN}\nclass Thing(AmcwDecoder): type_name = 'direct-tof'", "of its own; 'direct-tof' is taken"),
        (f"{TWIN}\nclass Thing(AmcwToF):\n type_name = 'a'\n def __init__(self): raise OSError('x')", "OSError: x"),
        (f"{TWIN}\nclass Thing(AmcwToF):\n type_name = 'b'\n def frame_names(self): return ['a/b']", "frame_names"),
    ],
)
def test_a_file_without_a_sensor_is_refused_in_one_sentence(text: str | None, message: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    with pytest.raises(FileFormatError, match=message) as error:
        sensor_of("mine.py:Thing", tmp_path)
    assert "\n" not in str(error.value)
    assert sensor_of("direct-tof") == DirectToF()


def test_a_subclass_leaves_the_presets_of_its_parent_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        f"{TWIN}\nfrom dataclasses import dataclass\n@dataclass(frozen=True)\nclass Low(AmcwToF):\n"
        "    contrast: float = 0.3\n    type_name = 'low-contrast'\nLOWEST = Low(contrast=0.1)\n"
    )
    assert sensor_of("mine.py:Low", tmp_path).contrast == 0.3  # type: ignore[attr-defined]
    assert sensor_of("amcw") == AmcwToF()
    assert presets()["low-contrast"] == sensor_of("mine.py:Low", tmp_path)
    # Settings of an instance are kept where a table changes others
    lowest = sensor_from_dict({"type": "mine.py:LOWEST", "waveform": "square"}, "sensor", tmp_path)
    assert (lowest.contrast, lowest.waveform) == (0.1, "square")  # type: ignore[attr-defined]


def test_a_file_that_failed_is_loaded_again_once_it_is_mended(tmp_path: Path) -> None:
    """As in a notebook; and one that was edited, too."""
    path = tmp_path / "again.py"
    text = f"{TWIN}\nclass Again(AmcwToF): type_name = 'again'\n"
    for time_s, (body, fails) in enumerate(
        [(text + "1 / 0", True), (text, False), (text + "X = Again((3e7,))", False)]
    ):
        path.write_text(body)
        os.utime(path, (time_s, time_s))
        if fails:
            with pytest.raises(FileFormatError, match="ZeroDivisionError"):
                sensor_of("again.py:Again", tmp_path)
        else:
            assert sensor_of("again.py:Again", tmp_path).type_name == "again"
    assert sensor_of("again.py:X", tmp_path).modulation_hz == (3e7,)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"z": np.zeros((3, 3), np.float32)}, "return z of shape"),
        ({"z": np.zeros((120, 160))}, "and type float32"),
        ({"status": np.ones((120, 160), np.uint8)}, "to return z where status is OK"),
    ],
)
def test_what_a_decoder_returns_is_checked(changes: dict[str, np.ndarray], message: str) -> None:
    @dataclass(frozen=True)
    class Wrong(Smoothed):
        type_name: ClassVar[str] = "wrong"

        def decode(self, capture: Capture) -> RangeImage:
            return replace(self.inner.decode(capture), **changes)

    capture = expose(plane_signals(stereo_rig(baseline_m=0.03), AmcwToF()), AmcwToF())
    with pytest.raises(ValueError, match=f"expected Wrong .*{message}"):
        decode(capture, Wrong())


def test_a_range_image_is_of_the_decoder_that_was_asked() -> None:
    """Also where that one leaves the work to another."""
    capture = expose(plane_signals(stereo_rig(baseline_m=0.03), AmcwToF()), AmcwToF())
    assert decode(capture, Smoothed()).decoder == Smoothed()
    assert decode(capture, Smoothed().inner).decoder == AmcwDecoder()


def test_frames_and_detectors_that_do_not_fit_are_refused() -> None:
    class Odd(AmcwToF):
        type_name = "odd"

        def frames(self, *given: np.ndarray) -> np.ndarray:  # type: ignore[override]
            return super().frames(*given).astype(np.float64)  # type: ignore[arg-type]

    signals = plane_signals(stereo_rig(), AmcwToF())
    with pytest.raises(ValueError, match=r"expected frames of odd of shape .* and type float32, got .* float64"):
        expose(signals, Odd())
    with pytest.raises(ValueError, match="expected a SpadDetector"):
        Instrument("a", DirectToF(), Detector())
    with pytest.raises(ValueError, match="expected a sensor that counts photons"):
        Instrument("a", AmcwToF(), SpadDetector())


def test_what_is_read_back_runs_no_file(tmp_path: Path) -> None:
    """A result or a capture from elsewhere may name any file: only what a user names is run."""
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    name = f"{tmp_path / 'evil.py'}:Thing"
    for sensor in (name, {"type": name}):
        with pytest.raises(ValueError, match="expected"):
            sensor_from_dict(sensor, "sensor")
        with pytest.raises(ValueError, match="expected"):
            experiment_from_dict({"scene": "plane", "instrument": [{"name": "a", "sensor": sensor}]})
    assert not (tmp_path / "ran").exists()


def test_an_experiment_names_files_from_its_own_folder(tmp_path: Path) -> None:
    text = (EXAMPLES / "own_sensor.py").read_text()
    for name, other in (("gated-camera", "my-gates"), ("gate-ratio", "my-ratio"), ('"gates"', '"my-pulse"')):
        text = text.replace(name, other)
    (tmp_path / "mine.py").write_text(text)
    (tmp_path / "mine.toml").write_text('scene = "plane"\n[[instrument]]\nsensor = "mine.py:GatedCamera"\n')
    (one,) = load_experiment(tmp_path / "mine.toml").instruments
    assert one.name == "my-gates"
    assert one.detector == one.sensor.default_detector
    assert Instrument("x", one.sensor) == replace(one, name="x")


def test_a_file_imports_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "beside_the_sensor.py").write_text("CONTRAST = 0.25\n")
    (tmp_path / "with_a_neighbour.py").write_text(
        f"from beside_the_sensor import CONTRAST\n{TWIN}\nfrom dataclasses import dataclass\n@dataclass(frozen=True)\n"
        "class Beside(AmcwToF):\n    contrast: float = CONTRAST\n    type_name = 'beside'\n"
    )
    assert sensor_of("with_a_neighbour.py:Beside", tmp_path).contrast == 0.25  # type: ignore[attr-defined]


def test_a_file_that_fails_leaves_no_member_in_any_family(tmp_path: Path) -> None:
    """Its response, too, is unknown then: the name is free for another file."""
    source = """
from typing import ClassVar
from rangesim import AmcwToF
from rangesim.response import DenseResponse
class Half(DenseResponse):
    type_name: ClassVar[str] = "half-done"
    def weights(self, path, m):
        return [path.u]
"""
    failing, working = tmp_path / "failing.py", tmp_path / "working.py"
    failing.write_text(source + "raise RuntimeError('not yet')\n")
    working.write_text(source + "SENSOR = AmcwToF()\n")
    with pytest.raises(FileFormatError, match="not yet"):
        sensor_of(f"{failing}:SENSOR")
    assert "half-done" not in Response.known
    assert sensor_of(f"{working}:SENSOR").type_name == "amcw-tof"
    assert Response.known.pop("half-done").__name__ == "Half"
