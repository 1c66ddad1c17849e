# SPDX-License-Identifier: Apache-2.0
"""An instrument owns its camera, its emitter, their places, the wavelength and the detector."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rangesim import Intrinsics, Scene, Sensor, load_scene, look_at
from rangesim.codes import GrayPhase
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.experiment import Experiment, experiment_from_dict, experiment_to_dict
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import carry_out, run
from rangesim.pipeline.shared_passes import group_by_rig
from rangesim.presets import instrument
from rangesim.results.experiment_results import load_result
from rangesim.rig import Beam, RayTable, Spinning, translation
from rangesim.sensors import ActiveStereo, AmcwToF, DirectToF, IdealToF, ReferencePatternStereo, StructuredLight

CAMERA = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
ASIDE = look_at((0.2, 0.0, 0.0), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0))


@pytest.fixture(scope="module")
def plane() -> Scene:
    return load_scene("plane")


def test_noise_switched_off_and_on_again_keeps_the_detector(plane: Scene) -> None:
    own = Detector(full_well_e=1234.0)
    quiet = Instrument("one", AmcwToF(), own, noise=False)
    assert quiet.detector == own
    assert quiet.detector_in_use is None
    assert replace(quiet, noise=True).detector_in_use == own
    record = experiment_to_dict(Experiment("plane", instruments=(quiet,)))
    assert record["instrument"][0]["detector"]["full_well_e"] == 1234.0
    assert experiment_from_dict(record).instruments == (quiet,)


def test_the_scene_gives_what_an_instrument_does_not_own(plane: Scene) -> None:
    rig = Instrument("one", AmcwToF()).rig(plane, 64, 48)
    of_scene = plane.rig(0.03, width=64, height=48)
    assert replace(rig, wavelength_m=None) == of_scene
    assert rig.wavelength_m == 850e-9


def test_an_instrument_brings_camera_emitter_and_places(plane: Scene) -> None:
    T_world_camera = plane.T_world_camera @ translation(0.01, 0.02, 0.0)
    emitter = Intrinsics(100, 80, 90.0, 90.0, 50.0, 40.0)
    own = Instrument(
        "one", AmcwToF(), camera=CAMERA, T_world_camera=T_world_camera, projector=emitter, T_camera_projector=ASIDE
    )
    rig = own.rig(plane, 64, 48)
    assert (rig.camera, rig.projector) == (CAMERA, emitter)
    np.testing.assert_array_equal(rig.T_world_camera, T_world_camera)
    np.testing.assert_array_equal(rig.T_camera_projector, ASIDE)
    assert Instrument("one", AmcwToF(), width=20).rig(plane, 64, 48).camera.width == 20
    plain = experiment_to_dict(Experiment("plane", instruments=(own,)))
    assert experiment_from_dict(plain).instruments == (own,)
    assert own == replace(own)
    assert own != replace(own, T_camera_projector=np.eye(4))
    assert len({own, replace(own)}) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera": CAMERA, "width": 20}, "either camera or width of instrument 'one'"),
        ({"T_camera_projector": ASIDE, "baseline_m": 0.1}, "either T_camera_projector or baseline_m"),
        ({"T_world_camera": 2 * np.eye(4)}, "T_world_camera"),
        ({"wavelength_m": -1.0}, "wavelength_m"),
        ({"projector": Beam(), "baseline_m": 0.1}, "its beam starts at its ray"),
        ({"camera": RayTable([[[0.0, 0.0, 1.0]]])}, "expected a projector of instrument 'one'"),
    ],
)
def test_contradictions_and_bad_places_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Instrument("one", AmcwToF(), **change)


def test_an_instrument_has_rays_of_its_own_and_a_beam(plane: Scene) -> None:
    table = RayTable(np.array([[[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]]))
    scanner = Instrument("one", DirectToF(), camera=table, projector=Beam((1e-3, 1e-3)), power_w=0.5)
    rig = scanner.rig(plane, 64, 48)
    assert (rig.camera, rig.projector, rig.projector_power_w) == (table, Beam((1e-3, 1e-3)), 0.5)
    np.testing.assert_array_equal(rig.T_world_camera, plane.T_world_camera)
    np.testing.assert_array_equal(rig.T_camera_projector, np.eye(4))
    plain = experiment_to_dict(Experiment("plane", instruments=(scanner,)))
    assert experiment_from_dict(plain).instruments == (scanner,)


def test_a_pass_is_shared_where_emitter_and_camera_agree(plane: Scene) -> None:
    """Each instrument keeps its wavelength. What is left out without the sampling error changes no reading."""
    near_infrared = Instrument("a", AmcwToF())
    others = (
        Instrument("ideal", IdealToF()),
        Instrument("905", DirectToF()),
        Instrument("850", DirectToF(), replace(DirectToF().default_detector, wavelength_m=850e-9)),
        Instrument("small", AmcwToF(), width=20),
    )
    experiment = Experiment("plane", width=40, height=30, instruments=(near_infrared, *others))
    groups = [[i.name for i in members] for _, members in group_by_rig(experiment, plane)]
    assert groups == [["a", "ideal", "905", "850"], ["small"]]
    near_infrared = replace(near_infrared, width=10)
    shared = carry_out(
        replace(experiment, width=10, height=8, spp=4, instruments=(near_infrared, others[1])), scene=plane
    )
    assert [m.capture.rig.wavelength_m for m in shared.measurements] == [850e-9, 905e-9]
    alone = carry_out(replace(experiment, width=10, height=8, spp=4, instruments=(others[1],)), scene=plane)
    np.testing.assert_array_equal(shared.passes[0].energy.direct, alone.passes[0].energy.direct)


def test_instruments_of_different_sizes_stand_in_one_result(tmp_path: Path) -> None:
    instruments = (
        Instrument("lines", StructuredLight(64, 40, GrayPhase(8.0)), width=48),
        Instrument("tof", AmcwToF(), camera=CAMERA),
    )
    experiment = Experiment("plane", instruments=instruments, width=32, height=24, spp=4)
    shapes = [m.image.z.shape for m in carry_out(experiment).measurements]
    assert shapes == [(36, 48), (30, 40)]
    run(experiment, tmp_path / "out")
    found = load_result(tmp_path / "out")
    assert [m.image.z.shape for m in found.measurements] == shapes
    assert [p.truth.z.shape for p in found.passes] == shapes
    assert all(m.image.valid.mean() > 0.4 for m in found.measurements)


def test_a_preset_is_an_instrument_with_its_own_emitter() -> None:
    assert instrument("direct-tof").emitter_wavelength_m == 905e-9
    assert instrument("ideal-tof").emitter_wavelength_m is None


@pytest.mark.parametrize("sensor", [StructuredLight(64, 48), ActiveStereo(), ReferencePatternStereo()])
def test_a_sensor_that_triangulates_needs_pinholes(sensor: Sensor) -> None:
    """Else all light would be traced before the decoder refuses."""
    head, pinhole = Spinning(elevations_deg=(1.0, -1.0), columns=8), Intrinsics.from_fov(64, 48, fov_x_deg=60.0)
    with pytest.raises(ValueError, match=f"pinhole as the camera .* {sensor.type_name} triangulates, got a Spinning"):
        Instrument("one", sensor, camera=head, projector=pinhole)
    with pytest.raises(ValueError, match=f"pinhole as the projector .* {sensor.type_name} triangulates, got a Beam"):
        Instrument("one", sensor, camera=pinhole, projector=Beam((3e-3, 3e-3)))


def test_a_size_that_no_instrument_uses_is_told() -> None:
    alone = Experiment("plane", instruments=(Instrument("tof", AmcwToF(), camera=CAMERA),), width=32, height=24, spp=4)
    with pytest.warns(RangesimWarning, match="width and height of the experiment do not apply: tof have a camera"):
        carry_out(alone)


def test_an_emitter_outside_the_band_of_its_detector_is_refused() -> None:
    near = Detector(wavelength_m=850e-9, band_width_m=30e-9)
    assert Instrument("near", AmcwToF(), near, wavelength_m=860e-9).emitter_wavelength_m == 860e-9
    with pytest.raises(ValueError, match=r"wavelength_m of instrument 'far' within .* 850 nm \+- 15 nm, got 905 nm"):
        Instrument("far", AmcwToF(), near, wavelength_m=905e-9)
