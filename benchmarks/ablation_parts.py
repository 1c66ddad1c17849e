# SPDX-License-Identifier: Apache-2.0
"""The parts of pcgraph's default segmentation, each with the code it is and how it is switched off.

A part is switched off by patches: a name as it is looked up, such as `scan.detached_voxels`, gets another value, made
of the one it has. What kernels hold cannot be patched so; `tests/benchmarks/test_ablation.py` sees to that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.kinds import Acquisition, Evidence, MovingScanner, Scanner, acquisition_of, spacing_law
from pcgraph.acquisition.spacing_law import SpacingLaw
from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import Bridges, Gaps
from pcgraph.graph.contacts import edge_features, facing_sides
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.inputs import CleanCloud
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.voxelisation.adapted_size import VOXELS_PER_SEED
from pcgraph.voxels.grid import VoxelGrid, boundary_voxels
from pcgraph.voxels.ground_and_rooms import SupportingPlane
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import VisibleSides
from pcgraph.voxels.warp import NormalTransform

Replacement = Callable[[Any], Any]
"""What a name gets, given what it has."""


@dataclass(frozen=True)
class Part:
    """One part of the default.

    Attributes
    ----------
    name : str
    code : tuple of str
        What it consists of: files of the package, or definitions in them, "file.py:name". What nothing else uses goes
        with them (`ablation_cost.Source.removed_with`).
    off : dict of str to Replacement
        Names, within `pcgraph`, that are patched to switch it off.
    """

    name: str
    code: tuple[str, ...]
    off: dict[str, Replacement]


def jointly(parts: Iterable[Part]) -> Part:
    """All of some parts as one: what each gains alone another may gain in its place."""
    parts, off = tuple(parts), dict[str, Replacement]()
    for part in parts:
        for path, replacement in part.off.items():
            off[path] = _one_after_another(off[path], replacement) if path in off else replacement
    code = tuple(dict.fromkeys(one for part in parts for one in part.code))
    return Part(f"jointly: {'; '.join(part.name for part in parts)}", code, off)


def _one_after_another(first: Replacement, second: Replacement) -> Replacement:
    return lambda original: second(first(original))


class Target(NamedTuple):
    """A patched name: the module or class that holds it, the name there, and what it has."""

    owner: Any
    name: str
    value: Any

    @classmethod
    def of(cls, path: str) -> Target:
        """That of a dotted path within `pcgraph`; ImportError or KeyError if there is none."""
        steps = path.split(".")
        for n in range(len(steps) - 1, 0, -1):
            try:
                owner = import_module(".".join(("pcgraph", *steps[:n])))
            except ModuleNotFoundError:
                continue
            for step in steps[n:-1]:
                owner = vars(owner)[step]
            return cls(owner, steps[-1], vars(owner)[steps[-1]])
        raise ImportError(f"no module for {path}")


@contextmanager
def switched_off(part: Part) -> Iterator[None]:
    """The segmentation without a part, as long as the context lasts."""
    with ExitStack() as stack:
        for path, replacement in part.off.items():
            owner, name, value = Target.of(path)
            stack.callback(setattr, owner, name, value)
            setattr(owner, name, replacement(value))
        yield


# --- What a name may get ----------------------------------------------------------------------------------------------


def _is(value: Any) -> Replacement:
    return lambda original: value


def _gives(value: Any) -> Replacement:
    """A function that always gives this."""
    return lambda original: lambda *arguments, **named: value


def _keeps(which: int) -> Replacement:
    """A function that gives one of its arguments."""
    return lambda original: lambda *arguments, **named: arguments[which]


def _none_of(which: int) -> Replacement:
    """A function that says no to each element of one of its arguments."""
    return lambda original: lambda *arguments: np.zeros(len(arguments[which]), np.bool_)


def _then(change: Callable[[Any], Any]) -> Replacement:
    """The function, whose result is changed."""
    return lambda original: lambda *arguments, **named: change(original(*arguments, **named))


def _with(**fields: float) -> Replacement:
    """A method of a dataclass whose fields are others."""
    return lambda original: lambda self, *arguments: original(replace(self, **fields), *arguments)


def _altitude(**fields: float) -> dict[str, Replacement]:
    return {"tree.region_linkage._CONSTANTS": lambda constants: constants._replace(**fields)}


def _linkage(**fields: float) -> dict[str, Replacement]:
    return {"tree.region_linkage.RegionLinkage.merges": _with(**fields)}


def _cost(**fields: float) -> dict[str, Replacement]:
    return {"graph.boundary.BoundaryCost.__call__": _with(**fields)}


def _metric(**fields: float) -> dict[str, Replacement]:
    return {"supervoxels.surface_growth.Metric": _then(lambda metric: metric._replace(**fields))}


def _constants(file: str, *names: str) -> tuple[str, ...]:
    return tuple(f"{file}:{name}" for name in names)


def _no_voxels(grid: VoxelGrid) -> NDArray[np.bool_]:
    return np.zeros(grid.n_voxels, np.bool_)


def _no_gaps(surface: Surface, nodes: NodeFeatures, *others: object) -> Gaps:
    edges, none = np.empty((0, 2), np.int32), np.empty(0, np.int64)
    features = edge_features(nodes, facing_sides(surface, edges, none, none))
    return Gaps(
        edges,
        features,
        np.empty(0),
        np.empty(0),
    )


def _no_continuations(surface: Surface, nodes: NodeFeatures, *others: object) -> Continuations:
    return continuations_of(surface, nodes, np.empty((0, 2), np.int64))


def _no_law(points: NDArray[np.float64], viewpoint: NDArray[np.float64] | None = None, *others: object) -> SpacingLaw:
    return SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0, 0.0, 0.0)


def _no_camera(cloud: CleanCloud, viewpoint: Any, camera: bool | None, growth: float | None) -> Acquisition:
    """What the pixels tell but that a camera took them."""
    return acquisition_of(cloud, viewpoint, bool(camera), growth)


def _on_the_move(scanner: Scanner, grid: VoxelGrid) -> Acquisition:
    """A scanner whose place counts for the growth of voxels alone, unless it was given."""
    if scanner.told.evidence not in (Evidence.SPACING, Evidence.RINGS):
        return scanner
    return MovingScanner(scanner.told, scanner.place, scanner.growth)


def _from_above(grid: VoxelGrid, normals: NDArray[np.float64], *others: object) -> VisibleSides:
    """Normals as they are: upwards."""
    far = 1e3 * float(np.ptp(grid.centroids, axis=0).max()) * np.array([0.0, 0.0, 1.0])
    return VisibleSides((grid.centroids.mean(axis=0) + far)[None], normals)


def _from_outside(grid: VoxelGrid, normals: NDArray[np.float64], *others: object) -> VisibleSides:
    """Normals away from the middle."""
    found = _from_above(grid, normals)
    outwards = np.einsum("ij,ij->i", grid.centroids - grid.centroids.mean(axis=0), normals)
    return VisibleSides(found.places, np.where(outwards[:, None] < 0.0, -normals, normals))


def _every_reading(readings: Any, place: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.ones(len(readings.logs), np.bool_)


def _first_readings(readings: Any) -> NDArray[np.int64]:
    return np.arange(min(len(readings.logs), spacing_law._SEARCH.readings))


def _one_part(coarse: VoxelGrid, *others: object) -> tuple[NDArray[np.int64], list[Any]]:
    return np.zeros(coarse.n_voxels, np.int64), []


def _none_hidden(surface: Surface, places: object, ways: Any) -> list[NDArray[np.bool_]]:
    return [np.zeros(len(some.ends), np.bool_) for some in ways]


def _all_level(grid: VoxelGrid, pieces: object, ways: Any) -> NDArray[np.bool_]:
    return np.ones(len(ways.ends), np.bool_)


def _all_smooth(leaves: object, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    return np.ones(len(edges))


def _by_weight(seen: NDArray[np.bool_], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """All that count, by decreasing weight."""
    return np.argsort(-weights, kind="stable")[: np.count_nonzero(weights > 0.0)]


_NOWHERE = SupportingPlane(np.array([0.0, 0.0, 1.0]), -np.inf, False)
_NO_BRIDGES = Bridges(np.empty((0, 2), np.int32), np.empty(0), np.empty(0), np.empty(0, np.bool_))
_NO_OUTLIERS: dict[str, Replacement] = {"voxelisation.voxelised.outlier_voxels": _is(_no_voxels)}
_NO_DETACHED: dict[str, Replacement] = {"voxelisation.voxelised.detached_voxels": _is(_no_voxels)}
_NO_CLOSER_LOOK: dict[str, Replacement] = {
    "voxelisation.voxelised.is_full_of_noise": _gives(False),
    "voxelisation.voxelised._NOISY": _is(-1.0),
}
_NO_CONTINUATIONS: dict[str, Replacement] = {"graph.continuations._of_planes": _is(_no_continuations)}
_NO_TERRAIN: dict[str, Replacement] = {"graph.continuations._of_terrain": _is(_no_continuations)}
_NO_PIXELS: dict[str, Replacement] = {"scan.with_pixels": _keeps(0)}
_NO_LAW: dict[str, Replacement] = {
    "acquisition.kinds.spacing_law": _is(_no_law),
    "acquisition.kinds.law_on_rings": _keeps(1),
}
_UP: dict[str, Replacement] = {
    "acquisition.kinds.visible_sides": _is(_from_above),
    "acquisition.kinds.virtual_viewpoints": _gives(None),
}
_OUTWARDS: dict[str, Replacement] = {
    "acquisition.kinds.visible_sides": _is(_from_outside),
    "acquisition.kinds.virtual_viewpoints": _gives(None),
}
_SIDES = ("voxels/virtual_viewpoints.py", "voxels/visibility.py:visible_sides", "voxels/visibility.py:VisibleSides")

# Short names of files
_SCAN, _LINK, _SIZE = "scan.py", "tree/region_linkage.py", "voxelisation/adapted_size.py"
_LAW, _RINGS, _PIXELS, _LATTICE = (
    f"acquisition/{name}.py" for name in ("spacing_law", "rings", "pixels", "pixel_lattice")
)
_ACQUISITION, _VOXELS = "acquisition/kinds.py", "voxelisation/voxelised.py"
_NOISE, _VIEW, _SIDE = "voxels/outliers.py", "voxels/virtual_viewpoints.py", "voxels/visibility.py"
_IMAGE, _GROW, _GAPS, _BEHIND = (
    "acquisition/depth_image.py",
    "supervoxels/surface_growth.py",
    "graph/gaps.py",
    "graph/continuations.py",
)
_V = "voxels.virtual_viewpoints."


def _altitude_part(name: str, **fields: float) -> Part:
    code = _constants(_LINK, *(f"AltitudeConstants.{field}" for field in fields))
    return Part(f"linkage: {name}", code, _altitude(**fields))


def _constant(name: str, file: str, constant: str, value: Any, *more: str) -> Part:
    """A part that a constant of a file switches off."""
    module = file.removesuffix(".py").replace("/", ".")
    return Part(name, (f"{file}:{constant}", *(f"{file}:{one}" for one in more)), {f"{module}.{constant}": _is(value)})


def _threshold(name: str, file: str, settings: str, *more: str, **fields: Any) -> Part:
    """A part that fields of a dataclass of thresholds switch off, which a file holds under a name."""
    path = f"{file.removesuffix('.py').replace('/', '.')}.{settings}"
    kind = type(Target.of(path).value).__name__
    code = _constants(file, *(f"{kind}.{field}" for field in fields), *more)
    return Part(name, code, {path: lambda held: replace(held, **fields)})


def _function(name: str, file: str, function: str, replacement: Replacement, *constants: str) -> Part:
    """A part that is a function of a file."""
    module = file.removesuffix(".py").replace("/", ".")
    return Part(name, (f"{file}:{function}", *_constants(file, *constants)), {f"{module}.{function}": replacement})


GROUPS = (
    Part(
        "all: where it was seen from",
        (
            _PIXELS,
            _LAW,
            _RINGS,
            f"{_IMAGE}:image_view",
            f"{_ACQUISITION}:Scanner.confirmed",
            *_SIDES,
        ),
        _NO_PIXELS | _NO_LAW | _UP | {"acquisition.kinds.image_view": _gives(None)},
    ),
    Part("all: law of spacing and rings", (_LAW, _RINGS, f"{_ACQUISITION}:Scanner.confirmed"), _NO_LAW),
    Part("all: outside from what is visible; else upwards", _SIDES, _UP),
    Part("all: outside from what is visible; else outwards", _SIDES, _OUTWARDS),
    Part(
        "all: outliers",
        (_NOISE, f"{_VOXELS}:_without_near_outliers", f"{_VOXELS}:Voxelised.without"),
        _NO_OUTLIERS | _NO_DETACHED,
    ),
    Part(
        "all: joins behind what hides",
        (f"{_BEHIND}:continuations",),
        _NO_CONTINUATIONS | _NO_TERRAIN,
    ),
    Part(
        "all: adapted voxel size",
        (_SIZE, "voxels/grading.py", f"{_VOXELS}:_adapted", f"{_SCAN}:_oriented"),
        {"voxelisation.voxelised._adapted": lambda f: lambda found, *others: (found, found.grid.size)},
    ),
    Part(
        "all: colours",
        ("voxels/column_evidence.py:color_evidence", f"{_LINK}:RegionLinkage.color", f"{_LINK}:AltitudeConstants.k1"),
        {"scan.clean_cloud": lambda f: lambda points, colors, *others: f(points, None, *others)},
    ),
    Part("all: relief and heaps", (f"{_LINK}:_standing_out",), _linkage(relief=0.0) | _altitude(h1=0.0)),
)

CAMERAS = (
    Part("pixels of a list", (_PIXELS, _LATTICE), _NO_PIXELS),
    _function("pixels of a list, in any frame", _PIXELS, "_image_in_any_frame", _gives(None)),
    _function("pixels of a list, in its own frame", _PIXELS, "_image_in_own_frame", _gives(None)),
    _function(
        "pixels of depths in steps",
        _LATTICE,
        "_alike",
        lambda f: lambda camera, *others: [camera],
    ),
    _function("camera of an image in any frame", _IMAGE, "_camera", _gives(None)),
    Part("voxels grow with depth", (f"{_ACQUISITION}:CameraImage",), {"scan.acquisition_of": _is(_no_camera)}),
    Part(
        "spacing of a depth image",
        (f"{_IMAGE}:DepthImage.spacing",),
        {"acquisition.depth_image.DepthImage.spacing": _keeps(1)},
    ),
    _threshold(
        "spacing: steps of depth", _IMAGE, "_STEPS", "_step_along", "StepThresholds.max_step", max_coarsening=0.0
    ),
    _threshold("spacing: rows of an image", _IMAGE, "_STEPS", min_per_pitch=0.0),
    Part(
        "flying pixels",
        (f"{_VOXELS}:without_flying_pixels", f"{_IMAGE}:DepthImage.flying"),
        {"scan.without_flying_pixels": _keeps(0)},
    ),
)

LAW = (
    _constant("voxels grow with range", _ACQUISITION, "RANGE_GROWTH", 0.0),
    Part("rings", (_RINGS, f"{_LAW}:law_on_rings"), {"acquisition.kinds.law_on_rings": _keeps(1)}),
    Part("law of spacing, but for rings", (_LAW,), {"acquisition.kinds.spacing_law": _is(_no_law)}),
    Part(
        "scanner's position for normals",
        (f"{_ACQUISITION}:Scanner.confirmed",),
        {"acquisition.kinds.Scanner.confirmed": _is(_on_the_move)},
    ),
    _function("law: cosines of the surface", _LAW, "_fit_normals", lambda f: lambda *a: a[-1].fill(0.0)),
    _function(
        "law: readings drawn by spacing",
        _LAW,
        "_between_points_and_surface",
        _is(_first_readings),
    ),
    _function("law: readings off the line", _LAW, "_on_line", _is(_every_reading)),
    _threshold("law: near and far half", _LAW, "_LAW", "_least_exponent", min_exponent_of_half=-math.inf),
    _threshold("law: middling ranges", _LAW, "_LAW", "_exponent_of_most", min_trimmed=-math.inf),
    _threshold("law: origin as good", _LAW, "_LAW", better_than_origin=-math.inf),
    _threshold("law: prior of the exponent", _LAW, "_SEARCH", prior=0.0),
    _threshold("law: several starts", _LAW, "_SEARCH", "SearchThresholds.apart", starts=1),
    Part(
        "law: mirrored place",
        (f"{_SIDE}:likelier_viewpoint", f"{_LAW}:_mirrored", f"{_LAW}:SpacingLaw.mirrored"),
        {"acquisition.kinds.likelier_viewpoint": _keeps(1)},
    ),
    Part(
        "law: best place beside the origin",
        (f"{_LAW}:SpacingLaw.best_viewpoint",),
        {"acquisition.kinds.spacing_law": _then(lambda law: replace(law, best_viewpoint=None))},
    ),
    Part(
        "scanner moved: place must show all",
        (f"{_ACQUISITION}:_MIN_SHOWN", f"{_SIDE}:shown_fraction"),
        {"acquisition.kinds._MIN_SHOWN": _is(0.0)},
    ),
    Part(
        "axis: level ground faces its scanner",
        (f"{_SIDE}:sides_towards", f"{_SIDE}:_upwards"),
        {"acquisition.kinds.sides_towards": _keeps(1)},
    ),
)

SIZES = (
    Part(
        "spacing by the eighth neighbour, too",
        ("voxels/spacing.py:_NEIGHBOUR",),
        {"voxels.spacing._near": _then(lambda near: near._replace(distances=near.distances[[0, 0]]))},
    ),
    _threshold("spacing of copies", "voxels/spacing.py", "_READ", "_fullest", "SpacingThresholds.thin", max_copies=0),
    _constant("sizes per octave", _VOXELS, "_SIZES_PER_OCTAVE", 1 << 40),
    _constant("offset of the grid", _VOXELS, "_GRID_OFFSET", 0.0),
    _constant("control: another offset of the grid", _VOXELS, "_GRID_OFFSET", 0.618),  # as good: what luck makes
    _function("larger voxels", _SIZE, "_enlarged_size", lambda f: lambda points, grid, *others: grid.size),
    _threshold("larger: gain that is asked for", _SIZE, "_LARGER", min_gain=0.0),
    _threshold("larger: gain of sparse clouds", _SIZE, "_LARGER", min_gain_of_sparse=0.0),
    _function("smaller voxels", _SIZE, "_refined_size", lambda f: lambda points, grid, *others: grid.size),
    _threshold("smaller: price of roughness", _SIZE, "_SMALLER", price=0.0, price_of_large=0.0),
    _function("smaller: few voxels", _SIZE, "_enough_of_few", _gives(math.inf)),
    Part(
        "graded voxels",
        (f"{_SIZE}:adapted_grading", "voxels/grading.py:Grading"),
        {"voxelisation.voxelised.adapted_grading": _gives(None)},
    ),
    _function("graded: small grids less", _SIZE, "_sparse_below", _gives(0.6)),
    Part(
        "seeds nearer where few",
        _constants(_SIZE, "seed_spacing", "_edges_per_seed"),
        {"scan.seed_spacing": _is(lambda grid, acquisition: VOXELS_PER_SEED * grid.size)},
    ),
    _threshold("seeds nearer on smooth surfaces", _SIZE, "_SEEDS", min_supervoxels_on_smooth=800),
    _constant("normals as of larger voxels", _SCAN, "_FLIP_COSINE", 2.0),
)

NOISE = (
    Part("outlier voxels", (f"{_NOISE}:outlier_voxels",), _NO_OUTLIERS),
    Part("detached voxels", (f"{_NOISE}:detached_voxels",), _NO_DETACHED),
    Part(
        "noise looked at closer",
        (f"{_VOXELS}:_without_near_outliers", f"{_NOISE}:is_full_of_noise", f"{_NOISE}:fill_the_volume"),
        _NO_CLOSER_LOOK,
    ),
    Part(
        "noise: full of it", (f"{_NOISE}:is_full_of_noise",), {"voxelisation.voxelised.is_full_of_noise": _gives(False)}
    ),
    _constant("noise: much was found", _VOXELS, "_NOISY", -1.0),
    Part(
        "noise fills the volume",
        (f"{_NOISE}:fill_the_volume",),
        {"voxelisation.voxelised.fill_the_volume": _gives(True)},
    ),
    _constant("noise: scale estimated again", _VOXELS, "_FEW_OUTLIERS", 0.0),
    _function("noise: surfaces among it", _NOISE, "_surfaces_among", _none_of(0)),
    _threshold("noise: within reach", _NOISE, "_NOISE", reach_volume=math.inf),
    _threshold("noise: of all two thirds at most", _NOISE, "_NOISE", max_fraction=1.0),
)

SIDES = (
    _function("visible: carried over edges", _SIDE, "_carry_over", _gives(None)),
    _function("visible: votes smoothed", _SIDE, "_smoothed_votes", _keeps(2)),
    _threshold(
        "virtual: finer cells of rooms",
        _VIEW,
        "_RESOLUTION",
        "ResolutionThresholds.shows_most",
        "ResolutionThresholds.shows_nearly_all",
        finer=(1,),
    ),
    _function("virtual: layers", _VIEW, "_is_layered", _gives(False)),
    _function("virtual: rooms", _VIEW, "_is_room", _gives(False)),
    _function("virtual: parts far apart", _VIEW, "_parts", _is(_one_part)),
    _function("virtual: partitions", _VIEW, "_without_partitions", _keeps(0)),
    _threshold("virtual: passages", _VIEW, "_SCORE", min_shown_from_inside=math.inf),
    _threshold("virtual: planes from behind", _VIEW, "_SCORE", max_from_behind=math.inf),
    _threshold("virtual: differences that do not count", _VIEW, "_SCORE", shown_tolerance=0.0),
    _threshold("virtual: unanimous", _VIEW, "_SCORE", unanimous=0.0),
    _threshold("virtual: seen from outside", _VIEW, "_SCORE", outside=0.0),
    _threshold("virtual: above the ground", _VIEW, "_SCORE", above_ground=0.002),
    _threshold("virtual: free side of a plane", _VIEW, "_SCORE", free_side=0.0),
    Part(
        "virtual: plane that bears things",
        ("voxels/ground_and_rooms.py:supporting_plane",),
        {f"{_V}supporting_plane": _gives(_NOWHERE)},
    ),
    _function("virtual: origin as a camera's place", _VIEW, "_has_in_view", _gives(False)),
    _function("virtual: origin sees as much", _VIEW, "_sees_as_much", _gives(True)),
    _threshold("virtual: box along principal axes", _VIEW, "_CANDIDATES", max_turned_box=0.0),
    _function("virtual: choice spread out", _VIEW, "_spread_choice", _is(_by_weight)),
    _threshold("virtual: places not in corners", _VIEW, "_CANDIDATES", min_surrounded=0.0),
)

SUPERVOXELS = (
    Part(
        "windows that do not reach over an edge",
        ("voxels/surface.py:_take_best", "voxels/surface.py:_OWN_BONUS"),
        {"supervoxels.surface_growth.local_planes": lambda f: lambda grid, places, reach: f(grid, places, 0)},
    ),
    Part(
        "distance off the plane",
        ("supervoxels/clustering.py:_off_plane", f"{_GROW}:_NOISE_OFF_PLANE"),
        _metric(plane=0.0),
    ),
    Part("distance of normals", (f"{_GROW}:SurfaceGrowth.normal_weight",), _metric(normal=0.0)),
    Part("distance of colours", (f"{_GROW}:SurfaceGrowth.color_weight",), _metric(color=0.0)),
    Part(
        "colours count as they tell",
        ("voxels/column_evidence.py:color_evidence",),
        {"supervoxels.surface_growth.color_evidence": _gives(1.0), "scan.color_evidence": _gives(1.0)},
    ),
    Part(
        "two seeds on parallel surfaces",
        ("supervoxels/clustering.py:_on_another_surface",),
        {"supervoxels.surface_growth.seed_voxels": lambda f: lambda *a, two_sided: f(*a, two_sided=True)},
    ),
    Part(
        "voxels taken from others early",
        ("supervoxels/clustering.py:EARLY_SWEEPS",),
        {"supervoxels.surface_growth.EARLY_SWEEPS": _is(0.0)},
    ),
    Part("refinement", ("supervoxels/clustering.py:refine",), {"supervoxels.surface_growth.refine": _gives(None)}),
    Part(
        "points go to the surface they lie on",
        (f"{_GROW}:assign_points", f"{_GROW}:SurfaceGrowth.supervoxel_of_point"),
        {"supervoxels.surface_growth.SurfaceGrowth.supervoxel_of_point": _is(SupervoxelMethod.supervoxel_of_point)},
    ),
    Part(
        "normals in the warped space",
        (_constants("voxels/warp.py", "RangeWarp.slant", "CameraWarp.slant", "warped_normal")),
        {
            "voxels.warp.RangeWarp.slant": _is(property(lambda warp: NormalTransform())),
            "voxels.warp.CameraWarp.slant": _is(property(lambda warp: NormalTransform())),
        },
    ),
)

GRAPH = (
    Part("gaps", (_GAPS,), {"scan.gaps": _is(_no_gaps)}),
    _function("gaps: seen through", _GAPS, "_open_ways", _none_of(3)),
    Part(
        "gaps: strips",
        (f"{_GAPS}:_ends_of_surfaces",),
        {"graph.gaps._ends_of_surfaces": lambda f: lambda grid, *others: np.flatnonzero(boundary_voxels(grid))},
    ),
    Part("gaps: wider in one scan", ("voxels/warp.py:RangeWarp.max_gap",), {"voxels.warp.RangeWarp.max_gap": _is(3.0)}),
    Part("gaps: price", (f"{_LINK}:RegionLinkage.gap", f"{_LINK}:_GAP_OF_SEVERAL_SCANS"), _linkage(gap=0.0)),
    _constant("gaps: cheaper in several scans", _LINK, "_GAP_OF_SEVERAL_SCANS", 1.0),
    Part("pieces of one plane", (f"{_BEHIND}:_of_planes",), _NO_CONTINUATIONS),
    _function("continuations", _BEHIND, "_unseen", _is(_none_hidden), "_ALONG_WAY", "_MIN_DEPTH"),
    _function("continuations: level", _BEHIND, "_are_level", _is(_all_level), "_MIN_NOISE"),
    _constant("continuations: three places", _ACQUISITION, "_MAX_PLACES", 1),
    _function("bounding planes", _BEHIND, "_behind_something", lambda f: lambda *a: np.zeros(len(a[3].ends), np.bool_)),
    Part("terrain", (f"{_BEHIND}:_of_terrain",), _NO_TERRAIN),
    _function("terrain: pieces that touch", _BEHIND, "_touching", _gives(np.empty((0, 2), np.int64))),
    Part("bridges", ("graph/bridges.py", f"{_LINK}:RegionLinkage.bridge"), {"scan.bridges": _gives(_NO_BRIDGES)}),
    _threshold(
        "bridges between specks",
        "graph/bridges.py",
        "_THRESHOLDS",
        "_are_near",
        "BridgeThresholds.times_nearest",
        "BridgeThresholds.max_width_of_surface",
        max_points=0,
    ),
)

LINKAGE = (
    Part("cost: at the contact", ("graph/boundary.py:BoundaryCost.contact",), _cost(contact=0.0)),
    Part("cost: of whole supervoxels", ("graph/boundary.py:BoundaryCost.contact",), _cost(contact=1.0)),
    Part("cost: convex edges", ("graph/boundary.py:BoundaryCost.convex",), _cost(convex=0.0)),
    Part(
        "cost: steps", _constants("graph/boundary.py", "BoundaryCost.step", "BoundaryCost.step_limit"), _cost(step=0.0)
    ),
    _threshold(
        "cost: narrow valleys",
        "graph/boundary.py",
        "_NARROW",
        "ValleyThresholds.per_room",
        "ValleyThresholds.noise",
        per_opening=1e9,
    ),
    _threshold("cost: room in a valley", "graph/boundary.py", "_NARROW", "ValleyThresholds.noise", per_room=0.0),
    Part(
        "linkage: relief R",
        (
            f"{_LINK}:RegionLinkage.relief",
            *_constants(_LINK, *(f"AltitudeConstants.{field}" for field in ("b1", "d1", "v0"))),
        ),
        _linkage(relief=0.0),
    ),
    _altitude_part("heaps H", h1=0.0, h0=0.0),
    Part(
        "linkage: relief only outwards",
        (f"{_LINK}:_Outlines.sides_known",),
        {"tree.region_linkage._Outlines": _then(lambda outlines: outlines._replace(sides_known=False))},
    ),
    _altitude_part("relief: far off the plane counts less (d1)", d1=math.inf),
    _altitude_part("relief: noise v0", v0=0.0),
    Part("linkage: colours", (f"{_LINK}:RegionLinkage.color",), _linkage(color=0.0)),
    _altitude_part("valley where colours change (k1)", k1=0.0),
    _altitude_part("least evidence c0", c0=0.0),
    _altitude_part("increase in the evidence (c1)", c1=0.0),
    _altitude_part("steep valleys (c2, s0, u)", c2=math.inf, s0=0.5),
    _function("linkage: smoothness u of what is steep", _LINK, "_smoothness", _is(_all_smooth)),
    _altitude_part("same plane first: e0", e0=1e-9),
    _altitude_part("uneven surfaces (e1, q0)", e1=0.0, q0=2.0),
    _altitude_part("much larger surfaces late (r)", r=1e12),
    _altitude_part("small pieces early (m0)", m0=0.0),
    _altitude_part("specks early (m1)", m1=0.0),
    _altitude_part("small masses (m2)", m2=0.0),
)

PARTS: tuple[Part, ...] = (*GROUPS, *CAMERAS, *LAW, *SIZES, *NOISE, *SIDES, *SUPERVOXELS, *GRAPH, *LINKAGE)
