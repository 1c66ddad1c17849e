# SPDX-License-Identifier: Apache-2.0
"""A scene never runs native code that lies beside it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rangesim
from rangesim.errors import FileFormatError

SOURCE = """
#include <stdio.h>
__attribute__((constructor)) static void run(void) { FILE *f = fopen("%s", "w"); if (f) fclose(f); }
"""
XML = """<scene version="3.0.0">
<sensor type="perspective">
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
<transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform></sensor>
<shape type="rectangle">%s</shape></scene>"""


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that native code in `plugins/` of the working directory, where the scene is, makes when it is run."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make a plugin with")
    marker, code = tmp_path / "was_run", tmp_path / "evil.c"
    code.write_text(SOURCE % marker)
    (tmp_path / "plugins").mkdir()
    subprocess.run([compiler, "-shared", "-fPIC", "-o", tmp_path / "plugins" / "evil.so", code], check=True)
    for name in ("hdrfilm", "rectangle", "perspective", "diffuse"):
        shutil.copy(tmp_path / "plugins" / "evil.so", tmp_path / "plugins" / f"{name}.so")
    shutil.copy(tmp_path / "plugins" / "evil.so", tmp_path / "evil.so")
    monkeypatch.chdir(tmp_path)
    return marker


@pytest.mark.parametrize("name", ["evil", "../evil", "./evil", "$name", "plugins/evil"])
@pytest.mark.parametrize("default", ["evil", "../evil"])
def test_types_that_mitsuba_lacks_are_refused_unrun(name: str, default: str, marker: Path) -> None:
    scene = marker.parent / "scene.xml"
    given = f'<default name="name" value="{default}"/>'
    scene.write_text((XML % f'<bsdf type="{name}"/>').replace("<sensor", given + "<sensor", 1))
    with pytest.raises(FileFormatError, match="type"):
        rangesim.load_scene(scene)
    assert not marker.exists()


@pytest.mark.parametrize("name", ["evil", "../evil"])
def test_types_in_dictionaries_are_refused_unrun(name: str, marker: Path) -> None:
    scene = {"type": "scene", "shape": {"type": "rectangle", "bsdf": {"type": name}}}
    with pytest.raises(FileFormatError, match="type"):
        rangesim.load_scene(scene)
    assert not marker.exists()


def test_a_scene_of_plain_types_takes_mitsubas_own(marker: Path) -> None:
    """In a process of its own, where Mitsuba has loaded no plugin yet."""
    (marker.parent / "scene.xml").write_text(XML % '<bsdf type="diffuse"/>')
    code = "import rangesim; print(len(rangesim.load_scene('scene.xml').instances), rangesim.load_scene('plane').name)"
    done = subprocess.run([sys.executable, "-c", code], cwd=marker.parent, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "plane"]
    assert not marker.exists()
