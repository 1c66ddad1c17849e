# SPDX-License-Identifier: Apache-2.0
"""The command line."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
from scenes.tables import two_boxes_on_a_plane
from typer.testing import CliRunner

import pcgraph
from pcgraph.cli import app
from pcgraph.families import member, members
from pcgraph.io import decode_cloud
from pcgraph.io.ply import encode_ply
from pcgraph.tree.learned import EdgeModel


def ply(points) -> bytes:
    points = np.asarray(points, float).reshape(-1, 3)
    return encode_ply({name: points[:, i] for i, name in enumerate("xyz")})


def run(*arguments):
    return CliRunner().invoke(app, ["segment", *map(str, arguments)])


@pytest.fixture
def scene(tmp_path):
    points, _, _ = two_boxes_on_a_plane()
    path = tmp_path / "scene.ply"
    path.write_bytes(ply(points))
    return path


VIEW = ("--viewpoint", "0.8", "-1", "3")


def test_segment_writes_a_file_and_a_summary(scene, tmp_path):
    done = run(scene, "--out", tmp_path / "new" / "folder", *VIEW)
    assert done.exit_code == 0, done.output
    summary = dict(line.split(maxsplit=1) for line in done.stdout.splitlines() if line.strip())
    assert summary["objects"].strip() == "3"
    assert "supervoxels" in summary
    assert "seconds" in summary
    names = sorted(path.name for path in (tmp_path / "new" / "folder").iterdir())
    assert names == ["scene.segmentation.npz", "scene.segments.ply"]
    labelled = pcgraph.read_cloud(tmp_path / "new" / "folder" / "scene.segments.ply")
    saved = pcgraph.load_segmentation(tmp_path / "new" / "folder" / "scene.segmentation.npz")
    assert np.array_equal(labelled.columns["object"], saved.labels)
    assert np.array_equal(labelled.columns["part"], saved.parts)


def records(done):
    assert done.exit_code == 0, done.output
    return [json.loads(line, parse_constant=pytest.fail) for line in done.stdout.splitlines()]


def test_many_clouds_as_lines_of_json_with_levels_and_boxes(scene, tmp_path):
    pcgraph.write_cloud(tmp_path / "other.pcd", pcgraph.read_cloud(scene))
    options = ("--json", "--boxes", "--levels", "2,5", "--colorize", *VIEW)
    done = run(scene, tmp_path / "other.pcd", "--out", tmp_path, *options)
    first, second = records(done)
    assert (first["cloud"], first["objects"], first["written"][1]) == (
        str(scene), 3, str(tmp_path / "scene.segmentation.npz")
    )  # fmt: skip
    assert second["written"][0] == str(tmp_path / "other.segments.pcd")
    assert second["boxes"] == first["boxes"]
    assert sum(one["points"] for one in first["boxes"]) == first["segmented"]
    assert "1 of 2" in done.stderr
    labelled = pcgraph.read_cloud(first["written"][0])
    assert [len(np.unique(labelled.columns[f"level_{n}"])) for n in (2, 5)] == [2, 5]
    assert len(np.unique(labelled.colors, axis=0)) == 3
    pcgraph.write_cloud(tmp_path / "bad.ply", pcgraph.Cloud(np.full((3, 3), np.nan)))
    done = run(tmp_path / "bad.ply", scene, "--out", tmp_path, "--overwrite", "--json", *VIEW)
    assert done.exit_code == 1
    assert "at least one point" in done.stderr
    assert json.loads(done.stdout)["cloud"] == str(scene)
    assert_refused(run(scene, scene, "--out", tmp_path / "a.ply"), "as a folder for 2 clouds", tmp_path, [
        "bad.ply", "other.pcd", "other.segmentation.npz", "other.segments.pcd", "scene.ply", "scene.segmentation.npz",
        "scene.segments.ply",
    ])  # fmt: skip


def test_a_cloud_goes_from_pipe_to_pipe(scene, tmp_path):
    arguments = ["segment", "-", "--from", "ply", "--out", "-", "--to", "pcd", *map(str, VIEW)]
    done = CliRunner().invoke(app, arguments, input=scene.read_bytes())
    assert done.exit_code == 0, done.stderr
    labelled = decode_cloud(done.stdout_bytes, "a.pcd")
    assert np.array_equal(labelled.columns["object"], pcgraph.segment(scene, viewpoint=(0.8, -1, 3)).labels)
    assert [path.name for path in tmp_path.iterdir()] == [scene.name]
    refused = CliRunner().invoke(app, ["segment", "-"], input=scene.read_bytes())
    assert_refused(refused, "expected the format of the cloud on stdin", tmp_path, [scene.name])


def test_a_saved_segmentation_is_cut_again(scene, tmp_path):
    assert run(scene, "--out", tmp_path, *VIEW).exit_code == 0
    saved = tmp_path / "scene.segmentation.npz"
    done = CliRunner().invoke(app, ["cut", str(saved), "--objects", "6", "--levels", "9", "--boxes"])
    assert len(records(done)) == 6
    finer = pcgraph.read_cloud(tmp_path / "scene.cut.ply")
    segmentation = pcgraph.load_segmentation(saved)
    assert np.array_equal(finer.columns["object"], segmentation.cut(6))
    assert np.array_equal(finer.columns["level_9"], segmentation.cut(9))
    segmentation.save(tmp_path / "bare.npz")
    names = ["bare.npz", "scene.cut.ply", "scene.ply", "scene.segmentation.npz", "scene.segments.ply"]
    refused = CliRunner().invoke(app, ["cut", str(tmp_path / "bare.npz"), "--objects", "6"])
    assert_refused(refused, "holds no points, as it was saved without its cloud", tmp_path, names)
    told = CliRunner().invoke(app, ["info", str(saved), str(tmp_path / "bare.npz"), "--json"])
    whole, bare = records(told)
    assert whole["segmentation"] == bare["segmentation"]
    assert (whole["segmentation"]["objects"], whole["finite"], "finite" in bare) == (3, segmentation.labels.size, False)
    assert "a segmentation" in CliRunner().invoke(app, ["info", str(saved)]).stdout
    refused = CliRunner().invoke(app, ["cut", str(scene)])
    assert_refused(refused, "expected a file that Segmentation.save wrote", tmp_path, names)


def test_info_tells_what_a_file_holds(scene, tmp_path):
    cloud = pcgraph.Cloud(np.array([[0, 0, 0], [1, 2, 3], [np.nan] * 3], np.float32))
    cloud.columns["intensity"] = np.array([3.0, np.nan, 5.0], np.float32)
    pcgraph.write_cloud(tmp_path / "a.pcd", cloud)
    (record,) = records(CliRunner().invoke(app, ["info", "--json", str(tmp_path / "a.pcd")]))
    assert (record["shape"], record["finite"], record["high"]) == ([3], 2, [1, 2, 3])
    assert record["columns"] == {"intensity": {"type": "float32", "low": 3.0, "high": 5.0}}
    columns = {"gps_time": 3.1e8 + 0.001 * np.arange(9), "n": np.arange(9) + 10**8}
    copies = pcgraph.Cloud(np.ones((9, 3)), columns=columns)
    pcgraph.write_cloud(tmp_path / "copies.npz", copies)
    told = CliRunner().invoke(app, ["info", str(tmp_path / "copies.npz")]).stdout
    assert "float64, 310000000 to 310000000.008\n" in told
    assert "int64, 100000000 to 100000008\n" in told
    assert "spacing" not in told
    done = CliRunner().invoke(app, ["info", str(tmp_path / "none.pcd"), str(scene)])
    assert done.exit_code == 1
    assert "No such file" in done.stderr
    assert "spacing" in done.stdout


def test_number_of_objects_and_one_file(scene, tmp_path):
    done = run(scene, "--out", tmp_path / "a.ply", "--objects", 7, "--no-color", *VIEW)
    assert done.exit_code == 0, done.output
    assert len(np.unique(pcgraph.read_cloud(tmp_path / "a.ply").columns["object"])) == 7


def test_an_output_that_exists_is_replaced_only_if_told(scene, tmp_path):
    """And the input never."""
    out = tmp_path / "a.ply"
    out.write_bytes(b"a thesis")
    assert_refused(run(scene, "--out", out), "a.ply exists: add --overwrite", tmp_path, ["a.ply", scene.name])
    assert out.read_bytes() == b"a thesis"
    done = run(scene, "--out", out, "--overwrite", *VIEW)
    assert done.exit_code == 0, done.output
    assert "object" in pcgraph.read_cloud(out).columns
    before, link = scene.read_bytes(), tmp_path / "scene.segments.ply"
    link.symlink_to(scene)
    for place in (scene, tmp_path):
        done = run(scene, "--out", place, "--overwrite")
        assert_refused(done, "is an input: choose another --out", tmp_path, ["a.ply", scene.name, link.name])
    assert scene.read_bytes() == before


def test_colours_that_are_not_used_are_kept(tmp_path):
    points, _, _ = two_boxes_on_a_plane()
    shades = np.random.default_rng(2).integers(0, 256, (len(points), 3), np.uint8)
    columns = {name: points[:, i] for i, name in enumerate("xyz")}
    columns |= {name: shades[:, i] for i, name in enumerate(("red", "green", "blue"))}
    (tmp_path / "a.ply").write_bytes(encode_ply(columns))
    done = run(tmp_path / "a.ply", "--out", tmp_path / "b.ply", "--no-color", *VIEW)
    assert done.exit_code == 0, done.output
    read = pcgraph.read_cloud(tmp_path / "b.ply")
    assert np.array_equal(read.colors, shades)
    assert np.array_equal(read.columns["object"], pcgraph.segment(points, viewpoint=(0.8, -1, 3)).labels)


def test_compile_says_how_long_it_took():
    done = CliRunner().invoke(app, ["compile"])
    assert done.exit_code == 0, done.output
    assert done.stdout.split()[0] == "seconds"
    assert done.stderr == ""


@pytest.mark.parametrize("points", [[[1, 2, 3]], [[1, 2, 3], [4, 5, 6]], np.ones((9, 3))])
def test_few_points_work(points, tmp_path):
    path = tmp_path / "few.ply"
    path.write_bytes(ply(points))
    done = run(path, "--out", tmp_path / "few.npz")
    assert done.exit_code == 0, done.output
    assert (pcgraph.load_segmentation(tmp_path / "few.npz").labels >= 0).all()


def assert_refused(done, message, folder, files):
    assert done.exit_code == 1
    assert done.stdout == ""
    assert done.stderr.startswith("pcgraph: ")
    assert done.stderr.endswith(".\n")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in folder.iterdir()) == sorted(files)


CONTENTS = {
    "empty.ply": (ply(np.empty((0, 3))), "at least one point"),
    "nan.ply": (ply(np.full((5, 3), np.nan)), "all 5 points are NaN"),
    "short.ply": (ply(np.ones((5, 3)))[:-1], "promises 5 vertices"),
    "text.ply": (b"hello", "PLY header"),
    "text.pcd": (b"hello", "PCD header"),
    "cloud.doc": (b"word", "expected a file ending in .pcd, .ply, "),
}


@pytest.mark.parametrize("name", CONTENTS)
def test_bad_files(name, tmp_path):
    content, message = CONTENTS[name]
    (tmp_path / name).write_bytes(content)
    assert_refused(run(tmp_path / name, "--out", tmp_path / "out.ply"), message, tmp_path, [name])


def test_bad_options(scene, tmp_path):
    for options, message in (
        (("--objects", 0), "expected a whole number n"),
        (("--objects", 10**6), "expected a whole number n"),
        (("--voxel-size", -1), "finite voxel_size above 0 metres, got -1"),
        (("--voxel-size", 0), "above 0 metres, got 0"),
        (("--voxel-size", 0.1, "--seed-size", 0.01), "seed_size of at least"),
        (("--voxel-size", "nan"), "voxel_size"),
        (("--objects", 2, "--altitude", 0.5), "--objects or --altitude, got both"),
        (("--altitude", "nan"), "object_altitude to be a finite number"),
        (("--min-size", 0), "min_size as a whole number of at least 1"),
        (
            ("--linkage", "x"),
            "convexity, felzenszwalb, lccp, mumford-shah, quasi-flat, region, ward, or FILE.py:NAME, got 'x'",
        ),
        (("--linkage", ""), "got ''"),
        (("--linkage", tmp_path / "none.json"), "cannot read"),
        (("--method", "supervoxels"), "one of surface-growth, vccs, or FILE.py:NAME, got 'supervoxels'"),
        (("--out", "-"), "expected one cloud, --to and neither --json nor --boxes"),
        (("--levels", "3,x"), "expected --levels as whole numbers with commas, such as 10,50,200, got '3,x'"),
        (("--levels", "0"), "got '0'"),
        (("--out", tmp_path / "a.doc"), "got 'a.doc': choose another name"),
        (("--out", tmp_path / "no" / "a.ply"), "no folder"),
        (("--out", scene), "is an input: choose another --out"),
        (("--out", scene / "below"), "cannot create the folder"),
    ):
        base = () if "--out" in options else ("--out", tmp_path / "out.npz")
        assert_refused(run(scene, *base, *options), message, tmp_path, [scene.name])


def test_missing_file_in_a_process_of_its_own(tmp_path):
    command = [sys.executable, "-m", "pcgraph", "segment", str(tmp_path / "none.pcd")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert_refused_process = (done.returncode, done.stdout, list(tmp_path.iterdir()))
    assert assert_refused_process == (1, "", [])
    assert done.stderr == f"pcgraph: cannot read {tmp_path / 'none.pcd'}: No such file or directory.\n"


@pytest.mark.parametrize("letters", [256, 300, 5000])
def test_names_too_long_are_one_sentence(scene, tmp_path, letters):
    name = "n" * letters
    for arguments in (
        (f"{name}.ply",),
        (tmp_path / f"{name}.pcd", "--out", tmp_path / "out.npz"),
        (scene, "--out", tmp_path / f"{name}.npz"),
        (scene, "--out", tmp_path / name),
        (scene, "--linkage", f"{name}.json", "--out", tmp_path / "out.npz"),
    ):
        done = run(*arguments)
        assert_refused(done, "File name too long", tmp_path, [scene.name])
        assert len(done.stderr) <= 300


def test_a_link_to_itself_is_one_sentence(scene, tmp_path):
    loop = tmp_path / "loop.ply"
    loop.symlink_to(loop)
    names = [scene.name, loop.name]
    for arguments in ((loop,), (loop, "--out", tmp_path / "out.npz")):
        assert_refused(run(*arguments), f"cannot read {loop}", tmp_path, names)
    assert_refused(run(scene, "--out", loop), "is a link to a file that does not exist", tmp_path, names)
    assert_refused(run(scene, "--out", loop / "a.ply"), "there is no folder", tmp_path, names)


def test_a_working_directory_that_is_gone_is_one_sentence(scene, tmp_path):
    code = """if True:
        import os, sys
        from pcgraph.__main__ import main
        os.mkdir(sys.argv[1]); os.chdir(sys.argv[1]); os.rmdir(sys.argv[1])
        sys.argv = ["pcgraph", "segment", sys.argv[2], *sys.argv[3:]]
        main()
    """
    for more in ((), ("--out", "a.ply"), ("--out", "folder")):
        command = [sys.executable, "-c", code, str(tmp_path / "gone"), str(scene), *more]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr == "pcgraph: expected a working directory, but this one is gone: change to another.\n"


@pytest.mark.parametrize("order", ["\x1b[2J", "\u202e", "\x9b31m", "\n", "\r", "\u2028", "\u200f", "\udcff"])
def test_names_give_no_orders_to_a_terminal(scene, tmp_path, order):
    code = {"\n": "\\n"}.get(order[0], f"\\u{ord(order[0]):04x}") + order[1:]
    hostile = tmp_path / f"red{order}evil.ply"
    scene.rename(hostile)
    done = run(hostile, "--out", tmp_path / "out", *VIEW)
    assert done.exit_code == 0, done.output
    places = [line.split(maxsplit=1)[1] for line in done.stdout.splitlines() if line.startswith("written")]
    assert places == [f"{tmp_path}/out/red{code}evil{end}" for end in (".segments.ply", ".segmentation.npz")]
    missing = run(tmp_path / f"{order}no.ply")
    assert (missing.exit_code, missing.stdout) == (1, "")
    assert missing.stderr.count("\n") == 1
    assert not any(order[0] in text for text in (done.stdout.replace("\n", "") + missing.stderr[:-1],))


def test_a_directory_is_no_cloud(tmp_path):
    folder = tmp_path / "scans.pcd"
    folder.mkdir()
    for path in (tmp_path, folder):
        with pytest.raises(pcgraph.CloudReadError, match="is a directory: expected a file"):
            pcgraph.read_cloud(path)


def test_help_names_units():
    done = CliRunner().invoke(app, ["segment", "--help"])
    assert done.exit_code == 0
    assert "metres" in done.stdout


def test_every_member_of_a_family_is_named_in_the_help():
    text = CliRunner(env={"COLUMNS": "200", "TERM": "dumb"}).invoke(app, ["segment", "--help"]).stdout
    assert [*members("SupervoxelMethod")] == ["surface-growth", "vccs"]
    for name in (*members("SupervoxelMethod"), *members("Linkage")):
        assert name in text


def test_a_linkage_from_outside_has_a_name_too():
    class OutermostLinkage(pcgraph.Linkage):
        default_object_altitude = 1.0
        default_part_altitude = 0.5

        def merges(self, graph, leaves):
            raise NotImplementedError

    try:
        assert isinstance(member("Linkage", "outer"), OutermostLinkage)
    finally:
        del OutermostLinkage
        gc.collect()
    assert "outermost" not in members("Linkage")


@pytest.mark.parametrize("linkage", ["convexity", "mumford-shah", "lccp"])
def test_linkage_and_cut(linkage, scene, tmp_path):
    chosen = members("Linkage")[linkage]()
    altitude = 0.4 * chosen.default_object_altitude
    options = ("--linkage", linkage[:5], "--altitude", altitude, "--min-size", 40)
    done = run(scene, "--out", tmp_path / "a.npz", *options, *VIEW)
    assert done.exit_code == 0, done.output
    result = pcgraph.segment(scene, viewpoint=(0.8, -1, 3), linkage=chosen)
    saved = pcgraph.load_segmentation(tmp_path / "a.npz")
    assert np.array_equal(saved.labels, result.cut(altitude=altitude, min_size=40))


OWN = """
from dataclasses import dataclass
import pcgraph
from pcgraph.tree.single_linkage import single_linkage

