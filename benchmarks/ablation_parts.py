# SPDX-License-Identifier: Apache-2.0
"""The parts of pcgraph's default segmentation, each with the code it is and how it is switched off.

A part is switched off by patches: a name as it is looked up, such as `scan.detached_voxels`, gets another value, made
of the one it has. What kernels hold cannot be patched so; `tests/pcgraph/test_ablation.py` sees to that.
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

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import Bridges, Gaps
from pcgraph.graph.contacts import edge_features, facing_sides
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.voxels import spacing_law
from pcgraph.voxels.adapted_size import VOXELS_PER_SEED
from pcgraph.voxels.grid import VoxelGrid, boundary_voxels
from pcgraph.voxels.ground_and_rooms import SupportingPlane
from pcgraph.voxels.spacing_law import SpacingLaw
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


def _shape(**fields: float) -> dict[str, Replacement]:
    return {"tree.region_linkage._SHAPE": lambda shape: shape._replace(**fields)}


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
    return Gaps(edges, features, np.empty(0), np.empty(0), surface.grid.warp.of_one_scan)


def _no_continuations(surface: Surface, nodes: NodeFeatures, *others: object) -> Continuations:
    return continuations_of(surface, nodes, np.empty((0, 2), np.int64))


def _no_law(points: NDArray[np.float64], viewpoint: NDArray[np.float64] | None = None, *others: object) -> SpacingLaw:
    return SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0, 0.0, 0.0)


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
    return np.arange(min(len(readings.logs), spacing_law._READINGS))


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
_NO_OUTLIERS: dict[str, Replacement] = {"scan.outlier_voxels": _is(_no_voxels)}
_NO_DETACHED: dict[str, Replacement] = {"scan.detached_voxels": _is(_no_voxels)}
_NO_CLOSER_LOOK: dict[str, Replacement] = {"scan.is_full_of_noise": _gives(False), "scan._NOISY": _is(-1.0)}
_NO_CONTINUATIONS: dict[str, Replacement] = {"graph.continuations._of_planes": _is(_no_continuations)}
_NO_TERRAIN: dict[str, Replacement] = {"graph.continuations._of_terrain": _is(_no_continuations)}
_NO_PIXELS: dict[str, Replacement] = {"scan.with_pixels": _keeps(0)}
_NO_LAW: dict[str, Replacement] = {"scan.spacing_law": _is(_no_law), "scan.law_on_rings": _keeps(1)}
_UP: dict[str, Replacement] = {"scan.visible_sides": _is(_from_above), "scan.virtual_viewpoints": _gives(None)}
_OUTWARDS: dict[str, Replacement] = {"scan.visible_sides": _is(_from_outside), "scan.virtual_viewpoints": _gives(None)}
_SIDES = ("voxels/virtual_viewpoints.py", "voxels/visibility.py:visible_sides", "voxels/visibility.py:VisibleSides")

# Short names of files
_SCAN, _LINK, _LAW, _SIZE = "scan.py", "tree/region_linkage.py", "voxels/spacing_law.py", "voxels/adapted_size.py"
_NOISE, _VIEW, _SIDE = "voxels/outliers.py", "voxels/virtual_viewpoints.py", "voxels/visibility.py"
_IMAGE, _GROW, _GAPS, _BEHIND = (
    "depth_image.py",
    "supervoxels/surface_growth.py",
    "graph/gaps.py",
    "graph/continuations.py",
)
_V = "voxels.virtual_viewpoints."


def _shape_part(name: str, **fields: float) -> Part:
    return Part(f"linkage: {name}", _constants(_LINK, *(f"_Shape.{field}" for field in fields)), _shape(**fields))


def _constant(name: str, file: str, constant: str, value: Any, *more: str) -> Part:
    """A part that a constant of a file switches off."""
    module = file.removesuffix(".py").replace("/", ".")
    return Part(name, (f"{file}:{constant}", *(f"{file}:{one}" for one in more)), {f"{module}.{constant}": _is(value)})


def _function(name: str, file: str, function: str, replacement: Replacement, *constants: str) -> Part:
    """A part that is a function of a file."""
    module = file.removesuffix(".py").replace("/", ".")
    return Part(name, (f"{file}:{function}", *_constants(file, *constants)), {f"{module}.{function}": replacement})


GROUPS = (
    Part(
        "all: where it was seen from",
        ("pixels.py", _LAW, "voxels/rings.py", f"{_IMAGE}:image_view", f"{_SCAN}:_scanner_position", *_SIDES),
        _NO_PIXELS | _NO_LAW | _UP | {"scan.image_view": _gives(None)},
    ),
    Part("all: law of spacing and rings", (_LAW, "voxels/rings.py", f"{_SCAN}:_scanner_position"), _NO_LAW),
    Part("all: outside from what is visible; else upwards", _SIDES, _UP),
    Part("all: outside from what is visible; else outwards", _SIDES, _OUTWARDS),
    Part(
        "all: outliers",
        (_NOISE, f"{_SCAN}:_without_near_outliers", f"{_SCAN}:_without"),
        _NO_OUTLIERS | _NO_DETACHED,
    ),
    Part(
        "all: joins behind what hides",
        (f"{_BEHIND}:continuations",),
        _NO_CONTINUATIONS | _NO_TERRAIN,
    ),
    Part(
        "all: adapted voxel size",
        (_SIZE, "voxels/grading.py", f"{_SCAN}:_with_adapted_size", f"{_SCAN}:_oriented_as_larger"),
        {"scan._with_adapted_size": _keeps(0)},
    ),
    Part(
        "all: colours",
        ("voxels/column_evidence.py:color_evidence", f"{_LINK}:RegionLinkage.color", f"{_LINK}:_Shape.k1"),
        {"scan.clean_cloud": lambda f: lambda points, colors, *others: f(points, None, *others)},
    ),
    Part("all: relief and heaps", (f"{_LINK}:_standing_out",), _linkage(relief=0.0) | _shape(h1=0.0)),
)

CAMERAS = (
    Part("pixels of a list", ("pixels.py", "pixel_lattice.py"), _NO_PIXELS),
    _function("pixels of a list, in any frame", "pixels.py", "_image_in_any_frame", _gives(None)),
    _function("pixels of a list, in its own frame", "pixels.py", "_image_in_own_frame", _gives(None)),
    _function("pixels of depths in steps", "pixel_lattice.py", "_alike", lambda f: lambda camera, *others: [camera]),
    _function("camera of an image in any frame", _IMAGE, "_camera", _gives(None)),
    _function("voxels grow with depth", _SCAN, "_grows_with_depth", _gives(False)),
    Part("spacing of a depth image", (f"{_IMAGE}:DepthImage.spacing",), {"depth_image.DepthImage.spacing": _keeps(1)}),
    _constant("spacing: steps of depth", _IMAGE, "_MAX_COARSENING", 0.0, "_step_along", "_MAX_STEP"),
    _constant("spacing: rows of an image", _IMAGE, "_MIN_PER_PITCH", 0.0),
    Part(
        "flying pixels",
        (f"{_SCAN}:_without_flying_pixels", f"{_IMAGE}:DepthImage.flying"),
        {"scan._without_flying_pixels": _keeps(0)},
    ),
)

LAW = (
    _constant("voxels grow with range", _SCAN, "RANGE_GROWTH", 0.0),
    Part("rings", ("voxels/rings.py", f"{_LAW}:law_on_rings"), {"scan.law_on_rings": _keeps(1)}),
    Part("law of spacing, but for rings", (_LAW,), {"scan.spacing_law": _is(_no_law)}),
    _function("scanner's position for normals", _SCAN, "_scanner_position", _gives(None)),
    _function("law: cosines of the surface", _LAW, "_fit_normals", lambda f: lambda *a: a[-1].fill(0.0)),
    _function(
        "law: readings drawn by spacing",
        _LAW,
        "_between_points_and_surface",
        _is(_first_readings),
    ),
    _function("law: readings off the line", _LAW, "_on_line", _is(_every_reading)),
    _constant("law: near and far half", _LAW, "_MIN_EXPONENT_OF_HALF", -math.inf, "_least_exponent"),
    _constant("law: middling ranges", _LAW, "_MIN_OF_MOST", -math.inf, "_exponent_of_most"),
    _constant("law: origin as good", _LAW, "_OWN_ORIGIN", -math.inf),
    _constant("law: prior of the exponent", _LAW, "_PRIOR", 0.0),
    _constant("law: several starts", _LAW, "_STARTS", 1, "_APART"),
    Part(
        "law: mirrored place",
        (f"{_SIDE}:likelier_viewpoint", f"{_LAW}:_mirrored", f"{_LAW}:SpacingLaw.mirrored"),
        {"scan.likelier_viewpoint": _keeps(1)},
    ),
    Part(
        "law: best place beside the origin",
        (f"{_LAW}:SpacingLaw.best_viewpoint",),
        {"scan.spacing_law": _then(lambda law: replace(law, best_viewpoint=None))},
    ),
    Part(
        "scanner moved: place must show all",
        (f"{_SCAN}:_MIN_SHOWN", f"{_SIDE}:shown_fraction"),
        {"scan._MIN_SHOWN": _is(0.0)},
    ),
    Part(
        "axis: level ground faces its scanner",
        (f"{_SIDE}:sides_towards", f"{_SIDE}:_upwards"),
        {"scan.sides_towards": _keeps(1)},
    ),
)

SIZES = (
    Part(
        "spacing by the eighth neighbour, too",
        ("voxels/spacing.py:_NEIGHBOUR",),
        {"voxels.spacing._near": _then(lambda near: near._replace(distances=near.distances[[0, 0]]))},
    ),
    _constant("spacing of copies", "voxels/spacing.py", "_COPIES", 0, "_fullest", "_THIN"),
    _constant("sizes per octave", _SCAN, "_SIZES_PER_OCTAVE", 1 << 40),
    _constant("offset of the grid", _SCAN, "_GRID_OFFSET", 0.0),
    _constant("control: another offset of the grid", _SCAN, "_GRID_OFFSET", 0.618),  # as good: what luck makes
    _function("larger voxels", _SIZE, "_enlarged_size", lambda f: lambda points, grid, *others: grid.size),
    _constant("larger: gain that is asked for", _SIZE, "_MIN_GAIN", 0.0),
    _constant("larger: gain of sparse clouds", _SIZE, "_MIN_GAIN_OF_SPARSE", 0.0),
    _function("smaller voxels", _SIZE, "_refined_size", lambda f: lambda points, grid, *others: grid.size),
    _constant("smaller: price of roughness", _SIZE, "_PRICE_OF_ROUGHNESS", (0.0, 0.0)),
    _function("smaller: few voxels", _SIZE, "_enough_of_few", _gives(math.inf)),
    Part(
        "graded voxels",
        (f"{_SIZE}:adapted_grading", "voxels/grading.py:Grading"),
        {"scan.adapted_grading": _gives(None)},
    ),
    _function("graded: small grids less", _SIZE, "_sparse_below", _gives(0.6)),
    Part(
        "seeds nearer where few",
        _constants(_SIZE, "seed_spacing", "_edges_per_seed"),
        {"scan.seed_spacing": _is(lambda grid: VOXELS_PER_SEED * grid.size)},
    ),
    _constant("seeds nearer on smooth surfaces", _SIZE, "_MIN_SUPERVOXELS_ON_SMOOTH", 800),
    _function("normals as of larger voxels", _SCAN, "_oriented_as_larger", _keeps(0)),
)

NOISE = (
    Part("outlier voxels", (f"{_NOISE}:outlier_voxels",), _NO_OUTLIERS),
    Part("detached voxels", (f"{_NOISE}:detached_voxels",), _NO_DETACHED),
    Part(
        "noise looked at closer",
        (f"{_SCAN}:_without_near_outliers", f"{_NOISE}:is_full_of_noise", f"{_NOISE}:fill_the_volume"),
        _NO_CLOSER_LOOK,
    ),
    Part("noise: full of it", (f"{_NOISE}:is_full_of_noise",), {"scan.is_full_of_noise": _gives(False)}),
    _constant("noise: much was found", _SCAN, "_NOISY", -1.0),
    Part("noise fills the volume", (f"{_NOISE}:fill_the_volume",), {"scan.fill_the_volume": _gives(True)}),
    _constant("noise: scale estimated again", _SCAN, "_FEW_OUTLIERS", 0.0),
    _function("noise: surfaces among it", _NOISE, "_surfaces_among", _none_of(0)),
    _constant("noise: within reach", _NOISE, "_VOLUME_OF_REACH", math.inf),
    _constant("noise: of all two thirds at most", _NOISE, "_MAX_FRACTION", 1.0),
)

SIDES = (
    _function("visible: carried over edges", _SIDE, "_carry_over", _gives(None)),
    _function("visible: votes smoothed", _SIDE, "_smoothed_votes", _keeps(2)),
    _constant("virtual: finer cells of rooms", _VIEW, "_FINER", (1,), "_SHOWS_MOST", "_SHOWS_NEARLY_ALL"),
    _function("virtual: layers", _VIEW, "_is_layered", _gives(False)),
    _function("virtual: rooms", _VIEW, "_is_room", _gives(False)),
    _function("virtual: parts far apart", _VIEW, "_parts", _is(_one_part)),
    _function("virtual: partitions", _VIEW, "_without_partitions", _keeps(0)),
    _constant("virtual: passages", _VIEW, "_MIN_SHOWN_FROM_INSIDE", math.inf),
    _constant("virtual: planes from behind", _VIEW, "_MAX_FROM_BEHIND", math.inf),
    _constant("virtual: differences that do not count", _VIEW, "_SHOWN_TOLERANCE", 0.0),
    _constant("virtual: unanimous", _VIEW, "_W_UNANIMOUS", 0.0),
    _constant("virtual: seen from outside", _VIEW, "_W_OUTSIDE", 0.0),
    _constant("virtual: above the ground", _VIEW, "_W_ABOVE_GROUND", 0.002),
    _constant("virtual: free side of a plane", _VIEW, "_W_FREE_SIDE", 0.0),
    Part(
        "virtual: plane that bears things",
        ("voxels/ground_and_rooms.py:supporting_plane",),
        {f"{_V}supporting_plane": _gives(_NOWHERE)},
    ),
    _function("virtual: origin as a camera's place", _VIEW, "_has_in_view", _gives(False)),
    _function("virtual: origin sees as much", _VIEW, "_sees_as_much", _gives(True)),
    _constant("virtual: box along principal axes", _VIEW, "_MAX_TURNED_BOX", 0.0),
    _function("virtual: choice spread out", _VIEW, "_spread_choice", _is(_by_weight)),
    _constant("virtual: places not in corners", _VIEW, "_MIN_SURROUNDED", 0.0),
)

SUPERVOXELS = (
    Part(
        "windows that do not reach over an edge",
        ("voxels/surface.py:_take_best", "voxels/surface.py:_OWN_BONUS"),
        {"supervoxels.surface_growth.local_planes": lambda f: lambda grid, places, reach: f(grid, places, 0)},
    ),
    Part("distance off the plane", ("supervoxels/clustering.py:_off_plane", f"{_GROW}:_SLACK"), _metric(plane=0.0)),
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
        (f"{_GAPS}:_ends_of_surfaces", "voxels/grid.py:at_ends"),
        {"graph.gaps._ends_of_surfaces": lambda f: lambda grid, *others: np.flatnonzero(boundary_voxels(grid))},
    ),
    Part("gaps: wider in one scan", ("voxels/warp.py:RangeWarp.max_gap",), {"voxels.warp.RangeWarp.max_gap": _is(3.0)}),
    Part("gaps: price", (f"{_LINK}:RegionLinkage.gap", f"{_LINK}:_OF_SEVERAL"), _linkage(gap=0.0)),
    _constant("gaps: cheaper in several scans", _LINK, "_OF_SEVERAL", 1.0),
    Part("pieces of one plane", (f"{_BEHIND}:_of_planes",), _NO_CONTINUATIONS),
    _function("continuations", _BEHIND, "_unseen", _is(_none_hidden), "_ALONG_WAY", "_MIN_DEPTH"),
    _function("continuations: level", _BEHIND, "_are_level", _is(_all_level), "_SIGMAS", "_MIN_NOISE"),
    _constant("continuations: three places", _SCAN, "_MAX_VIEWPOINTS", 1),
    _function("bounding planes", _BEHIND, "_behind_something", lambda f: lambda *a: np.zeros(len(a[3].ends), np.bool_)),
    Part("terrain", (f"{_BEHIND}:_of_terrain",), _NO_TERRAIN),
    _function("terrain: pieces that touch", _BEHIND, "_touching", _gives(np.empty((0, 2), np.int64))),
    Part("bridges", ("graph/bridges.py", f"{_LINK}:RegionLinkage.bridge"), {"scan.bridges": _gives(_NO_BRIDGES)}),
    _constant("bridges between specks", "graph/bridges.py", "_FEW", 0, "_are_near", "_AS_NEAR", "_MAX_WIDTH_BETWEEN"),
)

LINKAGE = (
    Part("cost: at the contact", ("graph/boundary.py:BoundaryCost.contact",), _cost(contact=0.0)),
    Part("cost: of whole supervoxels", ("graph/boundary.py:BoundaryCost.contact",), _cost(contact=1.0)),
    Part("cost: convex edges", ("graph/boundary.py:BoundaryCost.convex",), _cost(convex=0.0)),
    Part(
        "cost: steps", _constants("graph/boundary.py", "BoundaryCost.step", "BoundaryCost.step_limit"), _cost(step=0.0)
    ),
    _constant("cost: narrow valleys", "graph/boundary.py", "_AS_IT_CLOSES", 1e9, "_WITH_ROOM", "_NO_ROOM"),
    _constant("cost: room in a valley", "graph/boundary.py", "_WITH_ROOM", 0.0, "_NO_ROOM"),
    Part(
        "linkage: relief R",
        (f"{_LINK}:RegionLinkage.relief", *_constants(_LINK, "_Shape.b1", "_Shape.d1", "_Shape.v0")),
        _linkage(relief=0.0),
    ),
    _shape_part("heaps H", h1=0.0, h0=0.0),
    Part(
        "linkage: relief only outwards",
        (f"{_LINK}:_Outlines.sides_known",),
        {"tree.region_linkage._Outlines": _then(lambda outlines: outlines._replace(sides_known=False))},
    ),
    _shape_part("relief: far off the plane counts less (d1)", d1=math.inf),
    _shape_part("relief: noise v0", v0=0.0),
    Part("linkage: colours", (f"{_LINK}:RegionLinkage.color",), _linkage(color=0.0)),
    _shape_part("valley where colours change (k1)", k1=0.0),
    _shape_part("least evidence c0", c0=0.0),
    _shape_part("increase in the evidence (c1)", c1=0.0),
    _shape_part("steep valleys (c2, s0, u)", c2=math.inf, s0=0.5),
    _function("linkage: smoothness u of what is steep", _LINK, "_smoothness", _is(_all_smooth)),
    _shape_part("same plane first: e0", e0=1e-9),
    _shape_part("uneven surfaces (e1, q0)", e1=0.0, q0=2.0),
    _shape_part("much larger surfaces late (r)", r=1e12),
    _shape_part("small pieces early (m0)", m0=0.0),
    _shape_part("specks early (m1)", m1=0.0),
    _shape_part("small masses (m2)", m2=0.0),
)

PARTS: tuple[Part, ...] = (*GROUPS, *CAMERAS, *LAW, *SIZES, *NOISE, *SIDES, *SUPERVOXELS, *GRAPH, *LINKAGE)
