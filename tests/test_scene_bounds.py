# SPDX-License-Identifier: Apache-2.0
"""Scenes with properties that are none: refused where they enter, with the names of the shape and the property."""

from __future__ import annotations

import math
import os
import shutil
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import rangesim
from rangesim.errors import FileFormatError
from rangesim.files.image_files import write_grey
from rangesim.scene import load_scene
from rangesim.scene.nodes import check_type, shipped_types
from rangesim.settings import limits

CAMERA: dict[str, Any] = {
    "type": "perspective",
    "fov": 40.0,
    "film": {"type": "hdrfilm", "width": 16, "height": 12},
}
XML_CAMERA = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/></film></sensor>'


@pytest.fixture(autouse=True)
def _at_once() -> Iterator[None]:
    start = time.process_time()
    yield
    assert time.process_time() - start < 10  # on a new machine the renderer compiles kernels, for half of it


def scene(camera: dict[str, Any] | None = None, **things: Any) -> dict[str, Any]:
    return {"type": "scene", "camera": CAMERA | (camera or {}), "light": {"type": "constant"}} | things


def ball(bsdf: Any = None, **changes: Any) -> dict[str, Any]:
    place = {"center": [0.0, 0.0, 3.0], "radius": 0.5}
    return scene(ball={"type": "sphere", **place, "paint": bsdf or {"type": "diffuse"}} | changes)


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def look(scale: Any = 1.0, move: Any = 0.0) -> Any:
    turn = mi.ScalarTransform4f
    return turn().translate([0, 0, move]) @ turn().scale(scale)


def test_a_good_scene_loads() -> None:
    assert load_scene(ball()).instances[0].name == "ball"


