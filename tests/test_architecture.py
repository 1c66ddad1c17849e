# SPDX-License-Identifier: Apache-2.0
"""The walls of the house: who may import whom, what is public, and how fast it opens."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import networkx as nx
import pytest

import rangesim

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("rangesim", "pcgraph")
RENDERER = ("mitsuba", "drjit")
RENDERING_PACKAGES = ("rangesim/light_transport/", "rangesim/scene/", "rangesim/environment/backend.py")


# ---- Reading imports -----------------------------------------------------------------------------------------------


class Import(NamedTuple):
    """One module that a file imports.

    module : its full name; a name of the package's façade is resolved to the module that holds it. moment : "load" of
    the file, "call" of a function, or "types" for type checkers alone. by_facade : the name comes from the façade.
    """

    file: str
    line: int
    module: str
    moment: str
    by_facade: bool = False

    def __str__(self) -> str:
        return f"{self.file}:{self.line} imports {self.module}"


def files_of(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@cache
def known_modules() -> frozenset[str]:
    return frozenset(module_of(path) for package in PACKAGES for path in files_of(package))


@cache
def facade(package: str) -> dict[str, str]:
    """The module of each public name of a package, as its `__init__` tells type checkers."""
    block = next(node for node in ast.parse((ROOT / package / "__init__.py").read_text()).body if is_for_types(node))
    statements = [node for node in ast.walk(block) if isinstance(node, ast.ImportFrom) and node.module]
    return {alias.name: home_of(node.module, alias.name, {}) for node in statements for alias in node.names}


def home_of(module: str, name: str, public: dict[str, str]) -> str:
    """The module that `from module import name` needs."""
    full = f"{module}.{name}"
    return full if full in known_modules() else public.get(name, module)


def read_imports(source: str, file: str, package: str) -> Iterator[Import]:
    """All imports of a file, wherever they stand; a use of the façade (`rangesim.transport`) is one too."""
    tree, public = ast.parse(source), facade(package)
    aliases = [alias for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    facade_names = {alias.asname or package for alias in aliases if alias.name == package}
    facade_names |= {package for alias in aliases if alias.name.startswith(f"{package}.") and not alias.asname}
    waiting: list[tuple[ast.AST, str]] = [(tree, "load")]
    while waiting:
        node, moment = waiting.pop()
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(file, line, alias.name, moment, by_facade=alias.name == package)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                is_public = node.module == package and alias.name in public
                home = home_of(node.module, alias.name, public if is_public else {})
                yield Import(file, line, home, moment, by_facade=is_public and home != f"{package}.{alias.name}")
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in facade_names
            and node.attr in public
        ):
            yield Import(file, line, public[node.attr], moment, by_facade=True)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)) and moment == "load":
            moment = "call"
        if is_for_types(node):
            waiting += [(child, "types") for child in node.body] + [(child, moment) for child in node.orelse]
        else:
            waiting += [(child, moment) for child in ast.iter_child_nodes(node)]


@cache
def imports(package: str) -> tuple[Import, ...]:
    """All imports of all files of a package, but those of its façade."""
    paths = [path for path in files_of(package) if path != ROOT / package / "__init__.py"]
    return tuple(found for path in paths for found in read_imports(path.read_text(), relative(path), package))


def offenders(package: str, is_offence: Callable[[Import], bool]) -> list[str]:
    return [str(found) for found in sorted(imports(package)) if is_offence(found)]


def is_of(module: str, *roots: str) -> bool:
    """Whether a module is one of `roots` or stands below one."""
    return module.startswith(tuple(f"{root}." for root in roots)) or module in roots


def test_every_kind_of_import_is_read() -> None:
    source = """
import rangesim
from rangesim import settings, transport
if TYPE_CHECKING:
    from rangesim.scene import Scene
try:
    import fcntl
except ImportError:
    pass
def first():
    import rangesim.rig as r
    return rangesim.expose(settings, rangesim.__version__)
class Two:
    import cv2
