# SPDX-License-Identifier: Apache-2.0
"""Devices by name are what their data sheets say, and every number of theirs has a source."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import matte, scene_of, wall
from synthetic import signals_of_depth

from rangesim import (
    Beam,
    Capture,
    DirectToF,
    Intrinsics,
    RayTable,
    Rig,
    Spinning,
    Status,
    decode,
    expose,
    presets,
    transport,
)
from rangesim.cli import main
from rangesim.decoding.working_range import WorkingRange
from rangesim.errors import FileFormatError
from rangesim.experiment import Experiment, experiment_from_dict, experiment_to_dict
from rangesim.experiment.experiment import load_experiment
from rangesim.experiment.scan_settings import scan_settings_from_dict
from rangesim.files.text_files import read_toml
from rangesim.instrument.instrument import Instrument
from rangesim.presets.catalogue import FOLDER
from rangesim.presets.preset import STANDINGS, numbers_of, standing
from rangesim.rig import ScanningCamera, Zones
from rangesim.sensors import ActiveStereo, DirectToFDecoder, ReferencePatternStereo
from rangesim.sensors import presets as sensor_presets
from rangesim.settings.config import to_dict

NAMES = presets.names()
UNUSED = ("pixel_pitch_m", "min_exposure_s", "max_exposure_s", "ambient_transmission")
"""Settings of detectors on which nothing depends if the exposure is stated and the light's spectrum is known."""
OFF = {"projector_gamma": 1, "spads": 1, "coincidence": 1, "dead_time_s": 0, "afterpulsing": 0, "pixel_delay_s": 0}
"""Effects that a device without them need not mention, by the values that switch them off."""
WITH_THESE = ("coincidence_window_s", "afterpulse_decay_s", "pixel_seed")
"""Settings of such effects."""


@pytest.mark.parametrize("name", NAMES)
def test_every_number_of_a_device_is_in_its_file_with_a_source(name: str) -> None:
    """No setting of sensor and detector is left to a default of the package, and neither are power and exposure."""
    preset = presets.describe(name)
    data = read_toml(FOLDER / f"{name}.toml")
    assert set(preset.sources) == set(numbers_of({"sheet": data["sheet"], "instrument": data["instrument"]}))
    used = {standing(source) for source in preset.sources.values()}
    assert used - {*STANDINGS} <= set(preset.documents)
    cited = " ".join(preset.sources.values())
    assert all(document in cited for document in preset.documents)
    assert {"power_w", "exposure_s"} <= set(data["instrument"])
    assert preset.instrument.exposure_s is not None
    for part in ("sensor", "detector"):
        stated = set(data["instrument"][part])
        setting = getattr(preset.instrument, part)
        off = {name for name, value in OFF.items() if getattr(setting, name, None) == value}
        missing = set(settings_that_are_numbers(setting)) - stated - {*UNUSED} - off - {*WITH_THESE}
        assert not missing


def settings_that_are_numbers(setting: Any) -> Iterator[str]:
    for field in fields(setting):
        value = getattr(setting, field.name)
        first = value[0] if isinstance(value, tuple) and value else value
        if isinstance(first, (int, float)) and not isinstance(first, bool):
            yield field.name


@pytest.mark.parametrize("name", NAMES)
def test_an_experiment_with_a_device_is_read_back_equal(name: str) -> None:
    experiment = Experiment("plane", instruments=(presets.load(name),))
    assert experiment.instruments[0].name == name
    assert experiment_from_dict(experiment_to_dict(experiment)) == experiment


def pinholes() -> list[str]:
    return [name for name in NAMES if isinstance(presets.load(name).camera, Intrinsics)]


