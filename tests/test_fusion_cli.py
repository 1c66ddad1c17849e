# SPDX-License-Identifier: Apache-2.0
"""`rangesim scan`: what it writes, what it refuses, and its page."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from browser import BROWSER, browser
from fusion_scenes import part
from scroll_hints import check_scroll_hints
from small_result import ROOT
from tiers import to_validate
from typer.testing import CliRunner

from rangesim import load_range_image
from rangesim.cli import app
from rangesim.errors import FileFormatError
from rangesim.experiment import Dome, Turntable
from rangesim.experiment.scan_settings import (
    ScanSettings,
    load_scan_settings,
    scan_settings_from_dict,
    scan_settings_to_dict,
)
from rangesim.rig import look_at
from rangesim.settings import limits

Run = Callable[..., str]


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["scan", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scan") / "out"
    run("matte", "--views", "4", "--width", "96", "--spp", "4", "--out", str(out))
    return out


def test_a_scan_writes_mesh_poses_views_and_statistics(scanned: Path) -> None:
    mesh = trimesh.load_mesh(scanned / "mesh.ply", process=False)
    assert len(mesh.faces) > 1000
    record = json.loads((scanned / "scan.json").read_text())
    assert record["format"] == "rangesim-scan"
    assert record["statistics"]["triangles"] == len(mesh.faces)
    assert record["statistics"]["shapes"]["large_ball"]["accuracy_m"] < 3e-3
    assert 0.3 < record["statistics"]["shapes"]["large_ball"]["seen"]["surface"] <= 1
    assert len(record["statistics"]["views"]) == 4
    poses = json.loads((scanned / "poses.json").read_text())
    assert np.array_equal(poses["T_world_camera"], poses["true"])
    image = load_range_image(scanned / "view_03" / "range.npz")
    assert np.array_equal(image.T_world_camera, poses["T_world_camera"][2])
    again = scan_settings_from_dict(record["settings"])
    assert again.path == Turntable(4)
    assert scan_settings_to_dict(again) == record["settings"]
    assert "encloses no voxel: can, can_lid." in (scanned / "report.html").read_text()  # a tube and a disc
    result = CliRunner().invoke(app, ["verify", str(scanned)])
    assert result.exit_code == 0, result.output


def test_an_older_scan_is_replaced_and_files_beside_it_stay(scanned: Path) -> None:
    (scanned / "notes.txt").write_text("mine")
    poses = scanned.parent / "poses.json"
    given = json.loads((scanned / "poses.json").read_text())
    poses.write_text(json.dumps(given["true"][:2]))
    output = run("matte", "--path", str(poses), "--width", "80", "--spp", "4", "--voxel", "0.02", "--out", str(scanned))
    assert "large_ball" in output
    assert (scanned / "notes.txt").read_text() == "mine"
    assert not (scanned / "view_03").exists()
    assert json.loads((scanned / "scan.json").read_text())["statistics"]["voxel_m"] == 0.02


@pytest.mark.validation
def test_settings_come_from_a_file_and_options_go_first(tmp_path: Path) -> None:
    (tmp_path / "scan.toml").write_text(
        'scene = "matte"\nwidth = 200\nspp = 4\nvoxel_m = 0.02\n'
        '[instrument]\nsensor = "amcw"\n[path]\ntype = "dome"\nviews = 5\nlowest_deg = 20\n'
    )
    settings = load_scan_settings(tmp_path / "scan.toml")
    assert settings.path == Dome(5, lowest_deg=20.0)
    assert settings.instrument.name == "amcw"
    assert settings.voxel_m == 0.02
    run("--config", str(tmp_path / "scan.toml"), "--views", "2", "--width", "64", "--out", str(tmp_path / "out"))
    record = json.loads((tmp_path / "out" / "scan.json").read_text())
    assert record["settings"]["path"]["views"] == 2
    assert record["settings"]["path"]["lowest_deg"] == 20
    assert record["settings"]["width"] == 64


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('scene = "matte"\nvoxel = 1', "did you mean 'voxel_m'"),
        ('scene = "matte"\n[path]\ntype = "turntabel"', "did you mean 'turntable'"),
        ('scene = "matte"\n[path]\ntype = "turntable"\nviews = 0', "views"),
        ('scene = "matte"\nregistration = "perhaps"', "known, unknown"),
        ('scene = "matte"\nvoxel_m = -1', "voxel_m"),
        ("width = 3", "missing 'scene'"),
        ('scene = "matte"\n[[instrument]]\nsensor = "amcw"', "table of settings"),
    ],
)
def test_bad_settings_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "scan.toml").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        load_scan_settings(tmp_path / "scan.toml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.xml"], "does not exist"),
        (["matte", "--path", "spiral"], "turntable, dome, hand-held"),
        (["matte", "--path", "poses.json"], r"poses\.json"),
        (["matte", "--sensor", "lidar"], "lidar"),
        (["matte", "--sensor", "gray", "--sensor", "amcw"], "one --sensor"),
        (["matte", "--voxel", "0.00001", "--views", "1", "--width", "32", "--spp", "2"], "tenth of the distance"),
        (["plane", "--views", "2", "--width", "48", "--spp", "2", "--unknown-poses"], "cannot be aligned|slide"),
    ],
)
def test_bad_input_leaves_nothing_behind(tmp_path: Path, arguments: list[str], message: str) -> None:
    with pytest.raises((ValueError, FileFormatError), match=message):
        CliRunner().invoke(app, ["scan", *arguments, "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert not list(tmp_path.iterdir())


COST = re.compile(
    r"about (?P<paths>\S+ [kMGT]?) ?light paths of up to 5 segments in (?P<passes>\d+) passes, "
    r"(?P<memory>[\d.]+) GB of memory, (?P<disk>[\d.]+ [MG]B) on disk, "
    r"(?P<time>[\d.]+) (?P<unit>s|min|h|d) on (\d+ idle cores?|an idle GPU)"
)


def test_what_a_scan_will_cost_is_said_before_it_starts(tmp_path: Path) -> None:
    """4K, 256 paths per pixel, 100 views: more than a day of two cores."""
    large = ("matte", "--width", "3840", "--height", "2160", "--spp", "256", "--views", "100")
    with limits.raised(memory=10**13):
        found = COST.fullmatch(run(*large, "--estimate").strip())
    assert found is not None
    assert found["paths"] == "212 G"  # 3840 x 2160 x 256 x 100
    assert found["passes"] == "100"
    assert 40 < float(found["memory"]) < 120  # 100 range images and their truths
    assert found["disk"].endswith("GB")
    assert 4 < float(found["disk"][:-3]) < 20
    assert found["unit"] in ("h", "d")
    assert not list(tmp_path.iterdir())


def test_a_scan_beyond_the_memory_is_refused_before_the_work(tmp_path: Path) -> None:
    large = ("matte", "--width", "3840", "--height", "2160", "--views", "100", "--out", str(tmp_path / "out"))
    with limits.raised(memory=10**10), pytest.raises(ValueError, match=r"within the 10\.0 GB of memory"):
        run(*large)
    assert not list(tmp_path.iterdir())
    assert "expected --out DIRECTORY" in CliRunner().invoke(app, ["scan", "matte"]).output


@pytest.mark.parametrize(("width", "views"), [(80, 3), *to_validate((128, 2))])
@pytest.mark.validation
def test_the_cost_of_a_scan_is_as_counted(width: int, views: int, tmp_path: Path) -> None:
    options = ("matte", "--width", str(width), "--views", str(views), "--spp", "4")
    found = COST.fullmatch(run(*options, "--estimate").strip())
    assert found is not None
    assert found["passes"] == str(views)
    run(*options, "--out", str(tmp_path / "out"))
    size = sum(file.stat().st_size for file in (tmp_path / "out").rglob("*") if file.is_file())
    assert found["disk"].endswith("MB")
    assert size / 2 < 1e6 * float(found["disk"][:-3]) < 2 * size


@pytest.mark.validation
def test_poses_that_see_nothing_are_said(tmp_path: Path) -> None:
    """Of a file without the key, and of poses that look at the wall over all things."""
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({"poses": [np.eye(4).tolist()]}))
    with pytest.raises(ValueError, match="the key 'T_world_camera'"):
        run("matte", "--path", str(poses), "--out", str(tmp_path / "out"))
    poses.write_text(json.dumps([look_at((0, 0.1, 0.6), (0, 0.75, 0.7)).tolist()]))
    said = run("matte", "--path", str(poses), "--width", "48", "--spp", "4", "--out", str(tmp_path / "out"))
    assert "no view measured any of these" in said
    assert "No view measured any of" in (tmp_path / "out" / "report.html").read_text()


def test_a_result_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "experiment.json").write_text("{}")
    with pytest.raises(FileFormatError):
        run("matte", "--out", str(tmp_path))


def test_settings_refuse_what_is_no_scene() -> None:
    with pytest.raises(ValueError, match="scene"):
        ScanSettings("")


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_the_page_shows_its_pictures_and_breaks_none_of_its_rules(scanned: Path, tmp_path: Path) -> None:
    with browser(tmp_path) as page:
        page.open(scanned / "report.html")
        broken = page.evaluate("[...document.images].filter((i) => !i.naturalWidth).length")
        assert broken == 0
        assert page.evaluate("document.images.length") >= 9
        assert page.evaluate("violations.length") == 0
        assert "measured" in page.evaluate("document.querySelector('.verdict').textContent")
        assert page.said == []


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_tables_wider_than_the_page_say_that_they_scroll(scanned: Path, tmp_path: Path) -> None:
    with browser(tmp_path) as page:
        check_scroll_hints(page, scanned / "report.html")


@pytest.mark.validation
def test_the_documented_scan_with_unknown_poses_works(tmp_path: Path) -> None:
    """The line of docs/fusion.md as it stands, but for fewer pixels, of a part that looks different from all sides."""
    line = next(s for s in (ROOT / "docs" / "fusion.md").read_text().splitlines() if "--unknown-poses" in s)
    program, command, scene, *options = shlex.split(line, comments=True)
    assert (program, command, scene) == ("rangesim", "scan", "part.ply")
    mesh = part()
    trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces, process=False).export(tmp_path / scene)  # millimetres
    options[options.index("--out") + 1] = str(tmp_path / "out")
    run(str(tmp_path / scene), *options, "--width", "240")
    views = json.loads((tmp_path / "out" / "scan.json").read_text())["statistics"]["views"]
    assert len(views) == 24
    assert max(view["angle_error_deg"] for view in views) < 0.1
    assert max(view["centre_error_m"] for view in views) < 2e-3
