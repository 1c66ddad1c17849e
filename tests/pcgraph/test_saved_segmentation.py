# SPDX-License-Identifier: Apache-2.0
"""Saved segmentations: what is opened again equals what was saved, goes on like it, and damage is refused."""

from __future__ import annotations

import dataclasses
import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes.images import floor_wall_and_boxes
from scenes.rooms import two_densities

import pcgraph
from pcgraph import detection, metrics
from pcgraph.acquisition.kinds import Evidence, MovingScanner, Told
from pcgraph.families import members
from pcgraph.plumbing.array_archive import Archive, DamagedError, decode_archive, encode_archive, field_names, rebuild
from pcgraph.saved_segmentation import ARRAYS, row_of
from pcgraph.segmentation import SAVED_FORMAT, SAVED_MARK, SAVED_VERSION, Segmentation

Mutation = Callable[[Archive, np.random.Generator], None]
MODEL = pcgraph.EdgeModel(("concavity", "step_voxels"), (0.1, 0.5), (0.3, 1.0), (2.0, -0.1), -0.7, 0.45)


# --- What is saved ----------------------------------------------------------------------------------------------------


def ridge(n: int = 40, seed: int = 0) -> NDArray[np.float64]:
    """A roof and a block on it, as a list of n * n points in no order, metres."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, n))
    z = 2.0 + np.abs(x) - 0.2 * (np.hypot(x, y - 0.2) < 0.15)
    points = np.stack((x, y, z), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    return (points + rng.normal(0.0, 0.002, points.shape))[rng.permutation(n * n)]


def image() -> pcgraph.Segmentation:
    """Of a camera's pixels with colours and a hole."""
    points = floor_wall_and_boxes(0).points[::2, ::2].copy()
    points[3:6, 4:9] = np.nan
    colors = np.clip(points - np.nanmin(points), 0.0, 1.0)
    return pcgraph.segment(points, np.nan_to_num(colors))


def unknown() -> pcgraph.Segmentation:
    return pcgraph.segment(ridge())


def with_features() -> pcgraph.Segmentation:
    points = ridge()
    return pcgraph.segment(points, viewpoint=(0.0, 0.0, 0.0), camera=False, features=points[:, 2:])


def scanner() -> pcgraph.Segmentation:
    return pcgraph.segment(ridge(), viewpoint=(0.0, 0.0, 0.0), range_growth=0.5)


def moving() -> pcgraph.Segmentation:
    result = scanner()
    told = Told(Evidence.SPACING, growth=0.5)
    return replace(result, graph=replace(result.graph, acquisition=MovingScanner(told, np.ones(3), 0.5)))


def from_several_places() -> pcgraph.Segmentation:
    points = ridge()
    return pcgraph.segment(points, viewpoint=np.where(points[:, :1] < 0.0, [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]))


def updated() -> pcgraph.Segmentation:
    return pcgraph.update(pcgraph.update(scanner(), ridge(seed=1) + np.array([0.4, 0.0, 0.0])), ridge(seed=2))


def graded() -> pcgraph.Segmentation:
    return pcgraph.segment(two_densities(4.0).points)


def of_absurdly_small_voxels() -> pcgraph.Segmentation:
    return pcgraph.segment(np.random.default_rng(0).random((50, 3)) - 0.5, voxel_size=1e-200)


CASES = (of_absurdly_small_voxels, image, unknown, with_features, scanner, moving, from_several_places, updated, graded)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[pcgraph.Segmentation, Path]]:
    """Segmentations and their files by name."""
    folder = tmp_path_factory.mktemp("saved")
    made = {case.__name__: case() for case in CASES}
    for name, result in made.items():
        result.save(folder / f"{name}.npz")
    return {name: (result, folder / f"{name}.npz") for name, result in made.items()}