@pytest.mark.parametrize("name", pinholes())
def test_the_corners_of_the_image_lie_at_the_angles_of_the_sheet(name: str) -> None:
    preset = presets.describe(name)
    camera = preset.instrument.camera
    assert isinstance(camera, Intrinsics)
    assert (camera.width, camera.height) == preset.sheet.resolution_px
    left, right = camera.directions([[0.0, camera.cy], [camera.width, camera.cy]])
    top, bottom = camera.directions([[camera.cx, 0.0], [camera.cx, camera.height]])
    across, down = (
        math.degrees(math.acos(a @ b / math.sqrt(a @ a * (b @ b)))) for a, b in ((left, right), (top, bottom))
    )
    assert (across, down) == pytest.approx(preset.sheet.field_of_view_deg)


def test_an_equidistant_lens_has_its_edges_at_the_angles_of_the_sheet() -> None:
    for name in ("azure-kinect-wfov", "azure-kinect-wfov-binned"):
        preset = presets.describe(name)
        camera = preset.instrument.camera
        assert camera is not None
        half = np.radians(preset.sheet.field_of_view_deg) / 2
        edges = camera.project([[np.sin(half[0]), 0.0, np.cos(half[0])], [0.0, np.sin(half[1]), np.cos(half[1])]])
        assert edges == pytest.approx(np.array([[camera.width, camera.height / 2], [camera.width / 2, camera.height]]))


def floods() -> list[str]:
    """Devices of one pinhole camera that see all of their view at once."""
    found = {name: presets.load(name) for name in pinholes()}
    return [n for n, i in found.items() if isinstance(i.projector, Intrinsics) and not i.sensor.compares_texture]


@pytest.mark.parametrize("name", floods())
def test_a_device_reads_a_wall_within_its_range_and_none_beyond(name: str) -> None:
    preset = presets.describe(name)
    near_m, far_m = preset.sheet.range_m
    for distance_m, least, most in (
        (0.95 * near_m, 0.0, 0.0),
        (math.sqrt(near_m * far_m), 0.9, 1.0),
        (1.05 * far_m, 0.0, 0.0),
    ):
        image = of_wall(preset.instrument, distance_m)
        assert least <= image.valid.mean() <= most
        assert not image.valid.any() or np.nanmedian(np.abs(image.z - distance_m)) < 0.01 * distance_m
        if most == 0.0:
            assert (image.status == Status.OUT_OF_RANGE).mean() > 0.5 or (image.status != Status.OK).all()


def of_wall(instrument: Instrument, distance_m: float, albedo: float = 0.6) -> Any:
    """Range image of a wall that faces the device, 32 x 32 pixels in the middle."""
    camera, projector, pose = instrument.camera, instrument.projector, instrument.T_camera_projector
    assert isinstance(camera, Intrinsics)
    assert projector is not None
    assert pose is not None
    rig = Rig(
        replace(camera, width=32, height=32, cx=16.0, cy=16.0),
        projector,
        T_camera_projector=pose,
        camera_lens=instrument.camera_lens,
        projector_power_w=instrument.power_w,
    )
    signals = signals_of_depth(rig, np.full((32, 32), distance_m), [instrument.sensor], albedo=albedo)
    capture = expose(signals, instrument.sensor, instrument.detector, instrument.exposure_s)
    return decode(capture, instrument.decoder)


def test_a_kinect_v2_has_its_published_noise_from_2_to_4_m() -> None:
    """The power was fitted at 3 m; nearer than 2 m the published noise has a floor that photons do not explain."""
    preset = presets.describe("kinect-v2")
    noise = preset.sheet.noise
    assert noise is not None
    for distance_m, sigma_m in list(zip(noise.range_m, noise.sigma_m, strict=True))[1:]:
        z = of_wall(preset.instrument, distance_m, noise.reflectance).z
        assert np.nanstd(z) == pytest.approx(sigma_m, rel=0.2)


def scanners() -> list[str]:
    return [name for name in NAMES if isinstance(presets.load(name).camera, ScanningCamera)]