NONSENSE: dict[str, tuple[Any, str]] = {
    "radius nan": (lambda: ball(radius=math.nan), 'shape "ball": expected radius to be positive and .* got nan'),
    "radius negative": (lambda: ball(radius=-1.0), 'shape "ball": expected radius to be positive'),
    "radius 0": (lambda: ball(radius=0.0), 'shape "ball": expected radius to be positive'),
    "radius far": (lambda: ball(radius=1e12), 'shape "ball": expected radius'),
    "centre nan": (lambda: ball(center=[0, math.nan, 0]), 'shape "ball": expected center .* got nan'),
    "centre far": (lambda: ball(center=[0, 1e12, 0]), 'shape "ball": expected center .* got 1000000000000'),
    "place nan": (lambda: ball(to_world=look(math.nan)), 'shape "ball": expected to_world .* got nan'),
    "place far": (lambda: ball(to_world=look(move=1e12)), 'shape "ball": expected to_world'),
    "no area": (lambda: scene(card={"type": "rectangle", "to_world": look([1, 0, 1])}), 'shape "card": .* extent'),
    "reflectance": (lambda: ball({"type": "diffuse", "reflectance": 2.0}), "expected reflectance to be a fraction"),
    "reflectance int": (lambda: ball({"type": "diffuse", "reflectance": 2}), "expected reflectance to be a fraction"),
    "reflectance nan": (lambda: ball({"type": "diffuse", "reflectance": math.nan}), "reflectance .* got nan"),
    "reflectance rgb": (lambda: ball({"type": "diffuse", "reflectance": rgb(0.1, 1.5, 0)}), "reflectance .* got 1.5"),
    "reflectance below": (lambda: ball({"type": "diffuse", "reflectance": rgb(0.1, -1, 0)}), "reflectance .* got -1"),
    "nested": (
        lambda: ball({"type": "twosided", "bsdf": {"type": "plastic", "diffuse_reflectance": 3.0}}),
        "expected diffuse_reflectance to be a fraction",
    ),
    "checkerboard": (
        lambda: ball({"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": rgb(0, 0, 7)}}),
        "reflectance.color0 to be a fraction, 0 to 1, got 7",
    ),
    "pixels": (
        lambda: ball({"type": "diffuse", "reflectance": {"type": "bitmap", "data": mi.TensorXf([9.0], (1, 1, 1))}}),
        "reflectance.data to be a fraction, 0 to 1, got 9",
    ),
    "alpha": (lambda: ball({"type": "roughconductor", "alpha": -0.1}), "expected alpha to be a roughness .* got -0.1"),
    "alpha nan": (lambda: ball({"type": "roughconductor", "alpha": math.nan}), "expected alpha .* got nan"),
    "ior nan": (lambda: ball({"type": "dielectric", "int_ior": math.nan}), "expected int_ior .* got nan"),
    "ior 0": (lambda: ball({"type": "dielectric", "int_ior": 0.0}), "expected int_ior .* got 0.0"),
    "ior negative": (lambda: ball({"type": "dielectric", "ext_ior": -1.5}), "expected ext_ior .* got -1.5"),
    "eta nan": (lambda: ball({"type": "conductor", "eta": math.nan, "k": 1.0}), "expected eta .* got nan"),
    "falloff": (
        lambda: ball({"type": "retroreflector", "falloff": -1.0, "b": {"type": "roughconductor"}}),
        "expected falloff .* got -1",
    ),
    "radiance": (lambda: scene(light={"type": "constant", "radiance": -1.0}), 'emitter "light": expected radiance'),
    "radiance nan": (lambda: scene(light={"type": "constant", "radiance": math.nan}), "expected radiance .* got nan"),
    "radiance rgb": (lambda: ball(glow={"type": "area", "radiance": rgb(1, math.inf, 0)}), "radiance .* got inf"),
    "radiance large": (lambda: ball(glow={"type": "area", "radiance": 1e300}), "expected radiance .* got 1e.300"),
    "point": (lambda: scene(lamp={"type": "point", "position": [0, 0, 1e12]}), 'emitter "lamp": expected position'),
    "fov": (lambda: scene(camera={"fov": 180.0}), 'sensor "camera": expected fov to be degrees'),
    "fov nan": (lambda: scene(camera={"fov": math.nan}), 'sensor "camera": expected fov .* got nan'),
    "fov negative": (lambda: scene(camera={"fov": -3.0}), 'sensor "camera": expected fov'),
    "near": (lambda: scene(camera={"near_clip": math.nan}), "expected near_clip .* got nan"),
    "camera far": (lambda: scene(camera={"to_world": look(move=1e12)}), 'sensor "camera": expected to_world'),
    "film": (lambda: scene(camera={"film": {"type": "hdrfilm", "width": 0, "height": 9}}), "width to be a whole"),
    "large film": (
        lambda: scene(camera={"film": {"type": "hdrfilm", "width": 10**6, "height": 10**6}}),
        "at most 100000000 pixels of the film",
    ),
    "long film": (lambda: scene(camera={"film": {"type": "hdrfilm", "width": 10**30, "height": 1}}), "."),
    "true": (lambda: ball(radius=True), "."),
    "text": (lambda: ball(radius="large"), "."),
    "none": (lambda: ball(radius=None), "."),
    "list": (lambda: ball(radius=[1]), "."),
    "albedo": (
        lambda: ball({"type": "null"}, interior={"type": "homogeneous", "albedo": 1.5, "sigma_t": 1.0}),
        'medium .*expected albedo to be a fraction',
    ),
    "sigma": (
        lambda: ball({"type": "null"}, interior={"type": "homogeneous", "albedo": 0.5, "sigma_t": -1.0}),
        "expected sigma_t to be 0 or positive",
    ),
    "anisotropy": (
        lambda: ball({"type": "null"}, interior={"type": "homogeneous", "p": {"type": "hg", "g": 1.0}}),
        "expected g to be above -1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NONSENSE)
def test_nonsense_in_a_dictionary_is_one_sentence(case: str) -> None:
    load_scene(ball())  # selects the variant
    make, message = NONSENSE[case]
    with pytest.raises((FileFormatError, ValueError), match=message) as caught:
        load_scene(make())
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<shape type="sphere" id="ball"><float name="radius" value="nan"/></shape>', 'shape "ball": expected radius'),
        ('<shape type="sphere"><float name="radius" value="-1"/></shape>', 'shape "sphere_.*": expected radius'),
        ('<shape type="sphere"><float name="radius" value="1e400"/></shape>', "radius"),
        (
            '<shape type="sphere" id="ball"><bsdf type="twosided"><bsdf type="diffuse">'
            '<rgb name="reflectance" value="0, 2, 0"/></bsdf></bsdf></shape>',
            'bsdf "diffuse" of bsdf "twosided" of shape "ball": expected reflectance to be a fraction, 0 to 1, got 2',
        ),
        (
            '<bsdf type="diffuse" id="paint"><spectrum name="reflectance" value="400:0.5, 500:1.5"/></bsdf>'
            '<shape type="sphere"><ref id="paint"/></shape>',
            'bsdf "paint": expected reflectance to be a fraction, 0 to 1, got 1.5',
        ),
        ('<shape type="sphere"><transform name="to_world"><translate x="1e12"/></transform></shape>', "to_world"),
        ('<shape type="cube"><transform name="to_world"><scale value="0"/></transform></shape>', "to_world|invert"),
        ('<shape type="obj"><string name="filename" value="missing.obj"/></shape>', "missing.obj"),
    ],
)  # fmt: skip
def test_nonsense_in_a_file_is_one_sentence(tmp_path: Path, body: str, message: str) -> None:
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    with pytest.raises(FileFormatError, match=message) as caught:
        load_scene(tmp_path / "a.xml")
    assert len(str(caught.value)) < 600


def test_a_reflectance_may_be_a_spectrum(tmp_path: Path) -> None:
    paint = '<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.5, 500:0.7"/></bsdf>'
    body = f'<shape type="sphere" id="ball">{paint}</shape>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    assert load_scene(tmp_path / "a.xml").instances[0].name == "ball"


def mesh(tmp_path: Path, name: str, text: bytes) -> Path:
    (tmp_path / name).write_bytes(text)
    kind = name.rpartition(".")[2]
    body = f'<shape type="{kind}" id="part"><string name="filename" value="{name}"/></shape>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    return tmp_path / "a.xml"


PLY = b"""ply
format ascii 1.0
element vertex %s
property float x
property float y
property float z
element face 1
property list uchar int vertex_index
end_header
%s
3 0 1 2
"""


