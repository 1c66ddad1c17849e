# SPDX-License-Identifier: Apache-2.0
"""Spoilt captures are refused, mended or warned of in words that name the cause; none is read wrong in silence."""

from __future__ import annotations

import re

import pytest
from spoilt_captures import CASES, GRAY, PHASE, Case, answer, other_codes
from tiers import to_validate

from rangesim.capture import Capture
from rangesim.errors import DoubtWarning
from rangesim.sensors import StructuredLight, StructuredLightDecoder

QUICK = ("black before white", "rows first", "finest bit first", "fringes run backward", "a mirrored camera, both axes")
"""Cases that `make test` runs; the others are left to `make validate`."""

ALL = [(case, code) for case in CASES for code in case.codes]
EVERY = [(case, code) for case in CASES if not case.codes for code in other_codes()]
IS_QUICK = [case.name in QUICK and code == case.codes[-1] for case, code in ALL]


def name_of(value: object) -> str:
    return value.name if isinstance(value, Case) else str(value)


@pytest.mark.parametrize(
    ("case", "code"),
    [
        *(pair for pair, quick in zip(ALL, IS_QUICK, strict=True) if quick),
        *to_validate(*(pair for pair, quick in zip(ALL, IS_QUICK, strict=True) if not quick)),
    ],
    ids=name_of,
)
def test_what_is_wrong_is_named(case: Case, code: str) -> None:
    found = answer(case, code)
    assert found.verdict != "SILENT", found
    assert re.search(case.words, found.said), found


@pytest.mark.validation
@pytest.mark.skipif(not EVERY, reason="there are no other codes")
@pytest.mark.parametrize(("case", "code"), EVERY, ids=name_of)
def test_no_code_is_read_wrong_in_silence(case: Case, code: str) -> None:
    """Other codes may say it in other words, or decode all the same."""
    found = answer(case, code)
    assert found.verdict != "SILENT", found


@pytest.mark.parametrize("code", [GRAY, PHASE, *to_validate(*other_codes())])
def test_a_sound_capture_is_right_and_silent(code: str) -> None:
    found = answer(Case("sound", lambda given: given, ""), code)
    assert found.verdict == "right", found
    assert found.said == ""


def test_white_and_black_in_a_wrong_order_that_was_stated_are_said() -> None:
    """Phases tell the place without white and black, so that nothing but their brightness tells."""
    sensor = StructuredLight(64, 48, "phase-shift")
    frames = sensor.patterns()[[0, 1, 2, 3, 5, 4]]
    with pytest.warns(DoubtWarning, match="black is brighter than white at 100 % of the pixels"):
        StructuredLightDecoder().coordinates(Capture(frames, sensor))