@pytest.mark.parametrize("name", scanners())
def test_the_rays_of_a_scanner_fill_the_angles_of_the_sheet(name: str) -> None:
    preset = presets.describe(name)
    camera, (across_deg, down_deg) = preset.instrument.camera, preset.sheet.field_of_view_deg
    assert camera is not None
    x, y, z = np.moveaxis(camera.pixel_rays().directions, -1, 0)
    azimuth, elevation = np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(-y))
    assert np.ptp(elevation) == pytest.approx(down_deg, rel=0.02)
    turned = np.unwrap(azimuth, axis=1, period=360)
    step = np.median(np.diff(turned, axis=1))
    last = step if across_deg == 360 else 0.0  # the first column follows on the last one
    assert np.ptp(turned, axis=1) + last == pytest.approx(across_deg, rel=0.02)
    assert preset.sheet.range_along == "ray"


@pytest.mark.parametrize("name", [name for name in NAMES if isinstance(presets.load(name).projector, Beam)])
def test_a_scanner_reads_a_wall_in_its_beams(name: str) -> None:
    """8 x 8 of its beams, traced: all the power goes into the spot."""
    preset = presets.describe(name)
    instrument, distance_m = preset.instrument, math.sqrt(preset.sheet.range_m[0] * preset.sheet.range_m[1])
    camera: Any = instrument.camera
    if isinstance(camera, ScanningCamera):
        ahead = np.tile([0.0, 0.0, 1.0], (8, 8, 1))
        camera = RayTable(ahead, field_rad=camera.field_rad, acceptance=camera.acceptance)
    else:
        camera = replace(camera, width=8, height=8, cx=4.0, cy=4.0)
    scene = scene_of(wall=wall(distance_m, matte(0.6)))
    rig = replace(instrument, camera=camera).rig(scene)
    signals = transport(scene, rig, [instrument.sensor], spp=8, max_depth=2, caustics=False, glint=False)
    capture = expose(signals, instrument.sensor, instrument.detector, instrument.exposure_s)
    image = decode(capture, instrument.decoder)
    assert image.valid.mean() > 0.9
    assert np.nanmedian(np.abs(image.range_m - distance_m)) < 0.01 * distance_m


@pytest.mark.parametrize("name", [name for name in NAMES if isinstance(presets.load(name).camera, Zones)])
def test_zones_tile_the_angles_of_the_sheet_and_read_a_wall(name: str) -> None:
    preset = presets.describe(name)
    zones = preset.instrument.camera
    assert isinstance(zones, Zones)
    fine = zones.camera
    assert isinstance(fine, Intrinsics)
    half = [fine.width / 2 / fine.fx, fine.height / 2 / fine.fy]
    assert 2 * np.degrees(np.arctan(half)) == pytest.approx(preset.sheet.field_of_view_deg, abs=0.01)
    distance_m = math.sqrt(preset.sheet.range_m[0] * preset.sheet.range_m[1])
    scene = scene_of(wall=wall(distance_m, matte(0.6)))
    rig = preset.instrument.rig(scene)
    signals = transport(scene, rig, [preset.instrument.sensor], spp=4, max_depth=2, caustics=False, glint=False)
    image = decode(
        expose(signals, preset.instrument.sensor, preset.instrument.detector, preset.instrument.exposure_s),
        preset.instrument.decoder,
    )
    assert image.z.shape == preset.sheet.resolution_px[::-1]
    assert image.valid.mean() > 0.9
    assert np.nanmedian(np.abs(image.z - distance_m)) < 0.03 * distance_m


