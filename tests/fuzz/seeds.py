# SPDX-License-Identifier: Apache-2.0
"""Valid small files, made by the package's own writers where it has them; the same ones at every call."""

from __future__ import annotations

import io
import itertools
import json
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from unittest import mock

import numpy as np

from fuzz.inputs import Input

Seeds = dict[str, Input]
ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scenes"
SPAD = """[[instrument]]
name = "spad"
power_w = 0.5
[instrument.sensor]
type = "direct-tof"
bins = 64
bin_s = 400e-12
pulse_fwhm_s = 1e-9
"""
"""An instrument of an experiment file."""


def of_file(name: str, content: bytes, **others: bytes) -> Input:
    """Input of one file, and what it refers to."""
    return Input({name: content, **others}, name)


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """Bytes of what a writer writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def directory(folder: Path, under: str) -> dict[str, bytes]:
    """All files of a directory, by their path below `under`."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return {f"{under}/{p.relative_to(folder).as_posix()}": p.read_bytes() for p in paths}


# --- results and captures ---------------------------------------------------------------------------------------------


@cache
def result_files() -> dict[str, bytes]:
    """Files of a small result, under `result/`: structured light and an ideal ranger before a plane."""
    from rangesim.codes import GrayPhase
    from rangesim.experiment import Experiment
    from rangesim.instrument.instrument import Instrument
    from rangesim.pipeline.experiment_run import run
    from rangesim.sensors import AmcwToF, IdealToF, StructuredLight

    instruments = (
        Instrument("lines", StructuredLight(32, 24, GrayPhase(8.0))),
        Instrument("amcw", AmcwToF()),
        Instrument("ideal", IdealToF()),
    )
    experiment = Experiment(str(SCENES / "plane.xml"), width=32, height=24, spp=1, instruments=instruments)
    with tempfile.TemporaryDirectory() as folder, mock.patch("time.monotonic", itertools.count(0.0, 0.01).__next__):
        run(experiment, Path(folder) / "result")  # times of a clock of our own: the same bytes at every call
        return directory(Path(folder) / "result", "result")


def results() -> Seeds:
    """A result directory."""
    return {"result": Input(result_files(), "result")}


