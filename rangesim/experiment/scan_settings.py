# SPDX-License-Identifier: Apache-2.0
"""The settings of a scan: a scene, an instrument, a camera path, and how the views are fused to a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rangesim.electronics.ambient import Ambient
from rangesim.experiment.camera_paths import CameraPath, Turntable
from rangesim.files.settings_files import load_settings
from rangesim.instrument.instrument import Instrument
from rangesim.presets import instrument, instrument_from_dict
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Metres, check_fields, whole
from rangesim.settings.config import check_keys, from_dict, shown, to_dict
from rangesim.settings.seeds import check_seed

if TYPE_CHECKING:
    from rangesim.light_transport.transport_settings import TransportSettings

SENSOR = "gray-phase"
"""Preset of the sensor that a scan uses if none is given."""


@dataclass(frozen=True)
class ScanSettings:
    """A scan: one instrument takes many views of a scene, and the views are fused to a surface.

    `rangesim.pipeline.scan_run.carry_out_scan` carries it out, and `run_scan` writes the results as well.

    Parameters
    ----------
    scene, material, unit_m, width, height, max_depth, caustics, glint, seed, ambient : as for
        `rangesim.experiment.Experiment`.
    spp : light paths per pixel; None: the default of `rangesim.transport`.
    instrument : Instrument, whose camera and emitter move together.
    path : CameraPath. The scene's camera gives what the path does not state.
    registration : "known": the fusion uses the poses of the path. "unknown": it uses poses found from the readings
        (`rangesim.fusion.multiway_registration.align`).
    voxel_m : edge of a voxel, metres; None: 1.5 times the distance between readings.
    truncation_m, weights, min_weight : as for `rangesim.fusion.truncated_average.fuse`.

    Raises
    ------
    ValueError
        A number out of its range.

    Examples
    --------
    >>> settings = ScanSettings("matte", path=Turntable(views=6), voxel_m=2e-3)
    >>> settings.instrument.name
    'gray-phase'
    >>> scan_settings_from_dict(scan_settings_to_dict(settings)) == settings
    True
    """

    scene: str
    material: str | None = None
    unit_m: Metres | None = None
    width: Annotated[int, whole(1, "pixels")] | None = None
    height: Annotated[int, whole(1, "pixels")] | None = None
    spp: Annotated[int, whole(1, "spp")] | None = None
    max_depth: Annotated[int, whole(1, "depth")] = 5
    caustics: bool = True
    glint: bool = True
    seed: int = 0
    ambient: Ambient | None = None
    instrument: Instrument = field(default_factory=lambda: instrument(SENSOR))
    path: CameraPath = field(default_factory=Turntable)
    registration: Literal["known", "unknown"] = "known"
    voxel_m: Metres | None = None
    truncation_m: Metres | None = None
    weights: Literal["confidence", "uniform"] = "confidence"
    min_weight: Annotated[float, Bounds("0 or positive", 0, 1e6)] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.scene or "\0" in self.scene:
            raise ValueError(f"expected scene to be the path of a scene or a mesh, got {shown(self.scene)}.")
        limits.check("pixels", (self.width or 1) * (self.height or 1), f"pixels, not {self.width} x {self.height}")
        object.__setattr__(self, "seed", check_seed(self.seed))

    def transport_settings(self) -> TransportSettings:
        """Settings of the light-transport pass of each view."""
        from rangesim.light_transport.transport_settings import TransportSettings

        return TransportSettings(
            "auto" if self.spp is None else self.spp, self.max_depth, caustics=self.caustics, glint=self.glint
        )


def load_scan_settings(file: str | Path) -> ScanSettings:
    """The scan that a TOML file describes.

    The file has the fields of `ScanSettings`. `[instrument]` and `[path]` are tables; `[path]` has a key `type`. A
    relative path of the scene counts from the directory of the file.

    Raises
    ------
    FileFormatError
        The file is missing, is no valid TOML, or has an unknown key or a bad value. The message names the place.
    """
    return load_settings(file, "the settings of a scan", scan_settings_from_dict)


def scan_settings_from_dict(data: Mapping[str, Any], files_in: Path | None = None) -> ScanSettings:
    """The scan that plain data describes.

    files_in : as for `rangesim.presets.instrument_from_dict`.

    Raises
    ------
    ValueError
        An unknown key or a bad value. The message names the place.
    """
    check_keys(data, [f.name for f in fields(ScanSettings)], "scan")
    settings = from_dict(ScanSettings, {k: v for k, v in data.items() if k not in ("instrument", "path")})
    if data.get("instrument") is not None:
        settings = replace(settings, instrument=instrument_from_dict(data["instrument"], "instrument", files_in))
    if data.get("path") is not None:
        settings = replace(settings, path=from_dict(CameraPath, data["path"], "path"))  # type: ignore[type-abstract]
    return settings


def scan_settings_to_dict(settings: ScanSettings) -> dict[str, Any]:
    """The scan as plain data, from which `scan_settings_from_dict` makes an equal scan."""
    return dict(to_dict(settings))