@pytest.mark.parametrize("name", [name for name in NAMES if presets.load(name).sensor.compares_texture])
def test_a_stereo_device_reads_a_wall_by_its_dots(name: str) -> None:
    """A part of the image; its left columns show what a second camera does not see."""
    preset = presets.describe(name)
    instrument, camera = preset.instrument, preset.instrument.camera
    assert isinstance(camera, Intrinsics)
    small = replace(instrument, camera=replace(camera, width=192, height=64, cx=96.0, cy=32.0))
    scene = scene_of(wall=wall(1.0, matte(0.6)))
    rigs = small.rigs(scene)
    rig_or_rigs: Any = rigs if len(rigs) > 1 else rigs[0]
    signals = transport(scene, rig_or_rigs, [small.sensor], spp=16, max_depth=2, caustics=False, glint=False)
    image = decode(expose(signals, small.sensor, small.detector, small.exposure_s), small.decoder)
    assert isinstance(small.sensor, (ActiveStereo, ReferencePatternStereo))
    disparity_px = camera.fx * small.sensor.baseline_m
    inner = image.z[8:-8, int(disparity_px) + 12 : -8]
    assert np.isfinite(inner).mean() > 0.9
    assert np.nanmedian(np.abs(inner - 1.0)) < 0.01


# ---- Names ---------------------------------------------------------------------------------------------------------


def test_no_device_has_the_name_of_a_sensor() -> None:
    assert not set(NAMES) & set(sensor_presets())
    assert len(NAMES) >= 14


@pytest.mark.parametrize("find", [presets.load, presets.instrument])
def test_an_unknown_name_is_refused_with_the_nearest(find: Any) -> None:
    with pytest.raises(ValueError, match=re.escape("got 'kinectv2' (did you mean 'kinect-v2'?)")):
        find("kinectv2")


def test_a_device_in_an_experiment_is_changed_key_by_key() -> None:
    device = presets.load("kinect-v2")
    assert device.decoder is not None
    table = {
        "sensor": "kinect-v2",
        "name": "weak",
        "power_w": 0.5,
        "detector": {"read_noise_e": 8.0},
        "decoder": {"max_residual": 0.2},
    }
    (one,) = experiment_from_dict({"scene": "plane", "instrument": [table]}).instruments
    assert one == replace(
        device,
        name="weak",
        power_w=0.5,
        detector=replace(device.detector, read_noise_e=8.0),  # type: ignore[type-var]
        decoder=replace(device.decoder, max_residual=0.2),  # type: ignore[call-arg]
    )
    scan = scan_settings_from_dict({"scene": "plane", "instrument": {"sensor": "kinect-v2"}})
    assert scan.instrument == device
    with pytest.raises(ValueError, match=r"instrument\[0\]: unknown key 'powr_w' \(did you mean 'power_w'"):
        experiment_from_dict({"scene": "plane", "instrument": [{"sensor": "kinect-v2", "powr_w": 1.0}]})
    with pytest.raises(ValueError, match=r"instrument\[0\].sensor: .*did you mean 'kinect-v2'"):
        experiment_from_dict({"scene": "plane", "instrument": [{"sensor": "kinect-v22"}]})


def test_a_file_of_a_device_is_found_beside_the_experiment(tmp_path: Path) -> None:
    text = presets.describe("kinect-v2").text.replace("[512, 424]", "[64, 53]")
    (tmp_path / "mine.toml").write_text(text)
    (tmp_path / "experiment.toml").write_text('scene = "plane"\n[[instrument]]\nsensor = "mine.toml"\n')
    (one,) = load_experiment(tmp_path / "experiment.toml").instruments
    assert one.name == "mine"
    assert one.camera == presets.load(tmp_path / "mine.toml").camera
    with pytest.raises(ValueError, match="sensor"):  # a record that is read back loads no file
        experiment_from_dict({"scene": "plane", "instrument": [{"sensor": str(tmp_path / "mine.toml")}]})


RANGE, PIXELS = '"sheet.range_m"', '"sheet.resolution_px"'
"""Two keys of the sources."""


