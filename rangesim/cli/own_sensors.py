# SPDX-License-Identifier: Apache-2.0
"""The option that names sensors of the user's own in a result."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import typer

OwnSensors = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor",
        help="A sensor of your own that the result contains, as FILE.py:NAME. The file is run. Repeat the option "
        "for several sensors.",
        show_default=False,
    ),
]


def load_own_sensors(names: Iterable[str] | None) -> None:
    """Load the classes of sensors, so that a result that contains them can be read."""
    from rangesim.sensors import sensor_of

    for name in names or ():
        sensor_of(name)  # from then on the sensor's class is known by its type_name
