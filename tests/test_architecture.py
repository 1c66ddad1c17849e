# SPDX-License-Identifier: Apache-2.0
"""The walls of the house: who may import whom, what is public, and how fast it opens."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

import rangesim

ROOT = Path(__file__).resolve().parent.parent
RENDERER = {"mitsuba", "drjit"}
RENDERING_PACKAGES = ("rangesim/light_transport/", "rangesim/scene/", "rangesim/environment/backend.py")


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@cache
def imports(path: Path, top_level_only: bool = False) -> tuple[str, ...]:
    tree = ast.parse(path.read_text())
    found: list[str] = []
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            found += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return tuple(found)


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", modules("pcgraph"), ids=relative)
def test_pcgraph_never_imports_rangesim_or_a_renderer(path: Path) -> None:
    roots = {name.split(".")[0] for name in imports(path)}
    assert not roots & ({"rangesim"} | RENDERER)


STOREYS = [
    "plumbing",
    "errors",
    "cloud",
    "columns",
    "kernel_cache",
    "parallel",
    "disjoint_sets",
    "pairs",
    "hierarchy",
    "voxels",
    "resection",
    "inputs",
    "depth_image",
    "pixel_lattice",
    "pixels",
    "features",
    "supervoxels",
    "graph",
    "tree",
    "segmentation",
    "plausibility",
    "warmup",
    "scan",
    "all_kernels",
]
"""Of pcgraph, from the ground up: nobody imports from above."""
ON_TOP = {"detection", "learning", "io", "families", "cli"}
"""What stands on these and may import all of them."""


def storey(name: str) -> str:
    return name.split(".")[1] if "." in name else ""


@pytest.mark.parametrize("path", modules("pcgraph"), ids=relative)
def test_nobody_in_pcgraph_imports_from_above(path: Path) -> None:
    own = storey(".".join(path.relative_to(ROOT).with_suffix("").parts))
    above = {storey(name) for name in imports(path, top_level_only=True) if name.startswith("pcgraph.")} - {own}
    if own == "metrics":
        assert above <= {"plumbing", "parallel", "hierarchy"}  # plain arrays in, numbers out
    elif own in STOREYS:
        assert above <= set(STOREYS[: STOREYS.index(own)])
    else:
        assert own in ON_TOP or own in ("", "__init__", "__main__")
        assert "metrics" not in above


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path, known: set[str]) -> Iterator[str]:
    """Modules out of `known` that are loaded when this one is, packages around them included."""
    for node in ast.parse(path.read_text()).body:
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in known else node.module for name in inner]
        for name in names:
            parts = name.split(".")
            yield from known & {".".join(parts[:n]) for n in range(2, len(parts) + 1)}


def import_graph(package: str) -> nx.DiGraph:
    """Which module of a package loads which; imports for type checks alone, and inside functions, load nothing."""
    paths = {module_of(path): path for path in modules(package)}
    files = nx.DiGraph()
    for module, path in paths.items():
        known = {m for m in paths if m != module and not module.startswith(f"{m}.")}
        files.add_edges_from((module, other) for other in imported_modules(path, known))
    return files


def test_no_files_of_pcgraph_import_in_a_circle() -> None:
    assert [c for c in nx.strongly_connected_components(import_graph("pcgraph")) if len(c) > 1] == []


def test_no_imports_go_in_a_circle() -> None:
    """Between files and between rooms."""
    files = import_graph("rangesim")
    assert [c for c in nx.strongly_connected_components(files) if len(c) > 1] == []
    room = {module: module.split(".")[1] for module in files}
    rooms = nx.DiGraph([(room[a], room[b]) for a, b in files.edges if room[a] != room[b]])
    circles = [sorted(c) for c in nx.strongly_connected_components(rooms) if len(c) > 1]
    # Limits are a setting of their own, at the top for their users; what a capture's files hold is a sensor
    assert circles == [["limits", "settings"], ["capture", "decoding", "sensors"]]


@pytest.mark.parametrize("path", modules("rangesim"), ids=relative)
def test_only_scenes_and_light_transport_import_the_renderer(path: Path) -> None:
    rendering = relative(path).startswith(RENDERING_PACKAGES)
    roots = {name.split(".")[0] for name in imports(path, top_level_only=True)}
    assert rendering or not roots & RENDERER


@pytest.mark.parametrize("path", modules("rangesim/decoding"), ids=relative)
def test_decoders_know_neither_scene_nor_renderer(path: Path) -> None:
    forbidden = ("rangesim.scene", "rangesim.light_transport", "rangesim.signals", "mitsuba", "drjit", "pcgraph")
    loops = ("pcgraph.parallel", "pcgraph.kernel_cache")  # know nothing of points either
    assert not [name for name in imports(path) if name.startswith(forbidden) and name not in loops]


@pytest.mark.parametrize("path", [*modules("rangesim"), *modules("pcgraph")], ids=relative)
def test_open3d_is_imported_only_where_it_is_used(path: Path) -> None:
    assert "open3d" not in {name.split(".")[0] for name in imports(path, top_level_only=True)}


@pytest.mark.parametrize("path", [*modules("rangesim"), *modules("pcgraph")], ids=relative)
def test_opencv_is_imported_only_inside_functions_of_geometry_and_calibration(path: Path) -> None:
    assert "cv2" not in {name.split(".")[0] for name in imports(path, top_level_only=True)}
    rooms = ("rangesim/geometry/", "rangesim/calibration/")
    assert relative(path).startswith(rooms) or "cv2" not in {n.split(".")[0] for n in imports(path)}


@pytest.mark.parametrize("path", modules("rangesim"), ids=relative)
def test_scikit_image_is_imported_only_inside_functions_of_fusion(path: Path) -> None:
    assert "skimage" not in {name.split(".")[0] for name in imports(path, top_level_only=True)}
    inside = "skimage" in {name.split(".")[0] for name in imports(path)}
    assert not inside or relative(path).startswith("rangesim/fusion/")


@pytest.mark.parametrize("path", modules("rangesim/geometry"), ids=relative)
def test_geometry_knows_cameras_and_arrays_alone(path: Path) -> None:
    inside = {name for name in imports(path) if name.startswith(("rangesim", "pcgraph"))}
    assert all(
        n.startswith(("rangesim.geometry", "rangesim.rig", "rangesim.settings", "pcgraph.parallel")) for n in inside
    )


GEOMETRY = {
    "camera_matrix": "CameraParts back_project calibration_matrix centre decompose decompose_zero_skew depth "
    "ideal_pixels lens_pixels project projection_matrix rays",
    "camera_pose": "CameraPose find_camera_pose fit_camera_pose",
    "camera_projector": "ProjectorTriangulation triangulate_coordinates",
    "hand_eye": "HandEye eye_in_hand eye_to_hand",
    "homography": "Homography find_homography fit_homography homography_dlt transfer_error",
    "projective_plane": "LINE_AT_INFINITY Decomposition PlaneTransform affine_rectification classify euclidean "
    "homogeneous "
    "is_at_infinity join map_lines map_points meet metric_rectification point_at_infinity",
    "registration": "Registration icp register",
    "stereo": "ParallelCameras RectifiedPair match_rows rectify",
    "two_view": "Epipoles FundamentalMatrix RelativePose eight_point epipoles essential_from_pose find_fundamental "
    "find_relative_pose fit_fundamental fit_relative_pose fundamental_from_cameras fundamental_from_pose in_front "
    "lines_in_first lines_in_second poses_from_essential sampson_distance seven_point",
    "two_view_triangulation": "CorrectedPixels TriangulatedPoints correct_pixels point_covariance triangulate_linear "
    "triangulate_midpoint triangulate_optimal",
    "uncalibrated_rectification": "UncalibratedPair rectify_uncalibrated",
}


MULTIVIEW = {
    "bundle_adjustment": "BundleAdjustment bundle_adjust",
    "factorisation": "AffineFactorisation OrthographicFactorisation ProjectiveFactorisation factorise_affine "
    "factorise_orthographic factorise_projective",
    "incremental_reconstruction": "StructureFromMotion structure_from_motion",
    "multi_view_triangulation": "ManyViewPoints triangulate_many",
    "nonrigid": "NonRigidShape UnknownCount adjust_nonrigid count_unknowns factorise_nonrigid",
    "orthographic": "TemporalPrior",
    "sliding_window": "OnlineAdjustment adjust_online",
    "tracks": "CommonPoints Tracks",
}


@pytest.mark.parametrize(("room", "chapters"), [("geometry", GEOMETRY), ("multiview", MULTIVIEW)])
def test_the_public_surface_of_a_room_is_this(room: str, chapters: dict[str, str]) -> None:
    """And type checkers see the same names."""
    loaded = importlib.import_module(f"rangesim.{room}")
    wanted = {name: f"rangesim.{room}.{chapter}" for chapter, names in chapters.items() for name in names.split()}
    assert set(loaded.__all__) == set(wanted)
    assert not set(wanted) & set(chapters)  # a module would take the place of a function of its name
    tree = ast.parse((ROOT / "rangesim" / room / "__init__.py").read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {a.asname: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names if a.asname}
    assert seen == wanted
    for name in wanted:
        assert getattr(loaded, name).__doc__ or name.isupper()


@pytest.mark.parametrize("path", modules("rangesim/multiview"), ids=relative)
def test_multiview_stands_on_geometry_alone(path: Path) -> None:
    allowed = (
        "rangesim.multiview",
        "rangesim.geometry",
        "rangesim.rig",
        "rangesim.settings",
        "rangesim.errors",
        "pcgraph.parallel",
    )
    inside = {name for name in imports(path) if name.startswith(("rangesim", "pcgraph"))}
    assert all(name.startswith(allowed) for name in inside)


CALIBRATION = {
    "boards": "Board BoardView CharucoBoard Checkerboard CircleGrid",
    "bundle": "Bundle Observation adjust",
    "rendered": "RenderedSet default_rig render_set",
    "rig_calibration": "RigCalibration calibrate_rig projector_view",
    "suspects": "Suspect",
    "time_of_flight": "ToFCalibration board_range calibrate_tof find_board_ranges load_tof_calibration plane_range "
    "triangle_harmonics wiggling",
    "zhang": "CameraCalibration calibrate_camera intrinsics_from_homographies",
}


def test_the_public_surface_of_calibration_is_this() -> None:
    """And type checkers see the same names."""
    import rangesim.calibration as calibration

    wanted = {n: f"rangesim.calibration.{chapter}" for chapter, names in CALIBRATION.items() for n in names.split()}
    assert set(calibration.__all__) == set(wanted)
    tree = ast.parse((ROOT / "rangesim" / "calibration" / "__init__.py").read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {a.asname: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names if a.asname}
    assert seen == wanted
    for name in wanted:
        assert getattr(calibration, name).__doc__


def test_geometry_loads_nothing_that_takes_long_until_it_is_used() -> None:
    code = (
        "from rangesim.geometry import classify, fundamental_from_cameras, rectify, icp, eye_in_hand; "
        "from rangesim.multiview import Tracks, bundle_adjust, factorise_nonrigid, structure_from_motion; "
        "import sys; print(*sys.modules)"
    )
    assert not (RENDERER | {"open3d", "cv2", "scipy.stats"}) & set(run(code).split())


FUSION = {
    "computed_tomography": "Sinogram filtered_back_projection sampling_angles with_photon_noise xray_projections",
    "joint_registration": "refine_jointly",
    "mesh_error": "SurfaceError surface_error",
    "multiway_registration": "Alignment PairFit PoseErrors align pose_errors",
    "paths": "Dome HandHeld Path PoseList Turntable Viewpoint",
    "sdf": "average_signed_distances reading_weights signed_distance",
    "seen_volume": "Occupancy SeenOfShape VoxelState occupancy true_occupancy voxel_states",
    "solids": "Solid attenuation_volume inside_voxels",
    "truncated_average": "FusedSurface fuse",
    "views": "Scan scan",
    "voxel_grid": "VoxelGrid",
}


def test_the_public_surface_of_fusion_is_this() -> None:
    """And type checkers see the same names."""
    import rangesim.fusion as fusion

    wanted = {name: f"rangesim.fusion.{chapter}" for chapter, names in FUSION.items() for name in names.split()}
    assert set(fusion.__all__) == set(wanted)
    assert not set(wanted) & set(FUSION)
    tree = ast.parse((ROOT / "rangesim" / "fusion" / "__init__.py").read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {a.asname: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names if a.asname}
    assert seen == wanted
    for name in wanted:
        assert getattr(fusion, name).__doc__


def test_the_public_surface_is_this() -> None:
    assert rangesim.__all__ == [
        "Ambient",
        "AmcwToF",
        "Capture",
        "Decoder",
        "Detector",
        "DirectToF",
        "IdealToF",
        "Intrinsics",
        "Lens",
        "PointCloud",
        "RangeImage",
        "Rig",
        "Scene",
        "Sensor",
        "Signals",
        "SpadDetector",
        "Status",
        "StillSignals",
        "StructuredLight",
        "TransportSettings",
        "compare",
        "decode",
        "explain",
        "expose",
        "import_capture",
        "load_calibration",
        "load_capture",
        "load_range_image",
        "load_scene",
        "load_signals",
        "look_at",
        "transport",
    ]


def test_type_checkers_see_the_public_names() -> None:
    """Lazy names are Any to them otherwise."""
    tree = ast.parse((ROOT / "rangesim" / "__init__.py").read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {a.asname: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names if a.asname}
    assert seen == rangesim._HOME


def test_every_public_name_resolves_and_says_what_it_is() -> None:
    for name in rangesim.__all__:
        thing = getattr(rangesim, name)
        assert callable(thing), f"{name} is shadowed by a module"
        assert thing.__doc__


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60).stdout


def test_import_is_light() -> None:
    loaded = run("import rangesim, sys; print(*sys.modules)").split()
    assert not {"mitsuba", "drjit", "open3d", "numpy"} & set(loaded)


def test_decoding_loads_no_renderer() -> None:
    code = "from rangesim import decode, load_capture, StructuredLight, AmcwToF; import sys; print(*sys.modules)"
    assert not (RENDERER | {"open3d"}) & set(run(code).split())