# ---- Files ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '"sheet.range_m" = "libfreenect2: least and largest depth of its settings"\n',
            "",
            "no source for sheet.range_m",
        ),
        (
            '"sheet.range_m" = "libf',
            '"sheet.rang_m" = "libf',
            "'sheet.rang_m' is no setting .*did you mean 'sheet.range_m'",
        ),
        (
            '"instrument.detector" = "assumed: a common lock-in pixel"',
            '"instrument.detector" = "assumed"',
            "say more than",
        ),
        (
            '"sheet.resolution_px" = "libfreenect2"',
            '"sheet.resolution_px" = "libfrenect"',
            "did you mean 'libfreenect2'",
        ),
        ('"sheet.resolution_px" = "libfreenect2"', '"sheet.resolution_px" = 1', "as text, got 1"),
        ("taps = 3", "tabs = 3", "instrument.sensor: unknown key 'tabs'"),
        ("range_m = [0.5, 4.5]", "range_m = [4.5, 0.5]", "range_m as nearest, farthest"),
        ("[512, 424]", "[512]", "resolution_px"),
        ("[70.0, 60.0]", "[180.0, 60.0]", "at most 175 degrees for a pinhole"),
        ("fitted_at_m = 3.0", "fitted_at_m = 3.5", "fitted_at_m"),
        ("0.0027, 0.0043]", "0.0027]", "as many sigma_m as range_m"),
        ("[documents]", "[papers]", "unknown key 'papers'"),
        ('title = "Kinect for Xbox One (Kinect v2)"', "", "missing 'title'"),
        ('title = "Kinect for Xbox One (Kinect v2)"', "title = 1", "title as text"),
        ("[sheet]", "[[sheet]]", "no valid TOML|sheet as a table"),
    ],
)
def test_a_faulty_file_is_refused_in_one_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = presets.describe("kinect-v2").text
    assert text.count(old) == 1
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(FileFormatError, match=words) as error:
        presets.load(path)
    assert str(path) in str(error.value)


def test_a_file_has_the_name_of_an_instrument(tmp_path: Path) -> None:
    path = tmp_path / "my device.toml"
    path.write_text(presets.describe("kinect-v2").text)
    with pytest.raises(FileFormatError, match=r"expected a file name of letters.*got 'my device'"):
        presets.load(path)
    path.write_text(path.read_text().replace("[instrument]\n", '[instrument]\nname = "mine"\n'))
    assert presets.load(path).name == "mine"


def test_a_table_has_its_own_camera_instead_of_the_pinhole_of_the_sheet(tmp_path: Path) -> None:
    own = Intrinsics(512, 424, 365.5, 365.5, 255.0, 205.0)
    text = presets.describe("kinect-v2").text
    camera = "\n".join(f"{key} = {value}" for key, value in to_dict(own).items())
    text = text.replace(
        "[instrument.sensor]", f"[instrument.camera]\n{camera}\n\n[instrument.sensor]".replace("()", "[]")
    )
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("[sources]", '[sources]\n"instrument.camera" = "libfreenect2"'))
    assert presets.load(path).camera == own


