# SPDX-License-Identifier: Apache-2.0
"""Files of devices: a data sheet, the settings of an instrument, and a source for every number.

A file is TOML with these parts:

- `title`: the name of the device in words.
- `[sheet]`: a `DataSheet`.
- `[instrument]`: what `Instrument` takes besides what follows from the sheet, as in an experiment. Its name is that of
  the file, unless it is stated.
- `[documents]`: short names of documents, with their full titles.
- `[sources]`: for every number, by the name of its setting, where it comes from: the short name of a document, with a
  place in it after a colon if need be; or `assumed: why`, `computed: how`, `fitted: to what`. The name of a table or of
  a part of the file stands for all of its numbers that have no source of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangesim.errors import FileFormatError
from rangesim.files.text_files import parse_toml, read_text
from rangesim.instrument.instrument import MAX_NAME, Instrument, instrument_from_dict, is_name
from rangesim.presets.data_sheet import DataSheet
from rangesim.rig import Spinning
from rangesim.settings.config import ShortRepr, check_keys, from_dict, nearest, shown

PARTS = ("title", "sheet", "instrument", "documents", "sources")
"""The parts of a file, all of which it has to have."""

STANDINGS = ("assumed", "computed", "fitted")
"""Standings of a number that no document states: chosen because nothing is known, computed from other numbers of the
file, or fitted to a published figure. The source has to say why, how, or to what."""

VIEW_TOLERANCE = 0.05
"""Fraction by which a head's angles may differ from those of its sheet, because sheets round them."""

VIEW_TOLERANCE_DEG = 1.0
"""Degrees by which they may differ in addition: a sheet may count the width of the beams, and a head with one ring has
an angle of 0 down."""


@dataclass(frozen=True, eq=False, repr=False)
class Preset(ShortRepr):
    """A device: its instrument, what its data sheet states, and where each number comes from.

    Parameters
    ----------
    name : name of the instrument: that of the file without its suffix, unless the file states another.
    title : the device in words.
    sheet : DataSheet.
    instrument : Instrument.
    documents : full titles of documents by their short names.
    sources : source of every setting that is a number or a list of numbers, by its name, such as "sheet.range_m" or
        "instrument.sensor.modulation_hz".
    text : the file, as it stands on the disk.

    Examples
    --------
    >>> from rangesim import presets
    >>> one = presets.describe("azure-kinect-nfov")
    >>> one.kind, one.sheet.resolution_px
    ('Time of flight (AMCW)', (640, 576))
    >>> one.sources["sheet.range_m"]
    'microsoft: table of operating modes'
    """

    name: str
    title: str
    sheet: DataSheet
    instrument: Instrument
    documents: Mapping[str, str]
    sources: Mapping[str, str]
    text: str

    @property
    def kind(self) -> str:
        """The measuring principle in words."""
        return self.instrument.sensor.title

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of the settings that are assumed."""
        return tuple(name for name, source in self.sources.items() if standing(source) == "assumed")


def read_preset(path: str | Path) -> Preset:
    """The device that a TOML file describes.

    Raises
    ------
    FileFormatError
        The file is missing or no valid TOML, has an unknown key or a bad value, or a number has no source. The message
        names the place.
    """
    path = Path(path)
    try:
        text = read_text(path)
        return _preset(path.stem, parse_toml(text, path), text)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _preset(name: str, data: Mapping[str, Any], text: str) -> Preset:
    check_keys(data, PARTS, "device")
    if missing := [part for part in PARTS if part not in data]:
        raise ValueError(f"device: missing {', '.join(map(repr, missing))}.")
    if not isinstance(data["title"], str):
        raise ValueError(f"expected title as text, got {shown(data['title'])}.")
    for part in PARTS[1:]:
        if not isinstance(data[part], Mapping):
            raise ValueError(f"expected {part} as a table, got {shown(data[part])}.")
    sheet, given = from_dict(DataSheet, data["sheet"], "sheet"), data["instrument"]
    follows = sheet.settings(has_camera="camera" in given, has_projector="projector" in given)
    if "name" not in given and not is_name(name):
        raise ValueError(
            f"expected a file name of letters, digits, - and _, at most {MAX_NAME}, which is that of the instrument, "
            f"got {shown(name)}; or state its name under [instrument]."
        )
    decoder = given.get("decoder", {})
    if isinstance(decoder, Mapping):  # else it is refused below
        decoder = {**follows["decoder"], **decoder}
    instrument = instrument_from_dict({"name": name, **follows, **given, "decoder": decoder}, "instrument")
    camera = instrument.camera
    if camera is not None and (camera.width, camera.height) != sheet.resolution_px:
        size = "{} x {}".format(*sheet.resolution_px)
        raise ValueError(f"expected a camera of {size} pixels, as the sheet has, got {camera.width} x {camera.height}.")
    if isinstance(camera, Spinning):
        _check_turn(camera, sheet)
    numbers = list(numbers_of({"sheet": data["sheet"], "instrument": given}))
    sources = sources_of(numbers, data["sources"], data["documents"])
    return Preset(instrument.name, data["title"], sheet, instrument, data["documents"], sources, text)


def _check_turn(head: Spinning, sheet: DataSheet) -> None:
    """Raise ValueError if a head sees other angles than the sheet states."""
    across, down = abs(head.arc_deg), max(head.elevations_deg) - min(head.elevations_deg)
    for seen, stated in zip((across, down), sheet.field_of_view_deg, strict=True):
        if abs(seen - stated) > VIEW_TOLERANCE * stated + VIEW_TOLERANCE_DEG:
            stated_deg = "{:g} x {:g}".format(*sheet.field_of_view_deg)
            raise ValueError(
                f"expected a camera that sees {stated_deg} degrees, as the sheet has, got {across:g} x {down:g}."
            )


def numbers_of(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Names of the settings in a table that hold numbers; a list of numbers is one setting, texts and flags are none.

    Examples
    --------
    >>> list(numbers_of({"sheet": {"range_m": [0.5, 4.5], "range_along": "z", "noise": {"is_bound": True, "at": 1}}}))
    ['sheet.range_m', 'sheet.noise.at']
    """
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from numbers_of(value, f"{prefix}{key}.")
        elif _holds_numbers(value):
            yield f"{prefix}{key}"