@dataclass(frozen=True)
class Angles(pcgraph.Linkage):
    power: float = 1.0
    default_object_altitude = 0.5
    default_part_altitude = 0.1

    def merges(self, graph, leaves):
        return single_linkage(graph.n_nodes, graph.edges, graph.edge_features.normal_angle**self.power)

squared = Angles(2.0)
nothing = 3

@dataclass(frozen=True)
class Needs(Angles):
    def __post_init__(self):
        raise RuntimeError("no")
"""


def test_a_linkage_of_a_file_of_ones_own(scene, tmp_path):
    own, cut = tmp_path / "own.py", {}
    own.write_text(OWN)
    for name, altitude in (("Angles", 0.5), ("squared", 0.25)):
        out = tmp_path / f"{name}.pcd"
        done = run(scene, "--out", out, "--linkage", f"{own}:{name}", "--altitude", altitude, *VIEW)
        assert done.exit_code == 0, done.output
        cut[name] = pcgraph.read_cloud(out).columns["object"]
        out.unlink()
    assert len(np.unique(cut["squared"])) > 1
    assert np.array_equal(cut["squared"], cut["Angles"])
    (tmp_path / "fails.py").write_text("1 / 0")
    files = ["fails.py", "own.py", scene.name]
    for name, message in (
        ("own.py:Other", "expected Other to be a Linkage or a class of them, got None"),
        ("own.py:nothing", "got 3"),
        ("own.py:Needs", "Needs: RuntimeError: no"),
        ("fails.py:A", "fails: ZeroDivisionError: division by zero"),
        ("none.py:A", "none.py does not exist"),
    ):
        done = run(scene, "--out", tmp_path / "out.npz", "--linkage", tmp_path / name)
        assert_refused(done, message, tmp_path, files)
    done = run(scene, "--out", tmp_path / "out.npz", "--method", f"{own}:Angles")
    assert_refused(done, "expected Angles to be a SupervoxelMethod", tmp_path, files)


def test_a_learned_linkage_from_its_file(scene, tmp_path):
    names = ("step_voxels", "concavity")
    model = EdgeModel(names, (0.0, 0.0), (1.0, 1.0), (2.0, 3.0), -2.0, 0.5)
    model.save(tmp_path / "edges.json")
    done = run(scene, "--out", tmp_path / "a.npz", "--linkage", tmp_path / "edges.json", *VIEW)
    assert done.exit_code == 0, done.output


def test_version():
    done = CliRunner().invoke(app, ["--version"])
    assert (done.exit_code, done.stdout) == (0, f"pcgraph {pcgraph.__version__}\n")
    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())["project"]
    assert pcgraph.__version__ == project["version"]


def test_features_by_name_and_columns_from_end_to_end(tmp_path):
    points, truth, _ = two_boxes_on_a_plane()
    columns = {"Intensity": (900 + 70 * truth).astype(np.uint16), "time": 1.7e9 + np.arange(len(points)) * 1e-6}
    stored = {name: points[:, i] for i, name in enumerate("xyz")} | columns
    (tmp_path / "a.ply").write_bytes(encode_ply(stored))
    done = run(tmp_path / "a.ply", "--out", tmp_path, "--features", "Intensity", "--features", "time", *VIEW)
    assert done.exit_code == 0, done.output
    expected = pcgraph.segment(points, viewpoint=(0.8, -1, 3), features=np.stack([*columns.values()], axis=1))
    read = pcgraph.read_cloud(tmp_path / "a.segments.ply")
    assert np.array_equal(read.columns["supervoxel"], expected.supervoxels)
    for name, column in columns.items():
        assert read.columns[name].dtype == column.dtype
        assert np.array_equal(read.columns[name], column)
    (tmp_path / "a.segments.ply").unlink()
    (tmp_path / "a.segmentation.npz").unlink()
    done = run(tmp_path / "a.ply", "--out", tmp_path / "b.ply", "--features", "rings")
    assert_refused(done, "got 'rings'; there are: Intensity, time", tmp_path, ["a.ply"])


def test_warnings_are_a_line_on_stderr(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (900, 3))
    pcgraph.write_segmentation(tmp_path / "a.ply", pcgraph.Cloud(points), pcgraph.segment(points, voxel_size=0.3))
    done = run(tmp_path / "a.ply", "--out", tmp_path / "b.npz", "--voxel-size", 0.002)
    assert done.exit_code == 0
    assert "pcgraph: warning: expected far fewer objects than supervoxels" in done.stderr
    assert "cli.py" not in done.stderr
    np.savez(tmp_path / "c.npz", points=points[:50], name=np.full(50, "a"))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        done = run(tmp_path / "c.npz", "--out", tmp_path / "d.ply")
    assert done.stderr.splitlines()[0] == "pcgraph: warning: left out what holds no numbers: the array 'name'."


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["segment", "--help"], ["segment", "scene.ply"]])
def test_a_full_disk_under_what_is_printed_is_one_sentence(arguments, scene):
    """It was a traceback, although the files were written."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "pcgraph", *arguments],
            cwd=scene.parent,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.stderr == "pcgraph: cannot print: no space left on the device.\n"
    assert done.returncode == 1
    written = sorted(path.name for path in scene.parent.iterdir() if path != scene)
    assert written == (["scene.segmentation.npz", "scene.segments.ply"] if arguments[-1] == "scene.ply" else [])
