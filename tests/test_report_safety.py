# SPDX-License-Identifier: Apache-2.0
"""No code from data: names of a crafted result are shown as they are, and the page's policy would stop them anyway."""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from browser import BROWSER, Page, browser
from small_result import SENSORS, small_result

from rangesim.errors import FileFormatError
from rangesim.report import write_report
from rangesim.report.content_security import StyleRules
from rangesim.results.experiment_results import Measurement, Result, load_result

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium found; apt-get install chromium")

PAYLOADS = (
    "<img src=x onerror=window.attacked=1>",  # a file name, too: it has no slash
    '"><script>window.attacked=1</script>',
    "'></style></title></script><script>window.attacked=1</script>",
    "<!--<script>",
    '" onmouseover="window.attacked=1" onload=window.attacked=1 x="',
    "<svg/onload=window.attacked=1>",
    "<iframe srcdoc='<script>parent.attacked=1</script>'></iframe>",
    "javascript:window.attacked=1",
    "#fff;background:url(https://example.org/x)",
    "{{ 7 * 7 }} ${window.attacked=1} `+(window.attacked=1)+`",
    "\\u003cimg src=x onerror=window.attacked=1\\u003e &lt;script&gt; %3Cscript%3E",
    "line\u2028paragraph\u2029end",
    "\u202egnp.exe\u2066\u2069 \u0007bell \ud800half",
)
FILE_NAME = PAYLOADS[0]
HOSTILE = " | ".join(PAYLOADS)
SHOWN = "".join(f"\\u{ord(c):04x}" if c in "\u2028\u2029\u202e\u2066\u2069\u0007\ud800" else c for c in HOSTILE)
"""What the page must show: marks that would turn or break its text are spelt out."""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.mark.validation
def test_a_crafted_directory_runs_no_script(page: Page, tmp_path: Path) -> None:
    """Each name is either refused by the reader or shown; material classes of the truth ran a script on hover once."""
    folder = tmp_path / "result"
    shutil.copytree(small_result(), folder)
    shown = [what for what, craft in CRAFTS.items() if _accepted(folder, craft)]
    write_report(load_result(folder), folder / "report.html")
    text = _explore(page, folder / "report.html")
    for what in shown:
        assert CRAFTS_SHOW.get(what, f"{what} {SHOWN}") in text, what


def test_a_crafted_result_runs_no_script(page: Page, tmp_path: Path) -> None:
    """Past every reader: sensors and instruments of hostile names as well."""
    write_report(_crafted_result(), tmp_path / "report.html")
    text = _explore(page, tmp_path / "report.html")
    for what in (
        "scene",
        "sensor",
        "details",
        "instrument 0",
        "instrument 1",
        "frame",
        "material",
        "row",
        "object",
        "setting",
        "version",
    ):
        assert f"{what} {SHOWN}" in text, what


def test_the_policy_stops_what_escaping_let_through(page: Page, tmp_path: Path) -> None:
    """The second wall, without the first: code, styles, frames, forms and requests put into the finished page."""
    html = (small_result() / "report.html").read_text(encoding="utf-8")
    attacks = {
        "script-src-attr": "<img src=data:, onerror=window.attacked=1>",
        "script-src-elem": "<script>window.attacked=1</script>",
        "style-src-attr": "<p style='color:red'>red</p>",
        "style-src-elem": "<style>h1 { color: red }</style>",
        "frame-src": "<iframe src='data:text/html,x'></iframe>",
        "img-src": "<img src='http://127.0.0.1:9/x.png'>",
        "base-uri": "<base href='http://127.0.0.1:9/'>",
        "object-src": "<object data='data:text/html,x'></object>",
        "media-src": "<video src='http://127.0.0.1:9/x.mp4'></video>",
    }
    path = tmp_path / "report.html"
    path.write_text(html.replace("</main>", "".join(attacks.values()) + "</main>"), encoding="utf-8")
    page.open(path)
    assert {v.split()[0] for v in page.evaluate("violations")} == set(attacks)
    assert page.evaluate("window.attacked === undefined")
    assert page.evaluate("getComputedStyle(document.querySelector('h1')).color") != "rgb(255, 0, 0)"
    refused = "(() => { try { document.body.%s } catch (error) { return error.name } return 'done' })()"
    assert page.evaluate(refused % "innerHTML = '<i>'") == "TypeError"  # trusted types: no markup from strings at all
    assert page.evaluate(refused % "insertAdjacentHTML('beforeend', '<i>')") == "TypeError"
    assert page.evaluate("fetch('http://127.0.0.1:9/').catch(() => 'refused')") == "refused"
    assert "connect-src http://127.0.0.1:9/" in [v.strip() for v in page.evaluate("violations")]
    page.evaluate(
        "(() => { const form = document.createElement('form'); form.action = 'http://127.0.0.1:9/';"
        " document.body.append(form); form.submit(); })()"
    )
    page.wait_for("violations.some((v) => v.startsWith('form-action'))")


