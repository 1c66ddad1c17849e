# SPDX-License-Identifier: Apache-2.0
"""Laws of all codes, with random settings: encode, then decode, is the identity, or the pixel is refused."""

from __future__ import annotations

import re
import warnings
from contextlib import suppress
from dataclasses import fields, replace
from fnmatch import fnmatchcase

import numpy as np
import pytest
from flat_captures import all_columns, noisy
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from rangesim.capture import Capture
from rangesim.codes import AXES, Code, FringeConvention
from rangesim.codes.fringe_code import FringeCode
from rangesim.codes.fringe_stack import MIN_APART_TURNS
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.response import LightPath, NumpyMath
from rangesim.sensor import Background
from rangesim.sensors import StructuredLight, StructuredLightDecoder
from rangesim.settings.config import from_dict, to_dict

CODES = sorted(name for name, kind in Code.known.items() if kind.__module__.startswith("rangesim."))

CELL_CODES = {"binary", "ensemble", "gray", "max-min-stripe", "xor"}
"""Codes that tell cells from each other, and no place within a cell."""

MAX_ERROR_PX = 0.02
"""Largest error of a sub-pixel code without noise, projector pixels."""

SETTINGS = {
    "base_bit": st.integers(0, 2),
    "carrier_steps": st.integers(3, 5),
    "cell_px": st.integers(1, 5),
    "convention": st.builds(
        FringeConvention,
        st.sampled_from(["cos", "sin", "-cos", "-sin"]),
        st.sampled_from(["forward", "backward"]),
        st.sampled_from([0.0, 0.5, -3.0]),
    ),
    "line_px": st.floats(5.0, 9.0),
    "period_px": st.floats(8.0, 40.0),
    "step_px": st.floats(5.0, 9.0),
    "steps": st.integers(3, 7),
    "stripe_px": st.integers(3, 9),
}
"""Values of settings by the names of the fields; others keep their defaults."""


@st.composite
def sensors(draw: st.DrawFn, name: str) -> StructuredLight:
    """A sensor with a code of that name, random settings, sizes, axes and order of frames."""
    kind = Code.known[name]
    drawn = {f.name: draw(SETTINGS[f.name]) for f in fields(kind) if f.name in SETTINGS and draw(st.booleans())}
    axes = draw(st.sampled_from([("columns",), ("rows",), ("columns", "rows"), ("rows", "columns")]))
    width, height = (draw(st.integers(30, 140)) if axis in axes else 3 for axis in AXES)
    try:
        sensor = StructuredLight(width, height, kind(**drawn), axes)
    except ValueError:  # no such settings, or too few columns for them
        assume(False)
        raise
    absent = draw(st.lists(st.sampled_from(["white", "black", "*_inverse", "*_reverse"]), unique=True, max_size=3))
    shown = [one for one in sensor.frame_names() if not any(fnmatchcase(one, pattern) for pattern in absent)]
    for order in (shown, sensor.frame_names()):
        with suppress(ValueError):  # these frames do not suffice
            return StructuredLight(width, height, sensor.code, axes, tuple(draw(st.permutations(order))))
    raise AssertionError(f"{name} refuses all of its own frames")


def obeys_the_laws(sensor: StructuredLight) -> None:
    code = sensor.code
    again = from_dict(StructuredLight, to_dict(sensor))
    assert again == sensor
    assert hash(again) == hash(sensor)
    assert sensor.patterns().shape == (sensor.n_frames, sensor.projector_height, sensor.projector_width)
    for axis in sensor.axes:
        size = sensor.size(axis)
        names, patterns = code.names(size), code.patterns(size)
        assert len(set(names)) == len(names) == len(patterns)
        assert all(re.fullmatch(r"[A-Za-z0-9_.-]+", name) for name in names)
        assert set(code.representative(size)) <= set(names)
        assert patterns.dtype == np.float32
        assert 0 <= patterns.min() <= patterns.max() <= 1
        assert_responses_are_the_patterns(code, AXES.index(axis), size)
    assert_decodes_or_refuses(sensor)