def _holds_numbers(value: Any) -> bool:
    if isinstance(value, list):
        return any(_holds_numbers(v) for v in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def standing(source: str) -> str:
    """The short name of the document, or the word of `STANDINGS`, that a source begins with.

    Examples
    --------
    >>> standing("assumed: a common lens")
    'assumed'
    """
    return source.partition(":")[0].strip()


def sources_of(numbers: list[str], sources: Mapping[str, Any], documents: Mapping[str, Any]) -> dict[str, str]:
    """The source of each setting: its own, or that of the innermost table around it.

    Parameters
    ----------
    numbers : names of settings. sources : texts by the names of settings and of tables. documents : titles by short
        names.

    Raises
    ------
    ValueError
        A setting without source, a source without setting, an unknown document, or an assumption without a reason.

    Examples
    --------
    >>> sources_of(["sheet.range_m"], {"sheet": "sheet"}, {"sheet": "Data sheet of the device, 2020"})
    {'sheet.range_m': 'sheet'}
    >>> sources_of(["sheet.range_m"], {}, {})
    Traceback (most recent call last):
    ValueError: no source for sheet.range_m: name a document under [sources], or mark it "assumed: why".
    """
    for name, text in sources.items():
        if not any(number == name or number.startswith(f"{name}.") for number in numbers):
            raise ValueError(
                f"sources: {shown(name)} is no setting with a number in this file{nearest(name, numbers)}."
            )
        _check_source(name, text, documents)
    found = {}
    for number in numbers:
        parts = number.split(".")
        around = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
        source = next((sources[name] for name in around if name in sources), None)
        if source is None:
            raise ValueError(f'no source for {number}: name a document under [sources], or mark it "assumed: why".')
        found[number] = source
    return found


def _check_source(name: str, text: Any, documents: Mapping[str, Any]) -> None:
    if not isinstance(text, str):
        raise ValueError(f"expected the source of {name} as text, got {shown(text)}.")
    word, _, rest = text.partition(":")
    if word.strip() in STANDINGS:
        if not rest.strip():
            raise ValueError(f'expected the source of {name} to say more than {text!r}, such as "assumed: why".')
    elif not isinstance(documents.get(word.strip()), str):
        known = (*STANDINGS, *documents)
        raise ValueError(
            f"expected the source of {name} to begin with one of {', '.join(known)}, "
            f"got {shown(text)}{nearest(word, known)}."
        )
