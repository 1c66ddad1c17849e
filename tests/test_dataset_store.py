# SPDX-License-Identifier: Apache-2.0
"""Stores of data sets: what is in a sample, shards that survive every kill, checks, and exports that others read."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from browser import BROWSER, browser
from PIL import Image

from rangesim.campaign import Outcome
from rangesim.campaign.item_store import QuarantinedItem
from rangesim.cli.dataset import app
from rangesim.dataset import (
    DatasetSpec,
    Samples,
    Store,
    export_bop,
    export_coco,
    make_dataset,
    production,
    random_scene,
    spec_from_dict,
    verify_dataset,
)
from rangesim.dataset.bop_export import camera_of
from rangesim.dataset.contact_sheet import contact_sheet
from rangesim.dataset.sample import sample_bytes
from rangesim.dataset.sample_files import END_OF_TAR, SCENE_MEMBER, arrays_of, members_of, record_of, tar_segment
from rangesim.dataset.store import IndexRow, parquet_bytes, read_rows
from rangesim.errors import FileFormatError, RangesimWarning

SCENES = 3


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> DatasetSpec:
    """Two objects of primitives and one of a file, one sensor, 32 x 24 pixels."""
    path = tmp_path_factory.mktemp("models") / "peg.ply"
    trimesh.creation.cylinder(0.05, 0.2, sections=16).export(path)
    return spec_from_dict(
        {
            "scenes": SCENES,
            "width": 32,
            "height": 24,
            "spp": 4,
            "objects": [
                {"model": ["box", "torus"], "count": 2, "size_m": 0.2},
                {"model": str(path), "category": "peg"},
            ],
            "instrument": [{"sensor": "gray-phase"}],
        }
    )


@pytest.fixture(scope="module")
def sample(spec: DatasetSpec) -> Callable[[int], bytes]:
    """`sample_bytes`, which computes each scene once."""
    return cache(lambda number: sample_bytes(spec, number))


def inline(
    function: Any, items: Any, store: Any, workers: Any, tell: Any, on_done: Any, retry: bool = False
) -> Outcome:
    """`rangesim.campaign.run_items` in this process, one item after the other."""
    for key in items:
        if retry and store.is_quarantined(key):
            store.discard(key)
        if key not in store and not store.is_quarantined(key):
            content = function(items[key])
            store.write(key, content, items[key])
            on_done(key)
            assert key in store  # also if it is in a shard by now
            assert store.read(key) == content
    return Outcome(len(items), 0, store.quarantined)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, sample: Any) -> pytest.MonkeyPatch:
    """Data sets are made as by `in_process`."""
    in_process(monkeypatch, sample)
    return monkeypatch


def in_process(patch: pytest.MonkeyPatch, sample: Any) -> None:
    """Make data sets in this process, with a shard for each two scenes."""
    patch.setattr(production, "run_items", inline)
    patch.setattr(production, "sample_bytes", lambda spec, number: sample(number))
    patch.setattr(production, "SHARD_BYTES", len(sample(0)) + 1)


@pytest.fixture(scope="module")
def store(spec: DatasetSpec, sample: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("store") / "set"
    with pytest.MonkeyPatch.context() as patch:
        in_process(patch, sample)
        make_dataset(spec, folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- Samples -------------------------------------------------------------------------------------------------------


def test_a_scene_always_has_the_same_bytes(spec: DatasetSpec, sample: Any) -> None:
    assert sample_bytes(spec, 1) == sample(1)


def test_masks_hold_the_first_hits_and_depths_lie_on_the_models(spec: DatasetSpec, store: Path) -> None:
    samples = Samples(store)
    assert len(samples) == SCENES
    seen = 0
    for number, one in enumerate(samples):
        truth, scene = one["camera.1"], one["scene"]
        drawn = random_scene(spec, number)
        assert [each["category"] for each in scene["objects"]] == [each.category for each in drawn.objects]
        for mask, each in zip(truth["amodal"], scene["objects"], strict=True):
            visible = truth["instance"] == each["shape"]
            assert not (visible & ~mask).any()
            seen += int(visible.sum())
        assert np.isfinite(one["sensor.gray-phase"]["true_projector_column"]).sum() > 100
    assert seen > 50
    findings = verify_dataset(store)
    assert (findings.scenes, findings.failed, findings.problems) == (SCENES, 0, ())


def test_hidden_objects_have_amodal_masks() -> None:
    from rangesim.light_transport.hidden_shapes import shapes_on_rays
    from rangesim.scene import load_scene

    sphere = {"type": "sphere", "radius": 0.1, "bsdf": {"type": "diffuse"}}
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40.0, "film": {"type": "hdrfilm", "width": 16, "height": 12}},
            "behind": {**sphere, "center": [0.0, 0.0, 3.0]},
            "front": {**sphere, "center": [0.0, 0.0, 1.0]},
            "beside": {**sphere, "center": [0.3, 0.0, 1.0]},
        }
    )
    behind, front, beside = shapes_on_rays(scene, scene.rig())
    assert 0 < behind.sum() < front.sum()
    assert not (behind & ~front).any()
    assert not (beside & front).any()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_webdataset_reads_the_shards(store: Path) -> None:
    import webdataset

    urls = [str(path) for path in sorted((store / "shards").glob("*.tar"))]
    assert len(urls) == 2
    read = list(webdataset.WebDataset(urls, shardshuffle=False).decode())
    assert [one["__key__"] for one in read] == [f"{number:06d}" for number in range(SCENES)]
    for theirs, ours in zip(read, Samples(store), strict=True):
        assert theirs["scene.json"] == ours["scene"]
        for name in ("camera.1", "sensor.gray-phase"):
            assert sorted(theirs[f"{name}.npz"]) == sorted(ours[name])
            for key, array in ours[name].items():
                np.testing.assert_array_equal(theirs[f"{name}.npz"][key], array)


def test_frames_are_kept_on_request(spec: DatasetSpec) -> None:
    drawn = random_scene(spec, 0)
    from rangesim.dataset.sample import bytes_of

    members = members_of(bytes_of(drawn, 0, keeps_frames=True), "here")
    record = record_of(members, "here")
    frames = arrays_of(members, "frames.gray-phase.npz", "here", record.sizes("frames.gray-phase"))["camera_1"]
    assert frames.shape[1:] == (24, 32)
    assert frames.dtype == np.uint16


def test_only_wanted_members_are_read(store: Path) -> None:
    assert set(Samples(store, members=("camera.1",))[0]) == {"scene", "camera.1"}
    with pytest.raises(ValueError, match=r"did you mean 'camera\.1'"):
        Samples(store, members=("camera.2",))


# ---- Making --------------------------------------------------------------------------------------------------------


def test_a_run_that_is_killed_at_any_write_ends_with_the_same_bytes(
    spec: DatasetSpec, store: Path, tmp_path: Path, quick: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    write, clear = production.write_file, production._Packing.clear
    done = 0

    def limited(*args: Any, **settings: Any) -> None:
        nonlocal done
        if done == last:
            raise Killed
        done += 1
        write(*args, **settings)

    def killed_before_clearing(packing: Any) -> None:
        raise Killed

    quick.setattr(production, "write_file", limited)
    kills, last = 0, 0
    while True:
        try:
            done = 0
            make_dataset(spec, tmp_path / "set")
        except Killed:
            kills += 1
            last = kills % 3  # up to two writes go well before the next kill
            continue
        break
    assert kills >= 6
    assert contents(tmp_path / "set") == contents(store)
    quick.setattr(production, "write_file", write)
    quick.setattr(production._Packing, "clear", killed_before_clearing)
    with pytest.raises(Killed):
        make_dataset(spec, tmp_path / "other")
    quick.setattr(production._Packing, "clear", clear)
    make_dataset(spec, tmp_path / "other")
    assert contents(tmp_path / "other") == contents(store)


def test_scenes_that_fail_are_listed_with_their_error(
    spec: DatasetSpec, tmp_path: Path, quick: pytest.MonkeyPatch
) -> None:
    quick.setattr(production, "run_items", failing_on("000001"))
    outcome = make_dataset(spec, tmp_path / "set")
    assert outcome.exit_status == 1
    rows = Store(tmp_path / "set").rows
    assert [row.scene for row in rows] == [0, 1, 2]
    assert (rows[1].error, rows[1].traceback, rows[1].shard) == ("ValueError: no light", "Traceback ...", None)
    assert [one["scene"]["number"] for one in Samples(tmp_path / "set")] == [0, 2]
    findings = verify_dataset(tmp_path / "set")
    assert (findings.failed, findings.problems) == (1, ())
    assert "1 scenes failed" in str(findings)


def failing_on(*keys: str) -> Any:
    """`inline`, which fails on these items."""

    def failing(function: Any, items: Any, store: Any, *rest: Any) -> Outcome:
        for key in keys:
            store.quarantine(QuarantinedItem(key, "ValueError: no light", {}, "Traceback ..."))
        return inline(function, items, store, *rest)

    return failing


@pytest.mark.parametrize("failed", [("000000",), ("000001",), ("000002",), ("000000", "000001", "000002")])
def test_scenes_that_failed_are_computed_again_and_leave_no_trace(
    failed: tuple[str, ...], spec: DatasetSpec, store: Path, tmp_path: Path, quick: pytest.MonkeyPatch
) -> None:
    """Also if it is killed at any write."""

    class Killed(BaseException):
        pass

    def dying(*args: Any, **settings: Any) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed
        write(*args, **settings)

    quick.setattr(production, "run_items", failing_on(*failed))
    make_dataset(spec, tmp_path / "set")
    quick.setattr(production, "run_items", inline)
    assert make_dataset(spec, tmp_path / "set").exit_status == 1  # without `retry` nothing is computed
    write, allowed = production.write_file, 0
    quick.setattr(production, "write_file", dying)
    while True:
        left = allowed
        try:
            outcome = make_dataset(spec, tmp_path / "set", retry=True)
        except Killed:
            allowed += 1
            continue
        break
    assert allowed >= 4
    assert (outcome.exit_status, outcome.quarantined) == (0, ())
    assert contents(tmp_path / "set") == contents(store)


def test_scenes_without_an_object_are_said(tmp_path: Path, quick: pytest.MonkeyPatch) -> None:
    instrument, group = {"sensor": "ideal-tof"}, {"model": "box", "size_m": 1.0}
    spec = spec_from_dict({"scenes": 1, "objects": [group], "instrument": [instrument], "width": 8, "height": 6})
    quick.setattr(production, "sample_bytes", sample_bytes)
    with pytest.warns(RangesimWarning, match="1 of 1 scenes have no object"):
        make_dataset(spec, tmp_path / "set")


def test_a_store_of_another_specification_is_refused(spec: DatasetSpec, store: Path, tmp_path: Path) -> None:
    other = spec_from_dict(
        {"scenes": SCENES, "seed": 1, "objects": [{"model": "box"}], "instrument": [{"sensor": "ideal-tof"}]}
    )
    with pytest.raises(FileFormatError, match="another specification"):
        make_dataset(other, store)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(FileFormatError, match=r"holds 'mine\.txt'"):
        make_dataset(spec, tmp_path)


# ---- Checks --------------------------------------------------------------------------------------------------------


def test_verify_says_what_is_broken_and_where(store: Path, tmp_path: Path) -> None:
    shutil.copytree(store, tmp_path / "set")
    shard = tmp_path / "set" / "shards" / "000000.tar"
    content = bytearray(shard.read_bytes())
    content[5000] ^= 1
    shard.write_bytes(content)
    (model,) = (tmp_path / "set" / "models").iterdir()
    model.unlink()
    (tmp_path / "set" / "shards" / "more.tar").write_bytes(END_OF_TAR)
    problems = verify_dataset(tmp_path / "set").problems
    assert any("000000.tar was changed" in each for each in problems)
    assert any(f"{model.name} is missing" in each for each in problems)
    assert any("more.tar does not belong" in each for each in problems)
    assert any("scene 0: its bytes are not those that the index lists" in each for each in problems)


def test_changed_files_are_refused_when_samples_are_read(store: Path, tmp_path: Path) -> None:
    """Each byte of the record, the index and the settings counts, also where it still is valid JSON or Parquet."""
    copy = tmp_path / "set"
    shutil.copytree(store, copy)

    def read_all() -> None:
        for number, _ in enumerate(samples := Samples(copy)):
            record, members = samples.record(number)
            for index in range(len(record.objects)):
                samples.store.mesh(record, index, members)

    def refused(name: str, content: bytes) -> str:
        original = (copy / name).read_bytes()
        (copy / name).write_bytes(content)
        with pytest.raises(FileFormatError) as caught:
            read_all()
        (copy / name).write_bytes(original)
        return str(caught.value)

    first, second = ((copy / "shards" / f"{number:06d}.tar").read_bytes() for number in range(2))
    digit = first.index(b'"scale":1.') + len(b'"scale":')
    assert "scene 0: its bytes are not" in refused("shards/000000.tar", first[:digit] + b"2" + first[digit + 1 :])
    assert "scene 0" in refused("shards/000000.tar", second)
    (model,) = (copy / "models").iterdir()
    assert "its checksum is not its name" in refused(f"models/{model.name}", model.read_bytes()[:-1] + b"\1")
    rows = Store(copy).rows
    assert "index.parquet was changed" in refused("index.parquet", parquet_bytes(rows[::-1]))
    settings = (copy / "store.json").read_bytes()
    assert "store.json was changed" in refused("store.json", settings.replace(b'"seed": 0', b'"seed": 1'))
    sums = (copy / "checksums.txt").read_bytes()
    assert "checksums.txt is broken" in refused("checksums.txt", sums.replace(b"index", b"indfx"))
    assert "checksums.txt is broken" in refused("checksums.txt", sums[:-1])


def test_an_index_from_elsewhere_is_refused() -> None:
    row = IndexRow(0, 0, 0, 512, "0" * 64, 1, 0, (), ("amcw",), (1.0,), (0.0,), (0.0,))
    assert read_rows(parquet_bytes([row]), "here")[0].place == (0, 0, 512)
    for changed in ({"offset": -512}, {"size": None}, {"scene": None}, {"right": []}):
        with pytest.raises(FileFormatError, match="here"):
            read_rows(parquet_bytes([replace(row, **changed)]), "here")


def hostile_entry(**values: Any) -> bytes:
    entry = tarfile.TarInfo("000000.scene.json")
    for name, value in values.items():
        setattr(entry, name, value)
    return entry.tobuf(tarfile.GNU_FORMAT)


@pytest.mark.parametrize(
    "segment",
    [
        hostile_entry(name="../evil.json"),
        hostile_entry(type=tarfile.SYMTYPE, linkname="/etc/passwd"),
        hostile_entry(type=tarfile.GNUTYPE_SPARSE, size=1 << 60),
        hostile_entry(size=1 << 60),
        hostile_entry(size=-512),
        hostile_entry() * 2,
        hostile_entry(type=tarfile.XHDTYPE, size=0) * 5000,
        hostile_entry(mode=0o4777),
        b"no tar",
        b"",
    ],
)
def test_hostile_tar_files_are_refused(segment: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"^here"):
        members_of(segment, "here")


@pytest.mark.parametrize(
    ("part", "values"),
    [
        ("objects", {"shape": 99}),
        ("objects", {"T_world_part": [[0.0] * 4] * 4}),
        ("objects", {"sha256": "../" * 20}),
        ("objects", {"scale": -1.0}),
        ("cameras", {"T_world_camera": [[1.0]]}),
        ("sensors", {"name": "../../home"}),
        ("sensors", {"camera": 2}),
        ("sensors", {"rows": []}),
    ],
)
def test_records_that_contradict_themselves_are_refused(sample: Any, part: str, values: dict[str, Any]) -> None:
    record = json.loads(members_of(sample(0), "here")[SCENE_MEMBER])
    record[part][0] |= values
    with pytest.raises(FileFormatError, match=r"here: scene\.json is broken"):
        record_of({SCENE_MEMBER: json.dumps(record).encode()}, "here")


@pytest.mark.parametrize("what", ["pose", "mask", "array", "mesh"])
def test_verify_checks_masks_against_poses(
    spec: DatasetSpec, sample: Any, tmp_path: Path, quick: pytest.MonkeyPatch, what: str
) -> None:
    """Also where all checksums are right, because the data set was made so."""
    members = members_of(sample(0), "here")
    record = json.loads(members[SCENE_MEMBER])
    arrays = dict(np.load(io.BytesIO(members["camera.1.npz"])))
    biggest = int(np.argmax([(arrays["instance"] == each["shape"]).sum() for each in record["objects"]]))
    if what == "pose":
        record["objects"][biggest]["T_world_part"][0][3] += 0.03
    elif what == "mask":
        arrays["amodal"][biggest] = np.roll(arrays["amodal"][biggest], 5, axis=1)
    elif what == "array":
        arrays["normal"][3, 4] = 2
    else:
        record["objects"][0]["sha256"] = "0" * 64
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    changed = tar_segment(0, {**members, SCENE_MEMBER: json.dumps(record).encode(), "camera.1.npz": buffer.getvalue()})
    quick.setattr(production, "sample_bytes", lambda spec, number: sample(number) if number else changed)
    make_dataset(spec, tmp_path / "set")
    problems = verify_dataset(tmp_path / "set").problems
    assert problems
    assert all("scene 0" in each for each in problems)
    said = {"pose": "do not fit its pose", "mask": "do not fit its pose", "array": "from -1.001 to 1.001"}
    assert any(said.get(what, "is not the one of the record's checksum") in each for each in problems)


# ---- Exports -------------------------------------------------------------------------------------------------------


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


def test_bop_readers_find_poses_masks_and_depth(store: Path, tmp_path: Path) -> None:
    """By BOP's documented format: lengths in millimetres, matrices row by row, and one file of each kind for all
    images."""
    assert export_bop(store, tmp_path / "bop") == SCENES
    scene = tmp_path / "bop" / "train_gray-phase" / "000000"
    cameras, poses, infos = (read_json(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info"))
    models_info = read_json(tmp_path / "bop" / "models" / "models_info.json")
    compared = 0
    for one in (samples := Samples(store)):
        number, truth = one["scene"]["number"], one["camera.1"]
        camera = cameras[str(number)]
        K = np.reshape(camera["cam_K"], (3, 3))
        rays = camera_of(samples.record(number)[0], "gray-phase").rays_at(np.ones((24, 32), bool), (0.0, 0.0))[1]
        v, u = np.mgrid[:24, :32].reshape(2, -1)  # in BOP, the ray at integer coordinates is that of a pixel's centre
        np.testing.assert_allclose((rays / rays[:, 2:]) @ K.T, np.stack([u, v, np.ones_like(u)], axis=1), atol=1e-4)
        depth = pixels(scene / "depth" / f"{number:06d}.png") * camera["depth_scale"]
        reading_mm = 1e3 * np.nan_to_num(one["sensor.gray-phase"]["reading_m"])
        assert np.abs(depth - reading_mm).max() <= camera["depth_scale"]
        assert pixels(scene / "gray" / f"{number:06d}.png").shape == (24, 32)
        objects = zip(one["scene"]["objects"], poses[str(number)], infos[str(number)], strict=True)
        for i, (each, pose, info) in enumerate(objects):
            name = f"{number:06d}_{i:06d}.png"
            mask, visible = (pixels(scene / kind / name) > 0 for kind in ("mask", "mask_visib"))
            assert info["px_count_all"] == mask.sum()
            assert info["px_count_visib"] == visible.sum() == (truth["instance"] == each["shape"]).sum()
            mesh = trimesh.load(tmp_path / "bop" / "models" / f"obj_{pose['obj_id']:06d}.ply", process=False)
            size = [models_info[str(pose["obj_id"])][f"size_{axis}"] for axis in "xyz"]
            np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size, rtol=1e-5)
            diameter = models_info[str(pose["obj_id"])]["diameter"]
            assert max(size) <= diameter * 1.00001 <= np.linalg.norm(size) * 1.0001
            points = mesh.vertices @ np.reshape(pose["cam_R_m2c"], (3, 3)).T + pose["cam_t_m2c"]
            x, y = (points @ K.T)[:, :2].T / points[:, 2]
            left, top, width, height = info["bbox_obj"]
            if x.min() > -0.5 and y.min() > -0.5 and x.max() < 31.5 and y.max() < 23.5:
                compared += 1
                projected = 0.5 + np.array([x.min(), y.min(), x.max(), y.max()])
                np.testing.assert_allclose(projected, [left, top, left + width, top + height], atol=1.01)
    assert compared >= 3


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_pycocotools_reads_the_masks(store: Path, tmp_path: Path) -> None:
    from pycocotools.coco import COCO

    assert export_coco(store, tmp_path / "coco") == SCENES
    coco = COCO(str(tmp_path / "coco" / "annotations_gray-phase.json"))
    assert sorted(each["name"] for each in coco.cats.values())[-2:] in (["box", "peg"], ["peg", "torus"])
    masks = 0
    for one in Samples(store):
        number = one["scene"]["number"]
        (image,) = coco.loadImgs(number)
        assert pixels(tmp_path / "coco" / image["file_name"]).shape == (image["height"], image["width"])
        shapes = [each["shape"] for each in one["scene"]["objects"]]
        seen = [shape for shape in shapes if (one["camera.1"]["instance"] == shape).any()]
        for annotation, shape in zip(coco.loadAnns(coco.getAnnIds(number)), seen, strict=True):
            mask = one["camera.1"]["instance"] == shape
            np.testing.assert_array_equal(coco.annToMask(annotation), mask)
            left, top, width, height = annotation["bbox"]
            assert mask[top : top + height, left : left + width].sum() == annotation["area"] == mask.sum()
            masks += 1
    assert masks >= SCENES


def test_the_shards_are_tar_files(store: Path) -> None:
    with tarfile.open(store / "shards" / "000000.tar") as archive:
        entries = archive.getmembers()
    assert entries[0].name == "000000.scene.json"
    assert {entry.mtime for entry in entries} == {0}


def test_the_command_checks_and_exports(store: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    run = CliRunner().invoke
    assert "3 scenes checked, 0 problems" in run(app, ["verify", str(store)]).output
    assert run(app, ["export", str(store), "--format", "coco", "--out", str(tmp_path / "coco")]).exit_code == 0
    assert run(app, ["export", str(store), "--format", "voc", "--out", str(tmp_path / "voc")]).exit_code == 2
    assert "data set of another" not in run(app, ["no.toml", "--out", str(tmp_path / "x")]).output


# ---- The contact sheet ---------------------------------------------------------------------------------------------


def test_the_contact_sheet_shows_scenes_and_filters_them(store: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    target = tmp_path / "sheet.html"
    assert CliRunner().invoke(app, ["show", str(store), "--out", str(target)]).exit_code == 0
    page = target.read_text()
    assert page.count("<article") == SCENES
    assert page.count("data:image/png") == 4 * SCENES
    assert isinstance(CliRunner().invoke(app, ["show", str(store), "--out", str(target)]).exception, FileFormatError)


def test_a_folder_of_something_else_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"expected a data set of `rangesim dataset`, got .* has no store\.json"):
        Samples(tmp_path)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_a_browser_filters_the_contact_sheet_without_an_error(store: Path, tmp_path: Path) -> None:
    target = tmp_path / "sheet.html"
    target.write_text(contact_sheet(store))
    held = [{each["category"] for each in one["scene"]["objects"]} for one in Samples(store)]
    with browser(tmp_path) as page:
        for width in (1440, 400):
            page.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
            page.open(target)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            shown = "[...document.querySelectorAll('article')].filter((each) => !each.hidden).length"
            assert page.evaluate(shown) == SCENES
            page.evaluate("document.querySelector('input[value=torus]').click()")
            assert page.evaluate(shown) == sum("torus" in each for each in held)
            assert page.said == []
            assert page.evaluate("violations") == []
