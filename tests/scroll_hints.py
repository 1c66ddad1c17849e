# SPDX-License-Identifier: Apache-2.0
"""Whether the tables of a page say that they scroll, as a reader sees it."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from browser import Page
from PIL import Image

BOXES = """[...document.querySelectorAll(".scroll")].map((box) => {
    const { left, top, width } = box.getBoundingClientRect();
    const height = box.querySelector("table").getBoundingClientRect().top - top;
    const hint = getComputedStyle(box, "::before").content, wider = box.scrollWidth > box.clientWidth;
    const focus = box.tabIndex === 0;
    return { left: left + scrollX, top: top + scrollY, width, height, hint, wider, focus }; })"""


def check_scroll_hints(page: Page, path: Path) -> None:
    """At 400 pixels each table that is wider has a line before it, also after scrolling; a wide window shows none."""
    _resize(page, 400)
    page.open(path)
    boxes = page.evaluate(BOXES)
    assert any(box["wider"] for box in boxes)
    for number, box in enumerate(boxes):
        assert ("scroll it sideways" in box["hint"]) == box["wider"] == box["focus"]
        seen = _ink(page, box)
        page.evaluate(f"document.querySelectorAll('.scroll')[{number}].scrollLeft = 10")  # text at whole pixels
        np.testing.assert_array_equal(_ink(page, box), seen)
        if box["wider"]:
            assert 0.01 < seen.mean() < 0.3  # a line of text
        else:
            assert not seen.any()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    _resize(page, 1280)
    page.wait_for("document.querySelector('.scroll.scrolls') === null")
    for box in page.evaluate(BOXES):
        assert box["hint"] == "none"
        assert not box["wider"]
        assert not _ink(page, box).any()
    assert page.said == []


def _resize(page: Page, width: int) -> None:
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=1000, deviceScaleFactor=1, mobile=False)


def _ink(page: Page, box: dict[str, Any]) -> np.ndarray:
    """(h, w) bool of the page between the top of a box and its table: whether a pixel is dark."""
    clip = {"x": box["left"], "y": box["top"], "width": box["width"], "height": box["height"], "scale": 1}
    answer = page.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
    with Image.open(io.BytesIO(base64.b64decode(answer["data"]))) as picture:
        return np.asarray(picture.convert("L")) < 200