def binary_ply(index: int, order: str = "<", kind: str = "int", extra: int = 0) -> bytes:
    """Three vertices, as many more as `extra`, and a face of the first two and of vertex `index`."""
    name = {"<": b"binary_little_endian", ">": b"binary_big_endian"}[order]
    head = PLY.partition(b"end_header\n")[0] % (b"%d" % (3 + extra)) + b"end_header\n"
    head = head.replace(b"ascii", name).replace(b"uchar int", b"uchar " + kind.encode())
    places = [0, 0, 3, 1, 0, 3, 0, 1, 3] + [0.5, 0.5, 3] * extra
    code = {"int": "i", "uint": "I", "short": "h", "ushort": "H", "uchar": "B"}[kind]
    return head + struct.pack(f"{order}{len(places)}f", *places) + struct.pack(f"{order}B3{code}", 3, 0, 1, index)


MESHES = {
    "good.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ""),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "."),
    "far.obj": (b"v 1e12 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "part.*vertices"),
    "malformed.obj": (b"v x y z\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "."),
    "short.obj": (b"v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "."),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "."),
    "point.obj": (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "extent"),
    "empty.obj": (b"v 1 1 1\n", "."),
    "good.ply": (PLY % (b"3", b"0 0 0\n1 0 0\n0 1 0"), ""),
    "nan.ply": (PLY % (b"3", b"nan 0 0\n1 0 0\n0 1 0"), "nan.ply|vertices"),
    "inf.ply": (PLY % (b"3", b"inf 0 0\n1 0 0\n0 1 0"), "inf.ply|vertices"),
    "large.ply": (PLY % (b"4000000000000", b"0 0 0\n1 0 0\n0 1 0"), "."),
    "index.ply": (
        (PLY % (b"3", b"0 0 0\n1 0 0\n0 1 0")).replace(b"3 0 1 2", b"3 0 1 9"),
        "expected faces of its 3 vertices, 0 to 2, got vertex 9|be read|repair",
    ),
    "binary.ply": (binary_ply(2), ""),
    "big.ply": (binary_ply(2, ">", "ushort", 70), ""),
    "short.ply": (binary_ply(2)[:-1], "ends early|."),
    "none.ply": (b"plyformat", "end_header|."),
}
INDICES = [3, 100_000, 1_000_000, 2_000_000_000, -1, -3, -(2**31)]


@pytest.mark.parametrize("name", MESHES)
def test_meshes_in_scenes_are_read_or_refused(tmp_path: Path, name: str) -> None:
    text, message = MESHES[name]
    path = mesh(tmp_path, name, text)
    if not message:
        assert load_scene(path).instances[0].name == "part"
        return
    with pytest.raises(FileFormatError, match=message):
        load_scene(path)


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
@pytest.mark.parametrize("index", INDICES)
def test_faces_of_vertices_that_are_not_there_are_refused(tmp_path: Path, order: str, index: int) -> None:
    """Mitsuba 3.9 crashes on large ones, where it computes normals, and makes vertex 0 of -1."""
    text = (PLY % (b"3", b"0 0 3\n1 0 3\n0 1 3")).replace(b"3 0 1 2", b"3 0 1 %d" % index)
    path = mesh(tmp_path, "a.ply", text if order == "ascii" else binary_ply(index, order))
    with pytest.raises(FileFormatError, match=f"faces of its 3 vertices, 0 to 2, got vertex {index}; repair"):
        load_scene(path)


@pytest.mark.parametrize("kind", ["int", "uint", "short", "ushort", "uchar"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_faces_of_ply_are_those_of_the_file(tmp_path: Path, order: str, kind: str) -> None:
    path = mesh(tmp_path, "a.ply", binary_ply(72, order, kind, extra=70))
    (shape,) = load_scene(path).mitsuba.shapes()
    np.testing.assert_array_equal(np.array(mi.traverse(shape)["faces"]), [0, 1, 72])
    mesh(tmp_path, "a.ply", binary_ply(73, order, kind, extra=70))
    with pytest.raises(FileFormatError, match="0 to 72, got vertex 73"):
        load_scene(path)


def serialized(*indices: int, version: int = 4, flags: int = 0x1000) -> bytes:
    """A file of Mitsuba's own format: for each index a mesh of three vertices, and a face of two and of that one."""
    content, places = b"", []
    for index in indices:
        numbers = 3 + 3 * bool(flags & 1) + 2 * bool(flags & 2) + 3 * bool(flags & 8)
        values = [0, 0, 3, 1, 0, 3, 0, 1, 3] + [0.5] * 3 * (numbers - 3)
        body = struct.pack("<I", flags) + (b"name\0" if version == 4 else b"") + struct.pack("<QQ", 3, 1)
        body += struct.pack(f"<{len(values)}{'d' if flags & 0x2000 else 'f'}", *values) + struct.pack(
            "<3I", 0, 1, index
        )
        places.append(len(content))
        content += struct.pack("<HH", 0x041C, version) + zlib.compress(body)
    return content + struct.pack(f"<{len(places)}{'Q' if version == 4 else 'I'}I", *places, len(places))


@pytest.mark.parametrize("flags", [0x1000, 0x1001, 0x1002, 0x100B, 0x2000, 0x200B])
@pytest.mark.parametrize("version", [3, 4])
def test_faces_of_serialized_meshes_are_checked_too(tmp_path: Path, version: int, flags: int) -> None:
    def shape(number: int, *indices: int) -> dict[str, Any]:
        (tmp_path / "a.serialized").write_bytes(serialized(*indices, version=version, flags=flags))
        return {"type": "serialized", "filename": str(tmp_path / "a.serialized"), "shape_index": number}

    for number, indices in enumerate([(2, 9, 9), (9, 2, 9), (9, 9, 2)]):
        (loaded,) = load_scene(scene(part=shape(number, *indices))).mitsuba.shapes()
        np.testing.assert_array_equal(np.array(mi.traverse(loaded)["faces"]), [0, 1, 2])
    for index in (3, 100_000, 2_000_000_000, 2**32 - 1):
        with pytest.raises(FileFormatError, match=f"faces of its 3 vertices, 0 to 2, got vertex {index}; repair"):
            load_scene(scene(part=shape(1, 2, index, 2)))
    with pytest.raises(FileFormatError, match="expected a shape_index from 0 to 1, got 2"):
        load_scene(scene(part=shape(2, 2, 2)))


def test_serialized_meshes_cut_short_or_large_are_refused(tmp_path: Path) -> None:
    path = mesh(tmp_path, "a.serialized", serialized(2))
    assert load_scene(path).instances[0].name == "part"
    for content in (serialized(2)[:30], serialized(2)[:3], b"", b"\x1c\x04\x05\x00" + serialized(2)[4:]):
        with pytest.raises(FileFormatError, match=r"a\.serialized cannot be read as a serialized mesh|is empty"):
            load_scene(mesh(tmp_path, "a.serialized", content))
    body = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", 4 * 10**9, 1)
    content = struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)
    with pytest.raises(FileFormatError, match=r"a\.serialized: expected at most 100000000 vertices or faces"):
        load_scene(mesh(tmp_path, "a.serialized", content))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"vertex 3", b"vertex 3x"),
        (b"vertex 3", b"vertex -3"),
        (b"face 1", b"vertex 1"),
        (b"float x", b"int x"),  # Mitsuba would read 0 and then .5
        (b"0.5 0 3", b"0.5.5 0"),
        (b"format ascii", b"format text"),
    ],
)
def test_ply_that_may_be_read_in_two_ways_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    text = PLY % (b"3", b"0.5 0 3\n1 0 3\n0 1 3")
    assert load_scene(mesh(tmp_path, "a.ply", text)).instances[0].name == "part"
    with pytest.raises(FileFormatError, match=r"a\.ply cannot be read as a PLY file of triangles"):
        load_scene(mesh(tmp_path, "a.ply", text.replace(old, new)))


@pytest.mark.parametrize("name", [name for name in MESHES if MESHES[name][1]])
def test_bare_meshes_are_read_or_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(MESHES[name][0])
    with pytest.raises(FileFormatError) as caught:
        load_scene(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_bare_meshes_have_a_size(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(MESHES["good.obj"][0])
    with limits.raised(points=2), pytest.raises(FileFormatError, match="at most 2 "):
        load_scene(tmp_path / "a.obj")
    (tmp_path / "b.obj").write_bytes(MESHES["good.obj"][0].replace(b"1 0 0", b"20 0 0"))
    with pytest.raises(FileFormatError, match=r"b\.obj within 1e\+07 metres"):
        load_scene(tmp_path / "b.obj", unit_m=1e6)
    for wrong in (0, -1, math.nan, True, "mm", 1e300):
        with pytest.raises(ValueError, match="unit_m"):
            load_scene(tmp_path / "a.obj", unit_m=wrong)  # type: ignore[arg-type]


def textured(tmp_path: Path, name: str) -> Path:
    texture = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
    body = f'<shape type="rectangle" id="card"><bsdf type="diffuse">{texture}</bsdf></shape>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    return tmp_path / "a.xml"


@pytest.mark.parametrize("value", [0.5, 1.5, -0.5, math.nan, math.inf])
def test_textures_are_fractions_too(tmp_path: Path, value: float) -> None:
    write_grey(tmp_path / "t.exr", np.full((4, 4), value, np.float32))
    path = textured(tmp_path, "t.exr")
    if value == 0.5:
        load_scene(path)
        return
    with pytest.raises(FileFormatError, match=rf"reflectance.filename t.exr to be a fraction, 0 to 1, got {value:g}"):
        load_scene(path)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a process of one core")
def test_on_a_single_core_a_texture_of_openexr_is_no_endless_wait(tmp_path: Path) -> None:
    write_grey(tmp_path / "t.exr", np.full((4, 4), 0.5, np.float32))
    script = "import os, sys; os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1]); import rangesim\n"
    script += "rangesim.load_scene(sys.argv[1])"
    subprocess.run([sys.executable, "-c", script, textured(tmp_path, "t.exr")], check=True, timeout=60)


def test_texture_bombs_are_refused_by_their_header(tmp_path: Path) -> None:
    (tmp_path / "t.pgm").write_bytes(b"P5 100000 100000 255\n" + bytes(100))
    with pytest.raises(FileFormatError, match="at most 100000000 pixels"):
        load_scene(textured(tmp_path, "t.pgm"))


DEEP = 20_000


def test_deep_files_are_refused_before_mitsuba_runs_out_of_stack(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    deep = '<bsdf type="twosided">' * DEEP + "</bsdf>" * DEEP
    path.write_text(f'<scene version="3.0.0">{XML_CAMERA}<shape type="sphere">{deep}</shape></scene>')
    with pytest.raises(FileFormatError, match="expected at most 100 levels"):
        load_scene(path)
    (tmp_path / "b.xml").write_text(f'<scene version="3.0.0">{deep}</scene>')
    path.write_text(f'<scene version="3.0.0">{XML_CAMERA}<include filename="b.xml"/></scene>')
    with pytest.raises(FileFormatError, match=r"expected at most 100 levels in .*b\.xml"):
        load_scene(path)
    path.write_text(
        f'<scene version="3.0.0"><default name="part" value="b"/>{XML_CAMERA}<include filename="$part.xml"/></scene>'
    )
    with pytest.raises(FileFormatError, match=r"expected at most 100 levels in .*b\.xml"):
        load_scene(path)
    path.write_text(f'<scene version="3.0.0">{XML_CAMERA}<include filename="a.xml"/></scene>')
    with pytest.raises(FileFormatError, match="includes itself"):
        load_scene(path)


def test_includes_that_double_are_refused(tmp_path: Path) -> None:
    for i in range(12):
        twice = f'<include filename="s{i + 1}.xml"/>' * 4
        (tmp_path / f"s{i}.xml").write_text(f'<scene version="3.0.0">{twice}<!--{"x" * 100_000}--></scene>')
    (tmp_path / "s12.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(FileFormatError, match=r"bytes in .* and what it includes"):
        load_scene(tmp_path / "s0.xml")


def test_long_chains_of_references_are_refused(tmp_path: Path) -> None:
    links = "".join(f'<bsdf type="twosided" id="b{i}"><ref id="b{i + 1}"/></bsdf>' for i in range(20_000))
    body = f'{links}<bsdf type="diffuse" id="b20000"/><shape type="sphere"><ref id="b0"/></shape>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    with pytest.raises(FileFormatError, match="refer to each other"):
        load_scene(tmp_path / "a.xml")


def test_deep_dictionaries_are_refused() -> None:
    bsdf: dict[str, Any] = {"type": "diffuse"}
    for _ in range(DEEP):
        bsdf = {"type": "twosided", "bsdf": bsdf}
    with pytest.raises(FileFormatError, match="expected at most 100 levels"):
        load_scene(ball(bsdf))
    loop = ball()
    loop["again"] = loop
    with pytest.raises(FileFormatError, match="expected at most 100 levels"):
        load_scene(loop)


def test_scenes_have_a_number_of_shapes() -> None:
    with limits.raised(shapes=2), pytest.raises(FileFormatError, match="expected at most 2 shapes"):
        load_scene(scene(**{f"s{i}": {"type": "sphere"} for i in range(3)}))


def test_an_envmap_may_be_bright_but_not_nan(tmp_path: Path) -> None:
    for value in (50.0, math.nan):
        write_grey(tmp_path / "sky.exr", np.full((4, 8), value, np.float32))
        light = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
        if value == 50.0:
            load_scene(ball() | {"light": light})
        else:
            with pytest.raises(FileFormatError, match=r"sky\.exr to be 0 or positive, and finite"):
                load_scene(ball() | {"light": light})


def test_a_bitmap_without_a_file_is_refused() -> None:
    """Mitsuba 3.9 crashes on it; found by fuzzing."""
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective"},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True}}},
    }
    with pytest.raises(FileFormatError, match="expected a filename, found none"):
        load_scene(scene)


HOT = {"type": "blackbody", "temperature": 3000.0}
CHECKS = {"type": "checkerboard"}
WITHOUT_A_BAND: dict[str, tuple[Any, str]] = {
    "blackbody sky": (lambda: ball() | {"light": {"type": "constant", "radiance": HOT}}, "'blackbody'"),
    "blackbody lamp": (lambda: ball(glow={"type": "area", "radiance": HOT}), "'blackbody' needs a spectrum"),
    "blackbody paint": (lambda: ball({"type": "diffuse", "reflectance": HOT}), "'blackbody' needs a spectrum"),
    "hair": (lambda: ball({"type": "hair"}), "'hair' needs a spectrum"),
    "sun and sky": (lambda: ball() | {"light": {"type": "sunsky"}}, "'sunsky' needs a spectrum.*constant emitter"),
    "sky of a day": (lambda: ball() | {"light": {"type": "timed_sunsky"}}, "'timed_sunsky' needs a spectrum"),
    "nested hair": (lambda: ball({"type": "mask", "opacity": 0.5, "b": {"type": "hair"}}), "'hair' needs a spectrum"),
    "regular": (
        lambda: ball({"type": "diffuse", "reflectance": {"type": "regular", "wavelength_min": 400.0,
                      "wavelength_max": 900.0, "values": "0.5,0.6"}}),
        "'regular' needs a spectrum",
    ),
    "irregular": (
        lambda: ball(glow={"type": "area", "radiance": {"type": "irregular", "wavelengths": "400,900",
                           "values": "0.5,0.6"}}),
        "'irregular' needs a spectrum",
    ),
    "bumps of checks": (
        lambda: ball({"type": "bumpmap", "t": CHECKS, "b": {"type": "diffuse"}}), "expected a texture with slopes"
    ),
    "normals of checks": (
        lambda: ball({"type": "normalmap", "normalmap": CHECKS, "b": {"type": "diffuse"}}),
        "expected a texture with three channels",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WITHOUT_A_BAND)
def test_what_needs_a_spectrum_is_refused_at_load_and_breaks_no_other_scene(case: str) -> None:
    good = load_scene(ball())
    rig = good.rig(width=16)
    before = rangesim.transport(good, rig, [], spp=1, seed=1).energy.direct
    make, message = WITHOUT_A_BAND[case]
    with pytest.raises(FileFormatError, match=message) as kept:
        load_scene(make())
    assert kept.value is not None  # alive, with all that its traceback holds
    np.testing.assert_array_equal(rangesim.transport(good, rig, [], spp=1, seed=1).energy.direct, before)
    assert before.max() > 0


def test_a_loaded_object_that_needs_a_spectrum_is_refused_too() -> None:
    load_scene(ball())  # selects the variant
    for plugin, message in (({"type": "hair"}, "'hair' needs a spectrum"), (HOT, "'blackbody' needs a spectrum")):
        loaded = mi.load_dict(plugin)
        paint = loaded if plugin is not HOT else {"type": "diffuse", "reflectance": loaded}
        with pytest.raises(FileFormatError, match=message):
            load_scene(ball(paint))


# ---- Native code ---------------------------------------------------------------------------------------------------


def library(folder: Path) -> tuple[Path, Path]:
    """A library that does nothing but write a file when it is loaded, and the path of that file."""
    compiler = shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("needs a C compiler, on Linux")
    mark, source, target = folder / "it-ran", folder / "mark.c", folder / "mark.so"
    source.write_text(
        "#include <stdio.h>\n__attribute__((constructor)) static void mark(void)"
        f'{{ FILE *file = fopen("{mark}", "w"); if (file) fclose(file); }}\n'
    )
    subprocess.run([compiler, "-shared", "-fPIC", "-o", target, source], check=True)
    return target, mark


@pytest.mark.parametrize(
    "name", ["../evil", "plugins/evil", "/tmp/evil", "evil.so", "a b", "..", "a\\b", "diffuse.", "é", "a" * 5000, "a\0"]
)
def test_a_plugin_type_is_a_plain_name(name: str) -> None:
    with pytest.raises(FileFormatError, match="expected types of plugins that come with Mitsuba") as caught:
        load_scene(ball({"type": name}))
    assert len(str(caught.value)) < 400


def test_plugin_types_of_mitsuba_and_of_python_pass() -> None:
    assert {"diffuse", "ply", "hdrfilm", "perspective"} <= shipped_types()
    for name in ("diffuse", "retroreflector", "rgb", "my_bsdf"):
        check_type(name, "the scene")
    paint = {"type": "retroreflector", "nested": {"type": "conductor"}}
    assert load_scene(ball(paint)).instances[0].name == "ball"


@pytest.mark.parametrize("form", ["xml", "parameter", "include", "path", "texture", "dictionary", "cwd"])
def test_a_scene_brings_no_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    """Mitsuba takes plugins/TYPE.so from beside the scene, or from the working directory."""
    code, mark = library(tmp_path)
    home = tmp_path / "home"
    (home / "plugins").mkdir(parents=True)
    name = f"brought_{form}"  # Mitsuba keeps a library that it has loaded
    shutil.copy(code, home / "plugins" / f"{name}.so")
    paint, before = f'<bsdf type="{name}"/>', ""
    path = home / "a.xml"
    if form == "parameter":
        before, paint = f'<default name="kind" value="{name}"/>', '<bsdf type="$kind"/>'
    if form == "include":
        (home / "b.xml").write_text(f'<scene version="3.0.0"><bsdf id="paint" type="{name}"/></scene>')
        before, paint = '<include filename="b.xml"/>', '<ref id="paint"/>'
    if form == "path":
        before, path = '<path value="home"/>', tmp_path / "a.xml"
    if form == "texture":
        paint = f'<bsdf type="diffuse"><texture name="reflectance" type="{name}"/></bsdf>'
    path.write_text(
        f'<scene version="3.0.0">{before}{XML_CAMERA}<shape type="sphere" id="ball">{paint}</shape></scene>'
    )
    if form in ("dictionary", "cwd"):
        monkeypatch.chdir(home)
    with pytest.raises(FileFormatError, match=f"got '{name}'.*; a scene must not bring a library of its own"):
        load_scene(ball({"type": name}) if form == "dictionary" else path)
    assert not mark.exists()


@pytest.mark.validation
def test_libraries_named_as_mitsubas_own_are_not_run(tmp_path: Path) -> None:
    """Beside a scene and in the working directory, for every form of a scene, and for the estimate of a run."""
    code, mark = library(tmp_path)
    (tmp_path / "plugins").mkdir()
    for name in shipped_types():
        (tmp_path / "plugins" / f"{name}.so").symlink_to(code)
    (tmp_path / "a.xml").write_text(
        f'<scene version="3.0.0"><path value="."/>{XML_CAMERA}<shape type="sphere" id="ball"/></scene>'
    )
    (tmp_path / "b.obj").write_bytes(MESHES["good.obj"][0])
    script = f"""
import sys
import rangesim
from rangesim.cli import main
print([i.name for i in rangesim.load_scene("a.xml").instances], len(rangesim.load_scene("b.obj").instances))
print([i.name for i in rangesim.load_scene({ball()}).instances])
sys.argv = ["rangesim", "run", "--estimate", "tabletop", "--out", "out"]
main()
"""
    root = str(Path(__file__).resolve().parents[1])
    environment = os.environ | {"PYTHONPATH": root}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert "['ball'] 2\n['ball']\n" in done.stdout
    assert "light paths" in done.stdout  # of the estimate
    assert not mark.exists()


FOG = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.5}
SMOKE = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.0}
MATCHED: dict[str, Any] = {"bsdf": {"type": "null"}}


def wall_behind(**bodies: Any) -> dict[str, Any]:
    paint = {"type": "twosided", "b": {"type": "diffuse"}}
    return scene(wall={"type": "rectangle", "to_world": look(5.0, 6.0), "bsdf": paint}) | bodies


@pytest.mark.parametrize("medium", [FOG, SMOKE], ids=["fog", "smoke"])
def test_a_medium_in_the_sensor_is_refused(medium: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError, match="expected the camera to stand in air, got a medium in its sensor"):
        load_scene(ball() | {"camera": CAMERA | {"medium": medium}})


def test_a_medium_in_the_sensor_of_a_file_is_refused(tmp_path: Path) -> None:
    fog = '<medium type="homogeneous" id="fog"/>'
    second = XML_CAMERA.replace("<film", '<ref id="fog"/><film', 1)
    body = f'{fog}{XML_CAMERA}{second}<shape type="sphere" id="ball"/>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    assert load_scene(tmp_path / "a.xml", sensor=0).instances[0].name == "ball"  # that in fog is not the camera
    with pytest.raises(FileFormatError, match="expected the camera to stand in air"):
        load_scene(tmp_path / "a.xml", sensor=1)


@pytest.mark.parametrize(
    ("fog", "who"),
    [
        ({"type": "sphere", "radius": 2.0}, "camera"),
        ({"type": "sphere", "radius": 50.0}, "camera"),
        ({"type": "cube"}, "camera"),
        ({"type": "sphere", "radius": 0.3, "center": [-0.6, 0.0, 0.0]}, "projector"),
        ({"type": "sphere", "radius": 0.3, "center": [0.6, 0.0, 0.0]}, ""),
        ({"type": "sphere", "radius": 1.0, "center": [0.0, 0.0, 3.0]}, ""),
        ({"type": "sphere", "radius": 1.0, "center": [0.0, 0.0, -3.0]}, ""),
    ],
)
@pytest.mark.parametrize("medium", [FOG, SMOKE], ids=["fog", "smoke"])
@pytest.mark.parametrize("shell", [False, True])
def test_a_device_inside_a_medium_is_refused(
    fog: dict[str, Any], who: str, medium: dict[str, Any], shell: bool
) -> None:
    """Also behind another surface: the shell is a ball of glass around the camera alone."""
    bodies: dict[str, Any] = {"fog": fog | MATCHED | {"interior": medium}}
    if shell:
        bodies["shell"] = {"type": "sphere", "radius": 0.05, "bsdf": {"type": "thindielectric"}}
    loaded = load_scene(wall_behind(**bodies))
    rig = loaded.rig(baseline_m=0.6, width=8)  # at x = -0.6: Mitsuba's x is to the left
    if not who:
        assert rangesim.transport(loaded, rig, [], spp=1, caustics=False).energy.ambient.max() > 0
        return
    with pytest.raises(ValueError, match=f"expected the {who} to stand in air, .* medium of shape 'fog'"):
        rangesim.transport(loaded, rig, [], spp=1)


def test_a_camera_inside_absorbing_glass_is_refused() -> None:
    water = {"type": "sphere", "radius": 2.0, "bsdf": {"type": "dielectric"}, "interior": SMOKE}
    loaded = load_scene(wall_behind(water=water))
    with pytest.raises(ValueError, match=r"expected the camera to stand in air, .* medium of shape 'water'"):
        rangesim.transport(loaded, loaded.rig(width=8), [], spp=1)


@pytest.mark.parametrize("medium", [FOG, SMOKE], ids=["fog", "smoke"])
@pytest.mark.parametrize("kind", ["ball", "box", "glass"])
def test_a_body_whose_normals_point_inwards_is_refused(kind: str, medium: dict[str, Any]) -> None:
    """The medium would be around it: in front of it the light would not be weakened, and behind it would."""
    if kind == "glass" and medium is FOG:
        medium = {**SMOKE, "sigma_t": 0.1}
    shape = {"type": "cube", "to_world": look(3.0, 4.0)} if kind == "box" else {"type": "sphere", "center": [0, 0, 3]}
    body = {**shape, **({"bsdf": {"type": "dielectric"}} if kind == "glass" else MATCHED), "interior": medium}
    for name, more, is_right in (("right", {}, True), ("turned", {"flip_normals": True}, False)):
        loaded = load_scene(wall_behind(**{name: body | more}))
        rig = loaded.rig(width=8)
        if is_right:
            rangesim.transport(loaded, rig, [], spp=1, caustics=False)
            continue
        with pytest.raises(ValueError, match=r"normals of shape 'turned' to point out of .* the camera sees them"):
            rangesim.transport(loaded, rig, [], spp=1)


@pytest.mark.validation
def test_an_exterior_medium_that_no_body_holds_is_refused() -> None:
    """A bubble of air in smoke: refused in the open, taken inside a ball of smoke, whichever way it is modelled."""
    bubble = {"type": "sphere", "radius": 0.3, "center": [0, 0, 3], "bsdf": {"type": "dielectric", "int_ior": 1.2}}
    loaded = load_scene(wall_behind(bubble=bubble | {"exterior": SMOKE}))
    with pytest.raises(ValueError, match=r"a body that holds the exterior medium of shape 'bubble'.* the camera would"):
        rangesim.transport(loaded, loaded.rig(width=8), [], spp=1)
    around = {"type": "sphere", "radius": 1.0, "center": [0, 0, 3], "bsdf": {"type": "dielectric"}, "interior": SMOKE}
    for side in ({"exterior": SMOKE}, {"interior": SMOKE, "flip_normals": True}):
        loaded = load_scene(wall_behind(around=around, bubble=bubble | side))
        rangesim.transport(loaded, loaded.rig(width=8), [], spp=1, caustics=False)


# ---- Pipes and devices ---------------------------------------------------------------------------------------------


def filename(name: str) -> str:
    return f'<string name="filename" value="{name}"/>'


def medium(kind: str) -> str:
    volume = f'<volume name="albedo" type="gridvolume">{filename(kind)}</volume>'
    return f'<bsdf type="null"/><medium name="interior" type="heterogeneous">{volume}</medium>'


NAMING = {
    "mesh.ply": f'<shape type="ply">{filename("mesh.ply")}</shape>',
    "mesh.obj": f'<shape type="obj">{filename("mesh.obj")}</shape>',
    "a.serialized": f'<shape type="serialized">{filename("a.serialized")}</shape>',
    "sdf.vol": f'<shape type="sdfgrid">{filename("sdf.vol")}</shape>',
    "hair.txt": f'<shape type="bsplinecurve">{filename("hair.txt")}</shape>',
    "blobs.ply": f'<shape type="ellipsoids">{filename("blobs.ply")}</shape>',
    "fog.vol": f'<shape type="sphere">{medium("fog.vol")}</shape>',
    "sky.exr": f'<emitter type="envmap">{filename("sky.exr")}</emitter>',
    "paint.png": f'<texture type="bitmap">{filename("paint.png")}</texture>',
    "a.bsdf": f'<bsdf type="measured">{filename("a.bsdf")}</bsdf>',
    "a.spd": '<bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf>',
    "b.spd": '<default name="n" value="b"/><bsdf type="diffuse"><spectrum name="x" filename="$n.spd"/></bsdf>',
    "part.xml": '<include filename="part.xml"/>',
    "sub/part.xml": '<path value="sub"/><include filename="part.xml"/>',
    "sub/a.spd": '<path value="sub"/><bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf>',
    "sub/other.xml": '<include filename="sub/include_other.xml"/>',  # which lies beside the file that includes it
}


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
@pytest.mark.parametrize("name", NAMING)
def test_scenes_name_plain_files(tmp_path: Path, name: str, kind: str) -> None:
    """Mitsuba 3.9 waits for ever for most of these pipes, and reads a device until there is no memory."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "include_other.xml").write_text(
        '<scene version="3.0.0"><include filename="other.xml"/></scene>'
    )
    if kind == "pipe":
        os.mkfifo(tmp_path / name)
    elif kind == "device":
        (tmp_path / name).symlink_to("/dev/zero")
    else:
        (tmp_path / name).mkdir()
    body = f'{NAMING[name]}<shape type="sphere"/>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}{body}</scene>')
    with pytest.raises(FileFormatError, match=rf"a\.xml.*cannot read .*{name.split('/')[-1]}: it is no plain file"):
        load_scene(tmp_path / "a.xml")


@pytest.mark.parametrize("kind", ["ply", "serialized", "bitmap", "envmap", "spectrum", "irregular"])
def test_dictionaries_name_plain_files(tmp_path: Path, kind: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    thing = {"type": kind, "filename": str(tmp_path / "pipe")}
    holder = {"type": "diffuse", "reflectance": thing} if kind in ("bitmap", "spectrum", "irregular") else thing
    with pytest.raises(FileFormatError, match=r"cannot read .*pipe: it is no plain file"):
        load_scene(ball() | {"thing": holder})


def test_files_of_scenes_have_a_size(tmp_path: Path) -> None:
    path = mesh(tmp_path, "a.ply", binary_ply(2))
    assert load_scene(path).instances[0].name == "part"
    with limits.raised(bytes=100), pytest.raises(FileFormatError, match=r"at most 100 bytes in .*a\.ply"):
        load_scene(path)


def test_an_include_searches_its_own_paths(tmp_path: Path) -> None:
    """The folder of the file that includes first, then the path that was added last, and only in that file."""
    for folder in ("p", "q"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "part.xml").write_text(
            f'<scene version="3.0.0"><shape type="sphere" id="{folder}"/></scene>'
        )
    (tmp_path / "a.xml").write_text(
        f'<scene version="3.0.0">{XML_CAMERA}<path value="p"/><path value="q"/><include filename="part.xml"/></scene>'
    )
    assert [i.name for i in load_scene(tmp_path / "a.xml").instances] == ["q"]
    (tmp_path / "q" / "part.xml").unlink()
    os.mkfifo(tmp_path / "q" / "part.xml")
    with pytest.raises(FileFormatError, match=r"q/part\.xml: it is no plain file"):
        load_scene(tmp_path / "a.xml")
    (tmp_path / "p" / "outer.xml").write_text(
        '<scene version="3.0.0"><path value="../q"/><include filename="part.xml"/></scene>'
    )
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{XML_CAMERA}<include filename="p/outer.xml"/></scene>')
    assert [i.name for i in load_scene(tmp_path / "a.xml").instances] == ["p"]