def scans() -> Seeds:
    """A scan directory of two views of a plane."""
    from rangesim.experiment import ScanSettings, Turntable
    from rangesim.instrument.instrument import Instrument
    from rangesim.pipeline.scan_run import run_scan
    from rangesim.sensors import IdealToF

    settings = ScanSettings(
        str(SCENES / "plane.xml"), width=16, height=12, spp=1, voxel_m=0.2,
        path=Turntable(views=2), instrument=Instrument("ideal", IdealToF()),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, mock.patch("time.monotonic", itertools.count(0.0, 0.01).__next__):
        run_scan(settings, Path(folder) / "scan")
        return {"scan": Input(directory(Path(folder) / "scan", "scan"), "scan")}


def decoded() -> Seeds:
    """What a capture decodes to, as a directory."""
    from synthetic import plane_signals, stereo_rig

    from rangesim import IdealToF, decode, expose
    from rangesim.results.decoded_captures import Decoded, save_decoded

    capture = expose(plane_signals(stereo_rig(12, 8), IdealToF()), IdealToF())
    of_capture = Decoded(decode(capture), capture.sensor, capture.rig, {"ok": 1.0}, None)
    with tempfile.TemporaryDirectory() as folder:
        save_decoded(of_capture, Path(folder) / "decoded", {})
        return {"decoded": Input(directory(Path(folder) / "decoded", "decoded"), "decoded")}


def captures() -> Seeds:
    """Capture directories: digital numbers in PNG, radiance in EXR."""
    seeds: Seeds = {}
    for name in ("lines", "amcw", "ideal"):
        start = f"result/{name}/capture/"
        files = {f"capture/{p.removeprefix(start)}": c for p, c in result_files().items() if p.startswith(start)}
        seeds[name] = Input(files, "capture")
    return seeds


def signals_files() -> Seeds:
    """Signals of two sensors."""
    from synthetic import plane_signals, stereo_rig

    from rangesim import AmcwToF, StructuredLight, save_signals

    rig = stereo_rig(12, 8)
    sensors = {"codes": StructuredLight(), "amcw": AmcwToF((20e6, 50e6))}
    return {
        k: of_file("signals.npz", written("s.npz", partial(save_signals, plane_signals(rig, s))))
        for k, s in sensors.items()
    }


def range_image_files() -> Seeds:
    """Range images with camera and decoder."""
    from synthetic import plane_signals, stereo_rig

    from rangesim import IdealToF, StructuredLight, decode, expose, save_range_image

    images = {
        s.type_name: decode(expose(plane_signals(stereo_rig(12, 8), s), s)) for s in (IdealToF(), StructuredLight())
    }
    return {
        name: of_file("range.npz", written("r.npz", partial(save_range_image, image))) for name, image in images.items()
    }


def experiments() -> Seeds:
    """Experiment files: the examples, and one with every kind of sensor."""
    examples = [ROOT / "examples" / f"{name}.toml" for name in ("multipath", "tabletop")]
    seeds = {p.stem: of_file("experiment.toml", p.read_bytes()) for p in examples}
    every = """scene = "plane.xml"
width = 16
height = 12
spp = 2
caustics = true
[ambient]
illuminant = "sun"
illuminance_lux = 50e3
scene_irradiance_w_m2 = 0.94
[[instrument]]
name = "gray"
baseline_m = 0.2
exposure_s = 0.005
[instrument.sensor]
type = "structured-light"
projector_width = 64
projector_height = 48
code = "gray"
axes = ["columns", "rows"]
[instrument.camera_lens]
focus_m = 1.0
[[instrument]]
name = "amcw"
[instrument.sensor]
type = "amcw-tof"
modulation_hz = [20e6, 100e6]
[[instrument]]
name = "ideal"
sensor = "ideal-tof"
"""
    return seeds | {"every sensor": of_file("experiment.toml", (every + SPAD).encode())}


def sweeps() -> Seeds:
    """The example of a sweep over ambient light, and one with every kind of setting and few points."""
    sun = (ROOT / "examples" / "sweep_sun.toml").read_bytes()
    every = b"""title = "All"
scene = { name = "wall", reflectance = 0.5, tilt_deg = 10.0 }
sensors = ["gray-phase", { sensor = "amcw", name = "weak", power_w = 0.1 }, "l515"]
seeds = 3
seed = 7
exposure = 0.001
tolerance_m = 0.002
window_px = 32
caustics = true
ambient.illuminant = "sun"
[vary]
scene.distance_m = [0.5, 1.0]
weak.detector.read_noise_e = [1.0, 7.5]
ambient.illuminance_lux = [0.0, 1e4]
max_depth = [2, 5]
"""
    return {"sun": of_file("sweep.toml", sun), "every": of_file("sweep.toml", every)}


def dataset_specs() -> Seeds:
    """The example of a data set."""
    return {"bin": of_file("dataset.toml", (ROOT / "examples" / "dataset_bin.toml").read_bytes())}


def devices() -> Seeds:
    """Files of devices, one of each kind of sensor."""
    from rangesim import presets

    found = {presets.load(name).sensor.type_name: name for name in presets.names()}
    texts = {
        n: presets.describe(n).text.replace("[instrument]\n", '[instrument]\nname = "one"\n') for n in found.values()
    }
    return {name: of_file("device.toml", text.encode()) for name, text in texts.items()}


# --- calibrations and models ------------------------------------------------------------------------------------------


def rig_files() -> Seeds:
    """Calibrations as JSON."""
    from synthetic import stereo_rig

    from rangesim.rig import Intrinsics
    from rangesim.rig.calibration_files import save_calibration

    seeds = {}
    projector = Intrinsics.from_fov(32, 24, 60)
    lens = Intrinsics(32, 24, 30.0, 31.0, 16.0, 12.0, (-0.1, 0.01, 1e-3, 1e-3, 0.0))
    rigs = {
        "pinhole": stereo_rig(32, 24, projector=projector),
        "lens": stereo_rig(32, 24, projector=projector, camera=lens),
    }
    for name, rig in rigs.items():
        seeds[name] = of_file("rig.json", written("rig.json", lambda path, rig=rig: save_calibration(rig, path)))  # type: ignore[misc]
    return seeds


def opencv_files() -> Seeds:
    """A calibration as procam-calibration writes it."""
    matrices = {
        "img_shape": ("24 32", 2, 1), "rms": ("0.3", 1, 1), "cam_int": ("30. 0. 16. 0. 31. 12. 0. 0. 1.", 3, 3),
        "cam_dist": ("-0.1 0.01 1e-3 1e-3 0.", 1, 5), "proj_int": ("40. 0. 16. 0. 40. 24. 0. 0. 1.", 3, 3),
        "proj_dist": ("0. 0. 0. 0. 0.", 1, 5), "roration": ("1. 0. 0. 0. 1. 0. 0. 0. 1.", 3, 3),
        "translation": ("-200. 0. 0.", 3, 1),
    }  # fmt: skip
    body = "".join(
        f'<{name} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n  <dt>d</dt>\n'
        f"  <data>\n    {values}</data></{name}>\n"
        for name, (values, rows, columns) in matrices.items()
    )
    text = f'<?xml version="1.0"?>\n<opencv_storage>\n{body}</opencv_storage>\n'
    return {"procam": of_file("calibration.xml", text.encode())}


def opencv_rig_files() -> Seeds:
    """Rigs as OpenCV's stereo calibration has them, YAML and XML."""
    from synthetic import stereo_rig

    from rangesim.calibration.opencv_files import save_opencv

    rig = stereo_rig(32, 24)
    return {name: of_file(name, written(name, lambda path: save_opencv(rig, path))) for name in ("rig.yml", "rig.xml")}


def pattern_sets() -> Seeds:
    """The sidecars of pattern sets."""
    from rangesim.results.pattern_sets import SIDECAR, PatternSet, save_patterns
    from rangesim.sensors import StructuredLight

    def sidecar(sensor: StructuredLight) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            save_patterns(PatternSet(sensor, 2.2), f"{folder}/p")
            return (Path(folder) / "p" / SIDECAR).read_bytes()

    sensors = {"gray": StructuredLight(8, 8, "gray"), "phase": StructuredLight(32, 24, order=("white", "*"))}
    return {name: of_file(SIDECAR, sidecar(sensor)) for name, sensor in sensors.items()}


def frames_files(suffix: str) -> Seeds:
    """Taps of a time-of-flight camera in one file."""
    rng, seeds = np.random.default_rng(6), {}
    for dtype in ("int16", "uint16", "float64"):
        frames = (1000 * rng.random((4, 6, 8))).astype(dtype)
        if suffix == "json":
            seeds[dtype] = of_file("taps.json", json.dumps(frames.tolist()).encode())
        else:
            stream = io.BytesIO()
            np.save(stream, frames)
            seeds[dtype] = of_file("taps.npy", stream.getvalue())
    return seeds


def tof_calibrations() -> Seeds:
    """The calibration of a time-of-flight camera."""
    import numpy as np
    from synthetic import stereo_rig

    from rangesim import AmcwToF
    from rangesim.calibration import ToFCalibration

    sensor = AmcwToF((20e6, 50e6))
    series = np.full((2, 2), 1e-3)
    numbers = {"shortest_m": 1.0, "longest_m": 5.0, "noise_m": 1e-3}
    found = ToFCalibration(
        stereo_rig(12, 8), sensor, sensor.default_decoder, (4, 8), series, -series, np.zeros((8, 12)), **numbers
    )
    return {"tof": of_file("tof.npz", written("tof.npz", found.save))}


def lidar_recordings() -> Seeds:
    """Recordings of an Ouster sensor: whole datagrams with one header, fragments and two returns with the other."""
    import made_recordings as made

    whole = of_file(
        "drive.pcap", made.recording(made.small_turns()), **{"drive.json": json.dumps(made.metadata()).encode()}
    )
    block = made.dual((2000, 5000), (10, 20), (30, 40), 50)
    payload = made.packet(70_000, [made.column(j, 10**6 * j, [block] * 4) for j in range(8)], is_safety=True)
    data = made.nested(made.metadata(columns=8, profile="RNG19_RFL8_SIG16_NIR16_DUAL"))
    fragments = made.pcap(made.ip_packets(payload, largest=400))
    return {
        "whole": whole,
        "fragments": of_file("drive.pcap", fragments, **{"drive.json": json.dumps(data).encode()}),
    }


def text_clouds(suffix: str) -> Seeds:
    """Text files of points with colours, in several dialects; PTX files of one scan and of two."""
    rows = ["1.5 -2 3e-1 7 10 20 30", "nan 4 5.25 -8 40 50 60", "0 0 0 0 0 0 0", "-1e2 5 6 9 255 0 1"]
    text = "\n".join(rows) + "\n"
    if suffix == "ptx":
        scan = "2\n2\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n1 2 3 1\n" + text
        return {"scan": of_file("a.ptx", scan.encode()), "scans": of_file("a.ptx", 2 * scan.encode())}
    if suffix == "pts":
        return {"blocks": of_file("a.pts", 2 * ("4\n" + text).encode())}
    names = "x y z intensity r g b"
    texts = {
        "commas": f"{names}\n{text}".replace(" ", ","),
        "semicolons": f"{names}\n{text}".replace(" ", ";").replace(".", ","),
        "cloudcompare": f"//{names.upper()}\n4\n{text}",
        "bare": text,
        "integers": "x y z id\n1 2 3 9007199254740993\n4 5 6 18446744073709551615\n",
    }
    return {name: of_file(f"a.{suffix}", content.encode()) for name, content in texts.items()}


def nuscenes_sweeps() -> Seeds:
    """A sweep with rings."""
    table = np.column_stack([np.random.default_rng(5).normal(size=(30, 4)), np.arange(30) % 8])
    return {"rings": of_file("a.pcd.bin", table.astype("<f4").tobytes())}


def kitti_sweeps() -> Seeds:
    """A sweep of three rings."""
    azimuth, elevation = np.meshgrid(np.linspace(0.1, 6.2, 40), np.radians([2.0, -3.0, -8.0]))
    across = 10 + 3 * np.cos(2 * azimuth)
    columns = [across * np.cos(azimuth), across * np.sin(azimuth), 0.2 + across * np.tan(elevation), 0.01 * across]
    return {"rings": of_file("000000.bin", np.stack(columns, axis=-1).astype("<f4").tobytes())}


def edge_models() -> Seeds:
    """A model of edges as `EdgeModel.save` writes it."""
    from pcgraph.tree.learned import EdgeModel

    model = EdgeModel(("concavity", "normal_angle"), (0.1, 0.2), (1.0, 0.5), (2.0, 3.0), -1.0, 0.5)
    return {"model": of_file("model.json", written("model.json", model.save))}


def node_classifiers() -> Seeds:
    """A forest of two trees as `NodeClassifier.save` writes it."""
    import numpy as np

    from pcgraph.learning import NodeClassifier
    from pcgraph.learning.classifier_file import StoredForest

    columns = [[1, -1, -1, -1], [2, -1, -1, -1], [1, 0, 0, 0]]
    fractions = np.array([[0.5, 0.5], [1.0, 0.0], [0.25, 0.75], [0.0, 1.0]])
    numbers = [np.array(column) for column in ([0, 3, 4], *columns)]
    classifier = NodeClassifier(neighbours=0, ancestors=0)
    classifier.estimator_ = StoredForest(np.array([2, 7]), *numbers, np.array([0.5, 0.0, 0.0, 0.0]), fractions)
    classifier.feature_names_ = ["width", "length"]
    return {"forest": of_file("forest.json", written("forest.json", classifier.save))}


# --- images -----------------------------------------------------------------------------------------------------------


def image_files(suffix: str) -> Seeds:
    """Images of all kinds that `rangesim.files.image_files` reads under this suffix, 24 x 16 pixels."""
    from PIL import Image

    from rangesim.files.image_files import write_grey

    rng = np.random.default_rng(1)
    eight = rng.integers(0, 255, (16, 24), dtype=np.uint8)
    sixteen = rng.integers(0, 65535, (16, 24), dtype=np.uint16)
    color = rng.integers(0, 255, (16, 24, 3), dtype=np.uint8)
    name = f"image.{suffix}"
    if suffix == "exr":
        radiance = rng.random((16, 24)).astype(np.float32)
        return {"grey": of_file(name, written(name, lambda path: write_grey(path, radiance)))} | _color_exr(radiance)

    def saved(image: Image.Image, **options: object) -> Input:
        return of_file(name, written(name, lambda path: image.save(path, **options)))

    seeds = {"grey": saved(Image.fromarray(eight)), "color": saved(Image.fromarray(color))}
    if suffix == "png":
        seeds["own"] = of_file(name, written(name, lambda path: write_grey(path, sixteen)))
        seeds["bits"] = saved(Image.fromarray(eight).convert("1"))
        seeds["palette"] = saved(Image.fromarray(color).quantize(16))
        seeds["alpha"] = saved(Image.fromarray(color).convert("RGBA"))
    if suffix == "tif":
        seeds["16 bits"] = saved(Image.fromarray(sixteen))
        seeds["float"] = saved(Image.fromarray(eight.astype(np.float32)))
        seeds["32 bits"] = saved(Image.fromarray(eight.astype(np.int32)))
        for compression in ("tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg"):
            seeds[compression] = saved(Image.fromarray(eight), compression=compression)
    if suffix == "jpg":
        seeds["progressive"] = saved(Image.fromarray(color), progressive=True)
        seeds["cmyk"] = saved(Image.fromarray(color).convert("CMYK"))
    if suffix == "bmp":
        seeds["bits"] = saved(Image.fromarray(eight).convert("1"))
    if suffix == "pgm":
        seeds["16 bits"] = saved(Image.fromarray(sixteen))
        text = "P2\n# made by hand\n4 3 255\n0 1 2 3\n4 5 6 7\n8 9 10 255\n"
        seeds["text"] = of_file(name, text.encode())
    return seeds


def _color_exr(radiance: np.ndarray) -> Seeds:
    import OpenEXR

    seeds = {}
    for compression in ("NO", "RLE", "ZIP", "PIZ", "PXR24", "B44", "DWAA"):
        header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        channels = {c: radiance.astype(np.float16) for c in "RGB"}
        content = written("image.exr", lambda path, h=header, c=channels: OpenEXR.File(h, c).write(str(path)))  # type: ignore[misc]
        seeds[compression] = of_file("image.exr", content)
    return seeds


def image_folders() -> Seeds:
    """Folders of bare images of a Gray code, in several formats."""
    from PIL import Image

    rng = np.random.default_rng(2)
    seeds = {}
    for suffix in ("png", "tif", "jpg", "bmp"):
        files = {}
        for i in range(BARE_FRAMES):
            image = Image.fromarray(rng.integers(0, 255, (6, 8), dtype=np.uint8))
            files[f"images/{i:02d}.{suffix}"] = written(f"x.{suffix}", image.save)
        seeds[suffix] = Input(files, "images")
    return seeds


BARE_FRAMES = 14
"""Of a Gray code of 8 x 8 projector pixels along columns and rows: 3 bits and inverses twice, white and black."""


# --- clouds and meshes ------------------------------------------------------------------------------------------------


def cloud_files(suffix: str) -> Seeds:
    """Clouds of all codings, by hand and by the package's writers."""
    from fuzz.cloud_files import CORPUS, ORDERS, ply_with_lists
    from pcgraph.io.ply import encode_ply
    from rangesim.point_cloud import PointCloud
    from rangesim.point_cloud.point_cloud_files import save_point_cloud

    name = f"cloud.{suffix}"
    seeds = {key: of_file(name, content) for key, content in CORPUS.items() if key.startswith(suffix)}
    rng = np.random.default_rng(4)
    points = rng.random((3, 4, 3)).astype(np.float32)
    cloud = PointCloud(points, normals=points, colors=np.zeros((3, 4, 3), dtype=np.uint8))
    seeds["rangesim"] = of_file(name, written(name, lambda path: save_point_cloud(cloud, path)))
    if suffix == "ply":
        columns = {axis: rng.random(20) for axis in "xyz"} | {"labels": np.arange(20, dtype=np.int32)}
        seeds["pcgraph"] = of_file(name, encode_ply(columns))
        seeds |= {f"lists {code}": of_file(name, ply_with_lists(code)) for code in ORDERS}
    return seeds


def scanner_files(suffix: str) -> Seeds:
    """Clouds of laser scanners with columns of their own, as pcgraph writes them, and LAS files as laspy does."""
    from pcgraph.cloud import Cloud
    from pcgraph.io.e57 import encode_e57
    from pcgraph.io.las import encode_las

    rng, name = np.random.default_rng(5), f"cloud.{suffix}"
    points = rng.random((40, 3))
    columns = {"intensity": np.arange(40, dtype=np.uint16), "ring": rng.integers(0, 9, 40), "beam": rng.random((40, 2))}
    full = Cloud(points, np.zeros((40, 3), np.uint8), points, np.arange(40, dtype=np.int32), np.ones(3), columns)
    encode = encode_e57 if suffix == "e57" else encode_las
    seeds = {
        "full": of_file(name, encode(full, f".{suffix}")),
        "bare": of_file(name, encode(Cloud(points), f".{suffix}")),
    }
    if suffix != "e57":
        import laspy

        for version, point_format in (("1.2", 3), ("1.4", 10)):
            las = laspy.create(point_format=point_format, file_version=version)
            las.x, las.y, las.z = points.T
            content = written(name, lambda path, las=las: las.write(str(path)))
            seeds[f"format {point_format}"] = of_file(name, content)
    return seeds


def array_files(suffix: str) -> Seeds:
    """Clouds as NumPy's files, with columns and without."""
    from pcgraph.cloud import Cloud
    from pcgraph.io import encode_cloud

    rng = np.random.default_rng(4)
    points = rng.random((3, 4, 3)).astype(np.float32)
    whole = Cloud(points, np.zeros((3, 4, 3), np.uint8), points, columns={"ring": np.zeros((3, 4), np.uint16)})
    name = f"cloud.{suffix}"
    clouds = {"plain": Cloud(rng.random((20, 3))), "whole": whole}
    return {key: of_file(name, encode_cloud(cloud, name)) for key, cloud in clouds.items()}


def mesh_files(suffix: str) -> Seeds:
    """Meshes: a box, with normals and colours where the format has them."""
    import trimesh

    name = f"mesh.{suffix}"
    box = trimesh.creation.box((1, 2, 3))
    if suffix == "gltf":
        parts = dict(box.export(file_type="gltf"))
        main = parts.pop("model.gltf")
        return {"box": Input({name: main, **parts}, name)}

    def exported(kind: str, mesh: trimesh.Trimesh = box) -> Input:
        content = mesh.export(file_type=kind)
        return of_file(name, content.encode() if isinstance(content, str) else content)

    seeds = {"box": exported(suffix)}
    if suffix == "ply":
        seeds["text"] = of_file(name, trimesh.exchange.ply.export_ply(box, encoding="ascii"))
    if suffix == "stl":
        seeds["text"] = exported("stl_ascii")
    if suffix == "obj":
        text = b"mtllib mesh.mtl\no a\nv 0 0 0\nv 1 0 0 1\nv 1 1 0 0.5 0.5 0.5\nv 0 1 1\nvt 0 0\nvt 1 0\nvn 0 0 1\n"
        text += b"usemtl red\ns off\nf 1/1/1 2/2/1 3/1/1 4/2/1\ng b\nf -1 -2 -3\nl 1 2\n"
        library = b"newmtl red\nKd 1 0 0\nmap_Kd texture.png\n"
        seeds["materials"] = Input({name: text, "mesh.mtl": library, "texture.png": _texture()}, name)
    if suffix == "glb":
        colored = trimesh.creation.icosphere(subdivisions=1)
        colored.visual.vertex_colors = np.full((len(colored.vertices), 4), 100, dtype=np.uint8)
        seeds["colors"] = exported("glb", colored)
        seeds["scene"] = of_file(name, trimesh.Scene([box, colored]).export(file_type="glb"))
    return seeds


def _texture() -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(stream, "PNG")
    return stream.getvalue()


# --- scenes -----------------------------------------------------------------------------------------------------------

_CAMERA = """<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>"""

_RICH = f"""<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
<default name="bright" value="0.5"/>
{_CAMERA}
<include filename="materials/silver.xml"/>
<include filename="more.xml"/>
<bsdf type="twosided" id="paint"><bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.2, 0.1"/></bsdf></bsdf>
<bsdf type="diffuse" id="printed"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.png"/><boolean name="raw" value="true"/></texture></bsdf>
<shape type="sphere" id="ball"><point name="center" x="0" y="0.5" z="0.2"/><float name="radius" value="0.3"/>
    <ref id="paint"/></shape>
<shape type="rectangle" id="wall"><transform name="to_world"><scale value="2"/><rotate x="1" angle="90"/>
    <translate y="1"/></transform><ref id="printed"/><string name="material_class" value="matte"/></shape>
<shape type="ply" id="box"><string name="filename" value="box.ply"/><transform name="to_world"><matrix
    value="0.1 0 0 0 0 0.1 0 0 0 0 0.1 0 0 0 0 1"/></transform>
    <bsdf type="roughconductor"><spectrum name="eta" value="2.9"/><spectrum name="k" value="3.3"/>
    <float name="alpha" value="0.25"/></bsdf></shape>
<shape type="obj" id="triangle"><string name="filename" value="triangle.obj"/>
    <bsdf type="dielectric"><string name="int_ior" value="bk7"/></bsdf></shape>
<shape type="cube" id="wax"><transform name="to_world"><scale value="0.1"/></transform><bsdf type="null"/>
    <medium type="homogeneous" name="interior"><rgb name="albedo" value="0.9,0.9,0.9"/>
    <float name="sigma_t" value="100"/><phase type="hg"><float name="g" value="0.8"/></phase></medium></shape>
<shape type="disk" id="sign"><bsdf type="retroreflector"><bsdf type="diffuse"/></bsdf></shape>
<emitter type="constant"><spectrum name="radiance" value="$bright"/></emitter>
<emitter type="point"><point name="position" x="0" y="-1" z="1"/><rgb name="intensity" value="1"/></emitter>
</scene>
"""

_MORE = """<scene version="3.0.0"><bsdf type="roughplastic" id="plastic"><float name="alpha" value="0.1"/>
<spectrum name="diffuse_reflectance" value="400:0.2, 700:0.6"/></bsdf>
<shape type="cylinder" id="can"><point name="p0" x="0.3" y="0" z="0"/><point name="p1" x="0.3" y="0" z="0.2"/>
<float name="radius" value="0.05"/><ref id="plastic"/></shape></scene>
"""


def scene_files() -> Seeds:
    """Scenes: a plain one, one with everything a scene may refer to, and shipped ones."""
    import trimesh

    plain = f"""<scene version="3.0.0">{_CAMERA}
<shape type="rectangle" id="wall"><transform name="to_world"><rotate x="1" angle="90"/></transform>
<bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></bsdf></shape></scene>"""
    others = {
        "more.xml": _MORE.encode(),
        "texture.png": _texture(),
        "box.ply": trimesh.creation.box((1, 1, 1)).export(file_type="ply"),
        "triangle.obj": b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n",
    }
    shipped = {name: of_file("scene.xml", (SCENES / f"{name}.xml").read_bytes()) for name in ("matte", "cornell")}
    rich = Input({"scene.xml": _RICH.encode(), **others}, "scene.xml")
    return {"plain": of_file("scene.xml", plain.encode()), "rich": rich, "rich again": rich, **shipped}
