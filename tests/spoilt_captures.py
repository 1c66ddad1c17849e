# SPDX-License-Identifier: Apache-2.0
"""Spoilt captures of a plane: what `rangesim decode` makes of each, and what it says.

`python tests/spoilt_captures.py > docs/spoilt_captures.md` writes the table.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from synthetic import plane_signals, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.cli.decode_summary import likely_cause, status_fractions, unchecked
from rangesim.codes import Code, FringeConvention, GrayPhase, MicroPhaseShifting
from rangesim.conventions import detect_convention
from rangesim.decoding import decode
from rangesim.electronics.detector import Detector
from rangesim.errors import DoubtWarning
from rangesim.rig import Intrinsics, Rig
from rangesim.sensors import StructuredLight
from rangesim.settings.config import has_defaults

PROJECTOR = (640, 480)
CAMERA = (160, 160)
COLUMNS, BOTH = ("columns",), ("columns", "rows")
GRAY, PHASE = "gray", "gray-phase"

MAX_WRONG_FRACTION = 0.02
"""Largest fraction of the readings that may be wrong in a capture that counts as read right."""
TOLERANCE_CAMERA_PX = 0.5
"""Largest error of a right projector coordinate in pixels of the camera: an edge that is seen by a camera without blur
lies anywhere between two of its pixels."""
TOLERANCE_SIGMAS = 3.0
"""Largest error of a right coordinate by noise, in standard deviations: 0.3 % of the readings exceed it."""
TOLERANCE_Z = 0.05
"""Largest relative error of a right depth."""


def all_codes() -> list[str]:
    """Codes that have defaults and fit the projector."""
    return [name for name, kind in Code.known.items() if has_defaults(kind)]


def other_codes() -> list[str]:
    """Codes beside those that have cases of their own."""
    return [name for name in all_codes() if name not in (GRAY, PHASE)]


@dataclass(frozen=True)
class Given:
    """What a user gives to `rangesim decode`: images, a sensor as described, and perhaps a calibration."""

    frames: np.ndarray
    sensor: StructuredLight
    rig: Rig | None = None

    def of(self, prefix: str) -> list[int]:
        """Places of the frames whose names begin with `prefix`."""
        return [i for i, name in enumerate(self.sensor.frame_names()) if name.startswith(prefix)]

    def pick(self, *places: int) -> Given:
        return replace(self, frames=self.frames[list(places)])

    def swap(self, i: int, j: int) -> Given:
        places = list(range(len(self.frames)))
        places[i], places[j] = j, i
        return self.pick(*places)


@dataclass(frozen=True)
class Case:
    """A way to spoil a capture.

    codes : codes of the capture; none: all that have defaults, but those of the other cases.
    words : what the answer must match, as a regular expression; "": no words are needed where all is right.
    shows : another code for the capture than the one that the user states.
    """

    name: str
    spoil: Callable[[Given], Given]
    words: str
    codes: tuple[str, ...] = (GRAY, PHASE)
    axes: tuple[str, ...] = COLUMNS
    shows: Code | None = None
    is_calibrated: bool = False
    exposure_s: float = 1e-3
    gamma: float = 1.0


@dataclass(frozen=True)
class Answer:
    """What came of a capture.

    verdict : refused, mended, warned, right or SILENT. status : fractions of the pixels. said : all sentences.
    """

    verdict: str
    status: str
    said: str


@cache
def _scene(
    code: Code, axes: tuple[str, ...], exposure_s: float, gamma: float
) -> tuple[Given, np.ndarray, np.ndarray, float]:
    """A capture, true projector coordinates (h, w, 2) and depths (h, w), and the largest error of a right coordinate.

    The error by noise is the one that the decoder states for the sound capture, whose detector it knows.
    """
    sensor = StructuredLight(*PROJECTOR, code=code, axes=axes, projector_gamma=gamma)  # type: ignore[arg-type]
    rig = stereo_rig(*CAMERA, projector=Intrinsics.from_fov(*PROJECTOR, 70))
    signals = plane_signals(rig, sensor, ambient=0.01)
    capture = expose(signals, sensor, Detector(bits=8), exposure_s=exposure_s)
    given = Given(capture.frames.astype(np.uint8), replace(sensor, projector_gamma=1.0), rig)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)  # the gamma
        sound = sensor.default_decoder.coordinates(capture)
    sigmas = [s[np.isfinite(s)] for s in (sound.column_sigma_px, sound.row_sigma_px) if s is not None]
    noise_px = max((float(np.median(s)) for s in sigmas if len(s)), default=0.0)
    uv = signals.truth.projector_uv
    camera_px = float(np.median(np.abs(np.diff(uv[..., 0], axis=1))))
    return given, uv, signals.truth.z, max(TOLERANCE_CAMERA_PX * camera_px, TOLERANCE_SIGMAS * noise_px)


def answer(case: Case, code: str) -> Answer:
    """What `rangesim decode` makes of a spoilt capture of that code."""
    stated = Code.known[code]()
    sound, uv, z, tolerance_px = _scene(case.shows or stated, case.axes, case.exposure_s, case.gamma)
    if case.shows:
        sound = replace(sound, sensor=replace(sound.sensor, code=stated))
    given = case.spoil(sound if case.is_calibrated else replace(sound, rig=None))
    try:
        found = detect_convention(given.frames, given.sensor)
        capture = Capture(given.frames, found.sensor, given.rig)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = decode(capture)
    except ValueError as error:
        return Answer("refused", "", str(error))
    cause = likely_cause(image, capture)
    unknown = unchecked(image) if case.is_calibrated else None
    shares = ", ".join(f"{100 * x:.0f} % {name}" for name, x in status_fractions(image).items() if x >= 0.005)
    wrong = 0.0
    for coordinate, true in ((image.projector_column, uv[..., 0]), (image.projector_row, uv[..., 1])):
        if coordinate is not None and coordinate.shape == true.shape:
            read = np.isfinite(coordinate)
            off = np.abs(coordinate - true)[read] > tolerance_px
            wrong = max(wrong, float(off.mean()) if read.any() else 0.0)
    if case.is_calibrated and image.z.shape == z.shape and image.valid.any():
        wrong = max(wrong, float((np.abs(image.z / z - 1)[image.valid] > TOLERANCE_Z).mean()))
    said = " ".join([*found.findings, *image.notes, *image.doubts, *(f"{c}." for c in (cause, unknown) if c)])
    is_right = wrong <= MAX_WRONG_FRACTION and image.valid.mean() > 0.5
    is_mended = bool(found.findings or image.notes)
    if is_mended and is_right and not image.doubts:
        verdict = "mended"
    elif image.doubts or cause or unknown or is_mended:
        verdict = "warned"
    else:
        verdict = "right" if is_right else "SILENT"
    return Answer(verdict, shares, said)


# ---- Ways to spoil a capture -----------------------------------------------------------------------------------------


def _bits(given: Given, axis: str = "columns") -> list[int]:
    return given.of(f"{axis}_bit")


def _fringes(given: Given) -> list[int]:
    return given.of("columns_phase")


def _moved(given: Given, source: list[int], order: list[int]) -> Given:
    """The frames at `source` replaced by those at `order`."""
    places = list(range(len(given.frames)))
    for i, j in zip(source, order, strict=True):
        places[i] = j
    return given.pick(*places)


def _scaled(given: Given, places: list[int], factor: float) -> Given:
    frames = given.frames.astype(np.float64)
    frames[places] *= factor
    return replace(given, frames=np.clip(np.rint(frames), 0, 255).astype(np.uint8))


def _posed(given: Given, change: Callable[[np.ndarray], np.ndarray]) -> Given:
    assert given.rig is not None
    return replace(given, rig=replace(given.rig, T_camera_projector=change(given.rig.T_camera_projector)))


def _shorter_lens(given: Given, factor: float) -> Given:
    """The calibration of a camera of another size of image: focal length and principal point times a factor."""
    assert given.rig is not None
    camera = given.rig.pinhole
    scaled = {name: factor * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    return replace(given, rig=replace(given.rig, camera=replace(camera, **scaled)))


def _millimetres(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] *= 1000
    return pose


def _plain_binary(given: Given) -> Given:
    frames, places = given.frames.copy(), _bits(given)
    pairs = frames[places].reshape(-1, 2, *frames.shape[1:])
    shown = np.logical_xor.accumulate(pairs[:, 0] > pairs[:, 1], axis=0)
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    frames[places] = np.stack([np.where(shown, high, low), np.where(shown, low, high)], axis=1).reshape(
        -1, *frames.shape[1:]
    )
    return replace(given, frames=frames)


def _clipped(given: Given) -> Given:
    return replace(given, frames=np.minimum(given.frames, int(np.percentile(given.frames[-2], 40))))


def _other_size(given: Given, width: int, height: int) -> Given:
    return replace(given, sensor=given.sensor.for_projector(width, height))


def _turned(given: Given, quarter: int) -> Given:
    return replace(given, frames=np.rot90(given.frames, quarter, axes=(1, 2)).copy())


def _n(given: Given) -> int:
    return len(given.frames)


def _lost_and_repeated(given: Given) -> Given:
    """The sixth frame is missing, and the seventh is there twice."""
    return given.pick(*range(5), *range(6, 7), *range(6, _n(given)))


def _alone(given: Given, lost: int | None = None) -> Given:
    """White, black, and the patterns without their inverses and without the bit of the place `lost`."""
    patterns = [i for k, i in enumerate(_bits(given)[::2]) if k != lost]
    return given.pick(-2, -1, *patterns)


MIRRORED = "mirrored"
CASES = [
    Case("black before white", lambda g: g.swap(-2, -1), "black before white"),
    Case("white and black first", lambda g: g.pick(-2, -1, *range(_n(g) - 2)), "white and black come first"),
    Case("no white and black", lambda g: g.pick(*range(_n(g) - 2)), "no white and black"),
    Case(
        "12 bits in 16",
        lambda g: replace(g, frames=(g.frames.astype(np.uint16) * 16)),
        r"brightest value is \d+ of 65535: give --bits 12",
    ),
    Case("an exposure that is too short", lambda g: g, "brightest value is", exposure_s=1.5e-5),
    Case(
        "rows first",
        lambda g: g.pick(*g.of("rows"), *g.of("columns"), -2, -1),
        "rows were shown before columns",
        axes=BOTH,
    ),
    Case("a pattern and its inverse exchanged", lambda g: g.swap(*_bits(g)[4:6]), "inverse seem to be exchanged"),
    Case("two pairs exchanged", lambda g: g.swap(2, 6).swap(3, 7), "each with its inverse, seem to be exchanged"),
    Case("two patterns exchanged", lambda g: g.swap(2, 6), "do not add up|exchanged"),
    Case("inverses before patterns", lambda g: _moved(g, b := _bits(g), [i ^ 1 for i in b]), "inverse stands before"),
    Case(
        "finest bit first",
        lambda g: _moved(g, b := _bits(g), [j for k in range(len(b) - 2, -1, -2) for j in (b[k], b[k + 1])]),
        "finest bits come first",
    ),
    Case(
        "patterns, then inverses",
        lambda g: g.pick(*(b := _bits(g))[::2], *b[1::2], *range(len(b), _n(g))),
        "all patterns",
    ),
    Case("one fringe lost, one repeated", lambda g: _moved(g, [_fringes(g)[1]], [_fringes(g)[0]]), "repeats", (PHASE,)),
    Case(
        "one fringe missing",
        lambda g: g.pick(*[i for i in range(_n(g)) if i != _fringes(g)[1]]),
        "contradict",
        (PHASE,),
    ),
    Case("a black fringe", lambda g: _moved(g, [_fringes(g)[2]], [_n(g) - 1]), "black everywhere", (PHASE,)),
    Case("a projector's gamma of 2.2", lambda g: g, "linear|gamma", (PHASE,), gamma=2.2),
    Case("a projector's gamma of 1.4", lambda g: g, "linear|gamma", (PHASE,), gamma=1.4),
    Case("a period of 20 stated as 16", lambda g: g, "period", (PHASE,), shows=GrayPhase(20.0)),
    Case("five fringes stated as four", lambda g: g, "expected", (PHASE,), shows=GrayPhase(steps=5)),
    Case("fringes start at sine", lambda g: g, "as sin", (PHASE,), shows=GrayPhase(convention=FringeConvention("sin"))),
    Case(
        "fringes run backward",
        lambda g: g,
        "towards smaller",
        (PHASE,),
        shows=GrayPhase(convention=FringeConvention("cos", "backward")),
    ),
    Case(
        "fringes are minus cosine and run backward",
        lambda g: g,
        "towards smaller",
        (PHASE,),
        shows=GrayPhase(convention=FringeConvention("-cos", "backward")),
    ),
    Case(
        "phase 0 at a pixel's centre",
        lambda g: g,
        "centre of the first pixel",
        (PHASE,),
        shows=GrayPhase(convention=FringeConvention(origin_px=0.5)),
    ),
    Case(
        "fringes 3 px late",
        lambda g: g,
        r"3\.\d projector pixels too late",
        (PHASE,),
        shows=GrayPhase(convention=FringeConvention(origin_px=3.0)),
    ),
    Case("fringes first", lambda g: g.pick(*_fringes(g), *_bits(g), -2, -1), "phase images come before", (PHASE,)),
    Case("a mirrored camera", lambda g: replace(g, frames=g.frames[:, :, ::-1].copy()), MIRRORED, is_calibrated=True),
    Case("a mirrored camera, both axes", lambda g: replace(g, frames=g.frames[:, :, ::-1].copy()), MIRRORED, axes=BOTH),
    Case("a camera turned by 90 degrees", lambda g: _turned(g, 1), "turned by 90", is_calibrated=True),
    Case("a camera turned by 90 degrees, no calibration", lambda g: _turned(g, 1), "turned by 90"),
    Case("a camera turned by 180 degrees", lambda g: _turned(g, 2), "turned by 180", is_calibrated=True, axes=BOTH),
    Case("a calibration in millimetres", lambda g: _posed(g, _millimetres), "millimetres", is_calibrated=True),
    Case(
        "an inverted calibration", lambda g: _posed(g, np.linalg.inv), "alone do not check|inverted", is_calibrated=True
    ),
    Case(
        "an inverted calibration, both axes",
        lambda g: _posed(g, np.linalg.inv),
        "inverted",
        is_calibrated=True,
        axes=BOTH,
    ),
    Case("a calibration at half the size", lambda g: _shorter_lens(g, 0.5), "beside the projector", is_calibrated=True),
    Case("a calibration with one axis", lambda g: g, "alone do not check", is_calibrated=True),
    Case("levels that clip at 40 % of the pixels", _clipped, ""),
    Case("plain binary", _plain_binary, "plain binary"),
    Case("a brighter frame", lambda g: _scaled(_scaled(g, list(range(_n(g))), 0.5), [_bits(g)[3]], 2.0), "exposure"),
    Case("a fringe exposed 1.3 times", lambda g: _scaled(g, [_fringes(g)[1]], 1.3), "exposure", (PHASE,)),
    Case("two frames the same", lambda g: _moved(g, [_bits(g)[2]], [_bits(g)[4]]), "same|add up"),
    Case("one frame lost, one repeated", _lost_and_repeated, "add up|same|repeat"),
    Case(
        "one frame missing",
        lambda g: g.pick(*range(5), *range(6, _n(g))),
        r"bit\d or of its inverse seems to be missing",
    ),
    Case("a dark stack", lambda g: replace(g, frames=np.zeros_like(g.frames)), "brightest value is 0"),
    Case("one image throughout", lambda g: g.pick(*[_n(g) - 2] * _n(g)), "half of the pixels change"),
    Case("white throughout", lambda g: replace(g, frames=np.full_like(g.frames, 255)), "expose shorter"),
    Case("a projector stated too small", lambda g: _other_size(g, 400, 480), "expected"),
    Case("a projector stated too large", lambda g: _other_size(g, 1280, 800), "size of the projector"),
    Case(
        "rows shown, columns stated",
        lambda g: replace(g, sensor=g.sensor.for_projector(480, 640, ("columns",))),
        "rows may have been shown",
        axes=("rows",),
    ),
    Case("two frames the same, any code", lambda g: _moved(g, [3], [2]), "same image|add up|repeats|one pattern", ()),
    Case("a mirrored camera, any code", lambda g: replace(g, frames=g.frames[:, :, ::-1].copy()), MIRRORED, (), BOTH),
    Case("a dark stack, any code", lambda g: replace(g, frames=np.zeros_like(g.frames)), "brightest value is 0", ()),
    Case("white throughout, any code", lambda g: replace(g, frames=np.full_like(g.frames, 255)), "expose shorter", ()),
    Case(
        "white and black first, any code", lambda g: g.pick(-2, -1, *range(_n(g) - 2)), "white and black come first", ()
    ),
    Case("black before white, any code", lambda g: g.swap(-2, -1), "black before white", ()),
    Case("patterns alone, cells of two pixels stated as one", lambda g: _alone(g, 9), "cell_px", (GRAY,)),
    Case("patterns alone, the coarsest lost", lambda g: _alone(g, 0), "no image is missing", (GRAY,)),
    Case("patterns alone, the fourth lost", lambda g: _alone(g, 3), "between the two seems to be missing", (GRAY,)),
    Case(
        "white and black for the coarsest bit",
        lambda g: _other_size(g.pick(-2, -1, *_bits(g)), 1280, 480),
        "size of the projector",
        (GRAY,),
    ),
    Case(
        "fringes read as bits",
        lambda g: g,
        "fringes seem to have been shown",
        (GRAY,),
        shows=MicroPhaseShifting(period_px=64.0),
    ),
    Case("frames in no order", lambda g: g.pick(*np.random.default_rng(0).permutation(_n(g))), "order|add up"),
]
"""Captures that were spoilt, each in one way."""


def table() -> str:
    """The table of all cases as Markdown."""
    lines = [
        "# Spoilt captures",
        "",
        "Captures of a plane that are spoilt, and what `rangesim decode` makes of each: *refused* with a sentence,",
        "*mended* (read right, with a sentence on what differs), *warned* (read, with a sentence on what is wrong), or",
        "*right*. `tests/test_spoilt_captures.py` checks that none is read wrong in silence.",
        "`python tests/spoilt_captures.py > docs/spoilt_captures.md` writes this page.",
        "",
        "| capture | code | verdict | pixels | what was said |",
        "| --- | --- | --- | --- | --- |",
    ]
    for case in CASES:
        for code in case.codes or other_codes():
            found = answer(case, code)
            said = found.said if len(found.said) <= 260 else f"{found.said[:257]}..."
            cells = (case.name, f"`{code}`", found.verdict, found.status, said.replace("|", "/"))
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(f"{table()}\n")
