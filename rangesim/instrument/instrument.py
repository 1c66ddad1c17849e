# SPDX-License-Identifier: Apache-2.0
"""An instrument: a sensor with its camera, emitter, detector, decoder and its place in the scene."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from rangesim.electronics.detector import PhotoDetector
from rangesim.motion import Timing
from rangesim.rig import CAMERA_LENS, PROJECTOR_LENS, Beam, Camera, CoverGlass, Intrinsics, Lens, Optics, pose
from rangesim.sensors import Decoder, Sensor, check_sensor, is_file_name, sensor_from_dict
from rangesim.settings.bounds import Metres, Seconds, Watts, Wavelength, check_fields, whole
from rangesim.settings.config import check_keys, from_dict, on_top_of, shown, to_dict

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

MAX_NAME = 100
"""Largest number of characters of an instrument's name. It is limited because a directory has the same name, and file
systems allow 255 bytes."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Names that are safe as names of directories on all systems."""


@dataclass(frozen=True, eq=False)
class Instrument:
    """A sensor with its camera, emitter, detector, decoder and its place in the scene.

    Where a field is None, the sensor (emitter, detector, decoder) or the scene (camera and its pose) gives the value.

    Parameters
    ----------
    name : name of the instrument and of its directory in the results: letters, digits, hyphens and underscores.
    sensor : Sensor, the measuring principle.
    detector : PhotoDetector; None: `Sensor.default_detector`.
    noise : bool. False: the detector is not used, and frames are noise-free float32.
    decoder : Decoder, with its thresholds; None: `Sensor.default_decoder`.
    camera : Intrinsics; None: those of the scene's camera.
    width, height : size of the image, pixels, if the scene's camera is used. Its field of view is kept. None: as the
        experiment says.
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres; None: the scene's camera.
    projector : Intrinsics of the emitter, or a Beam, which starts at its ray and has no pose; None: Intrinsics of the
        size that the sensor states, with a field of view that covers that of a pinhole camera.
    T_camera_projector : (4, 4) float64, maps projector coordinates to camera coordinates, metres. None: the emitter
        stands to the right of the camera, at the distance `baseline_m`, and is turned towards the point that the
        camera looks at.
    baseline_m : metres between camera and emitter. None: as the sensor states, which is a fifth of the working
        distance for structured light and 0.03 m for time of flight.
    wavelength_m : wavelength of the emitter's light, metres; None: that of the detector.
    power_w : mean radiant power of the emitter when it is fully on, watts.
    exposure_s : exposure of each frame, seconds; None: automatic.
    camera_lens, projector_lens : Lens, aperture, focus and vignetting.
    timing : Timing, the times at which frames are taken, for an experiment in which something moves.
    cover_glass : CoverGlass, the window in front of the device; None: it returns no light.

    Raises
    ------
    ValueError
        A name or a number out of its range, a decoder or detector that does not fit the sensor, two fields that
        contradict each other (`camera` and `width`, `T_camera_projector` and `baseline_m`, a Beam and either of these
        two), no projector for a camera that is no pinhole, or a working range along z for one with rays that lead
        backwards.

    Examples
    --------
    >>> from rangesim.sensors import AmcwToF
    >>> one = Instrument("tof", AmcwToF(), width=320, height=240, exposure_s=1e-3)
    >>> one.detector.wavelength_m == one.emitter_wavelength_m
    True
    """

    name: str
    sensor: Sensor
    detector: PhotoDetector | None = None
    noise: bool = True
    decoder: Decoder | None = None
    baseline_m: Metres | None = None
    power_w: Watts = 1.0
    exposure_s: Seconds | None = None
    camera_lens: Lens = CAMERA_LENS
    projector_lens: Lens = PROJECTOR_LENS
    timing: Timing = field(default_factory=Timing)
    camera: Camera | None = None
    width: Annotated[int, whole(1, "pixels")] | None = None
    height: Annotated[int, whole(1, "pixels")] | None = None
    T_world_camera: np.ndarray | None = None
    projector: Optics | None = None
    T_camera_projector: np.ndarray | None = None
    wavelength_m: Wavelength | None = None
    cover_glass: CoverGlass | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not is_name(self.name):
            raise ValueError(
                f"expected a name of letters, digits, - and _, at most {MAX_NAME}, got {shown(self.name)}."
            )
        check_sensor(self.sensor)
        if self.decoder is not None:
            self.decoder.check(self.sensor)
        if self.detector is None:
            object.__setattr__(self, "detector", self.sensor.default_detector)
        if self.detector is not None and not self.sensor.is_ideal:
            self.detector.check(self.sensor.gate)
            self._check_wavelength(self.detector)
        for one, others in (("camera", ("width", "height")), ("T_camera_projector", ("baseline_m",))):
            if getattr(self, one) is not None and (twice := [n for n in others if getattr(self, n) is not None]):
                raise ValueError(f"expected either {one} or {twice[0]} of instrument {self.name!r}, got both.")
        has_place = self.baseline_m is not None or self.T_camera_projector is not None
        for part in ("camera", "projector"):
            device = getattr(self, part)
            if self.sensor.triangulates and not isinstance(device, (Intrinsics, NoneType)):
                raise ValueError(
                    f"expected a pinhole as the {part} of instrument {self.name!r}, because {self.sensor.type_name} "
                    f"triangulates, got a {type(device).__name__}."
                )
        if isinstance(self.projector, Beam) and has_place:
            raise ValueError(
                f"expected neither baseline_m nor T_camera_projector of instrument {self.name!r}, because its beam "
                "starts at its ray; state offset_m of the beam."
            )
        if self.camera is not None and not self.camera.traced.is_pinhole and self.projector is None:
            raise ValueError(
                f"expected a projector of instrument {self.name!r}, such as a Beam, because its camera is no pinhole."
            )
        if self.camera is not None and self.decoder is not None and self.decoder.working_range is not None:
            self.decoder.working_range.check(self.camera)
        for pose_name in ("T_world_camera", "T_camera_projector"):
            if getattr(self, pose_name) is not None:
                object.__setattr__(self, pose_name, pose(getattr(self, pose_name), pose_name))

    def _check_wavelength(self, detector: PhotoDetector) -> None:
        """Raise ValueError if the emitter's light is outside the band of the detector."""
        if self.wavelength_m is None or abs(self.wavelength_m - detector.wavelength_m) <= 0.5 * detector.band_width_m:
            return
        raise ValueError(
            f"expected wavelength_m of instrument {self.name!r} within the band of its detector, "
            f"{1e9 * detector.wavelength_m:g} nm +- {5e8 * detector.band_width_m:g} nm, got "
            f"{1e9 * self.wavelength_m:g} nm; set the detector's wavelength_m as well."
        )

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Instrument) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash((self.name, self.sensor))

    @property
    def detector_in_use(self) -> PhotoDetector | None:
        """The detector that takes the frames, as `rangesim.expose` expects it; None: the frames are noise-free."""
        return self.detector if self.noise else None

    @property
    def emitter_wavelength_m(self) -> float | None:
        """Wavelength of the emitter's light, metres; None: the instrument is ideal and has no wavelength."""
        return self.wavelength_m or (self.detector.wavelength_m if self.detector else None)

    def rig(self, scene: Scene, width: int | None = None, height: int | None = None) -> Rig:
        """The instrument's camera and emitter in a scene.

        Parameters
        ----------
        width, height : size of the scene's camera, pixels, if the instrument does not state one.
        """
        size, baseline_m = self.sensor.default_emitter
        if (self.width, self.height) != (None, None):
            width, height = self.width, self.height
        rig = scene.rig(
            baseline_m if self.baseline_m is None else self.baseline_m, size, self.power_w, width, height,
            camera=self.camera.traced if self.camera is not None and self.camera.traced.is_pinhole else None,
            T_world_camera=self.T_world_camera,
        )  # fmt: skip
        T_camera_projector = rig.T_camera_projector if self.T_camera_projector is None else self.T_camera_projector
        return replace(
            rig,
            camera=self.camera or rig.camera,
            camera_lens=self.camera_lens,
            projector_lens=self.projector_lens,
            projector=self.projector or rig.projector,
            T_camera_projector=np.eye(4) if isinstance(self.projector, Beam) else T_camera_projector,
            wavelength_m=self.emitter_wavelength_m,
            cover_glass=self.cover_glass,
        )

    def rigs(self, scene: Scene, width: int | None = None, height: int | None = None) -> tuple[Rig, ...]:
        """Rigs of all cameras of the sensor in a scene, that of the reference camera first.

        They have one emitter, so one transport pass serves them all. Most sensors have one camera.

        Parameters
        ----------
        width, height : as for `rig`.
        """
        return self.sensor.rigs(self.rig(scene, width, height))


