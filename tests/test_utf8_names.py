# SPDX-License-Identifier: Apache-2.0
"""Folders and files whose names are no UTF-8: scenes and captures there are read and written as anywhere else."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

import rangesim
from rangesim import save_capture
from rangesim.capture.exposure import expose
from rangesim.errors import FileFormatError
from rangesim.experiment import Experiment
from rangesim.files.image_files import check_pixels, read_grey, write_grey
from rangesim.files.utf8_names import is_utf8, utf8_name
from rangesim.pipeline.experiment_run import run
from rangesim.presets import instrument
from rangesim.results.captures import import_capture, load_capture
from rangesim.results.experiment_results import load_result
from rangesim.sensors import IdealToF

NAMES = (b"caf\xe9", b"\xff\xfe", b"scan.\xe4", "Grüße".encode("utf-16-le"))
SCENE = """<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>
    <include filename="parts/matte.xml"/>
    <shape type="obj" id="part"><string name="filename" value="MESH"/><ref id="matte"/></shape></scene>"""
MATTE = """<scene version="3.0.0"><bsdf type="diffuse" id="matte"><texture type="bitmap" name="reflectance">
    <string name="filename" value="grey.exr"/></texture></bsdf></scene>"""
MESH = "v -1 0 -1\nv 1 0.5 -1\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


@pytest.fixture(params=NAMES, ids=ascii)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A directory whose name is no UTF-8."""
    path = tmp_path / os.fsdecode(request.param.replace(b"\0", b"\xff"))
    try:
        path.mkdir()
    except OSError:
        pytest.skip("the file system takes no such names")
    return path


def write_scene(folder: Path, name: str = "scene.xml", mesh: str = "mesh.obj") -> Path:
    """A scene that includes a file, which names an image, and names a mesh."""
    (folder / "parts").mkdir(exist_ok=True)
    (folder / "parts" / "matte.xml").write_text(MATTE)
    write_grey(folder / "grey.exr", np.full((4, 4), 0.5, np.float32))
    (folder / "mesh.obj").write_text(MESH)
    (folder / name).write_text(SCENE.replace("MESH", mesh))
    return folder / name


def depths(source: Path) -> np.ndarray:
    scene = rangesim.load_scene(source)
    assert [i.name for i in scene.instances] == ["part"]
    z: np.ndarray = rangesim.transport(scene, scene.rig(), [], spp=1).truth.z
    return z


def test_a_scene_is_read_as_in_any_other_folder(folder: Path, tmp_path: Path) -> None:
    expected = depths(write_scene(tmp_path))
    assert np.isfinite(expected).any()
    np.testing.assert_array_equal(depths(write_scene(folder)), expected)


def test_so_is_one_whose_own_name_is_no_utf8_or_that_a_link_leads_to(folder: Path, tmp_path: Path) -> None:
    expected = depths(write_scene(tmp_path))
    odd = write_scene(tmp_path, f"{folder.name}.xml")
    (tmp_path / "link").symlink_to(folder)
    write_scene(folder)
    for source in (odd, tmp_path / "link" / "scene.xml", write_scene(folder, f"{folder.name}.xml")):
        np.testing.assert_array_equal(depths(source), expected)


def test_so_are_those_of_the_working_directory(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a mesh of the working directory, and with temporary files there."""
    expected = depths(write_scene(tmp_path))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    write_scene(folder)
    np.testing.assert_array_equal(depths(Path("scene.xml")), expected)
    source = write_scene(elsewhere)
    (elsewhere / "mesh.obj").unlink()
    np.testing.assert_array_equal(depths(source), expected)


def test_what_is_wrong_with_a_scene_names_its_own_folder(folder: Path) -> None:
    write_scene(folder, mesh="absent.obj")
    with pytest.raises(FileFormatError) as caught:
        rangesim.load_scene(folder / "scene.xml")
    assert "absent.obj" in str(caught.value)
    assert tempfile.gettempdir() not in str(caught.value).replace(str(folder.parent), "")
    (folder / "flat.ply").write_text("no PLY")
    write_scene(folder, mesh="flat.ply")
    (folder / "scene.xml").write_text((folder / "scene.xml").read_text().replace('"obj"', '"ply"'))
    with pytest.raises(FileFormatError) as caught:
        rangesim.load_scene(folder / "scene.xml")
    shown = str(folder / "flat.ply").encode("ascii", "backslashreplace").decode()
    assert shown in str(caught.value).encode("ascii", "backslashreplace").decode()


def test_a_dictionary_that_names_such_a_file_is_refused(folder: Path) -> None:
    scene = {"type": "scene", "part": {"type": "ply", "filename": str(folder / "mesh.ply")}}
    with pytest.raises(FileFormatError, match=r"expected part\.filename in UTF-8, got .*; name a link to that file"):
        rangesim.load_scene(scene)


def test_captures_of_radiance_load_back_the_same(folder: Path) -> None:
    sensor = IdealToF()
    capture = expose(plane_signals(stereo_rig(32, 24), sensor, ambient=0.1), sensor, None)
    assert not capture.is_digital
    save_capture(capture, folder / "capture")
    np.testing.assert_array_equal(load_capture(folder / "capture").frames, capture.frames)
    np.testing.assert_array_equal(import_capture(folder / "capture", sensor).frames, capture.frames)


def test_images_whose_own_names_are_no_utf8(folder: Path) -> None:
    image = np.linspace(0, 2, 35, dtype=np.float32).reshape(5, 7)
    path = folder / f"{folder.name}.exr"
    write_grey(path, image)
    write_grey(folder.parent / "plain.exr", image)
    assert path.read_bytes() == (folder.parent / "plain.exr").read_bytes()
    check_pixels(path)
    np.testing.assert_array_equal(read_grey(path), image)


def test_an_experiment_there_ends_well_and_says_its_scene(folder: Path) -> None:
    source = write_scene(folder)
    run(Experiment(scene=str(source), spp=1, caustics=False, instruments=(instrument("ideal-tof"),)), folder / "out")
    result = load_result(folder / "out")
    assert result.experiment.scene == str(source)
    assert np.isfinite(result.measurements[0].image.z).any()
    assert (folder / "out" / "report.html").read_bytes().decode()


def test_without_a_folder_for_temporary_files_it_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr("rangesim.files.utf8_names.PLACES", ())
    with pytest.raises(FileFormatError, match=r"temporary files whose name is UTF-8, got .*; set TMPDIR to another"):
        rangesim.load_scene(write_scene(folder.parent))


def test_a_name_in_utf8_stays(tmp_path: Path) -> None:
    for name in ("a", "Grüße", "点群", "a b"):
        assert is_utf8(name)
        with utf8_name(tmp_path / name) as found:
            assert found == str(tmp_path / name)
