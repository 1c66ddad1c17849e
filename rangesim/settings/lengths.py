# SPDX-License-Identifier: Apache-2.0
"""Lengths as people write them: a number and a unit."""

from __future__ import annotations

import re
from decimal import Decimal

EXPONENTS = {"nm": -9, "um": -6, "µm": -6, "mm": -3, "cm": -2, "m": 0, "km": 3}
"""Decimal exponent of each unit in metres."""
_LENGTH = re.compile(r"\s*([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]{1,3})?)\s*([^\W\d_]*)\s*", re.IGNORECASE)


def metres(text: str, name: str = "a length") -> float:
    """The length in metres that a text states by a number and a unit; a number alone is in metres.

    name : what the length is, for the message.

    Raises
    ------
    ValueError
        The text is no number with a unit of `EXPONENTS`.

    Examples
    --------
    >>> metres("2mm"), metres("0.5 m"), metres("0.002")
    (0.002, 0.5, 0.002)
    >>> metres("2 feet", "tolerance")
    Traceback (most recent call last):
    ValueError: expected tolerance to be a length such as '2mm', in nm, um, µm, mm, cm, m or km, got '2 feet'.
    """
    found = _LENGTH.fullmatch(text)
    exponent = EXPONENTS.get(found[2] or "m") if found else None
    if found is None or exponent is None:
        *units, last = EXPONENTS
        raise ValueError(
            f"expected {name} to be a length such as '2mm', in {', '.join(units)} or {last}, got {text[:60]!r}."
        )
    return float(Decimal(found[1]).scaleb(exponent))  # in decimal digits, so that "1.1mm" is 0.0011