@pytest.mark.validation
def test_a_hash_in_the_address_chooses_colours_and_nothing_else(page: Page) -> None:
    for state in ("color=constructor", "color=__proto__", "color=%22]&altitude=x", "color=cause&altitude=-1"):
        page.open(small_result() / "report.html", state)
        assert page.said == []
        assert page.evaluate("page.mode") == ("cause" if "cause" in state else "intensity")
        assert "NaN" not in page.evaluate("document.body.innerText")


@pytest.mark.parametrize("name", ["report.html.j2", "report.js", "scroll.js", "sensor_views.js"])
def test_no_door_for_markup_or_code_in_the_sources(name: str) -> None:
    source = (Path(write_report.__code__.co_filename).parent / name).read_text(encoding="utf-8")
    doors = (
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function|srcdoc|setAttribute|\|\s*safe\b"
    )
    assert not re.search(doors, source)
    assert not re.search(r"\sstyle=|\son[a-z]+=|setTimeout\([\"'`]", source)


@pytest.mark.parametrize("value", ["red;}</style><script>", "url(https://example.org)", "#fff}*{color:red", "", 'x"y'])
def test_a_rule_is_plain_css_or_refused(value: str) -> None:
    with pytest.raises(ValueError, match="expected plain CSS"):
        StyleRules().name(f"background:{value}")


def _edit(path: Path, change: Callable[[Any], None]) -> None:
    data = json.loads(path.read_text(encoding="utf-8"))
    change(data)
    path.write_text(json.dumps(data), encoding="utf-8")


def _arrays(path: Path, **changed: Any) -> None:
    with np.load(path) as data:
        np.savez(path, **{**{name: data[name] for name in data.files}, **changed})


