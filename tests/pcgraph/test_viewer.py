# SPDX-License-Identifier: Apache-2.0
"""The viewer's page: what its data decode to, and what Chromium makes of it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, OPTIONS, WITHOUT_WEBGL, Page, browser
from click.testing import Result
from PIL import Image
from typer.testing import CliRunner

import pcgraph
from pcgraph.cli import app
from pcgraph.io.ply import encode_ply
from pcgraph.viewer import view_page, views_page, write_view
from pcgraph.viewer.cloud_data import Shown, cloud_data
from pcgraph.viewer.node_colors import distinct_colors, node_colors

needs_browser = pytest.mark.skipif(BROWSER is None, reason="there is no Chromium")
UTM = np.array([431_000.5, 5_412_000.25, 312.0])


def unpacked(text: str, dtype: Any) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype)


def data_of(page: str, number: int = 0) -> dict[str, Any]:
    block = re.search(rf'<script type="application/json" id="cloud-{number}">(.*?)</script>', page)
    assert block
    return dict(json.loads(block[1]))


@pytest.fixture(scope="module")
def rich(boxes) -> tuple[pcgraph.Cloud, pcgraph.Segmentation]:
    """Two boxes on a plane, with a column of each kind, and their segmentation."""
    points, truth, seen = boxes
    points = points.reshape(-1, 3)
    rng = np.random.default_rng(3)
    columns: dict[str, np.ndarray] = {
        "intensity": rng.integers(0, 60_000, len(points)).astype(np.uint16),
        "gps_time": 1.6e9 + np.arange(len(points)) * 1e-3,
        "ring": rng.integers(0, 16, len(points)).astype(np.uint8),
        "flow": rng.random((len(points), 2)).astype(np.float32),
    }
    columns["flow"][5, 0] = np.nan
    colors = rng.integers(0, 256, (len(points), 3)).astype(np.uint8)
    return pcgraph.Cloud(points, colors=colors, labels=truth.reshape(-1).astype(np.int32), columns=columns), seen


def test_the_page_holds_every_point_and_column_to_a_step(rich: tuple[pcgraph.Cloud, pcgraph.Segmentation]) -> None:
    cloud = replace(rich[0], points=rich[0].points + UTM)
    data = data_of(view_page(cloud))
    steps = unpacked(data["positions"], "<u2").reshape(3, -1).T
    places = np.array(data["low"]) + np.array(data["step"]) * steps
    assert (np.abs(places - cloud.points) <= np.array(data["step"]) * 0.501).all()
    assert max(data["step"]) < 1e-4
    assert (unpacked(data["colors"], np.uint8).reshape(-1, 3) == cloud.colors).all()
    columns = {column["name"]: column for column in data["columns"]}
    assert list(columns) == ["label", "intensity", "gps_time", "ring", "flow_0", "flow_1"]
    for name in ("intensity", "gps_time", "flow_1"):
        one, wanted = columns[name], cloud.columns[name.split("_1")[0]]
        values = one["low"] + one["step"] * (unpacked(one["keys"], "<u2") - 1.0)
        wanted = wanted[:, 1] if wanted.ndim == 2 else wanted
        assert (np.abs(values - wanted) <= 0.501 * one["step"] + 1e-6).all()
    assert (
        np.rint(
            columns["intensity"]["low"]
            + columns["intensity"]["step"] * (unpacked(columns["intensity"]["keys"], "<u2") - 1.0)
        )
        == cloud.columns["intensity"]
    ).all()
    for name, wanted in (("label", cloud.labels), ("ring", cloud.columns["ring"])):
        keys = unpacked(columns[name]["keys"], "<u2")
        assert (np.array(columns[name]["values"], int)[keys - 1] == wanted).all()
    assert (unpacked(columns["flow_0"]["keys"], "<u2") == 0).tolist().index(True) == 5


def test_the_page_holds_the_tree_and_the_graph(rich: tuple[pcgraph.Cloud, pcgraph.Segmentation]) -> None:
    cloud, seen = rich
    tree = data_of(view_page(cloud, seen))["tree"]
    assert (unpacked(tree["leaf"], "<u2") == seen.supervoxels + 1).all()
    assert (unpacked(tree["parents"], "<i4") == seen.tree.parents).all()
    assert (unpacked(tree["objects"], "<i4") == seen.objects).all()
    edges, kinds = unpacked(tree["edges"], "<i4").reshape(-1, 2), unpacked(tree["edgeKinds"], np.uint8)
    touching = len(seen.graph.edges)
    assert (edges[:touching] == seen.graph.edges).all()
    assert ((kinds[:touching] == 1) == (seen.graph.edge_features.convexity < -np.radians(10))).all()
    assert (kinds[touching:] == 2).all()
    assert tree["objectCount"] == len(np.unique(seen.labels[seen.labels >= 0]))
    names = tree["featureNames"]
    features = unpacked(tree["features"], "<f4").reshape(len(names), -1)
    assert np.allclose(features[names.index("planarity")], seen.tree.features().planarity)
    for box in tree["boxes"]:
        own = cloud.points[seen.labels == box["object"]]
        assert box["count"] == len(own)
        assert (
            pcgraph.detection.OrientedBox(*map(np.array, (box["center"], box["axes"], box["size"])))
            .contains(own, 1e-6)
            .all()
        )


def test_points_that_were_not_measured_or_lie_far_away_are_counted() -> None:
    points = np.random.default_rng(0).random((20_000, 3))
    points[7] = np.nan
    points[8] = (1e6, 0, 0)
    data = cloud_data(Shown("x", pcgraph.Cloud(points)))
    assert (data["count"], data["unmeasured"], data["far"]) == (19_998, 1, 1)
    assert max(data["step"]) < 2e-5
    assert (unpacked(data["index"], "<u4") == np.delete(np.arange(20_000), [7, 8])).all()


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((3, 3), np.nan), np.zeros((1, 3)), np.ones((5, 3))])
def test_clouds_of_no_extent_have_a_page(points: np.ndarray) -> None:
    data = data_of(view_page(pcgraph.Cloud(points)))
    assert data["count"] == np.isfinite(points).all(axis=1).sum()
    assert min(data["step"]) > 0


def test_a_cut_into_n_segments_has_the_first_n_colours(rich: tuple[pcgraph.Cloud, pcgraph.Segmentation]) -> None:
    tree = rich[1].tree
    colors = node_colors(tree.parents, tree.moments.counts[: tree.n_leaves])
    for n in (1, 2, 5, tree.n_leaves):
        shown = np.unique(colors[tree.cut_nodes(n)], axis=0)
        assert (shown == np.unique(distinct_colors(n), axis=0)).all()


def test_foreign_text_stays_text() -> None:
    cloud = pcgraph.Cloud(np.zeros((1, 3)), columns={"</script><script>alert(1)": np.ones(1)})
    page = view_page(cloud, title="<img src=x onerror=alert(1)>\u202e")
    assert "<img" not in page
    assert "<script>alert" not in page
    assert page.count("</script>") == 2
    assert "\u202e" not in page


def test_the_page_names_no_place_in_the_network() -> None:
    page = view_page(pcgraph.Cloud(np.zeros((1, 3))))
    assert set(re.findall(r"https?://[\w./-]+", page)) <= {"http://www.w3.org/1999/xhtml", "http://www.w3.org/2000/svg"}


def test_what_is_no_cloud_or_another_clouds_segmentation_is_refused(
    rich: tuple[pcgraph.Cloud, pcgraph.Segmentation], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="expected a Cloud"):
        view_page(np.zeros((3, 3)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected the segmentation of this cloud"):
        write_view(tmp_path / "x.html", pcgraph.Cloud(np.zeros((3, 3))), rich[1])
    with pytest.raises(ValueError, match="at least one cloud"):
        views_page([], "x")
    assert not list(tmp_path.iterdir())


def test_view_writes_one_page_for_a_file_or_a_folder_and_replaces_none(tmp_path: Path) -> None:
    def view(source: Path, *more: str) -> Result:
        return CliRunner().invoke(app, ["view", str(source), "--out", str(tmp_path / "page.html"), *more])

    (tmp_path / "clouds").mkdir()
    rng = np.random.default_rng(0)
    for i in range(2):
        places = rng.random((50 + i, 3))
        ply = encode_ply({axis: places[:, k] for k, axis in enumerate("xyz")})
        (tmp_path / "clouds" / f"{i}.ply").write_bytes(ply)
    done = view(tmp_path / "clouds" / "0.ply")
    assert done.exit_code == 0, done.output
    assert data_of((tmp_path / "page.html").read_text())["count"] == 50
    refused = view(tmp_path / "clouds")
    assert refused.exit_code == 1
    assert "add --overwrite" in refused.output
    done = view(tmp_path / "clouds", "--overwrite")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "page.html").read_text()
    assert [data_of(page, i)["name"] for i in range(2)] == ["0.ply", "1.ply"]
    (tmp_path / "empty").mkdir()
    assert "has no point cloud" in view(tmp_path / "empty", "--overwrite").output
    assert "expected --out as the name of a file" in view(tmp_path / "clouds", "--out", "-").output
    assert data_of((tmp_path / "page.html").read_text(), 1)["count"] == 51


def test_view_opens_a_saved_segmentation(rich: tuple[pcgraph.Cloud, pcgraph.Segmentation], tmp_path: Path) -> None:
    cloud, seen = rich
    seen.save(tmp_path / "boxes.npz", cloud)
    done = CliRunner().invoke(app, ["view", str(tmp_path / "boxes.npz"), "--out", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    kept, wanted = data_of((tmp_path / "page.html").read_text()), data_of(view_page(cloud, seen))
    assert kept["tree"] == wanted["tree"]
    assert kept["columns"] == wanted["columns"]
    seen.save(tmp_path / "bare.npz")
    refused = CliRunner().invoke(app, ["view", str(tmp_path / "bare.npz"), "--out", str(tmp_path / "bare.html")])
    assert "saved without its cloud" in refused.output


# ---- In the browser ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page_of_boxes(rich: tuple[pcgraph.Cloud, pcgraph.Segmentation], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "boxes.html"
    write_view(path, *rich, title="Two boxes")
    return path


@contextmanager
def opened(
    path: Path, folder: Path, *, width: int = 1440, state: str = "", options: tuple[str, ...] = OPTIONS
) -> Iterator[Page]:
    """The page in a window of a width; at the end nothing was said, refused or asked of the network."""
    with browser(folder, options) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        page.open(path, state)
        yield page
        assert page.said == []
        assert page.evaluate("violations") == []
        assert page.evaluate("performance.getEntriesByType('resource').map((r) => r.name)") == []


def picture(page: Page) -> np.ndarray:
    """The pixels of the view, (h, w, 3) uint8."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    png = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
    left, top, right, bottom = page.evaluate(
        "(() => { const b = viewer.canvas.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })()"
    )
    return np.asarray(Image.open(BytesIO(png)).convert("RGB").crop((left, top, right, bottom - 40)))