def assert_same(one: Any, other: Any, at: str = "") -> None:
    """Both are of one class and equal in every field, and arrays in every bit. Scalars of NumPy are plain numbers."""
    one, other = (part.item() if isinstance(part, np.generic) else part for part in (one, other))
    assert type(one) is type(other), at
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape, one.flags.c_contiguous) == (other.dtype, other.shape, other.flags.c_contiguous), (
            at
        )
        assert one.tobytes() == other.tobytes(), at
        return
    if isinstance(one, msgspec.Struct):
        one, other = msgspec.structs.asdict(one), msgspec.structs.asdict(other)
    elif dataclasses.is_dataclass(one):
        one, other = ({f.name: getattr(part, f.name) for f in dataclasses.fields(part)} for part in (one, other))
    elif hasattr(one, "_asdict"):
        one, other = one._asdict(), other._asdict()
    elif isinstance(one, (tuple, list)):
        one, other = (dict(enumerate(part)) for part in (one, other))
    if isinstance(one, dict):
        assert one.keys() == other.keys(), at
        for name, value in one.items():
            assert_same(value, other[name], f"{at}/{name}")
    else:
        assert one == other or (one != one and other != other), at  # NaN


@pytest.mark.parametrize("case", [case.__name__ for case in CASES])
def test_what_is_opened_equals_what_was_saved(saved: dict[str, Any], case: str, tmp_path: Path) -> None:
    result, path = saved[case]
    again = pcgraph.load_segmentation(path)
    assert_same(again, result)
    assert repr(again) == repr(result)
    again.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_the_cases_hold_every_array_that_a_file_may_hold(saved: dict[str, Any]) -> None:
    stored = {name for result, _ in saved.values() for name in archive_of(result).arrays}
    met = {id(row_of(name)) for name in stored}
    assert [pattern for pattern, row in ARRAYS.items() if id(row) not in met] == []


def test_the_docs_tell_every_array(saved: dict[str, Any]) -> None:
    text = (Path(pcgraph.__file__).parents[1] / "docs" / "files.md").read_text()
    assert [pattern for pattern in ARRAYS if f"`{pattern}`" not in text] == []


@pytest.mark.parametrize("kind", [*members("Linkage").values(), *members("SupervoxelMethod").values()])
def test_linkages_and_methods_come_back(saved: dict[str, Any], kind: type[Any], tmp_path: Path) -> None:
    argument = "linkage" if issubclass(kind, pcgraph.Linkage) else "method"
    numbers = [f.name for f in dataclasses.fields(kind) if isinstance(f.default, float)]
    chosen = kind(**dict.fromkeys(numbers, 0.125))
    result = replace(saved["unknown"][0], **{argument: chosen})
    result.save(tmp_path / "x.npz")
    assert_same(pcgraph.load_segmentation(tmp_path / "x.npz"), result)


def test_a_learned_linkage_comes_back(saved: dict[str, Any], tmp_path: Path) -> None:
    result = replace(saved["unknown"][0], linkage=pcgraph.LearnedLinkage(MODEL), object_altitude=np.float64(0.45))
    result.save(tmp_path / "x.npz")
    again = pcgraph.load_segmentation(tmp_path / "x.npz")
    assert again.linkage == result.linkage
    assert_same(pcgraph.update(again, ridge(seed=5)), pcgraph.update(result, ridge(seed=5)))


# --- Going on ---------------------------------------------------------------------------------------------------------


CALLS: dict[str, Callable[[pcgraph.Segmentation], Any]] = {
    "cut": lambda one: one.cut(3),
    "large": lambda one: one.cut(altitude=0.2, min_size=30),
    "parts": lambda one: one.parts,
    "groups": lambda one: one.groups,
    "outliers": lambda one: one.outliers,
    "saliency": lambda one: one.saliency(),
    "primitives": lambda one: one.primitives(),
    "occlusions": lambda one: one.occlusions() if one.viewpoint.ndim == 1 else None,
    "planes": detection.find_planes,
    "objects": lambda one: detection.objects_on(one, detection.find_planes(one)),
    "energy": lambda one: one.tree.cut_optimal(pcgraph.plane_energy(one.tree), 1e-3),
    "csr": lambda one: one.graph.to_csr("convexity").toarray(),
    "score": lambda one: metrics.segmentation_covering(one.labels, one.supervoxels),
}
"""What is computed from a segmentation."""


def results_of(one: pcgraph.Segmentation) -> dict[str, Any]:
    return {name: call(one) for name, call in CALLS.items()}


