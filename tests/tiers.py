# SPDX-License-Identifier: Apache-2.0
"""Cases of a test that are left to `make validate`, where others of the same law stay in `make test`."""

from __future__ import annotations

from typing import Any

import pytest


def to_validate(*cases: Any) -> list[Any]:
    """Cases for `parametrize` that run in `make validate` alone; a tuple is one case of several arguments."""
    return [pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=pytest.mark.validation) for c in cases]


def draws(n: int, quick: int = 2) -> list[Any]:
    """Seeds 0 to n - 1, of which `make test` runs the first `quick`."""
    return [*range(min(quick, n)), *to_validate(*range(quick, n))]