def set_slider(page: Page, place: int) -> None:
    page.evaluate(
        f"""(() => {{ const s = document.getElementById("level"); s.value = {place};
        s.dispatchEvent(new Event("input")); }})()"""
    )


@needs_browser
def test_the_slider_recolours_and_a_click_shows_the_path(page_of_boxes: Path, tmp_path: Path) -> None:
    with opened(page_of_boxes, tmp_path) as page:
        objects = picture(page)
        set_slider(page, 0)
        one = picture(page)
        set_slider(page, 1000)
        finest = picture(page)
        covered = (one != one[0, 0]).any(axis=-1)
        assert covered.mean() > 0.1
        tones = [len(np.unique((image[covered] // 32).astype(int) @ [64, 8, 1])) for image in (one, objects, finest)]
        assert tones[0] < tones[1] < tones[2]
        assert page.evaluate("viewer.count === viewer.cloud.tree.leaves")
        page.click("#to-objects")
        page.click("#view", *page.evaluate(
            """(() => { viewer.draw(); const i = Math.floor(viewer.cloud.count / 2);
            const at = new THREE.Vector3(...viewer.local(i)).project(viewer.camera());
            return [0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y]; })()"""
        ))  # fmt: skip
        path = page.evaluate("[...document.querySelectorAll('#path li')].map((row) => row.textContent)")
        assert path[0].startswith("Supervoxel")
        assert path[-1].startswith("Root")
        assert any("this level" in row for row in path)
        said = page.evaluate("document.getElementById('picked').textContent")
        for word in ("intensity", "gps_time", "planarity", "normal", "tight box"):
            assert word in said, word


@needs_browser
@pytest.mark.validation
def test_colours_toggles_keys_and_the_dendrogram_work(page_of_boxes: Path, tmp_path: Path) -> None:
    """Every colouring draws another picture; so do boxes, edges, keys, projection, axis and a click on a branch."""
    with opened(page_of_boxes, tmp_path) as page:
        pictures = {}
        for name in page.evaluate("[...document.querySelectorAll('#color option')].map((o) => o.value)"):
            page.evaluate(f"viewer.color({json.dumps(name)})")
            pictures[name] = picture(page)
        names = list(pictures)
        assert len(names) == 12
        same = [
            (a, b)
            for i, a in enumerate(names)
            for b in names[i + 1 :]
            if (np.abs(pictures[a].astype(int) - pictures[b]) > 8).any(axis=-1).mean() < 0.01
        ]
        # The level is that of the objects, and the objects are the true ones.
        assert same == [("level", "object"), ("level", "column 0"), ("object", "column 0")]
        page.evaluate("viewer.color('level')")
        last = picture(page)

        def changes(act: str) -> bool:
            nonlocal last
            page.evaluate(act)
            before, last = last, picture(page)
            return bool(
                before.shape != last.shape or (np.abs(before.astype(int) - last) > 8).any(axis=-1).mean() > 1e-3
            )

        key = "viewer.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{}', shiftKey: {} }}))"
        acts = [
            "document.getElementById('show-boxes').click()",
            "document.getElementById('show-edges').click()",
            key.format("ArrowLeft", "false"),
            key.format("ArrowUp", "true"),
            key.format("+", "false"),
            "(() => { const p = document.getElementById('projection'); p.value = 'parallel'; "
            "p.dispatchEvent(new Event('change')); })()",
            "(() => { const u = document.getElementById('up'); u.value = '0 1 0'; "
            "u.dispatchEvent(new Event('change')); })()",
            "document.getElementById('reset').click()",
            key.format("Enter", "false"),
            key.format("Escape", "false"),
            "document.getElementById('show-branches').click()",
        ]
        for act in acts:
            assert changes(act) or "reset" in act, act
        branches = "document.querySelectorAll('#dendrogram path.branch').length"
        assert page.evaluate(branches) == 401  # 200 merges and their children
        line = "document.querySelector('#dendrogram line').getAttribute('x1')"
        coarse = float(page.evaluate(line))
        set_slider(page, 700)
        assert float(page.evaluate(line)) > coarse
        branch = "document.querySelectorAll('#dendrogram path.hit')[3]"
        page.evaluate(f"{branch}.dispatchEvent(new MouseEvent('click', {{ bubbles: true }}))")
        assert page.evaluate("viewer.chosen.node") == page.evaluate(f"+{branch}.dataset.node")
        assert page.evaluate("viewer.chosen.inside.reduce((a, b) => a + b, 0)") > 0


@needs_browser
@pytest.mark.validation
def test_a_drag_turns_and_the_wheel_zooms(page_of_boxes: Path, tmp_path: Path) -> None:
    with opened(page_of_boxes, tmp_path) as page:
        before = page.evaluate("viewer.eye.position.toArray()")
        page.drag("#view", 120)
        turned = page.evaluate("viewer.eye.position.toArray()")
        assert np.linalg.norm(np.subtract(before, turned)) > 0.1 * np.linalg.norm(before)
        assert page.evaluate("viewer.chosen") is None
        x, y = page.place("#view")  # a drag that ends where it began is no click
        page.mouse("mousePressed", (x, y), button="left", clickCount=1)
        for place in (x + 60, x):
            page.mouse("mouseMoved", (place, y), button="left", buttons=1)
        page.mouse("mouseReleased", (x, y), button="left", clickCount=1)
        assert page.evaluate("viewer.chosen") is None
        page.mouse("mouseWheel", page.place("#view"), deltaX=0, deltaY=-300)
        page.wait_for(f"viewer.eye.position.length() < {0.99 * float(np.linalg.norm(turned))}")


@needs_browser
@pytest.mark.validation
def test_without_webgl_there_is_a_still_picture_and_a_sentence(page_of_boxes: Path, tmp_path: Path) -> None:
    """The silhouette is that of WebGL's picture, and the slider and a click work as there."""
    (tmp_path / "with").mkdir()
    (tmp_path / "without").mkdir()
    with opened(page_of_boxes, tmp_path / "with") as page:
        page.evaluate("viewer.scene.shading = false")
        drawn = picture(page)
        assert page.evaluate("document.getElementById('still-note').hidden")
    with opened(page_of_boxes, tmp_path / "without", options=WITHOUT_WEBGL) as page:
        still = picture(page)
        assert "no WebGL" in page.evaluate("document.getElementById('still-note').textContent")
        assert not page.evaluate("document.getElementById('still-note').hidden")
        ground = [(np.abs(image.astype(int) - (16, 21, 29)) <= 2).all(axis=-1) for image in (drawn, still)]
        assert (ground[0] == ground[1]).mean() > 0.98
        set_slider(page, 1000)
        assert (picture(page) != still).any(axis=-1).mean() > 0.05
        page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2, 200)")
        assert page.evaluate("document.querySelectorAll('#path li').length") > 2


@needs_browser
@pytest.mark.validation
def test_a_folder_becomes_one_page_with_a_chooser(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shown = [Shown(f"cloud {i}", pcgraph.Cloud(rng.random((500 * (i + 1), 3)))) for i in range(3)]
    path = tmp_path / "three.html"
    path.write_text(views_page(shown, "Three"))
    with opened(path, tmp_path, state="cloud=1") as page:
        assert page.evaluate("document.getElementById('summary').textContent").startswith("1,000 points")
        page.evaluate("document.getElementById('file').value = 2")
        page.evaluate("document.getElementById('file').dispatchEvent(new Event('change'))")
        page.wait_for("document.getElementById('summary').textContent.startsWith('1,500 points')")
        assert page.evaluate("[...document.querySelectorAll('.of-tree')].every((part) => part.hidden)")


@needs_browser
@pytest.mark.validation
def test_clouds_of_few_points_and_of_no_extent_are_shown(tmp_path: Path) -> None:
    """No point, one, equal ones, columns without a value, and a tree of one supervoxel."""
    one = np.random.default_rng(0).random((40, 3)) * 1e-3
    shown = [
        Shown("none", pcgraph.Cloud(np.empty((0, 3)))),
        Shown("unmeasured", pcgraph.Cloud(np.full((4, 5, 3), np.nan), columns={"a": np.full((4, 5), np.nan)})),
        Shown("one", pcgraph.Cloud(np.zeros((1, 3)), columns={"a": np.array([np.nan])})),
        Shown("equal", pcgraph.Cloud(np.full((5, 3), 1e7 + 0.25), columns={"same": np.full(5, 2.5)})),
        Shown.of("few", pcgraph.Cloud(one), pcgraph.segment(one, voxel_size=0.1)),
    ]
    path = tmp_path / "few.html"
    path.write_text(views_page(shown, "Few"))
    for number, entry in enumerate(shown):
        folder = tmp_path / str(number)
        folder.mkdir()
        with opened(path, folder, state=f"cloud={number}") as page:
            for name in page.evaluate("[...document.querySelectorAll('#color option')].map((o) => o.value)"):
                page.evaluate(f"viewer.color({json.dumps(name)})")
            page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2, 500)")
            said = page.evaluate("document.getElementById('panel').innerText")
            assert "NaN" not in said
            assert "undefined" not in said
            assert entry.name != "equal" or ("2.500000" in said and "10000000.250000 m" in said)
            if entry.tree is not None:
                page.evaluate("document.getElementById('show-branches').click()")
                set_slider(page, 1000)
                assert page.evaluate("viewer.count") == entry.tree.tree.n_leaves


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The script of axe-core, from npm."""
    folder = tmp_path_factory.mktemp("axe")
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("there is no npm")
    done = subprocess.run(
        [npm, "install", "--no-audit", "--no-fund", "--prefix", folder, "axe-core@4.14.1"], timeout=120
    )
    if done.returncode:
        pytest.skip("npm cannot fetch axe-core")
    return (folder / "node_modules" / "axe-core" / "axe.min.js").read_text()


@needs_browser
@pytest.mark.validation
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1440])
def test_axe_finds_nothing_serious(page_of_boxes: Path, tmp_path: Path, axe: str, width: int, scheme: str) -> None:
    with opened(page_of_boxes, tmp_path, width=width) as page:
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        for toggle in ("show-branches", "show-edges", "show-boxes"):
            page.evaluate(f"document.getElementById('{toggle}').click()")
        page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2, 300)")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.evaluate(axe + "; 0")
        found = page.evaluate(
            """axe.run().then((r) => r.violations.filter((v) => ["serious", "critical"].includes(v.impact))
            .map((v) => `${v.id}: ${v.nodes.map((n) => n.html.slice(0, 80)).join(" | ")}`))"""
        )
        assert found == []


@needs_browser
@pytest.mark.validation
def test_a_million_points_recolour_without_being_sent_again(tmp_path: Path) -> None:
    """Software rendering: the figures are printed for docs/viewer.md. Moving the slider writes one small texture."""
    rng = np.random.default_rng(0)
    points = rng.random((1_000_000, 3)) * (12.0, 9.0, 0.002) + UTM
    points[:, 2] += 0.4 * np.floor(points[:, 0] % 4)
    cloud = pcgraph.Cloud(points)
    seen = pcgraph.segment(cloud)
    start = time.perf_counter()
    write_view(tmp_path / "million.html", cloud, seen)
    build = time.perf_counter() - start
    with opened(tmp_path / "million.html", tmp_path) as page:
        frame, moving, part, slide, sent = page.evaluate(
            """(() => { const gl = viewer.scene.renderer.getContext(), pixel = new Uint8Array(4);
            const done = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
            const turn = (moving) => { viewer.turn(0.03, 0); viewer.moving = moving; viewer.draw(); done(); };
            const time = (moving) => { const t = performance.now();
              for (let i = 0; i < 8; i++) turn(moving); return (performance.now() - t) / 8; };
            turn(false);
            const frame = time(false);
            time(true);
            const moving = time(true), part = viewer.part;
            viewer.moving = false;
            let sent = 0; const old = gl.bufferData.bind(gl); gl.bufferData = (...a) => { sent++; return old(...a); };
            const sub = gl.bufferSubData.bind(gl); gl.bufferSubData = (...a) => { sent++; return sub(...a); };
            let n = 1; const t = performance.now(); for (let i = 0; i < 20; i++) viewer.setCount(n += 37);
            const slide = (performance.now() - t) / 20; viewer.draw(); done();
            return [frame, moving, part, slide, sent]; })()"""
        )
        assert sent == 0
        assert part == 1.0 or moving < frame
        assert slide < 100
        size = (tmp_path / "million.html").stat().st_size / 1e6
        frames = f"frame {frame:.0f} ms, while it moves {moving:.0f} ms with {part:.3f} of the points (software)"
        print(f"page {size:.1f} MB in {build:.1f} s; {frames}; slider {slide:.1f} ms")  # noqa: T201