# ---- The command line ----------------------------------------------------------------------------------------------


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["rangesim", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_the_command_lists_the_devices_and_draws_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    picture = tmp_path / "views.png"
    assert command(monkeypatch, "presets", "--picture", picture) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["device", *NAMES]
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert command(monkeypatch, "presets", "--picture", tmp_path / "views.jpg") == 2
    assert "ends with .png" in capsys.readouterr().err
    assert command(monkeypatch, "presets", "kinect-v2") == 0
    assert capsys.readouterr().out == (FOLDER / "kinect-v2.toml").read_text()
    assert command(monkeypatch, "presets", "kinect-v3") == 1
    assert "did you mean 'kinect-v2'" in capsys.readouterr().err


def test_a_device_runs_by_its_name_and_by_its_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = (
        presets.describe("kinect-v2").text.replace("[512, 424]", "[64, 53]").replace("range_m = [0.5", "range_m = [0.1")
    )
    path = tmp_path / "small.toml"
    path.write_text(text)
    assert command(monkeypatch, "run", "plane", "--sensor", path, "--spp", "2", "--out", tmp_path / "out") == 0
    assert (tmp_path / "out" / "small" / "capture").is_dir()
    assert command(monkeypatch, "run", "plane", "--sensor", "kinect-v3", "--out", tmp_path / "other") == 1
    assert "did you mean 'kinect-v2'" in capsys.readouterr().err
    assert command(monkeypatch, "scan", "plane", "--sensor", "kinect-v2", "--estimate") == 0


def test_a_scanner_with_a_working_range_along_z_is_refused() -> None:
    """Half of its rays lead backwards, where all readings would be out of range."""
    device = presets.load("vlp-16")
    along_z = WorkingRange(0.5, 100.0)
    with pytest.raises(ValueError, match="working range along the ray"):
        replace(device, decoder=replace(device.decoder, working_range=along_z))
    head = Spinning(elevations_deg=(0.0,), columns=8)
    capture = Capture(np.zeros((64, 1, 8), dtype=np.uint16), DirectToF(bins=64), rig=Rig(head, Beam((3e-3, 3e-3))))
    with pytest.raises(ValueError, match="working range along the ray"):
        decode(capture, DirectToFDecoder(working_range=along_z))


def test_a_sheet_without_range_along_is_refused_for_a_scanner(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(presets.describe("vlp-16").text.replace('range_along = "ray"\n', ""), encoding="utf-8")
    with pytest.raises(FileFormatError, match='range_along = "ray"'):
        presets.load(path)


def test_the_tables_of_a_change_leave_the_rest_of_the_device_as_it_is() -> None:
    change = {"camera": {"columns": 90}, "projector": {"divergence_rad": [1e-3, 1e-3]}}
    device, changed = presets.load("vlp-16"), presets.instrument_from_dict({"sensor": "vlp-16", **change}, "instrument")
    assert changed.camera == replace(device.camera, columns=90)  # type: ignore[type-var]
    assert changed.projector == Beam((1e-3, 1e-3))
    lens = presets.instrument_from_dict({"sensor": "kinect-v2", "camera_lens": {"focus_m": 2.0}}, "instrument")
    assert lens.camera_lens == replace(presets.load("kinect-v2").camera_lens, focus_m=2.0)


def test_a_whole_pinhole_replaces_a_scanner() -> None:
    pinhole = {"width": 8, "height": 4, "fx": 10.0, "fy": 10.0, "cx": 4.0, "cy": 2.0}
    changed = presets.instrument_from_dict({"sensor": "vlp-16", "camera": pinhole}, "instrument")
    assert changed.camera == Intrinsics(**pinhole)  # type: ignore[arg-type]


def test_an_emitter_offset_beside_a_beam_is_refused_by_its_cause(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    text = presets.describe("vlp-16").text
    text = text.replace('range_along = "ray"\n', 'range_along = "ray"\nemitter_offset_m = [0.05, 0.0, 0.0]\n')
    path.write_text(text.replace('"sheet.range_m" =', '"sheet.emitter_offset_m" = "velodyne"\n"sheet.range_m" ='))
    with pytest.raises(FileFormatError, match="state offset_m of the beam"):
        presets.load(path)


def test_a_sheet_with_another_view_than_the_head_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    text = presets.describe("vlp-16").text
    for view in ("[180.0, 30.0]", "[360.0, 40.0]"):
        path.write_text(text.replace("field_of_view_deg = [360.0, 30.0]", f"field_of_view_deg = {view}"))
        with pytest.raises(FileFormatError, match="as the sheet has, got 360 x 30"):
            presets.load(path)


def test_a_file_that_starts_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    """Editors under Windows write it."""
    mine = tmp_path / "mine.toml"
    mine.write_bytes(b"\xef\xbb\xbf" + (FOLDER / "kinect-v2.toml").read_bytes())
    assert replace(presets.load(str(mine)), name="kinect-v2") == presets.load("kinect-v2")
