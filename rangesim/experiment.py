# SPDX-License-Identifier: Apache-2.0
"""What to measure and with what: a scene, the settings of the light transport, and the instruments to compare."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from rangesim.ambient import Ambient
from rangesim.config import check_keys, from_dict, to_dict
from rangesim.errors import FileFormatError
from rangesim.instrument import DEFAULT_SENSORS, Instrument, instrument, instrument_from_dict
from rangesim.motion import Motion
from rangesim.motion.settings import motion_from_dict
from rangesim.seeds import check_seed


@dataclass(frozen=True)
class Experiment:
    """A scene, seen by one or more instruments.

    Parameters
    ----------
    scene : path of a Mitsuba 3 XML scene or of a mesh (PLY, OBJ, GLB ...).
    material : material class of a bare mesh (None: matte); refused for a scene, which names its own.
    unit_m : metres per unit of a bare mesh, 0.001 for millimetres (None: 1); refused for a scene.
    width, height : pixels of the camera; None: as in the scene. The field of view is kept.
    spp : light paths per pixel.
    max_depth : longest path in segments up to the light; 2 is direct light alone.
    photons : caustic photons of each pass; 0: no light through glass or off mirrors; None: the usual number.
    glint : whether the camera sees the projector's lens in mirrors.
    seed : of transport and noise, 0 to 2^64 - 1; the same seed gives the same bytes.
    ambient : what kind of light the scene's own emitters give, and how strong; None: not stated, see `expose`.
    instruments : those whose emitters stand in the same place share one light-transport pass, if nothing moves.
    motion : what moves; None: nothing.
    """

    scene: str
    material: str | None = None
    unit_m: float | None = None
    width: int | None = None
    height: int | None = None
    spp: int = 64
    max_depth: int = 5
    photons: int | None = None
    glint: bool = True
    seed: int = 0
    ambient: Ambient | None = None
    instruments: tuple[Instrument, ...] = tuple(instrument(name) for name in DEFAULT_SENSORS)
    motion: Motion | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "spp", "max_depth"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"expected {name} to be a whole number of at least 1, got {value}.")
        if self.photons is not None and self.photons < 0:
            raise ValueError(f"expected no negative number of photons, got {self.photons}.")
        object.__setattr__(self, "seed", check_seed(self.seed))
        for one in self.instruments if self.motion else ():
            period_s = one.timing.frame_period_s
            if one.exposure_s is not None and 0 < period_s < one.exposure_s:
                raise ValueError(
                    f"expected exposure_s of {one.name} within its frame_period_s of {period_s:g} s, "
                    f"got {one.exposure_s:g} s."
                )
        names = [i.name for i in self.instruments]
        if not names:
            raise ValueError("expected at least one instrument, got none.")
        twice = [n for n in names if names.count(n) > 1]
        if twice:
            raise ValueError(f"expected instruments of different names, got {twice[0]!r} twice.")


def load_experiment(path: str | Path) -> Experiment:
    """The experiment of a TOML file; a relative scene path counts from the file's directory.

    Raises
    ------
    FileFormatError
        The file is missing or no valid TOML, or holds an unknown key or a bad value; the message names the place.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected an experiment (.toml).")
    try:
        experiment = experiment_from_dict(tomllib.loads(path.read_text(encoding="utf-8")))
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is no text file.") from error
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(f"{path} is no valid TOML: {error}.") from error
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error
    return replace(experiment, scene=str(path.parent / experiment.scene))


def experiment_from_dict(data: Mapping[str, Any]) -> Experiment:
    """The experiment of plain data; each table under `instrument` is one instrument. ValueError as `from_dict`."""
    check_keys(data, ["instrument" if f.name == "instruments" else f.name for f in fields(Experiment)], "experiment")
    rest = {key: value for key, value in data.items() if key not in ("instrument", "motion")}
    experiment = from_dict(Experiment, rest)
    if data.get("motion") is not None:
        experiment = replace(experiment, motion=motion_from_dict(data["motion"]))
    tables = data.get("instrument")
    if tables is None:
        return experiment
    if not isinstance(tables, list):
        raise ValueError("expected instruments as tables headed [[instrument]], with two brackets.")
    return replace(
        experiment, instruments=tuple(instrument_from_dict(t, f"instrument[{i}]") for i, t in enumerate(tables))
    )


def experiment_to_dict(experiment: Experiment) -> dict[str, Any]:
    """Plain data that `experiment_from_dict` reads back equal."""
    data = to_dict(experiment)
    data["instrument"] = data.pop("instruments")
    return dict(data)
