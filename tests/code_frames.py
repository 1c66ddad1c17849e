# SPDX-License-Identifier: Apache-2.0
"""Where frames of a code stand in a capture of structured light."""

from __future__ import annotations

from rangesim.sensors import StructuredLight


def run_of(sensor: StructuredLight, prefix: str) -> slice:
    """Place of the frames whose names start with `prefix`, such as "columns_bit"; they follow each other."""
    places = [i for i, name in enumerate(sensor.frame_names()) if name.startswith(prefix)]
    return slice(places[0], places[-1] + 1)
