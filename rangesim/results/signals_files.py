# SPDX-License-Identifier: Apache-2.0
"""Files of signals: complete ones, to be exposed again without a new pass, and those of results, without channels."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.errors import FileFormatError
from rangesim.files.array_files import read_arrays, write_arrays
from rangesim.files.schema import MAX_METRES, SETTINGS, ArraySpec, read_checked_arrays, settings_array, settings_of
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.settings.config import ShortRepr, check_keys, from_dict, shown, to_dict
from rangesim.signals import EnergySplit, GroundTruth, SamplingError, Signals, StillSignals, Truncation

FORMAT = "rangesim-signals"
FORMAT_VERSION = 1
"""Number of the file format, as a count from 1; a change that older versions cannot read increases it."""
MAX_SETTINGS = 1_000_000
"""Largest size of the settings in a file, in bytes. Real settings have a few kilobytes; the limit protects from files
that would fill the memory."""

_RADIANCE = ArraySpec("float32", low=0)
_TRUE_DEPTH = ArraySpec("float32", low=1e-9, high=MAX_METRES, nan=True)
_OPTIONAL = ArraySpec("float32", required=False)
_PASS = {f"energy_{f.name}": _RADIANCE for f in fields(EnergySplit)} | {
    "truth_z": _TRUE_DEPTH,
    "truth_range_m": _TRUE_DEPTH,
    "truth_normal": ArraySpec("float32", ("h", "w", 3), low=-1.01, high=1.01, nan=True),
    "truth_instance": ArraySpec("int32", low=-1),
    "truth_material": ArraySpec("int32", low=-1),
    "truth_projector_uv": ArraySpec("float32", ("h", "w", 2), nan=True, inf=True),
    "truth_projector_visible": ArraySpec("bool"),
    "truth_instance_names": ArraySpec("str", ("instances",)),
    "truth_material_names": ArraySpec("str", ("materials",)),
    "motion_m": ArraySpec("float32", low=0, nan=True, required=False),
    "truncation": ArraySpec("float64", (len(fields(Truncation)),), low=0, high=1, nan=True, required=False),
}
"""Arrays of a pass, by name, with their types and limits."""


def save_signals(signals: StillSignals, path: str | Path) -> None:
    """Write signals with their channels and sampling error to a compressed .npz file; `load_signals` reads them back.

    Raises
    ------
    ValueError
        A response holds arrays (`Images`).
    FileFormatError
        The place cannot be written.
    """
    responses = list(signals.channels)
    settings = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "rig": to_dict(signals.rig),
        "responses": [_plain(response) for response in responses],
    }
    arrays = {"settings": settings_array(settings), **_pass_arrays(signals)}
    arrays |= {f"channels_{i}": signals.channels[response] for i, response in enumerate(responses)}
    if signals.sampling is not None:
        arrays |= {f"error_{i}": signals.sampling.channels[response] for i, response in enumerate(responses)}
        arrays["error_projector"] = signals.sampling.projector
    write_arrays(path, arrays)


def load_signals(path: str | Path) -> StillSignals:
    """Signals that `save_signals` wrote; `expose` makes captures of them as of traced ones.

    Raises
    ------
    FileFormatError
        The file is missing or broken, or holds a response of a class that is not loaded.

    Examples
    --------
    >>> from rangesim import expose, load_signals
    >>> signals = load_signals("signals.npz")  # doctest: +SKIP
    >>> capture = expose(signals, sensor)  # doctest: +SKIP
    """
    path = Path(path)
    settings = _settings(path)
    try:
        check_keys(settings, ("format", "format_version", "rig", "responses"), str(path))
        rig = Rig.from_dict(settings.get("rig"))
        responses = [
            from_dict(Response, table, f"responses[{i}]") for i, table in enumerate(settings.get("responses", ()))
        ]
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    if len(set(responses)) < len(responses):
        raise FileFormatError(f"{path}: expected responses that differ, got one twice.")
    sizes = {"h": rig.camera.height, "w": rig.camera.width}
    specs = {**_PASS, "settings": SETTINGS, "error_projector": _OPTIONAL}
    for i, response in enumerate(responses):
        shape = (response.channels, "h", "w")
        specs |= {
            f"channels_{i}": ArraySpec("float32", shape),
            f"error_{i}": ArraySpec("float32", shape, required=False),
        }
    data = read_checked_arrays(path, specs, sizes)
    energy, truth = _energy_and_truth(path, data)
    has_error = ["error_projector" in data, *(f"error_{i}" in data for i in range(len(responses)))]
    if any(has_error) and not all(has_error):
        raise FileFormatError(f"{path}: expected the sampling error of all channels, or of none.")
    sampling = None
    if all(has_error):
        sampling = SamplingError({r: data[f"error_{i}"] for i, r in enumerate(responses)}, data["error_projector"])
    channels = {response: data[f"channels_{i}"] for i, response in enumerate(responses)}
    return StillSignals(rig, energy, truth, truncation=_truncation(data), channels=channels, sampling=sampling)


@dataclass(frozen=True, eq=False, repr=False)
class LightPass(ShortRepr):
    """A transport pass as results keep it: all parts of its signals except the channels.

    energy : EnergySplit. truth : GroundTruth.
    motion_m : (h, w) float32, metres, see `Signals.motion_m`; None: nothing moves.
    truncation : Truncation, estimate of the light that is left out; None: not known.
    """

    energy: EnergySplit
    truth: GroundTruth
    motion_m: np.ndarray | None = None
    truncation: Truncation | None = None

    @classmethod
    def of(cls, signals: Signals) -> LightPass:
        """The pass that the signals come from."""
        return cls(signals.energy, signals.truth, signals.motion_m, signals.truncation)


def write_pass(light_pass: LightPass, path: str | Path) -> None:
    """Write a pass to a compressed .npz file; `read_pass` reads it back.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_arrays(path, _pass_arrays(light_pass))


