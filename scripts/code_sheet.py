# SPDX-License-Identifier: Apache-2.0
"""Draws the patterns of all codes of structured light on one sheet, docs/images/codes.png.

Each code has a panel. Each strip of it is a frame along the columns of a projector of 240 columns, the first frame on
top. Codes of many frames have thinner strips.

Usage: python scripts/code_sheet.py [OUT]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rangesim import StructuredLight
from rangesim.codes import Code
from rangesim.settings.config import has_defaults

COLUMNS = 240
"""Columns of the projector; each is `SCALE` pixels wide on the sheet."""
SCALE = 2
HEIGHT = 200
"""Height of the patterns of a code, pixels."""
ACROSS = 3
"""Number of panels side by side."""
MARGIN, TITLE = 16, 24
"""Pixels around a panel, and of the line above it."""
LINE = 150
"""Grey level of the lines around the frames, 0 to 255; it is neither that of a pattern nor that of the paper."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/images/codes.png"))
    args = parser.parse_args()
    panels = [panel(kind()) for _, kind in sorted(Code.known.items()) if has_defaults(kind)]
    width, height = panels[0].width + MARGIN, panels[0].height + MARGIN
    down = -(-len(panels) // ACROSS)
    sheet = Image.new("L", (ACROSS * width + MARGIN, down * height + MARGIN), 255)
    for number, drawn in enumerate(panels):
        sheet.paste(drawn, (MARGIN + number % ACROSS * width, MARGIN + number // ACROSS * height))
    sheet.save(args.out, optimize=True)
    print(args.out)


def panel(code: Code) -> Image.Image:
    """The frames of a code, with its name above them."""
    drawn = Image.new("L", (SCALE * COLUMNS + 2, TITLE + HEIGHT + 1), 255)
    names = code.names(COLUMNS)
    ink = ImageDraw.Draw(drawn)
    ink.text((0, 0), f"{code.type_name}: {len(names)} frames", fill=0, font=ImageFont.load_default(size=16))
    ink.rectangle((0, TITLE - 1, drawn.width, drawn.height), fill=LINE)
    frames = StructuredLight(COLUMNS, 8, code=code).patterns()[: len(names)]
    for number, frame in enumerate(np.uint8(np.rint(255 * np.clip(frames, 0, 1)))):
        top, end = (round(TITLE + HEIGHT * n / len(frames)) for n in (number, number + 1))
        gap = int(end - top > 5)  # lines between strips that are thick enough
        if end > top:
            strip = Image.fromarray(frame).resize((SCALE * COLUMNS, end - top - gap), Image.Resampling.NEAREST)
            drawn.paste(strip, (1, top))
    return drawn


if __name__ == "__main__":
    main()