@pytest.mark.parametrize("case", ["image", "with_features", "from_several_places", "updated"])
def test_all_goes_on_from_what_was_opened(saved: dict[str, Any], case: str) -> None:
    result, path = saved[case]
    again, points = pcgraph.load_segmentation(path), ridge(seed=3)
    assert_same(results_of(again), results_of(result))
    beside = {
        "image": {"colors": np.clip(np.abs(points), 0.0, 1.0)},
        "with_features": {"features": points[:, :1]},
        "from_several_places": {"viewpoint": np.where(points[:, :1] < 0.0, [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0])},
    }.get(case, {})
    assert_same(pcgraph.update(again, points, **beside), pcgraph.update(result, points, **beside))


# --- The cloud beside it ----------------------------------------------------------------------------------------------


def test_the_cloud_is_in_the_file_too(saved: dict[str, Any], tmp_path: Path) -> None:
    result, path = saved["unknown"][0], tmp_path / "x.NPZ"
    points, n = ridge().astype(np.float32), len(ridge())
    columns = {"intensity": np.arange(n, dtype=np.uint16), "a/b é": np.ones((n, 2)), "a.npy": np.zeros(n, bool)}
    cloud = pcgraph.Cloud(
        points, np.zeros((n, 3), np.uint8), -points, np.arange(n, dtype=np.int32), np.ones(3), columns
    )
    result.save(path, cloud)
    assert_same(pcgraph.load_segmentation(path), result)
    with np.load(path) as file:
        for name in ("points", "colors", "normals", "labels", "viewpoint"):
            assert_same(file[f"cloud/{name}"], getattr(cloud, name))
        assert {name.removeprefix("cloud/columns/") for name in file.files if "/columns/" in name} == set(columns)
        assert_same(file["cloud/columns/intensity"], columns["intensity"])
        assert_same(file["labels"], result.labels)


@pytest.mark.parametrize(
    ("cloud", "error"),
    [
        (np.zeros((3, 3)), ValueError),
        (pcgraph.Cloud(ridge(), colors=np.zeros((2, 3), np.uint8)), pcgraph.CloudWriteError),
        (pcgraph.Cloud(ridge(), columns={"x\0": np.zeros(1600)}), pcgraph.CloudWriteError),
        (pcgraph.Cloud(ridge(), columns={"x\ud800": np.zeros(1600)}), pcgraph.CloudWriteError),
        (pcgraph.Cloud(ridge(), columns={"names": np.full(1600, "a")}), pcgraph.CloudWriteError),
    ],
)
def test_another_cloud_is_refused(saved: dict[str, Any], cloud: Any, error: type[Exception], tmp_path: Path) -> None:
    with pytest.raises(error, match="expected "):
        saved["unknown"][0].save(tmp_path / "x.npz", cloud)
    assert not list(tmp_path.iterdir())


def test_places_that_cannot_be_written_are_refused(saved: dict[str, Any], tmp_path: Path) -> None:
    for name in ("x.ply", "x", "missing/x.npz"):
        with pytest.raises(pcgraph.CloudWriteError):
            saved["unknown"][0].save(tmp_path / name)


# --- Classes of a user ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Own(pcgraph.Linkage):
    """Convexity by the user's own name; it needs an argument, so that it is no member of the family by name."""

    weight: float
    default_object_altitude = 0.5
    default_part_altitude = 0.1

    def merges(self, graph: Any, leaves: Any) -> Any:
        return pcgraph.ConvexityLinkage().merges(graph, leaves)


@dataclass(frozen=True)
class Opaque(Own):
    """With a setting that no file can hold."""

    call: Any = len


def test_a_linkage_of_ones_own_comes_back_where_it_is_loaded(saved: dict[str, Any], tmp_path: Path) -> None:
    result = replace(saved["unknown"][0], linkage=Own(2.5))
    result.save(tmp_path / "x.npz")
    assert pcgraph.load_segmentation(tmp_path / "x.npz").linkage == Own(2.5)
    assert pcgraph.load_segmentation(tmp_path / "x.npz", linkage=Own(3.0)).linkage == Own(3.0)
    with pytest.raises(ValueError, match="expected the linkage that was saved, 'own:Own', got RegionLinkage"):
        pcgraph.load_segmentation(tmp_path / "x.npz", linkage=pcgraph.RegionLinkage())
    with pytest.raises(ValueError, match="expected a method such as"):
        pcgraph.load_segmentation(tmp_path / "x.npz", method=1)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Everything(Own):
    """With settings of each kind that a file can hold."""

    table: NDArray[np.int8] | None = None
    other: np.ndarray | None = None
    base: pcgraph.Linkage | None = None
    names: tuple[str, ...] = ()
    corner: tuple[float, float] = (0.0, 0.0)
    evidence: Evidence = Evidence.NOTHING
    is_on: bool = False
    number: int = 0
    text: str = ""


