# SPDX-License-Identifier: Apache-2.0
"""Colours that a sensor does not see, and lamps that glass keeps away: said once, and how to state it instead."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rangesim import Scene, load_scene, transport
from rangesim.environment.backend import select_variant
from rangesim.errors import FileFormatError, RangesimWarning
from rangesim.files.bundled_scenes import scene_names

RED = {"type": "rgb", "value": [0.8, 0.1, 0.1]}


def board(bsdf: dict[str, Any], **parts: dict[str, Any]) -> dict[str, Any]:
    select_variant()
    import mitsuba as mi

    to_world = mi.ScalarTransform4f()
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40.0},
        "board": {"type": "rectangle", "to_world": to_world.translate([0, 0, 1]).scale([2, 2, -1]), "bsdf": bsdf},
        **parts,
    }


def advice(scene: Any) -> list[str]:
    """What loading a scene warns of."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        load_scene(scene)
    assert all(one.category is RangesimWarning for one in seen)
    return [str(one.message) for one in seen]


def brightness(scene: Scene) -> float:
    return float(transport(scene, scene.rig(width=16, height=12), [], spp=1).energy.direct.mean())


@pytest.mark.parametrize("kind", ["diffuse", "plastic", "roughplastic", "principled"])
def test_colours_are_warned_of_once_and_can_be_stated_for_the_sensor(kind: str) -> None:
    key = {"diffuse": "reflectance", "principled": "base_color"}.get(kind, "diffuse_reflectance")
    (said,) = advice(board({"type": kind, "id": "dyed", key: RED}))
    assert said.startswith("the scene dictionary: colours of 1 material (dyed) are read as their luminance")
    assert advice(board({"type": kind, key: RED, "sensor_reflectance": 0.7})) == []
    assert advice(board({"type": kind, key: {"type": "rgb", "value": [0.4, 0.4, 0.41]}})) == []


def test_a_stated_reflectance_is_the_one_that_is_seen() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        coloured = brightness(load_scene(board({"type": "diffuse", "reflectance": RED})))
    grey, stated = (
        brightness(load_scene(board({"type": "diffuse", **properties})))
        for properties in ({"reflectance": 0.7}, {"reflectance": RED, "sensor_reflectance": 0.7})
    )
    assert stated == grey
    assert coloured == pytest.approx(grey * (0.2126 * 0.8 + 0.7152 * 0.1 + 0.0722 * 0.1) / 0.7, rel=1e-3)


def test_coloured_textures_are_warned_of_and_grey_ones_not(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 3), 90, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "grey.png")
    pixels[..., 0] = 200
    Image.fromarray(pixels).save(tmp_path / "red.png")
    for name, count in (("grey.png", 0), ("red.png", 1)):
        texture = {"type": "bitmap", "filename": str(tmp_path / name)}
        assert len(advice(board({"type": "twosided", "b": {"type": "diffuse", "reflectance": texture}}))) == count
    squares = {"type": "checkerboard", "color0": RED, "color1": 0.2}
    assert len(advice(board({"type": "diffuse", "reflectance": squares}))) == 1


@pytest.mark.parametrize(
    ("bsdf", "message"),
    [
        ({"type": "dielectric", "sensor_reflectance": 0.5}, "expected sensor_reflectance in a BSDF of type diffuse, "),
        ({"type": "diffuse", "sensor_reflectance": "bright"}, "expected sensor_reflectance to be a number, 0 to 1"),
        ({"type": "diffuse", "sensor_reflectance": 1.5}, "expected reflectance to be .*got 1.5"),
    ],
)
def test_wrong_reflectances_are_refused(bsdf: dict[str, Any], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_scene(board(bsdf))


@pytest.mark.parametrize("name", scene_names())
def test_scenes_of_our_own_need_no_advice(name: str) -> None:
    assert advice(name) == []


def test_the_command_line_prints_advice_as_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from rangesim.cli import main

    (tmp_path / "red.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/></sensor><shape type="sphere">'
        '<point name="center" x="0" y="0" z="3"/><bsdf type="diffuse" id="dyed"><rgb name="reflectance" '
        'value="0.8,0.1,0.1"/></bsdf></shape></scene>'
    )
    size = ("--width", "16", "--height", "12", "--spp", "1", "--sensor", "ideal-tof", "--out", str(tmp_path / "out"))
    monkeypatch.setattr("sys.argv", ["rangesim", "run", str(tmp_path / "red.xml"), *size])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    assert capsys.readouterr().err.startswith(f"rangesim: {tmp_path / 'red.xml'}: colours of 1 material (dyed)")
