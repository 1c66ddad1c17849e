# SPDX-License-Identifier: Apache-2.0
"""Writes and reads range images: one .npz file with the arrays, the camera and the decoder."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.returns import Returns
from rangesim.decoding.status import Status
from rangesim.errors import FileFormatError
from rangesim.files.array_files import write_arrays
from rangesim.files.schema import MAX_METRES, SETTINGS, ArraySpec, read_checked_arrays, settings_array, settings_of
from rangesim.rig import Camera
from rangesim.sensors import Decoder  # this import also makes the package's own decoders known by their type_name
from rangesim.settings.config import check_keys, from_dict, to_dict

_DEPTH = ArraySpec("float32", low=-MAX_METRES, high=MAX_METRES, nan=True)
_RANGE = {
    "z": _DEPTH,
    "range_m": _DEPTH,
    "confidence": ArraySpec("float32", low=0, high=1.001, nan=True),
    "status": ArraySpec("uint8", high=max(Status)),
    "intensity": ArraySpec("float32", nan=True),
    "T_world_camera": ArraySpec("float64", (4, 4), required=False),
    "projector_column": ArraySpec("float32", nan=True, required=False),
    "projector_row": ArraySpec("float32", nan=True, required=False),
    "sampling_sigma_m": ArraySpec("float32", low=0, nan=True, inf=True, required=False),
    "settings": replace(SETTINGS, required=False),
}
_RETURNS = {
    "range_m": ArraySpec("float32", ("k", "h", "w"), high=MAX_METRES, nan=True, required=False),
    "strength": ArraySpec("float32", ("k", "h", "w"), nan=True, required=False),
    "sigma_m": ArraySpec("float32", ("k", "h", "w"), low=0, nan=True, inf=True, required=False),
    "status": ArraySpec("uint8", ("k", "h", "w"), high=max(Status), required=False),
}
"""Those of `Returns`; in files their names begin with `_PREFIX`."""
_PREFIX = "returns_"
"""First letters of the names of arrays of `Returns` in files of range images."""
_ARRAYS = _RANGE | {_PREFIX + name: spec for name, spec in _RETURNS.items()}
"""Type, shape and bounds of the arrays of a range image, by their names in files. The bound of the confidence leaves
room for the rounding of single precision."""

_SENTENCES = ("doubts", "notes")
"""Fields of a range image that hold sentences."""


def save_range_image(image: RangeImage, path: str | Path) -> None:
    """Write the arrays of a range image, its camera and its decoder to a compressed .npz file.

    `load_range_image` reads an equal range image from it.

    Examples
    --------
    >>> from rangesim import decode, save_range_image
    >>> save_range_image(decode(capture), "out/range.npz")  # doctest: +SKIP
    """
    arrays = {f.name: getattr(image, f.name) for f in fields(image) if isinstance(getattr(image, f.name), np.ndarray)}
    returns = {} if image.returns is None else {_PREFIX + name: getattr(image.returns, name) for name in _RETURNS}
    settings = {"camera": to_dict(image.camera), "decoder": to_dict(image.decoder)}
    settings |= {name: list(sentences) for name in _SENTENCES if (sentences := getattr(image, name))}
    write_arrays(path, {**arrays, **returns, "settings": settings_array(settings)})


def load_range_image(path: str | Path, sizes: dict[str, int] | None = None) -> RangeImage:
    """The range image that `save_range_image` wrote.

    sizes : height "h" and width "w" that the image must have, pixels; None: any.

    Raises
    ------
    FileFormatError
        The file is missing or broken, or the class of its decoder is not loaded, for example a class from a Python file
        of the user.

    Examples
    --------
    >>> from rangesim import load_range_image
    >>> load_range_image("out/range.npz").to_point_cloud().save("out/cloud.ply")  # doctest: +SKIP
    """
    path = Path(path)
    arrays: dict[str, Any] = read_checked_arrays(path, _ARRAYS, dict(sizes or {}))
    settings = settings_of(arrays.pop("settings"), path) if "settings" in arrays else {}
    returns = {name: arrays.pop(_PREFIX + name) for name in _RETURNS if _PREFIX + name in arrays}
    try:
        if returns and len(returns) < len(_RETURNS):
            raise ValueError(f"expected all arrays {', '.join(_PREFIX + name for name in _RETURNS)} or none of them.")
        check_keys(settings, ("camera", "decoder", *_SENTENCES), "settings")
        camera, decoder = settings.get("camera"), settings.get("decoder")
        said = {name: settings.get(name, []) for name in _SENTENCES}
        for name, sentences in said.items():
            if not isinstance(sentences, list) or not all(isinstance(sentence, str) for sentence in sentences):
                raise ValueError(f"expected {name} as a list of sentences.")
        image = RangeImage(
            **arrays,
            returns=Returns(**returns) if returns else None,
            camera=None if camera is None else from_dict(Camera, camera, "camera"),  # type: ignore[type-abstract]
            decoder=None if decoder is None else from_dict(Decoder, decoder, "decoder"),  # type: ignore[type-abstract]
            doubts=tuple(said["doubts"]),
            notes=tuple(said["notes"]),
        )
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {error}") from error
    if not image.is_consistent:
        raise FileFormatError(f"{path}: expected z to be finite where status is {Status.OK.value}.")
    if image.camera is not None and image.z.shape != (image.camera.height, image.camera.width):
        raise FileFormatError(f"{path}: expected arrays of the camera's size.")
    return image