def read_pass(path: Path, sizes: dict[str, int]) -> LightPass:
    """The pass that `write_pass` wrote.

    Parameters
    ----------
    sizes : height "h" and width "w" of its images, in pixels.

    Raises
    ------
    FileFormatError
        The file is missing or broken.
    """
    data = read_checked_arrays(path, _PASS, dict(sizes))  # a copy: passes may see other instances
    energy, truth = _energy_and_truth(path, data)
    return LightPass(energy, truth, data.get("motion_m"), _truncation(data))


def _truncation(data: dict[str, np.ndarray]) -> Truncation | None:
    """Truncation in the arrays of a file; None if there is none."""
    return Truncation(*map(float, data["truncation"])) if "truncation" in data else None


def _pass_arrays(signals: Signals | LightPass) -> dict[str, np.ndarray]:
    """Arrays of signals besides their channels, by their names in files."""
    arrays = {f"energy_{f.name}": getattr(signals.energy, f.name) for f in fields(EnergySplit)}
    arrays |= {f"truth_{f.name}": np.asarray(getattr(signals.truth, f.name)) for f in fields(GroundTruth)}
    if signals.motion_m is not None:
        arrays["motion_m"] = signals.motion_m
    if signals.truncation is not None:
        arrays["truncation"] = np.array(astuple(signals.truncation))
    return arrays


def _energy_and_truth(path: Path, data: dict[str, np.ndarray]) -> tuple[EnergySplit, GroundTruth]:
    """Energy split and ground truth in the arrays of a file."""
    for ids in ("instance", "material"):
        if data[f"truth_{ids}"].max(initial=-1) >= len(data[f"truth_{ids}_names"]):
            raise FileFormatError(f"{path}: array truth_{ids}: expected indices into truth_{ids}_names.")
    energy = EnergySplit(**{f.name: data[f"energy_{f.name}"] for f in fields(EnergySplit)})
    truth: dict[str, Any] = {f.name: data[f"truth_{f.name}"] for f in fields(GroundTruth)}
    for name in ("instance_names", "material_names"):
        truth[name] = tuple(map(str, truth[name]))
    return energy, GroundTruth(**truth)


def _settings(path: Path) -> dict[str, Any]:
    """Settings in a file of signals; FileFormatError if it is none, or of another version."""

    def check(name: str, place: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if dtype != np.uint8 or len(shape) != 1 or shape[0] > MAX_SETTINGS:
            raise FileFormatError(f"{place}: expected up to {MAX_SETTINGS} bytes of text.")

    if not path.is_file():
        raise FileFormatError(f"{path} is missing.")
    settings = settings_of(read_arrays(path, ["settings"], check)["settings"], path)
    if settings.get("format") != FORMAT:
        raise FileFormatError(f"{path} is no {FORMAT} file.")
    if settings.get("format_version") != FORMAT_VERSION:
        found = shown(settings.get("format_version"))
        raise FileFormatError(f"{path}: expected format version {FORMAT_VERSION}, got {found}.")
    return settings


def _plain(response: Response) -> dict[str, Any]:
    """Plain data of a response; ValueError if no response can be made of them again."""
    name = type(response).__name__
    if not hasattr(response, "type_name"):
        raise ValueError(f"expected responses with a type_name, which names them in files, got {name} without one.")
    if any(isinstance(value, np.ndarray) for value in vars(response).values()):
        raise ValueError(f"expected responses of numbers, got {name}, which holds arrays.")
    table: dict[str, Any] = to_dict(response)
    return table
