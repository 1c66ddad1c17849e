# SPDX-License-Identifier: Apache-2.0
"""Writes and reads signals: complete ones, which can be exposed again, and those of a result, without channels."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields, replace
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
"""Name of the format in the file."""
FORMAT_VERSION = 1
"""Version of the format, a count from 1. A change that older versions of the package cannot read increases it."""
MAX_SETTINGS = 1_000_000
"""Largest size of the settings in a file, in bytes. Real settings take a few kilobytes; the limit keeps a damaged file
from filling the memory."""

_RADIANCE = ArraySpec("float32", low=0)
_TRUE_RANGE = ArraySpec("float32", low=1e-9, high=MAX_METRES, nan=True)
_OPTIONAL = ArraySpec("float32", required=False)
_PASS = {f"energy_{f.name}": _RADIANCE for f in fields(EnergySplit)} | {
    "truth_z": replace(_TRUE_RANGE, low=-MAX_METRES),
    "truth_range_m": _TRUE_RANGE,
    "truth_normal": ArraySpec("float32", ("h", "w", 3), low=-1.01, high=1.01, nan=True),
    "truth_instance": ArraySpec("int32", low=-1),
    "truth_material": ArraySpec("int32", low=-1),
    "truth_projector_uv": ArraySpec("float32", ("h", "w", 2), nan=True, inf=True),
    "truth_projector_visible": ArraySpec("bool"),
    "truth_instance_names": ArraySpec("str", ("instances",)),
    "truth_material_names": ArraySpec("str", ("materials",)),
    "truth_instance_objects": ArraySpec("str", ("instances",), required=False),
    "truth_nearest_m": replace(_TRUE_RANGE, required=False),
    "truth_farthest_m": replace(_TRUE_RANGE, required=False),
    "motion_m": ArraySpec("float32", low=0, nan=True, required=False),
    "truncation": ArraySpec("float64", (len(fields(Truncation)),), low=0, high=1, nan=True, required=False),
}
"""Type, shape and bounds of the arrays of a pass, by their names in files. The bounds of a normal leave room for the
rounding of single precision. Depths z are negative behind a scanner."""


def save_signals(signals: StillSignals, path: str | Path) -> None:
    """Write signals with their channels and sampling error to a compressed .npz file.

    Raises
    ------
    ValueError
        The signals are those of several cameras or of a moving scene; or a response holds arrays
        (`rangesim.response.Images`), which files cannot hold.
    FileFormatError
        The file cannot be written.

    Examples
    --------
    >>> from rangesim import save_signals
    >>> save_signals(signals, "out/signals.npz")  # doctest: +SKIP
    """
    if not isinstance(signals, StillSignals):
        raise ValueError(
            f"expected StillSignals, got {type(signals).__name__}; "
            "save the signals of each camera of a set by themselves."
        )
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
    """The signals that `save_signals` wrote. `rangesim.expose` makes captures of them without a new pass.

    Raises
    ------
    FileFormatError
        The file is missing or broken, or the class of a response is not loaded.

    Examples
    --------
    >>> from rangesim import expose, load_signals
    >>> signals = load_signals("out/signals.npz")  # doctest: +SKIP
    >>> capture = expose(signals, sensor, sensor.default_detector)  # doctest: +SKIP
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
        raise FileFormatError(f"{path}: expected different responses, got one twice.")
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
    """A light-transport pass without its channels, as a result keeps it.

    energy : EnergySplit.
    truth : GroundTruth.
    motion_m : (h, w) float32, metres, as `Signals.motion_m`; None: nothing moves.
    truncation : Truncation, the light that was left out; None: not known.
    """

    energy: EnergySplit
    truth: GroundTruth
    motion_m: np.ndarray | None = None
    truncation: Truncation | None = None

    @classmethod
    def of(cls, signals: Signals) -> LightPass:
        """The pass that these signals are from."""
        return cls(signals.energy, signals.truth, signals.motion_m, signals.truncation)


def write_pass(light_pass: LightPass, path: str | Path) -> None:
    """Write a pass to a compressed .npz file."""
    write_arrays(path, _pass_arrays(light_pass))


def read_pass(path: Path, sizes: dict[str, int]) -> LightPass:
    """The pass that `write_pass` wrote.

    Parameters
    ----------
    sizes : height "h" and width "w" that the images must have, pixels.

    Raises
    ------
    FileFormatError
        The file is missing or broken.
    """
    data = read_checked_arrays(path, _PASS, dict(sizes))  # a copy: the call adds sizes to it
    energy, truth = _energy_and_truth(path, data)
    return LightPass(energy, truth, data.get("motion_m"), _truncation(data))


def _truncation(data: dict[str, np.ndarray]) -> Truncation | None:
    return Truncation(*map(float, data["truncation"])) if "truncation" in data else None


def _pass_arrays(signals: Signals | LightPass) -> dict[str, np.ndarray]:
    """The arrays of a pass by their names in files."""
    arrays = {f"energy_{f.name}": getattr(signals.energy, f.name) for f in fields(EnergySplit)}
    known = {f.name: getattr(signals.truth, f.name) for f in fields(GroundTruth)}
    if not signals.truth.instance_objects:
        del known["instance_objects"]
    arrays |= {f"truth_{name}": np.asarray(value) for name, value in known.items() if value is not None}
    if signals.motion_m is not None:
        arrays["motion_m"] = signals.motion_m
    if signals.truncation is not None:
        arrays["truncation"] = np.array(astuple(signals.truncation))
    return arrays


def _energy_and_truth(path: Path, data: dict[str, np.ndarray]) -> tuple[EnergySplit, GroundTruth]:
    """Energy split and ground truth made of the arrays of a pass; FileFormatError for an index without a name."""
    for ids in ("instance", "material"):
        if data[f"truth_{ids}"].max(initial=-1) >= len(data[f"truth_{ids}_names"]):
            raise FileFormatError(f"{path}: array truth_{ids}: expected indices into truth_{ids}_names.")
    energy = EnergySplit(**{f.name: data[f"energy_{f.name}"] for f in fields(EnergySplit)})
    truth: dict[str, Any] = {f.name: data.get(f"truth_{f.name}") for f in fields(GroundTruth)}
    for name in ("instance_names", "material_names", "instance_objects"):
        truth[name] = tuple(map(str, truth[name])) if truth[name] is not None else ()
    return energy, GroundTruth(**truth)


def _settings(path: Path) -> dict[str, Any]:
    """The settings of a file of signals, checked in size before they are read."""

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
    """A response as plain data; ValueError if it could not be read back."""
    name = type(response).__name__
    if not hasattr(response, "type_name"):
        raise ValueError(f"expected responses with a type_name, which names them in files, got {name} without one.")
    if any(isinstance(getattr(response, f.name), np.ndarray) for f in fields(response)):  # type: ignore[arg-type]
        raise ValueError(f"expected responses of numbers, got {name}, which holds arrays.")
    table: dict[str, Any] = to_dict(response)
    return table