"""
    found = sorted((i.line, i.module, i.moment, i.by_facade) for i in read_imports(source, "a.py", "rangesim"))
    assert found == [
        (2, "rangesim", "load", True),
        (3, "rangesim.instrument.transport", "load", True),
        (3, "rangesim.settings", "load", False),
        (5, "rangesim.scene", "types", False),
        (7, "fcntl", "load", False),
        (11, "rangesim.rig", "call", False),
        (12, "rangesim.capture.exposure", "call", True),
        (14, "cv2", "load", False),
    ]


# ---- Who may import whom -------------------------------------------------------------------------------------------


def test_pcgraph_never_imports_rangesim_or_a_renderer() -> None:
    assert offenders("pcgraph", lambda i: is_of(i.module, "rangesim", *RENDERER)) == []


STOREYS = [
    "plumbing",
    "user_modules",
    "errors",
    "cloud",
    "columns",
    "kernel_cache",
    "io",
    "cloud_sources",
    "parallel",
    "rounding",
    "disjoint_sets",
    "pairs",
    "hierarchy",
    "voxels",
    "inputs",
    "acquisition",
    "voxelisation",
    "features",
    "supervoxels",
    "graph",
    "tree",
    "families",
    "segmentation",
    "saved_segmentation",
    "labelling",
    "history",
    "plausibility",
    "scan",
    "stream",
    "all_kernels",
]
"""Of pcgraph, from the ground up: nobody imports from above."""
ON_TOP = ("detection", "learning", "viewer", "service", "cli", "__main__")
"""What stands on these and may import all of them."""


def room_of(name: str) -> str:
    """The room of a file or of a module: the folder or file directly below its package; "" for the package itself."""
    parts = name.removesuffix(".py").replace("/", ".").split(".")
    return parts[1] if len(parts) > 1 else ""


def test_nobody_in_pcgraph_imports_from_above() -> None:
    def is_offence(found: Import) -> bool:
        own, other = room_of(found.file), room_of(found.module)
        if found.moment == "types" or not is_of(found.module, "pcgraph") or other in (own, ""):
            return False
        if own == "metrics":  # plain arrays in, numbers out
            return other not in ("plumbing", "parallel", "hierarchy")
        return other == "metrics" if own in ON_TOP else other not in STOREYS[: STOREYS.index(own)]

    assert offenders("pcgraph", is_offence) == []


def rings(graph: nx.DiGraph) -> list[set[str]]:
    return [ring for ring in nx.strongly_connected_components(graph) if len(ring) > 1]


def test_no_files_import_in_a_ring() -> None:
    """Imports inside functions load nothing yet; importing a module loads the packages around it, too."""
    files = nx.DiGraph()
    for package in PACKAGES:
        for found in imports(package):
            importer = module_of(ROOT / found.file)
            parts = found.module.split(".")
            loaded = {".".join(parts[:n]) for n in range(2, len(parts) + 1)} & known_modules()
            if found.moment == "load":  # a package around the importer is loading already
                files.add_edges_from((importer, m) for m in loaded if m != importer and not is_of(importer, m))
    assert rings(files) == []


def test_no_rooms_import_in_a_ring() -> None:
    """Every import counts but those for type checkers, wherever it stands and by whatever name."""
    found_rings = []
    for package in PACKAGES:
        places: dict[tuple[str, str], str] = {}
        for found in sorted(imports(package), reverse=True):
            rooms = room_of(found.file), room_of(found.module)
            if found.moment != "types" and is_of(found.module, package) and rooms[0] != rooms[1]:
                places[rooms] = str(found)
        for ring in rings(nx.DiGraph(places.keys())):
            found_rings.append([place for (a, b), place in sorted(places.items()) if {a, b} <= ring])
    assert found_rings == []


def documented_rooms() -> list[str]:
    """Rooms of rangesim in the order of the table in docs/architecture.md, from the ground up."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("| room | what is in it |")[1].split("\n\n")[0]
    first_cells = [line.split("|")[1] for line in table.splitlines()[2:]]
    return [name.strip("/").removesuffix(".py") for cell in first_cells for name in re.findall(r"`(.+?)`", cell)]


def test_rooms_stand_in_the_order_of_the_documented_table() -> None:
    order = documented_rooms()
    rooms = {room_of(relative(path)) for path in files_of("rangesim")} - {"__init__", "__main__"}
    assert set(order) == rooms

    def is_offence(found: Import) -> bool:
        own, other = room_of(found.file), room_of(found.module)
        counts = found.moment != "types" and is_of(found.module, "rangesim") and own in order and other in order
        return counts and order.index(other) > order.index(own)

    assert offenders("rangesim", is_offence) == []


def test_no_file_imports_the_facade_of_its_own_package() -> None:
    """It imports the module that holds a name, so that a reader sees the way, and the law of rings too."""
    for package in PACKAGES:
        assert offenders(package, lambda i: i.by_facade) == []


def test_only_scenes_and_light_transport_import_the_renderer() -> None:
    """Others do so inside functions, or not at all."""

    def is_offence(found: Import) -> bool:
        is_renderer = found.moment == "load" and is_of(found.module, *RENDERER)
        return is_renderer and not found.file.startswith(RENDERING_PACKAGES)

    assert offenders("rangesim", is_offence) == []


def test_decoders_know_neither_scene_nor_renderer() -> None:
    forbidden = ("rangesim.scene", "rangesim.light_transport", "rangesim.signals", "pcgraph", *RENDERER)
    loops = ("pcgraph.parallel", "pcgraph.kernel_cache")  # know nothing of points either

    def is_offence(found: Import) -> bool:
        return room_of(found.file) == "decoding" and is_of(found.module, *forbidden) and found.module not in loops

    assert offenders("rangesim", is_offence) == []