def assert_responses_are_the_patterns(code: Code, axis: int, size: int) -> None:
    x = np.arange(size) + 0.5
    u, v = (x, np.zeros_like(x)) if axis == 0 else (np.zeros_like(x), x)
    path = LightPath(u=u, v=v, path_length_m=1.0, is_first=True)
    channels = [np.array(r.weights(path, NumpyMath()))[:, None] for r in code.responses(axis, size)]
    frames = np.array([*code.frames(size, channels, np.ones((1, size)))])[:, 0]
    np.testing.assert_allclose(frames, code.patterns(size), atol=1e-4)


def assert_decodes_or_refuses(sensor: StructuredLight) -> None:
    """A pixel is within half a cell of its place, or refused; with all frames, none is refused.

    Fringes may repeat after all pixels but one: then the first and the last one look alike.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # doubts have tests of their own
        seen = StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor))
    is_ok = seen.status == Status.OK
    if set(sensor.frame_names()) == set(StructuredLight.frame_names(as_the_code_orders(sensor))):
        inner = is_ok
        for axis, along in zip(AXES, (1, 0), strict=True):
            if axis in sensor.axes and isinstance(sensor.code, FringeCode):
                size = sensor.size(axis)
                if sensor.code.stack(size).apart(size)[0] < MIN_APART_TURNS:
                    inner = np.take(inner, range(1, size - 1), along)
        assert inner.all()
    allowed = MAX_ERROR_PX
    if sensor.code.type_name in CELL_CODES:
        allowed = 0.5 * getattr(sensor.code, "cell_px", 1) + 1e-3
    rows, columns = np.indices(is_ok.shape) + 0.5
    for found, place in ((seen.column, columns), (seen.row, rows)):
        if found is not None:
            assert np.abs(found - place)[is_ok].max(initial=0) <= allowed


def as_the_code_orders(sensor: StructuredLight) -> StructuredLight:
    """The sensor that shows all frames."""
    return StructuredLight(sensor.projector_width, sensor.projector_height, sensor.code, sensor.axes)


@pytest.mark.parametrize("name", CODES)
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_code_obeys_the_laws(name: str, data: st.DataObject) -> None:
    obeys_the_laws(data.draw(sensors(name)))


@pytest.mark.validation
@pytest.mark.parametrize("name", CODES)
@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_code_obeys_the_laws_with_many_settings(name: str, data: st.DataObject) -> None:
    obeys_the_laws(data.draw(sensors(name)))


LONE_BITS = ("white", "black", "*_bit*[0-9]")
"""Order of frames in which codes of bits show no inverse."""


@pytest.mark.parametrize("ambient_e", [0.0, 400.0], ids=["dark", "sunlit"])
@pytest.mark.parametrize(
    ("name", "order"),
    [
        *((name, ()) for name in CODES),
        *((name, LONE_BITS) for name in sorted(CELL_CODES)),
        ("gray-phase", (*LONE_BITS, "*phase*")),
    ],
)
def test_the_least_signal_is_that_of_the_thresholds(name: str, order: tuple[str, ...], ambient_e: float) -> None:
    """With twice the least light most pixels are read, and rightly; with half of it few are, with a tenth none.

    At the least light itself noise decides: a code of many frames is refused if one of them is too weak.
    """
    detector, size = Detector(), 640
    sensor = StructuredLight(size, 4, name, order=order)
    at_black = np.array([detector.black_level_dn])
    own_variance = float((detector.noise_dn(at_black)[0] / detector.gain_dn_e) ** 2)
    background = Background(np.full((1, 1), ambient_e), bright=1e4, noise_variance=own_variance)
    least_e = float(sensor.default_decoder.least_signal(sensor, background)[0, 0])
    flat, x = all_columns(sensor, rows=10)
    read = {}
    for factor in (0.1, 0.5, 2.0):
        signal_e = factor * least_e
        lit = replace(flat, frames=flat.frames + np.float32(ambient_e / signal_e))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RangesimWarning)
            seen = sensor.default_decoder.coordinates(noisy(lit, signal_e * detector.gain_dn_e))
        is_read = seen.status == Status.OK
        read[factor] = is_read.mean()
        allowed = 1.0 if seen.column_sigma_px is None else 1.0 + 5 * seen.column_sigma_px
        if factor == 2:
            assert (np.abs(seen.column - x) > allowed)[is_read].mean() < 0.015
    assert read[2.0] > 0.65
    assert read[0.5] < 0.05
    assert read[0.1] == 0