def _info(change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda folder: _edit(folder / "experiment.json", change)


def _renamed_instrument(folder: Path) -> None:
    """A second instrument of one kind, so that the page tells them apart by name; it names a directory."""
    shutil.copytree(folder / "amcw", folder / FILE_NAME)
    _edit(
        folder / "experiment.json",
        lambda d: d["instruments"].append({**d["instruments"][1], "name": FILE_NAME}),
    )


def _truth(key: str, what: str) -> Callable[[Path], None]:
    def craft(folder: Path) -> None:
        for path in folder.glob("pass_*.npz"):
            with np.load(path) as data:
                names = data[key]
            _arrays(path, **{key: np.array([f"{what} {HOSTILE}"] * len(names))})

    return craft


def _rows(folder: Path) -> None:
    for path in folder.glob("*/comparison.json"):
        _edit(path, lambda d: d["rows"][0].update(material=f"row {HOSTILE}"))


CRAFTS: dict[str, Callable[[Path], None]] = {
    "scene": _info(lambda d: d["scene"].update(name=f"scene {HOSTILE}")),
    "checksum": _info(lambda d: d["scene"].update(sha256=f"checksum {HOSTILE}")),
    "version": _info(lambda d: d["versions"].update(python=f"version {HOSTILE}")),
    "package": _info(lambda d: d["versions"].update({f"package {HOSTILE}": "1"})),
    "variant": _info(lambda d: d.update(variant=f"variant {HOSTILE}")),
    "setting": _info(lambda d: d["experiment"].update(scene=f"setting {HOSTILE}")),
    "instance": _truth("truth_instance_names", "instance"),
    "material": _truth("truth_material_names", "material"),
    "row": _rows,
    "file name": _renamed_instrument,
}
"""Places in a result directory where a name comes from."""
CRAFTS_SHOW = {"instance": "", "file name": f"Time of flight (AMCW), {FILE_NAME}"}
"""What each shows where it is not its label and the payloads; instance names are not in the page."""


def _accepted(folder: Path, craft: Callable[[Path], None]) -> bool:
    """Whether the reader takes the directory with this change; where it refuses, the change is taken back."""
    before = folder.with_name("before")
    shutil.copytree(folder, before)
    craft(folder)
    try:
        load_result(folder)
    except FileFormatError:
        shutil.rmtree(folder)
        before.rename(folder)
        return False
    shutil.rmtree(before)
    return True


def _crafted_result() -> Result:
    plain = load_result(small_result())
    names = tuple(f"instrument {i} {HOSTILE}" for i in range(len(plain.measurements)))
    measurements = tuple(
        _crafted(m, name, i < 2) for i, (m, name) in enumerate(zip(plain.measurements, names, strict=True))
    )
    info = msgspec.structs.replace(
        plain.info,
        scene=msgspec.structs.replace(plain.info.scene, name=f"scene {HOSTILE}", sha256=HOSTILE),
        variant=HOSTILE,
        versions={f"version {HOSTILE}": HOSTILE},
        experiment={f"setting {HOSTILE}": HOSTILE, "instrument": [{HOSTILE: [HOSTILE]}]},
    )
    return replace(plain, measurements=measurements, info=info)


def _crafted(m: Measurement, name: str, sensor_as_well: bool) -> Measurement:
    capture: Any = m.capture
    if sensor_as_well:
        frames = [f"frame {HOSTILE}"] * len(capture.frames)
        sensor = SimpleNamespace(
            type_name=f"sensor {HOSTILE}",
            title=f"sensor {HOSTILE}",
            details=f"details {HOSTILE}",
            is_ideal=False,
            frame_names=lambda: frames,
            representative_frames=lambda _: [0],
        )
        capture = copy.copy(m.capture)
        object.__setattr__(capture, "sensor", sensor)
    truth = replace(m.truth, material_names=tuple(f"material {HOSTILE}" for _ in m.truth.material_names))
    rows = [{**row, "name": f"row {HOSTILE}" if row["kind"] == "object" else row["name"]} for row in m.rows]
    objects = tuple(replace(o, name=f"object {HOSTILE}", merged_with=(HOSTILE,)) for o in m.objects.objects[:1])
    return replace(m, name=name, capture=capture, truth=truth, rows=rows, objects=replace(m.objects, objects=objects))


def _explore(page: Page, path: Path) -> str:
    """Use the whole page as a reader would; its text. Asserts that it works, and that nothing of the data ran."""
    page.open(path)
    page.click("summary")
    texts = []
    for kind in (1, 2, 3):
        page.mouse("mouseMoved", page.place(f".grid .panel:nth-child({kind}) .map", 0.5, 0.9))
        texts.append(page.evaluate("document.querySelector('#probe').textContent"))
        assert re.match(r"\(\d+, \d+\) ", texts[-1])
    pictures = []
    for mode in ("intensity", "error", "cause", "material", "segments"):
        page.click(f"input[value={mode}]")
        assert page.evaluate("page.mode") == mode
        pictures.append(_canvases(page))
    assert len(set(pictures)) > 3  # where all materials are one, their picture shows intensity
    for place, said in ((0.01, "whole scene"), (0.99, "supervoxels")):
        page.click("#level", x=place)
        assert said in page.evaluate("document.querySelector('#altitude').textContent") or place > 0.5
        texts.append(page.evaluate("document.querySelector('#altitude').textContent"))
    assert texts[-1] != texts[-2]
    page.drag("canvas.cloud", 60)
    assert page.evaluate("page.view.yaw") > -0.4
    page.click("#reset")
    assert page.evaluate("page.view.yaw") == -0.45
    assert page.evaluate("window.attacked === undefined")
    assert page.evaluate("[...document.images].every((i) => i.complete && i.naturalWidth > 0)")
    assert page.evaluate("document.images.length") > 20
    assert (
        page.evaluate("document.querySelectorAll('script, style, iframe, base, form, main svg, [onload]').length") == 3
    )
    assert page.evaluate("violations") == []
    assert page.said == []
    texts.append(page.evaluate("[document.title, ...[...document.images].map((i) => i.alt)].join('\\n')"))
    texts.append(page.evaluate("document.querySelector('header').textContent"))
    texts.append(page.evaluate("document.querySelector('main').textContent"))
    return "\n".join(texts)


def _canvases(page: Page) -> str:
    """The pictures of all canvases, none of them of one colour."""
    draw = "page.clouds.forEach((cloud) => cloud.draw());"  # a picture of WebGL does not stay
    colours = (
        draw
        + """[...document.querySelectorAll("canvas")].map((canvas) => {
        const copy = document.createElement("canvas"), context = copy.getContext("2d");
        copy.width = canvas.width; copy.height = canvas.height;
        context.drawImage(canvas, 0, 0);
        return new Set(new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer)).size; })"""
    )
    counts = page.evaluate(colours)
    assert len(counts) >= 2 * len(SENSORS)
    assert min(counts) > 3, counts
    return "".join(page.evaluate(draw + "[...document.querySelectorAll('canvas.cloud')].map((c) => c.toDataURL())"))
