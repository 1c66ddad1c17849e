# SPDX-License-Identifier: Apache-2.0
"""The viewer's page: what its data decode to, and what Chromium makes of it."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, OPTIONS, Page, browser
from PIL import Image

import pcgraph
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
