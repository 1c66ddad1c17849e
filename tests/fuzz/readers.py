# SPDX-License-Identifier: Apache-2.0
"""The readers that are fuzzed. One entry declares one: what it is called with, its seeds, and what is made by hand."""

from __future__ import annotations

import fnmatch
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz import hostile, seeds
from fuzz.cloud_files import lies
from fuzz.hostile import Made
from fuzz.inputs import Input
from fuzz.mutation import MAX_BYTES, mutate, mutate_arguments
from rangesim.settings import limits

Arguments = tuple[str, ...]


@dataclass(frozen=True)
class Reader:
    """A function that reads what may come from anywhere.

    Parameters
    ----------
    name : names it in tables, and its directory in the corpus.
    read : called with the path of the input and its arguments; for a command, its entry point `main`.
    seeds : makes valid inputs by name.
    targets : patterns of the files that are mutated.
    by_hand : makes hostile inputs of a seed and one of its targets.
    share : tries of this reader for each try of a cheap one.
    command : name of the program if `read` is a command line, which ends in exit status 0, 1 and a line, or 2.
    refuses : names of the exceptions by which it refuses; not subclasses of ValueError, for those have escaped.
    check : looks at what `read` returned; an AssertionError is a failure.
    names_file : whether a refusal must name the file.
    lists : whether a command lists what is wrong, line by line, before the line that says so.
    may_write : patterns of paths that it may leave in the folder of the input.
    mutates_arguments : whether it is the command line that is mutated, not files.
    renames : whether the entry is given hostile names; once is enough where several readers call the same function.
    """

    name: str
    read: Callable[[Path, Arguments], Any]
    seeds: Callable[[], seeds.Seeds]
    targets: tuple[str, ...] = ("*",)
    by_hand: tuple[Callable[[Input, str], Made], ...] = ()
    share: float = 1.0
    command: str = ""
    refuses: tuple[str, ...] = ("ValueError", "FileFormatError")
    check: Callable[[Any], None] = field(default=lambda result: None)
    names_file: bool = True
    lists: bool = False
    may_write: tuple[str, ...] = ()
    mutates_arguments: bool = False
    renames: bool = True

    def made_by_hand(self, known: Mapping[str, Input]) -> Made:
        """Hostile inputs by name: the seeds themselves, those of any file, those of this kind."""
        made: Made = {f"seed {name}": partial(_itself, seed) for name, seed in known.items()}
        first = next(iter(known.values()))
        if self.mutates_arguments:
            for by_hand in self.by_hand:
                made |= by_hand(first, "")
            return made
        suffixes: dict[str, str] = {}
        for target in self.targets_of(first):
            suffixes.setdefault(target.rpartition(".")[2], target)
        for target in suffixes.values():
            made |= hostile.any_file(first, target)
            for by_hand in self.by_hand:
                made |= by_hand(first, target)
        return made | hostile.any_name(first) if self.renames else made

    def targets_of(self, one: Input) -> list[str]:
        """Files of an input that are mutated."""
        return [n for n in one.files if any(fnmatch.fnmatch(n, t) for t in self.targets)]


class Cases:
    """The inputs of one reader by number: those made by hand come first."""

    def __init__(self, reader: Reader, known: Mapping[str, Input]) -> None:
        self.reader = reader
        self.seeds = known
        self.by_hand = reader.made_by_hand(known)
        self._makers = list(self.by_hand.values())

    def __call__(self, seed: int, number: int) -> Input:
        """Input `number` of the stream `seed`; always the same bytes."""
        if number < len(self._makers):
            return self._makers[number]()
        rng = Random(zlib.crc32(f"{self.reader.name} {seed} {number}".encode()))
        one = self.seeds[rng.choice(list(self.seeds))]
        if self.reader.mutates_arguments:
            return Input(one.files, one.entry, mutate_arguments(one.arguments, rng))
        for _ in range(rng.choice((1, 1, 1, 1, 2, 3))):
            target = rng.choice(self.reader.targets_of(one))
            content = one.files[target]
            assert isinstance(content, bytes)
            if len(content) < MAX_BYTES:
                one = one.with_file(target, mutate(target, content, rng))
        return one

    def name(self, number: int) -> str:
        """What a case is called: what was made by hand has a name."""
        names = list(self.by_hand)
        return names[number] if number < len(names) else f"case {number}"


def _itself(one: Input) -> Input:
    return one


# --- what they are called with ----------------------------------------------------------------------------------------