LOADED_WHEN_USED = {"open3d": None, "cv2": ("geometry", "calibration"), "skimage": ("fusion",)}
LOADED_WHEN_USED |= dict.fromkeys(("laspy", "lazrs", "pye57"), ("io",))
LOADED_WHEN_USED |= dict.fromkeys(("distributed", "dask", "cloudpickle"), ("campaign",))
"""Packages that take long to import, or that may be missing, and the rooms that use them; None: any room may."""


def test_what_takes_long_to_import_is_imported_inside_functions_of_its_rooms() -> None:
    def is_offence(found: Import) -> bool:
        package = found.module.split(".")[0]
        rooms = LOADED_WHEN_USED.get(package)
        is_elsewhere = rooms is not None and room_of(found.file) not in rooms
        return package in LOADED_WHEN_USED and (found.moment == "load" or is_elsewhere)

    assert [offenders(package, is_offence) for package in PACKAGES] == [[], []]


SHARED_WITH_GEOMETRY = (
    "rangesim.geometry",
    "rangesim.robust_scale",
    "rangesim.rig",
    "rangesim.settings",
    "pcgraph.parallel",
)


def test_geometry_knows_cameras_and_arrays_alone() -> None:
    def is_offence(found: Import) -> bool:
        is_own = is_of(found.module, *PACKAGES)
        return room_of(found.file) == "geometry" and is_own and not is_of(found.module, *SHARED_WITH_GEOMETRY)

    assert offenders("rangesim", is_offence) == []


def test_multiview_stands_on_geometry_alone() -> None:
    allowed = (*SHARED_WITH_GEOMETRY, "rangesim.multiview", "rangesim.errors")

    def is_offence(found: Import) -> bool:
        is_own = is_of(found.module, *PACKAGES)
        return room_of(found.file) == "multiview" and is_own and not is_of(found.module, *allowed)

    assert offenders("rangesim", is_offence) == []


GEOMETRY = {
    "camera_matrix": "CameraParts back_project calibration_matrix centre decompose decompose_zero_skew depth "
    "ideal_pixels lens_pixels project projection_matrix rays",
    "camera_pose": "CameraPose find_camera_pose fit_camera_pose",
    "camera_projector": "ProjectorTriangulation triangulate_coordinates",
    "dense_stereo": "DenseMatch DenseMatching MatchOutcome match_densely",
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
    assert not ({*RENDERER, "open3d", "cv2", "scipy.stats"}) & set(run(code).split())


FUSION = {
    "computed_tomography": "Sinogram filtered_back_projection sampling_angles with_photon_noise xray_projections",
    "joint_registration": "refine_jointly",
    "mesh_error": "SurfaceError surface_error",
    "multiway_registration": "Alignment PairFit PoseErrors align pose_errors",
    "virtual_cameras": "pinhole_views",
    "posed_images": "Scan",
    "sdf": "average_signed_distances reading_weights signed_distance",
    "seen_volume": "Occupancy SeenOfShape VoxelState occupancy true_occupancy voxel_states",
    "solids": "Solid attenuation_volume inside_voxels",
    "truncated_average": "FusedSurface fuse",
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
        "ActiveStereo",
        "Ambient",
        "AmcwToF",
        "Beam",
        "Camera",
        "Capture",
        "CaptureSet",
        "CoverGlass",
        "Decoder",
        "Detector",
        "DirectToF",
        "Fisheye",
        "IdealToF",
        "Intrinsics",
        "Lens",
        "Lissajous",
        "Orthographic",
        "PointCloud",
        "Pulse",
        "RangeImage",
        "RayTable",
        "Returns",
        "Rig",
        "Risley",
        "Scene",
        "Sensor",
        "Signals",
        "SpadDetector",
        "Spinning",
        "Status",
        "StillSignals",
        "StructuredLight",
        "TransportSettings",
        "Zones",
        "compare",
        "decode",
        "errors_markdown",
        "explain",
        "expose",
        "failures_markdown",
        "import_capture",
        "load_calibration",
        "load_capture",
        "load_range_image",
        "load_scene",
        "load_signals",
        "look_at",
        "save_capture",
        "save_range_image",
        "save_signals",
        "scan",
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


def test_settings_of_the_light_transport_load_neither_sensors_nor_decoders() -> None:
    loaded = run("import rangesim.light_transport.transport_settings, sys; print(*sys.modules)").split()
    rooms = {name.split(".")[1] for name in loaded if name.startswith("rangesim.")}
    assert rooms == {"environment", "errors", "light_transport", "settings"}


def test_decoding_loads_no_renderer() -> None:
    code = "from rangesim import decode, load_capture, StructuredLight, AmcwToF; import sys; print(*sys.modules)"
    assert not ({*RENDERER, "open3d"}) & set(run(code).split())
