# SPDX-License-Identifier: Apache-2.0
"""Pictures of pages for README.md and docs/, cut from what a browser shows of them.

rangesim run tabletop --out out/demo
rangesim scan tabletop --path turntable --views 12 --width 320 --height 240 --out out/scan
rangesim calibrate POSES --points 9x6 --spacing 0.025 --out out/rig.json --report out/rig.html
PYTHONPATH=tests python scripts/page_pictures.py out/demo/report.html out/scan/report.html out/rig.html
"""

from __future__ import annotations

import argparse
import base64
import io
import tempfile
from pathlib import Path

from browser import Page, browser
from PIL import Image

IMAGES = Path(__file__).parent.parent / "docs" / "images"
WIDTH_PX = 960
"""Width of the window: three pictures fit side by side, and the pages' text has no empty margin."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("scan", type=Path)
    parser.add_argument("calibration", type=Path)
    pages = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, browser(Path(folder)) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=WIDTH_PX, height=1000, deviceScaleFactor=1, mobile=False)
        _cut(page, pages.report, ".maps h3", ".maps > .block:nth-child(3)", "report.png")
        _cut(page, pages.scan, "h1", "#seen", "scan_page.png")
        _cut(page, pages.calibration, "h1", "#boards", "calibration_page.png")


def _cut(page: Page, path: Path, first: str, end: str, name: str) -> None:
    """Write the part of a page from one element to the beginning of another one."""
    page.open(path)
    place = "document.querySelector('{}').getBoundingClientRect().top + scrollY"
    top, bottom = (page.evaluate(place.format(selector)) for selector in (first, end))
    clip = {"x": 0, "y": top - 20, "width": WIDTH_PX, "height": bottom - top, "scale": 1}
    shot = page.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)["data"]
    with Image.open(io.BytesIO(base64.b64decode(shot))) as picture:
        picture.convert("RGB").save(IMAGES / name, optimize=True)


if __name__ == "__main__":
    main()