def is_name(text: str) -> bool:
    """Whether an instrument may have this name.

    Examples
    --------
    >>> is_name("kinect-v2"), is_name("../results")
    (True, False)
    """
    return bool(_NAME.fullmatch(text)) and len(text) <= MAX_NAME


def name_of(given: str, sensor: Sensor) -> str:
    """Name of an instrument that is given by its sensor only: the preset's, or the `type_name` if it is from a file."""
    return sensor.type_name if is_file_name(given) else given


def instrument_from_dict(table: Any, place: str, files_in: Path | None = None) -> Instrument:
    """The instrument that a table of settings describes.

    Parameters
    ----------
    table : fields of `Instrument`. `sensor` is the name of a preset, or a table with a `type`. The tables `detector`
        and `decoder` change the sensor's own ones key by key.
    place : where the table stands, for messages.
    files_in : folder that relative paths FILE.py:NAME of sensors count from, see `rangesim.sensors.sensor_of`. None:
        no file is loaded, as for results that are read back.

    Raises
    ------
    ValueError
        An unknown key or a bad value. The message names the place.

    Examples
    --------
    >>> one = instrument_from_dict({"sensor": "amcw", "detector": {"read_noise_e": 8.0}}, "instrument[0]")
    >>> one.name, one.detector.read_noise_e
    ('amcw', 8.0)
    """
    if not isinstance(table, Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(table)}.")
    values = dict(table)
    if "optics" in values:
        raise ValueError(
            f"{place}: expected the tables camera_lens and projector_lens instead of optics, see docs/optics.md."
        )
    check_keys(values, [f.name for f in fields(Instrument)], place)
    given, sensor = values.get("sensor"), None
    if given is not None:
        values["sensor"] = sensor = sensor_from_dict(given, f"{place}.sensor", files_in)
        if isinstance(given, str):
            values.setdefault("name", name_of(given, sensor))
    for key, kind, default in (
        ("detector", PhotoDetector, getattr(sensor, "default_detector", None)),
        ("decoder", Decoder, getattr(sensor, "default_decoder", None)),
    ):
        if values.get(key) is not None:
            values[key] = from_dict(kind, on_top_of(default, values[key]), f"{place}.{key}")
    return from_dict(Instrument, values, place)