@settings(max_examples=50, deadline=None)
@given(
    weight=st.floats(allow_nan=False),
    number=st.integers(),
    text=st.text(),
    names=st.lists(st.text()).map(tuple),
    corner=st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.just(1.0)),
    table=st.lists(st.integers(-128, 127)).map(lambda values: np.array(values, np.int8)),
    evidence=st.sampled_from(Evidence),
)
def test_settings_of_each_kind_come_back(**values: Any) -> None:
    one, archive = Everything(base=Own(2.0), other=np.eye(2), **values), Archive()
    archive.flatten(one, "linkage")
    header, stored = decode_archive(encode_archive(archive, {"format": "x"}, SAVED_MARK), "cloud/")
    assert header == {"format": "x"}
    assert_same(rebuild(stored, pcgraph.Linkage, "linkage", {}), one)


def test_a_linkage_of_ones_own_is_asked_for_where_it_is_not_loaded(saved: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    write(path, archive_of(saved["unknown"][0]), lambda archive, _: archive.values.update(linkage="own:Gone"))
    with pytest.raises(pcgraph.CloudReadError, match=r"with a linkage of your own, Gone: give it, .*linkage=Gone\(\)"):
        pcgraph.load_segmentation(path)
    result = replace(saved["unknown"][0], linkage=Opaque(1.0, call=sum))
    result.save(path)
    with pytest.raises(pcgraph.CloudReadError, match="with a linkage of your own, Opaque: give it"):
        pcgraph.load_segmentation(path)
    assert_same(pcgraph.load_segmentation(path, linkage=result.linkage), result)


def test_a_class_of_a_users_does_not_pass_for_one_of_ours(saved: dict[str, Any], tmp_path: Path) -> None:
    own = dataclass(frozen=True)(type("RegionLinkage", (Own,), {"__module__": "elsewhere"}))
    replace(saved["unknown"][0], linkage=own(1.0)).save(tmp_path / "x.npz")
    assert type(pcgraph.load_segmentation(tmp_path / "x.npz").linkage) is own
    assert type(pcgraph.load_segmentation(saved["unknown"][1]).linkage) is pcgraph.RegionLinkage
    other = dataclass(frozen=True)(type("RegionLinkage", (Own,), {"__module__": "elsewhere_too"}))
    assert other is not own  # two of one name: which of them is not told
    with pytest.raises(pcgraph.CloudReadError, match="with a linkage of your own, RegionLinkage"):
        pcgraph.load_segmentation(tmp_path / "x.npz")


# --- Damage -----------------------------------------------------------------------------------------------------------


def archive_of(result: pcgraph.Segmentation) -> Archive:
    archive = Archive()
    for name in field_names(Segmentation):
        archive.flatten(getattr(result, name), name)
    return archive


def write(path: Path, archive: Archive, change: Mutation, seed: int = 0, **header: Any) -> None:
    """Write a changed archive as `Segmentation.save` does: with a seal, which tells nothing of the change."""
    changed = Archive({name: array.copy() for name, array in archive.arrays.items()}, dict(archive.values))
    change(changed, np.random.default_rng(seed))
    known = {"format": SAVED_FORMAT, "version": SAVED_VERSION}
    path.write_bytes(encode_archive(changed, known | header, SAVED_MARK))


def refusal_of(path: Path) -> str:
    with pytest.raises(pcgraph.CloudReadError) as caught:
        pcgraph.load_segmentation(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    return str(caught.value)


def test_files_of_something_else_are_refused(saved: dict[str, Any], tmp_path: Path) -> None:
    path, archive = tmp_path / "x.npz", archive_of(saved["unknown"][0])
    assert "No such file" in refusal_of(path)
    assert "no plain file" in refusal_of(tmp_path)
    for content in (b"", b"ply\n", b"PK\x05\x06" + 18 * b"\0"):
        path.write_bytes(content)
        assert "expected a file that Segmentation.save wrote" in refusal_of(path)
    np.savez(path, **archive.arrays)
    assert "expected a file that Segmentation.save wrote" in refusal_of(path)
    write(path, archive, lambda *_: None, version=SAVED_VERSION + 1)
    assert "another version of pcgraph" in refusal_of(path)
    write(path, archive, lambda *_: None, format="pcgraph edges")
    assert "other arrays" in refusal_of(path)


@pytest.mark.parametrize("seed", range(30))
def test_a_changed_file_is_refused(saved: dict[str, Any], seed: int, tmp_path: Path) -> None:
    rng, content = np.random.default_rng(seed), bytearray(saved["unknown"][1].read_bytes())
    if seed % 3 == 0:
        content = content[: rng.integers(len(content))]
    elif seed % 3 == 1:
        content += bytes(rng.integers(1, 2000))
    else:
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    (tmp_path / "x.npz").write_bytes(content)
    refusal_of(tmp_path / "x.npz")


def set_one(name: str, value: float, at: Any = 0) -> Mutation:
    def change(archive: Archive, _: np.random.Generator) -> None:
        archive.arrays[name][at] = value

    return change


def set_value(name: str, value: Any) -> Mutation:
    return lambda archive, _: archive.values.__setitem__(name, value)


def set_array(name: str, change: Callable[[Any], Any]) -> Mutation:
    return lambda archive, _: archive.arrays.__setitem__(name, change(archive.arrays[name]))


DAMAGE: list[tuple[Mutation, str]] = [
    (set_one("supervoxels", 10**6), "supervoxels"),
    (set_one("supervoxels", -1), "as many points"),
    (set_one("objects", -3), "objects"),
    (set_one("objects", 10**6), "objects below the next one"),
    (set_one("viewpoint", np.nan), "viewpoint"),
    (set_array("viewpoint", lambda a: a[:2]), "viewpoint"),
    (set_one("graph/edges", 10**6, (-1, 1)), "graph/edges"),
    (set_one("graph/edges", -1), "graph/edges"),
    (set_array("graph/edges", lambda a: a[::-1]), "ascending order"),
    (set_array("graph/edges", lambda a: a[:, ::-1]), "i < j"),
    (set_array("graph/edges", lambda a: a[:-1]), "of shape"),
    (set_array("graph/edges", lambda a: a.astype(np.int64)), "int32"),
    (set_array("graph/edges", lambda a: a.astype(np.float64)), "int32"),
    (set_one("graph/gaps/edges", 10**6, (0, 1)), "graph/gaps/edges"),
    (set_one("graph/edge_features/contact_voxels", 0), "contact_voxels"),
    (set_one("graph/edge_features/convexity", np.nan), "up to"),
    (set_one("graph/edge_features/contact_length", 0.0), "positive length"),
    (set_one("tree/parents", 0, -2), "tree/parents"),
    (set_one("tree/parents", 10**6), "tree/parents"),
    (set_array("tree/parents", lambda a: np.r_[a[:-1] * 0 + len(a) - 1, a[-1]].astype(np.int32)), "two children"),
    (set_one("tree/altitudes", np.nan, -1), "altitudes"),
    (set_one("tree/altitudes", 1.0, 0), "altitudes"),
    (set_one("tree/moments/counts", 0), "counts"),
    (set_one("surface/normals", np.inf), "up to"),
    (set_one("surface/normals", 7.0), "up to 1"),
    (set_one("surface/normals", 0.9), "unit length"),
    (set_array("surface/supervoxels", lambda a: a * 0), "each supervoxel"),
    (set_array("surface/supervoxels", lambda a: np.roll(a, 1)), "in one piece"),
    (set_one("surface/grid/voxel_of_point", 10**6), "voxel_of_point"),
    (set_one("surface/grid/voxel_of_point", -5), "voxel_of_point"),
    (set_array("surface/grid/order", lambda a: a * 0), "each point in the list"),
    (set_one("surface/grid/order", 10**9), "surface/grid/order"),
    (set_one("surface/grid/starts", 10**9, 3), "lists of the points"),
    (set_one("surface/grid/counts", 0), "counts"),
    (set_one("surface/grid/indptr", 10**9, 3), "lists of the neighbours"),
    (set_one("surface/grid/neighbours", 10**8), "neighbours"),
    (set_one("surface/grid/neighbours", -(10**8)), "neighbours"),
    (set_array("surface/grid/neighbours", lambda a: a[::-1]), "neighbours"),
    (set_one("surface/grid/cells", np.nan), "up to"),
    (set_array("surface/grid/cells", lambda a: a[::-1]), "order of their cells"),
    (set_array("surface/grid/cells", lambda a: a + 0.5), "whole numbers"),
    (set_array("surface/grid/cells", lambda a: a + 1.0), "voxels in their cells"),
    (set_array("surface/grid/centroids", lambda a: a * 1e90), "centroids where the warp has them"),
    (set_one("surface/grid/centroids", 1e200), "up to 1e+102"),
    (set_one("surface/grid/edge_lengths", 9.0), "edges as the warp has them"),
    (set_one("tree/moments/counts", 10**6), "points of two nodes"),
    (set_array("surface/grid/cells", lambda a: a[:, :2]), "of shape"),
    (set_one("surface/grid/edge_lengths", -1.0), "positive size"),
    (set_value("surface/grid/size", 0.0), "positive size"),
    (set_value("surface/grid/size", "nan"), "positive size"),
    (set_value("surface/grid/size", None), "size as float"),
    (set_value("surface/grid/warp/growth", 1.5), "growth"),
    (set_value("surface/grid/warp", "VoxelGrid"), "no Warp"),
    (set_value("graph/acquisition", "Evidence"), "no Acquisition"),
    (set_value("graph/acquisition/told/evidence", "HEARSAY"), "not one of"),
    (set_value("linkage", "LearnedLinkage"), "linkage/model"),
    (set_value("linkage/gap", -1.0), "gap"),
    (set_value("linkage/cost", "os"), "no BoundaryCost"),
    (set_value("next_object", 0), "objects below the next one"),
    (set_value("next_object", True), "next_object as int"),
    (set_value("next_object", 1 << 31), "objects in 31 bits"),
    (set_value("linkage/gap", 1 << 63), "linkage/gap as float"),
    (set_value("seed_size", -1), "distance of seeds"),
    (set_value("object_altitude", "inf"), "altitude of objects"),
    (set_value("further", 1), "further"),
    (lambda archive, _: archive.arrays.__setitem__("further", np.zeros(3)), "further"),
    (lambda archive, _: archive.arrays.pop("tree/moments/scatters"), "scatters is missing"),
    (lambda archive, _: archive.arrays.pop("tree/moments/normals"), "normals is missing"),
]


@pytest.mark.parametrize("number", range(len(DAMAGE)))
def test_what_no_segmentation_has_is_refused_before_a_kernel_sees_it(
    saved: dict[str, Any], number: int, tmp_path: Path
) -> None:
    change, word = DAMAGE[number]
    write(tmp_path / "x.npz", archive_of(saved["scanner"][0]), change)
    assert word in refusal_of(tmp_path / "x.npz")


def test_files_that_would_fill_the_memory_or_run_code_are_refused() -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, labels=np.zeros(10**6, np.int32))
    with pytest.raises(DamagedError, match="compressed"):
        decode_archive(stream.getvalue(), "cloud/")
    huge = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    with zipfile.ZipFile(huge, "w") as file, file.open("labels.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(DamagedError, match="cut off"):
        decode_archive(huge.getvalue(), "cloud/")
    pickled = io.BytesIO()
    np.savez(pickled, header=np.array([{}], dtype=object))
    with pytest.raises(DamagedError):
        decode_archive(pickled.getvalue(), "cloud/")


def mutate(archive: Archive, rng: np.random.Generator) -> None:
    """Spoil an array or a value in one of many ways."""
    names = [name for name, array in archive.arrays.items() if array.size]
    name, other = rng.choice(names, 2)
    array = archive.arrays[name]
    way = rng.integers(9)
    if way < 3:  # some entries
        extremes = [-1, 0, 1, 2, 10**6, 2**31 - 1, -(2**31), len(array) - 1, len(array)]
        extremes += [np.nan, np.inf, -np.inf, 1e300, 1e-300] if array.dtype.kind == "f" else []
        at = rng.integers(array.size, size=rng.integers(1, 4))
        info = np.iinfo(array.dtype) if array.dtype.kind in "iu" else None
        value = rng.choice(np.array(extremes, float))
        array.reshape(-1)[at] = value if info is None else np.clip(value, info.min, info.max)
    elif way == 3:
        archive.arrays[name], archive.arrays[other] = archive.arrays[other], array
    elif way == 4:
        archive.arrays[name] = rng.permutation(array)
    elif way == 5:
        archive.arrays[name] = array[: rng.integers(len(array))]
    elif way == 6:
        archive.arrays[name] = array.astype(rng.choice(["i1", "i4", "i8", "f4", "f8", "u4", "?"]), casting="unsafe")
    elif way == 7:
        archive.arrays[name] = [np.roll(array, 1), array.reshape(-1), array[None], np.concatenate((array, array))][
            rng.integers(4)
        ]
    else:
        one = rng.choice(list(archive.values))
        value: Any = [None, -1, 0, 1e308, 1e-308, "inf", "nan", "", "Warp", [], True, "Shift", 3][rng.integers(13)]
        archive.values[one] = value


def go_on(found: pcgraph.Segmentation) -> None:
    """Let the kernels see a segmentation; ValueErrors and warnings of nonsense are fine, a crash is not."""
    points, grid = ridge(12, seed=4), found.surface.grid
    colors = None if grid.colors is None else np.zeros_like(points)
    features = None if grid.features is None else np.zeros((len(points), grid.features.shape[1]))
    calls = [*CALLS.values(), lambda one: pcgraph.update(one, points, colors, features=features)]
    for call in calls:
        with suppress(ValueError, ArithmeticError, Warning, np.linalg.LinAlgError):
            call(found)


def check_mutation(result: pcgraph.Segmentation, path: Path, seed: int) -> bool:
    """Whether a spoilt file with a good seal is opened; then all goes on from it without a crash."""
    with np.errstate(all="ignore"):
        write(path, archive_of(result), mutate, seed)
    try:
        found = pcgraph.load_segmentation(path)
    except pcgraph.CloudReadError:
        return False
    go_on(found)
    return True


@pytest.mark.parametrize("seed", range(30))
def test_a_spoilt_file_is_refused_or_harmless(saved: dict[str, Any], seed: int, tmp_path: Path) -> None:
    check_mutation(saved["updated"][0], tmp_path / "x.npz", seed)


@pytest.mark.validation
@pytest.mark.parametrize("case", ["image", "with_features", "from_several_places", "updated", "graded"])
def test_no_spoilt_file_crashes(saved: dict[str, Any], case: str, tmp_path: Path) -> None:
    opened = [check_mutation(saved[case][0], tmp_path / "x.npz", seed) for seed in range(600)]
    assert 0.02 < np.mean(opened) < 0.5  # both happen


def test_the_header_is_plain_json(saved: dict[str, Any]) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    with np.load(saved["updated"][1]) as file:
        header = json.loads(bytes(file["header"]), parse_constant=refuse)
    assert (header["format"], header["version"]) == ("pcgraph segmentation", 1)
    assert header["values"]["graph/acquisition"] == "SeveralScans"


def test_a_new_process_knows_all_methods_and_linkages(tmp_path: Path) -> None:
    """Only what a file needs is loaded before: it was refused there."""
    points = np.random.default_rng(0).random((500, 3)) * [1.0, 1.0, 0.01]
    result = pcgraph.segment(points, method=pcgraph.Vccs(), linkage=pcgraph.WardLinkage())
    result.save(tmp_path / "x.npz")
    code = "import sys, pcgraph; found = pcgraph.load_segmentation(sys.argv[1]); print(found.method, found.linkage)"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "x.npz"], capture_output=True, text=True)
    assert done.stdout == f"{result.method} {result.linkage}\n", done.stderr
