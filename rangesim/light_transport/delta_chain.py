# SPDX-License-Identifier: Apache-2.0
"""How far light is followed through delta interactions: glass, mirrors, thin panes, coats, holes.

They scatter nothing, so they do not count towards `max_depth`; they have a limit of their own, of surfaces in a row.
Photons, camera paths and glint share it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

MAX_CHAIN = 128
"""Delta interactions in a row, after which light is cut off. A pane has two faces, a hollow glass four."""
ROULETTE_AFTER = 8
"""Delta interactions in a row, after which Russian roulette may end the light."""


def survival(chain: Any, share: Any) -> Any:
    """Chance of light to go on after `chain` delta interactions that left `share` of it; survivors are divided by it.

    Lossless glass keeps all: its paths go on to the limit. Light that fades off metals ends in time.
    """
    return dr.select(chain > ROULETTE_AFTER, dr.minimum(share, 1), 1)
