# SPDX-License-Identifier: Apache-2.0
"""The settings of an experiment: a scene, the instruments that measure it, and the settings of the light transport."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rangesim.electronics.ambient import Ambient
from rangesim.evaluation.comparison import TOLERANCE_M
from rangesim.files.settings_files import load_settings
from rangesim.instrument.instrument import Instrument
from rangesim.motion import Motion
from rangesim.motion.pose_tracks import motion_from_dict
from rangesim.presets import DEFAULT_SENSORS, instrument, instrument_from_dict
from rangesim.settings import limits
from rangesim.settings.bounds import Metres, check_fields, whole
from rangesim.settings.config import check_keys, from_dict, shown, to_dict
from rangesim.settings.seeds import check_seed

if TYPE_CHECKING:
    from rangesim.light_transport.transport_settings import TransportSettings


@dataclass(frozen=True)
class Experiment:
    """A scene that one or more instruments measure.

    `rangesim.pipeline.experiment_run.carry_out` measures it, and `run` writes the results as well.

    Parameters
    ----------
    scene : path of a Mitsuba 3 XML scene or of a mesh (PLY, OBJ, GLB ...), or the name of a scene that the package
        contains, such as "tabletop".
    material : material class of a bare mesh; None: matte. Refused for a scene, which has materials of its own.
    unit_m : metres per unit of a bare mesh, 0.001 for millimetres; None: 1. Refused for a scene.
    width, height : size of the camera's image, pixels; None: as in the scene. The field of view is kept.
    spp : light paths per pixel. None: 8, and up to `max_spp` where the renderer's noise would not be small against
        the detector's noise, see `rangesim.instrument.adaptive_sampling`.
    max_spp : largest number of light paths per pixel where `spp` is None.
    max_depth : largest number of segments of a path between surfaces that scatter it, the last segment to the light
        included. 2 means direct light only. Glass and mirrors do not count.
    caustics : whether the projector's light reaches surfaces through glass and off mirrors.
    glint : whether the camera sees the projector's lens in mirrors.
    tolerance_m : largest error of a right reading in metres, which the task sets: what the gripper can bear. Tables and
        causes count readings that are off by more as wrong.
    seed : seed of light transport and noise, 0 to 2^64 - 1. The same seed gives the same bytes.
    ambient : Ambient, kind and strength of the light that the scene's own emitters give; None: not stated, see
        `rangesim.expose`.
    instruments : instruments to compare. Those whose emitter, wavelength and camera agree share a light-transport
        pass, if nothing moves, see `rangesim.pipeline.shared_passes`.
    motion : Motion, objects that move; None: nothing moves.
    objects : names of the shapes, or of the things that they are parts of, that count as objects; all others are
        background. None: as the scene states, or as follows from its geometry (`rangesim.scene.objects`).

    Raises
    ------
    ValueError
        A number out of its range, no instrument, or two instruments of the same name.

    Examples
    --------
    >>> experiment = Experiment("tabletop", width=320, height=240)
    >>> [each.name for each in experiment.instruments]
    ['gray-phase', 'amcw', 'ideal-tof']
    >>> experiment_from_dict(experiment_to_dict(experiment)) == experiment
    True
    """

    scene: str
    material: str | None = None
    unit_m: Metres | None = None
    width: Annotated[int, whole(1, "pixels")] | None = None
    height: Annotated[int, whole(1, "pixels")] | None = None
    spp: Annotated[int, whole(1, "spp")] | None = None
    max_spp: Annotated[int, whole(1, "spp")] = 64
    max_depth: Annotated[int, whole(1, "depth")] = 5
    caustics: bool = True
    glint: bool = True
    tolerance_m: Metres = TOLERANCE_M
    seed: int = 0
    ambient: Ambient | None = None
    instruments: tuple[Instrument, ...] = tuple(instrument(name) for name in DEFAULT_SENSORS)
    motion: Motion | None = None
    objects: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.scene or "\0" in self.scene:
            raise ValueError(f"expected scene to be the path of a scene or a mesh, got {shown(self.scene)}.")
        limits.check("pixels", (self.width or 1) * (self.height or 1), f"pixels, not {self.width} x {self.height}")
        limits.check("instruments", len(self.instruments), "instruments")
        object.__setattr__(self, "seed", check_seed(self.seed))
        for each in self.instruments if self.motion else ():
            period_s = each.timing.frame_period_s
            if each.exposure_s is not None and 0 < period_s < each.exposure_s:
                raise ValueError(
                    f"expected exposure_s of {each.name} within its frame_period_s of {period_s:g} s, "
                    f"got {each.exposure_s:g} s."
                )
        names = [i.name for i in self.instruments]
        if not names:
            raise ValueError("expected at least one instrument, got none.")
        if twice := [n for n in names if names.count(n) > 1]:
            raise ValueError(f"expected instruments of different names, got {twice[0]!r} twice.")

    def transport_settings(self, instruments: Sequence[Instrument]) -> TransportSettings:
        """Settings of the light-transport pass that these instruments share."""
        from rangesim.instrument.adaptive_sampling import AdaptiveSampling
        from rangesim.light_transport.transport_settings import TransportSettings

        spp: int | Literal["auto"] | AdaptiveSampling = "auto"
        if self.spp is not None:
            spp = self.spp
        elif self.motion is None:
            spp = AdaptiveSampling(tuple(instruments), self.max_spp, ambient=self.ambient)
        return TransportSettings(spp, self.max_depth, seed=self.seed, caustics=self.caustics, glint=self.glint)


def load_experiment(path: str | Path) -> Experiment:
    """The experiment that a TOML file describes.

    A relative path of the scene counts from the directory of the TOML file. If no file has this path, it may be the
    name of a scene that the package contains. `examples/tabletop.toml` shows the common keys.

    Raises
    ------
    FileFormatError
        The file is missing, is no valid TOML, or has an unknown key or a bad value. The message names the place.
    """
    return load_settings(path, "an experiment", experiment_from_dict)


def experiment_from_dict(data: Mapping[str, Any], files_in: Path | None = None) -> Experiment:
    """The experiment that plain data describes. Each table under `instrument` is one instrument.

    files_in : as for `rangesim.presets.instrument_from_dict`.

    Raises
    ------
    ValueError
        An unknown key or a bad value. The message names the place.

    Examples
    --------
    >>> experiment_from_dict({"scene": "matte", "instrument": [{"sensor": "amcw", "power_w": 2.0}]}).instruments[0].name
    'amcw'
    """
    check_keys(data, ["instrument" if f.name == "instruments" else f.name for f in fields(Experiment)], "experiment")
    rest = {key: value for key, value in data.items() if key not in ("instrument", "motion")}
    experiment = from_dict(Experiment, rest)
    if data.get("motion") is not None:
        experiment = replace(experiment, motion=motion_from_dict(data["motion"]))
    tables = data.get("instrument")
    if tables is None:
        return experiment
    if not isinstance(tables, list):
        raise ValueError("expected instruments as tables with the header [[instrument]], with two brackets.")
    return replace(
        experiment,
        instruments=tuple(instrument_from_dict(t, f"instrument[{i}]", files_in) for i, t in enumerate(tables)),
    )


def experiment_to_dict(experiment: Experiment) -> dict[str, Any]:
    """The experiment as plain data, from which `experiment_from_dict` makes an equal experiment."""
    data = to_dict(experiment)
    data["instrument"] = data.pop("instruments")
    return dict(data)