def _cloud(path: Path, _: Arguments) -> Any:
    import pcgraph

    return pcgraph.read_cloud(path)


def _vertices(path: Path, arguments: Arguments) -> Any:
    import warnings

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "read the .* vertices of the mesh")
        warnings.filterwarnings("ignore", "left out what the mesh file has besides")
        return _cloud(path, arguments)


def _edge_model(path: Path, _: Arguments) -> Any:
    from pcgraph.tree.learned import EdgeModel

    return EdgeModel.load(path)


def _node_classifier(path: Path, _: Arguments) -> Any:
    from pcgraph.learning import NodeClassifier

    return NodeClassifier.load(path)


def _predicts(classifier: Any) -> None:
    import numpy as np

    table = np.zeros((3, len(classifier.feature_names_)))
    table[1], table[2] = 1e300, -1.0
    fractions = classifier.estimator_.predict_proba(table)
    assert fractions.shape == (3, len(classifier.classes_))
    assert np.isfinite(fractions).all()


def _scene(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_scene(path)


def _image(path: Path, _: Arguments) -> Any:
    from rangesim.files.image_files import read_grey

    return read_grey(path)


def _image_folder(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.import_capture(path, rangesim.StructuredLight(8, 8, code="gray", axes=("columns", "rows")))


def _capture(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_capture(path)


def _decoded(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.decode(rangesim.load_capture(path))


def _experiment(path: Path, _: Arguments) -> Any:
    from rangesim.experiment import load_experiment

    return load_experiment(path)


def _sweep(path: Path, _: Arguments) -> Any:
    from rangesim.sweep import load_sweep

    return load_sweep(path)


def _dataset_spec(path: Path, _: Arguments) -> Any:
    from rangesim.dataset import load_spec

    return load_spec(path)


def _device(path: Path, _: Arguments) -> Any:
    from rangesim import presets

    return presets.describe(path)


def _calibration(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_calibration(path, (32, 48) if path.suffix == ".xml" else None)


def _opencv_rig(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_calibration(path, (32, 24), camera_size=(32, 24))


def _patterns(path: Path, _: Arguments) -> Any:
    from rangesim.results.pattern_sets import load_patterns

    return load_patterns(path)


def _frames_file(path: Path, _: Arguments) -> Any:
    import rangesim
    from rangesim.errors import without_warnings

    with without_warnings():
        return rangesim.import_capture(path, rangesim.AmcwToF((60e6,)))


def _tof_calibration(path: Path, _: Arguments) -> Any:
    from rangesim.calibration import load_tof_calibration

    return load_tof_calibration(path)


def _ouster(path: Path, _: Arguments) -> Any:
    from rangesim.recordings import read_ouster

    beside = path.with_name("drive.json")  # whatever the recording is called
    return read_ouster(path, beside if beside.exists() else None)


def _kitti(path: Path, _: Arguments) -> Any:
    from rangesim.recordings import read_kitti

    return read_kitti(path)


def _result(path: Path, _: Arguments) -> Any:
    from rangesim.results.experiment_results import load_result

    return load_result(path)


def _scan(path: Path, _: Arguments) -> Any:
    from rangesim.results.scan_results import load_scan

    return load_scan(path)


def _decoded_record(path: Path, _: Arguments) -> Any:
    from rangesim.results.decoded_captures import load_decoded

    return load_decoded(path)


def _signals(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_signals(path)


def _range_image(path: Path, _: Arguments) -> Any:
    import rangesim

    return rangesim.load_range_image(path)


def _rangesim(path: Path, arguments: Arguments) -> Any:
    from rangesim.cli import main

    return main()


def _run(path: Path, arguments: Arguments) -> Any:
    """`rangesim run` where more than a few seconds of honest work is refused as too large."""
    with limits.raised(memory=500_000_000, spp=64):
        return _rangesim(path, arguments)


def _pcgraph(path: Path, arguments: Arguments) -> Any:
    from pcgraph.cli import main

    return main()


# --- what must hold of what they return -------------------------------------------------------------------------------


def _arrays_agree(cloud: Any) -> None:
    import numpy as np

    shape = cloud.points.shape[:-1]
    assert cloud.points.dtype in (np.float32, np.float64)
    assert cloud.points.shape == (*shape, 3)
    assert len(shape) in (1, 2)
    if cloud.colors is not None:
        assert (cloud.colors.dtype, cloud.colors.shape) == (np.uint8, (*shape, 3))
    if cloud.normals is not None:
        assert cloud.normals.shape == (*shape, 3)
    if cloud.labels is not None:
        assert (cloud.labels.dtype, cloud.labels.shape) == (np.int32, shape)
    if cloud.viewpoint is not None:
        assert np.isfinite(cloud.viewpoint).all()


def _is_grey(image: Any) -> None:
    assert image.ndim == 2
    assert image.dtype.name in ("uint8", "uint16", "float32")


def _has_a_camera(scene: Any) -> None:
    import numpy as np

    assert scene.instances
    assert np.isfinite(scene.T_world_camera).all()
    assert 0 < scene.working_distance_m < np.inf


def _rig_is_finite(rig: Any) -> None:
    import numpy as np

    assert np.isfinite(rig.T_camera_projector).all()
    assert np.isfinite(rig.camera.directions([0.5, 0.5])[..., 2]).all()


def _is_sweep(sweep: Any) -> None:
    import numpy as np

    k, h, w = sweep.range_m.shape
    assert (k, h, w) == (sweep.returns, *sweep.rays.times_s.shape)
    assert np.isfinite(sweep.time_s).any()
    assert not np.isfinite(sweep.range_m[..., np.isnan(sweep.time_s)]).any()
    assert len(sweep.to_point_cloud(return_number=None).points) == np.isfinite(sweep.range_m).sum()


def _rings_agree(cloud: Any) -> None:
    import numpy as np

    assert np.isfinite(cloud.points).all()
    assert cloud.ring is None or cloud.ring.shape == cloud.points.shape[:-1]


# --- the list ---------------------------------------------------------------------------------------------------------


def _lies(kind: str) -> Callable[[Input, str], Made]:
    def made(seed: Input, target: str) -> Made:
        return {name: partial(seed.with_file, target, content) for name, content in lies() if name.startswith(kind)}

    return made


def _sidecar_trees(seed: Input, target: str) -> Made:
    return hostile.json_trees(seed, target) if target.endswith(".json") else {}


def _settings_to_run(seed: Input, target: str) -> Made:
    """Settings that can be run soon, or must be refused."""
    return {n: make for n, make in hostile.toml_files(seed, target).items() if n != "2000 instruments"}


def _options(*words: str) -> Callable[[Input, str], Made]:
    """Command lines of the seed in which the value of one option is another, or to which one is added."""

    def made(seed: Input, target: str) -> Made:
        lines: Made = {}
        for word in words:
            (option, value), start = word.removeprefix(hostile.NONSENSE).split(" ", 1), list(seed.arguments)
            if option in start:
                start[start.index(option) + 1] = value
            else:
                start += [option, value]
            lines[word] = partial(_itself, Input(seed.files, seed.entry, tuple(start)))
        return lines

    return made


def _nonsense(*words: str) -> tuple[str, ...]:
    return tuple(f"{hostile.NONSENSE}{word}" for word in words)


def _by_suffix(seed: Input, target: str) -> Made:
    """What is made by hand of a file in a result, by its suffix; of one file of each kind."""
    if target.endswith(".json"):
        return hostile.json_trees(seed, target)
    if target.endswith(".npz"):
        return hostile.npz_files(seed, target)
    return hostile.images(seed, target) if target.endswith(".png") else {}


def _with_arguments(make: Callable[[], seeds.Seeds], *lines: str) -> Callable[[], seeds.Seeds]:
    """Seeds called with command lines."""

    def called() -> seeds.Seeds:
        return {
            f"{name}, {line}": Input(one.files, one.entry, tuple(line.split()))
            for name, one in make().items()
            for line in lines
        }

    return called


def _beside_a_plane() -> seeds.Seeds:
    """A scene of a plane, to be run."""
    return {"plane": seeds.of_file("plane.xml", (seeds.SCENES / "plane.xml").read_bytes())}


def _small_experiment() -> seeds.Seeds:
    """An experiment on a plane, to be run; its command line makes it small."""
    plane = (seeds.SCENES / "plane.xml").read_bytes()
    text = b"""scene = "plane.xml"
seed = 1
max_depth = 3
[[instrument]]
name = "gray"
[instrument.sensor]
type = "structured-light"
projector_width = 32
projector_height = 24
code = { type = "gray-phase", period_px = 8.0 }
[[instrument]]
name = "amcw"
baseline_m = 0.03
[instrument.sensor]
type = "amcw-tof"
modulation_hz = [20e6, 100e6]
"""
    return {"small": seeds.of_file("experiment.toml", text + seeds.SPAD.encode(), **{"plane.xml": plane})}


def _calibrated_captures() -> seeds.Seeds:
    """A capture, and calibrations beside it."""
    capture = seeds.captures()["lines"]
    others = {"rig.json": seeds.rig_files()["pinhole"].files["rig.json"]}
    others |= {"calibration.xml": seeds.opencv_files()["procam"].files["calibration.xml"]}
    return {"capture": Input({**capture.files, **others}, "capture")}


def _bare_images() -> seeds.Seeds:
    """A folder of bare images."""
    return {"images": seeds.image_folders()["png"]}


def _one_cloud() -> seeds.Seeds:
    """A cloud of a plane and a box."""
    import numpy as np

    from pcgraph.io.ply import encode_ply

    x, y = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30))
    z = np.where((x > 0.4) & (y > 0.4), 0.8, 1.0)
    columns = {"x": x.ravel(), "y": y.ravel(), "z": z.ravel()}
    return {"box": seeds.of_file("cloud.ply", encode_ply(columns))}


_RESULT_PARTS = {
    "settings": ("result/experiment.json",),
    "passes": ("result/pass_*.npz",),
    "range": ("result/*/range.npz",),
    "causes": ("result/*/causes.npz",),
    "segmentation": ("result/*/segmentation.npz",),
    "tables": ("result/*/comparison.json", "result/*/measurement.json"),
    "captures": ("result/*/capture/*",),
}
_CLOUD = ("CloudReadError",)
_IMAGES = {"png": "png", "tif": "tiff", "bmp": "bmp", "jpg": "jpeg", "pgm": "pgm"}
_RUN = "run {entry} --out {out} --width 16 --height 12 --spp 1"
_DECODE = "decode {entry} --out {out} --code gray --projector 8x8 --axes columns,rows --bits 8"
_TURNED = "decode {entry} --out {out} --projector 8x8 --images *.png --order * --rotate 180 --channel grey --mirror"
_OF_RUN = (
    *_nonsense(
        "--width 1000000000",
        "--height 1000000000",
        "--width 0",
        "--width -5",
        "--width nan",
        "--spp 0",
        "--spp -1",
        f"--spp {10**30}",
        "--photons 1000",
        "--max-depth 0",
        f"--max-depth {10**12}",
        "--seed -1",
        f"--seed {2**70}",
        "--baseline nan",
        "--baseline inf",
        "--baseline 1e300",
        "--sensor x",
        "--unit-m 0",
        "--material glossy",
    ),
    "--baseline -1",
    "--baseline 0",
    "--seed 18446744073709551615",
)
_OF_DECODE = (
    *_nonsense(
        "--projector 0x0",
        "--projector 8",
        "--projector 8x",
        "--projector 1000000x1000000",
        f"--projector {'9' * 5000}x8",
        "--projector \u0661\u0662x8",
        "--projector -8x8",
        "--axes columns,columns",
        "--axes ,",
        "--axes rows,rows",
        "--bits 0",
        "--bits 99",
        f"--bits {10**30}",
        "--code x",
        "--order x",
        "--order ,",
        "--images none*",
        "--images ,",
        "--images none.txt",
        "--rotate 45",
        f"--rotate {10**30}",
        "--channel x",
        "--channel red",
        "--patterns none.json",
        "--sensor x",
        "--bits s0",
        "--bits s33",
    ),
    *(f"--code gray-phase --set period_px={text}" for text in ("nan", "inf", "1e-300", "[1]", "{a=1}", "'")),
    *(f"--code gray-phase --set steps={text}" for text in (10**30, 1000000000, 0)),
    "--set =",
    "--set type=x",
    "--set decoder.type=x",
    "--set contrast_of_scale=nan",
    "--set decoder={}",
    "--bits s8",
    "--rotate 90",
    "--images *.png",
    "--order *",
    f"--order {'*' * 5000}",
    "--axes rows,columns",
)
_OF_SEGMENT = (
    *_nonsense(
        "--voxel-size nan",
        "--voxel-size inf",
        "--voxel-size 0",
        "--voxel-size -1",
        "--voxel-size 1e300",
        "--voxel-size 1e-300",
        "--seed-size nan",
        "--seed-size 0",
        "--seed-size 1e300",
        "--objects 0",
        "--objects -1",
        f"--objects {10**30}",
        "--method x",
        "--linkage x",
        "--linkage none.json",
        "--altitude nan",
        "--altitude -1",
        "--min-size 0",
        f"--min-size {10**30}",
        "--range-growth nan",
        "--range-growth -1",
        "--range-growth 1e300",
        "--viewpoint nan",
        "--viewpoint inf",
    ),
    "--voxel-size 1e-6",
    "--seed-size 1e-9",
    "--objects 1000000000",
)
_MORE = "--sensor ideal-tof --seed 1 --baseline 0.2 --max-depth 3"
_PLAIN = "decode {entry} --out {out}"
_CALIBRATED = "decode {entry} --out {out} --calibration"

READERS = {
    reader.name: reader
    for reader in (
        *(
            Reader(
                suffix, _cloud, partial(seeds.cloud_files, suffix), by_hand=(_lies(suffix),), refuses=_CLOUD,
                check=_arrays_agree,
            )
            for suffix in ("ply", "pcd")
        ),
        *(
            Reader(suffix, _cloud, partial(seeds.scanner_files, suffix), refuses=_CLOUD, check=_arrays_agree)
            for suffix in ("las", "laz", "e57")
        ),
        *(
            Reader(
                f"vertices-{suffix}", _vertices, partial(seeds.mesh_files, suffix), by_hand=(hostile.meshes,),
                refuses=_CLOUD, check=_arrays_agree,
            )
            for suffix in ("obj", "stl", "off", "glb", "gltf")
        ),
        *(
            Reader(
                f"cloud-{suffix}", _cloud, partial(seeds.text_clouds, suffix), refuses=_CLOUD, check=_arrays_agree,
                share=0.5, renames=False,
            )
            for suffix in ("csv", "pts", "ptx")
        ),
        Reader(
            "cloud-nuscenes", _cloud, seeds.nuscenes_sweeps, refuses=_CLOUD, check=_arrays_agree, share=0.2,
            renames=False,
        ),
        Reader(
            "cloud-ouster", _cloud, seeds.lidar_recordings, ("*.pcap", "*.json"), (_sidecar_trees,), refuses=_CLOUD,
            check=_arrays_agree, share=0.2, renames=False,
        ),
        Reader(
            "npz", _cloud, partial(seeds.array_files, "npz"), by_hand=(hostile.npz_files,), refuses=_CLOUD,
            check=_arrays_agree,
        ),
        Reader("npy", _cloud, partial(seeds.array_files, "npy"), refuses=_CLOUD, check=_arrays_agree),
        Reader(
            "edge-model", _edge_model, seeds.edge_models, by_hand=(hostile.json_trees,),
            refuses=("ValueError", *_CLOUD),
        ),
        Reader(
            "node-classifier", _node_classifier, seeds.node_classifiers, by_hand=(hostile.json_trees,),
            refuses=("ValueError", *_CLOUD), check=_predicts,
        ),
        *(
            Reader(
                f"mesh-{suffix}", _scene, partial(seeds.mesh_files, suffix), by_hand=(hostile.meshes,), share=0.5,
                check=_has_a_camera,
            )
            for suffix in ("ply", "obj", "stl", "off", "glb", "gltf")
        ),
        Reader(
            "scene", _scene, seeds.scene_files, ("*.xml", "*.png", "*.ply", "*.obj"), (hostile.xml_files,), share=0.5,
            check=_has_a_camera,
        ),
        *(
            Reader(name, _image, partial(seeds.image_files, suffix), by_hand=(hostile.images,), check=_is_grey)
            for suffix, name in _IMAGES.items()
        ),
        Reader("exr", _image, partial(seeds.image_files, "exr"), by_hand=(hostile.exr_files,), check=_is_grey),
        Reader("image-folder", _image_folder, seeds.image_folders, share=0.5),
        Reader("capture", _capture, seeds.captures, ("*.json", "*.json", "*/00*.*"), (_sidecar_trees,)),
        Reader("capture-decoded", _decoded, seeds.captures, ("*.json",), (_sidecar_trees,), share=0.5),
        Reader("experiment", _experiment, seeds.experiments, by_hand=(hostile.toml_files,)),
        Reader("sweep", _sweep, seeds.sweeps, by_hand=(hostile.toml_files,), share=0.5, renames=False),
        Reader(
            "dataset-spec", _dataset_spec, seeds.dataset_specs, by_hand=(hostile.toml_files,), share=0.5, renames=False
        ),
        Reader("device", _device, seeds.devices, share=0.5),
        Reader("calibration-json", _calibration, seeds.rig_files, by_hand=(hostile.json_trees,), check=_rig_is_finite),
        Reader(
            "calibration-xml", _calibration, seeds.opencv_files, by_hand=(hostile.opencv_calibrations,),
            check=_rig_is_finite,
        ),
        Reader("patterns", _patterns, seeds.pattern_sets, ("*.json",), (_sidecar_trees,), share=0.3),
        *(
            Reader(f"frames-{suffix}", _frames_file, partial(seeds.frames_files, suffix), share=0.5)
            for suffix in ("npy", "json")
        ),
        Reader("opencv-rig", _opencv_rig, seeds.opencv_rig_files, share=0.3, check=_rig_is_finite),
        Reader("tof-calibration", _tof_calibration, seeds.tof_calibrations, by_hand=(hostile.npz_files,), share=0.3),
        Reader("ouster", _ouster, seeds.lidar_recordings, ("*.pcap", "*.json"), (_sidecar_trees,), check=_is_sweep),
        Reader("kitti", _kitti, seeds.kitti_sweeps, check=_rings_agree),
        Reader("signals", _signals, seeds.signals_files, by_hand=(hostile.npz_files,), share=0.3),
        Reader("range-image", _range_image, seeds.range_image_files, by_hand=(hostile.npz_files,), share=0.3),
        *(
            Reader(
                f"result-{part}", _result, seeds.results, targets, (_by_suffix,), share=0.3,
                renames=part == "settings",
            )
            for part, targets in _RESULT_PARTS.items()
        ),
        Reader("scan", _scan, seeds.scans, ("scan/*.json", "scan/*.npz", "scan/*.ply"), (_by_suffix,), share=0.3),
        Reader("decoded", _decoded_record, seeds.decoded, ("decoded/*.json",), (_by_suffix,), share=0.3),
        Reader(
            "report", _rangesim, _with_arguments(seeds.results, "report {entry}"),
            ("result/*.json", "result/*.npz", "result/*/capture/00*"), (_sidecar_trees,), share=0.2,
            command="rangesim", may_write=("result/report.html",),
        ),
        Reader(
            "verify", _rangesim, _with_arguments(seeds.results, "verify {entry}"), ("result/manifest.json",),
            (_by_suffix,), share=0.5, command="rangesim",
            lists=True,
        ),
        Reader(
            "compare", _rangesim, _with_arguments(seeds.results, "compare {entry}"),
            ("result/experiment.json", "result/*/comparison.json"), (_by_suffix,), share=0.2, command="rangesim",
        ),
        Reader(
            "decode", _rangesim,
            _with_arguments(
                _calibrated_captures, f"{_CALIBRATED} rig.json", f"{_CALIBRATED} calibration.xml", _PLAIN
            ),
            ("*.json", "*.xml", "*/00*.png"), share=0.2, command="rangesim", may_write=("out*",),
        ),
        Reader(
            "run-experiment", _run, _with_arguments(_small_experiment, f"run --config {_RUN[4:]}"), ("*.toml",),
            (_settings_to_run,), share=0.05, command="rangesim", may_write=("out*",),
        ),
        Reader(
            "options-decode", _rangesim, _with_arguments(_bare_images, _DECODE, _TURNED), share=0.2, command="rangesim",
            by_hand=(_options(*_OF_DECODE),), names_file=False, may_write=("*",), mutates_arguments=True,
        ),
        Reader(
            "options-run", _run, _with_arguments(_beside_a_plane, f"{_RUN} --sensor gray", f"{_RUN} {_MORE}"),
            share=0.1, command="rangesim", by_hand=(_options(*_OF_RUN),),
            names_file=False, may_write=("*",), mutates_arguments=True,
        ),
        Reader(
            "options-segment", _pcgraph,
            _with_arguments(
                _one_cloud,
                "segment {entry} --out {out} --voxel-size 0.05 --seed-size 0.3 --objects 2 --viewpoint 0 0 0",
                "segment {entry} --out {out} --method vccs --range-growth 0.5 --voxel-size 0.05",
            ),
            share=0.1, command="pcgraph", by_hand=(_options(*_OF_SEGMENT),),
            names_file=False, may_write=("*",), mutates_arguments=True,
        ),
    )
}  # fmt: skip


def _execute(path: Path, _: Arguments) -> None:
    _KEPT["path"] = path
    exec(path.read_text(), _KEPT)


_KEPT: dict[str, Any] = {}
SELF_TEST = Reader("self-test", _execute, lambda: {"pass": seeds.of_file("code.py", b"pass")})
"""Not a reader: runs a Python file, so that tests of the harness can be as broken as a reader may be."""
