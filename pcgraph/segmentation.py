# SPDX-License-Identifier: Apache-2.0
"""Segmentation of a cloud: its supervoxels, graph, tree and objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.acquisition.kinds import Acquisition
from pcgraph.cloud import Cloud, plain_cloud
from pcgraph.cloud_sources import as_cloud
from pcgraph.columns import RobustScaling
from pcgraph.disjoint_sets import connected_components
from pcgraph.errors import CloudWriteError
from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.inputs import non_negative
from pcgraph.plumbing.array_archive import Archive, class_name, encode_archive, field_names
from pcgraph.plumbing.plain_files import write_file
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.supervoxels.surface_growth import SurfaceGrowth
from pcgraph.tree.linkage import Linkage
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.tree import SegmentationTree
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.warp import CameraWarp

if TYPE_CHECKING:
    from pcgraph.features.primitives import Primitives
    from pcgraph.graph.occlusion import Occlusions

SAVED_FORMAT = "pcgraph segmentation"
"""Name of the format in the header of each saved segmentation."""
SAVED_VERSION = 1
"""Version of that format, a count from 1. It rises when files of the version before cannot be read as files of this
one."""
SAVED_MARK = "pcgraph-segmentation"
"""Mark of the seal of saved segmentations, in the comment at the end of each."""
NOT_STORED = " (settings not stored)"
"""Suffix of the name of a method or linkage in the header, if an archive cannot hold its settings."""


@dataclass(frozen=True)
class Settings:
    """Method, linkage and cut of a segmentation, checked."""

    method: SupervoxelMethod
    linkage: Linkage
    object_altitude: float

    @classmethod
    def of(cls, method: SupervoxelMethod | None, linkage: Linkage | None, object_altitude: float | None) -> Settings:
        """Settings, by default those of `pcgraph.segment`; without an altitude that of the linkage.

        Raises
        ------
        ValueError
            The method is no `SupervoxelMethod`, the linkage no `Linkage`, or the altitude negative.
        """
        method = SurfaceGrowth() if method is None else method
        linkage = RegionLinkage() if linkage is None else linkage
        if not isinstance(method, SupervoxelMethod):
            raise ValueError(_refusal("method", "SupervoxelMethod", method))
        if not isinstance(linkage, Linkage):
            raise ValueError(_refusal("linkage", "Linkage", linkage))
        altitude = linkage.default_object_altitude if object_altitude is None else object_altitude
        return cls(method, linkage, non_negative("object_altitude", altitude))


@dataclass(frozen=True, eq=False)
class Supervoxels(ShortRepr):
    """Supervoxels of a cloud and their graph, before a tree merges them.

    Attributes
    ----------
    labels : (n,) or (h, w) int32
        Supervoxel of each point, that is node of the graph; -1 where it has none, because nothing was measured or
        because it is an outlier.
    outliers : (n,) or (h, w) bool
        Whether each point is an outlier: no denser around than noise would be.
    moments : Moments of k supervoxels
        Moments of their points.
    graph : AdjacencyGraph of k nodes
    surface, seed_size, method, viewpoint, feature_scaling
        As in `Segmentation`.
    """

    labels: NDArray[np.int32]
    outliers: NDArray[np.bool_]
    moments: Moments
    graph: AdjacencyGraph
    surface: Surface
    seed_size: float
    method: SupervoxelMethod
    viewpoint: NDArray[np.float64]
    feature_scaling: RobustScaling | None = None

    def _counts(self) -> str:
        return f"{np.count_nonzero(self.labels >= 0)} points, {len(self.moments)} supervoxels"


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation:
    """Segmentation of a cloud: supervoxels, their graph, the tree and the objects.

    Attributes
    ----------
    labels : (n,) or (h, w) int32
        Object of each point, the default cut of the tree; -1 where it has none, because nothing was measured (not
        finite, or a hole written as (0, 0, 0)) or because it is an outlier.
    outliers : (n,) or (h, w) bool
        Whether each point is an outlier: no denser around than noise would be.
    supervoxels : (n,) or (h, w) int32
        Supervoxel of each point, that is leaf of the tree and node of the graph; -1 where `labels` is -1.
    objects : (k,) int32
        Object of each supervoxel, also of those that hold no point of the last scan. After an update some numbers may
        be missing, as those of objects that have joined another.
    graph : AdjacencyGraph
    tree : SegmentationTree
    surface : Surface
        The voxels behind the points.
    seed_size : float, metres
        Spacing of supervoxels that was used, given or derived.
    method : SupervoxelMethod
    linkage : Linkage
    object_altitude : float, the linkage's unit
        Altitude of the cut that gives `labels`.
    viewpoint : (3,) or (n, 3) float64, metres, the points' frame
        Sensor position, given or estimated: one for all points, or one row per point that has a supervoxel, if it was
        given per point.
    ages : (k,) int32
        Number of scans since the last one that saw a point of each supervoxel; 0 for those of the last scan.
    supervoxel_of_earlier : (k_earlier,) int32
        New number of each supervoxel of the segmentation before the last update; -1 if it was forgotten. It is empty
        after `pcgraph.segment`.
    feature_scaling : RobustScaling, or None
        Center and spread of each column of the features; None if none were given.
    next_object : int
        Least number that no object has had, in this scan or an earlier one.
    """

    labels: NDArray[np.int32]
    outliers: NDArray[np.bool_]
    supervoxels: NDArray[np.int32]
    objects: NDArray[np.int32]
    graph: AdjacencyGraph
    tree: SegmentationTree
    surface: Surface
    seed_size: float
    method: SupervoxelMethod
    linkage: Linkage
    object_altitude: float
    viewpoint: NDArray[np.float64]
    ages: NDArray[np.int32]
    supervoxel_of_earlier: NDArray[np.int32]
    feature_scaling: RobustScaling | None = None
    next_object: int = 0

    def __repr__(self) -> str:
        """Counts, sizes and the acquisition, in one line."""
        outliers = np.count_nonzero(self.outliers)
        beside = f" and {outliers} outliers" if outliers else ""
        return (
            f"Segmentation({np.count_nonzero(self.supervoxels >= 0)} points{beside}, {self.tree.n_leaves} supervoxels, "
            f"{len(self.graph.edges)} edges, {len(np.unique(self.objects))} objects, "
            f"voxels of {self.voxel_size:.3g} m, seeds every {self.seed_size:.3g} m, {self.acquisition})"
        )

    @property
    def acquisition(self) -> Acquisition:
        """The sensor that took the cloud, its place, and the evidence for both."""
        return self.graph.acquisition

    @property
    def voxel_size(self) -> float:
        """Edge length of a voxel where the grid's warp keeps lengths, metres: what was used, given or derived."""
        return self.surface.grid.size

    @property
    def parts(self) -> NDArray[np.int32]:
        """Part of each point, in the input's shape, -1 as in `labels`: faces and smooth pieces.

        Each lies within one object: the cut at the linkage's altitude of parts, or at that of the objects if that is
        lower.
        """
        return self.cut(altitude=min(self.linkage.default_part_altitude, self.object_altitude))

    @property
    def groups(self) -> NDArray[np.int32]:
        """Group of each point, in the input's shape, -1 as in `labels`: a connected component of objects, such as a
        table with all that stands on it.

        Objects are connected by the graph's contacts, gaps and continuations.
        """
        k = len(self.objects)
        _, first, object_of = np.unique(self.objects, return_index=True, return_inverse=True)
        first = first[object_of]
        whole = np.stack((np.arange(k), first), axis=1).astype(np.int32)
        return self.on_points(connected_components(np.concatenate((self.graph.joined, whole)), k))

    @property
    def camera(self) -> bool:
        """Whether voxels grow in proportion to depth (the `camera` of `pcgraph.segment`)."""
        return isinstance(self.surface.grid.warp, CameraWarp)

    @property
    def leaves(self) -> Moments:
        """Moments of the supervoxels."""
        return self.tree.known_moments()[: self.tree.n_leaves]

    def cut(self, n: int | None = None, altitude: float | None = None, min_size: int = 1) -> NDArray[np.int32]:
        """Segment of each point in the input's shape, -1 as in `labels`; see `SegmentationTree.cut`."""
        return self.on_points(self.tree.cut(n, altitude, min_size))

    def points_of(self, node: int) -> NDArray[np.int64]:
        """Flat indices of the points below a node of the tree, ascending, (p,) int64.

        They index the input as a list: ``points.reshape(-1, 3)[result.points_of(node)]``. After an update the points
        are those of the last scan.

        Raises
        ------
        ValueError
            The tree has no such node.
        """
        is_below = np.zeros(self.tree.n_leaves, np.bool_)
        is_below[self.tree.leaves_of(node)] = True
        return np.flatnonzero(self.on_points(is_below))

    def summary(self) -> dict[str, Any]:
        """Counts, sizes in metres and the acquisition, as plain values for JSON.

        ``segmented`` and ``outliers`` count points; ``objects`` counts those of the last scan.
        """
        return {
            "segmented": int(np.count_nonzero(self.supervoxels >= 0)),
            "outliers": int(np.count_nonzero(self.outliers)),
            "acquisition": self.acquisition.in_words,
            "voxel_size": self.voxel_size,
            "seed_size": self.seed_size,
            "supervoxels": self.tree.n_leaves,
            "edges": len(self.graph.edges),
            "objects": len(np.unique(self.labels[self.labels >= 0])),
        }

    def with_objects(self, n: int | None = None, altitude: float | None = None, min_size: int = 1) -> Segmentation:
        """The same segmentation with another cut of its tree as its objects; parameters as for `SegmentationTree.cut`.

        `labels`, `objects` and `object_altitude` change. `parts`, `groups`, `update`, detection and
        `write_segmentation` then use the new objects.

        Raises
        ------
        ValueError
            As for `SegmentationTree.cut`.

        Examples
        --------
        >>> import numpy as np, pcgraph
        >>> floor = np.random.default_rng(0).random((4000, 3)) * [1.0, 1.0, 0.0]
        >>> result = pcgraph.segment(np.concatenate((floor, floor + [0.0, 0.0, 1.0])))
        >>> finer = result.with_objects(n=5)
        >>> len(np.unique(finer.labels)), (finer.labels == result.cut(n=5)).all()
        (5, np.True_)
        """
        objects = self.tree.cut(n, altitude, min_size)
        if altitude is None:  # that of the last merge, or a finite one above all if parts that do not touch are one
            last = self.tree.altitudes[len(self.tree.parents) - len(np.unique(objects))]
            altitude = min(float(last), float(np.finfo(np.float64).max))
        return replace(
            self,
            labels=self.on_points(objects),
            objects=objects,
            object_altitude=altitude,
            next_object=int(objects.max()) + 1,
        )

    def on_points(self, values: ArrayLike) -> NDArray[Any]:
        """Values of supervoxels on the points, in the input's shape + s.

        Parameters
        ----------
        values : (k,) + s numbers or truth values, one row per supervoxel

        Returns
        -------
        Points without a supervoxel have NaN, or -1 where the values are whole numbers, or False.

        Raises
        ------
        ValueError
            There is not one row per supervoxel, or the values are neither numbers nor truth values.
        """
        rows = np.asarray(values)
        if rows.ndim == 0 or len(rows) != self.tree.n_leaves:
            raise ValueError(f"expected one row of values per supervoxel, {self.tree.n_leaves}, got {rows.shape}")
        if rows.dtype.kind == "u":
            rows = rows.astype(np.int64)
        if rows.dtype.kind not in "fib":
            raise ValueError(f"expected values as numbers or truth values, got {rows.dtype}")
        missing = {"f": np.nan, "i": -1, "b": False}[rows.dtype.kind]
        return np.concatenate((rows, np.full((1, *rows.shape[1:]), missing, rows.dtype)))[self.supervoxels]

    def of_earlier(self, supervoxels: ArrayLike) -> NDArray[np.int32]:
        """New numbers of supervoxels, given those before the last update; -1 for forgotten ones.

        Parameters
        ----------
        supervoxels : (...) int
            For example the earlier segmentation's `supervoxels`. -1, for points without a supervoxel, stays -1.

        Examples
        --------
        >>> import numpy as np, pcgraph
        >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 64), np.linspace(-1.0, 1.0, 64))
        >>> wall = np.stack((x, y, np.full_like(x, 2.0)), axis=-1)
        >>> earlier = pcgraph.segment(wall)
        >>> result = pcgraph.update(earlier, wall)
        >>> now = result.of_earlier(earlier.supervoxels)
        >>> labels = np.where(now >= 0, result.objects[now], -1)  # today's objects of the earlier points
        >>> bool((labels == earlier.labels).all())
        True
        """
        return np.append(self.supervoxel_of_earlier, np.int32(-1))[np.asarray(supervoxels)]

    def saliency(self) -> NDArray[np.float64]:
        """Boundary strength of each point in the input's shape, the altitudes' unit; NaN without a supervoxel.

        The largest altitude at which the supervoxel of the point's voxel merges with one that the voxel touches: 0
        inside supervoxels, and what is left above a level are the boundaries of the cut at that altitude.
        """
        from pcgraph.tree.saliency import point_saliency

        return self._in_input_shape(point_saliency(self.tree, self.surface), np.nan)

    def occlusions(self) -> Occlusions:
        """Pairs of supervoxels of which one hides the other from the viewpoint, and surfaces that may go on behind it.

        Neighbours in an organised input's image, or in bearing where there is no image. After an update the
        viewpoint, and the image, are those of the last scan.

        Raises
        ------
        ValueError
            The points were seen from more than one place; `pcgraph.graph.occlusion.occlusions` takes one at a time.
        """
        from pcgraph.graph.occlusion import occlusions

        if self.viewpoint.ndim != 1:
            raise ValueError("expected one viewpoint, got one per point; call graph.occlusion.occlusions for each scan")
        image = self._in_input_shape(self.surface.grid.voxel_of_point, -1) if self.supervoxels.ndim == 2 else None
        return occlusions(self.surface, self.graph.node_features, self.viewpoint, image)

    def primitives(self, points: ArrayLike | None = None) -> Primitives:
        """Plane, sphere and cylinder fitted to every node of the tree, supervoxels first.

        Parameters
        ----------
        points : (n, 3) or (h, w, 3) float, metres, the array given to `pcgraph.segment`, optional
            Default: the voxels' centroids, each as one point; a little less exact, but they hold all scans.

        Raises
        ------
        ValueError
            The shape is another, or the segmentation holds points of earlier scans, which are not among these.
        """
        from pcgraph.features.primitives import fit_primitives, primitive_moments, primitive_moments_up_tree

        surface = self.surface
        places, normals, groups = surface.grid.centroids, surface.normals, surface.supervoxels
        if points is not None:
            inside, given = self.supervoxels >= 0, np.asarray(points)
            if given.shape != (*inside.shape, 3):
                raise ValueError(f"expected the points that were segmented, {(*inside.shape, 3)}, got {given.shape}")
            if np.count_nonzero(inside) != self.tree.sizes[-1]:
                raise ValueError("expected the points of every scan, got one scan's; leave them out to use the voxels")
            places, groups = given[inside].astype(np.float64), self.supervoxels[inside]
            normals = normals[surface.grid.voxel_of_point]
        leaves = primitive_moments(places, normals, groups, self.tree.n_leaves)
        return fit_primitives(primitive_moments_up_tree(leaves, self.tree.parents))

    def save(self, path: str | PathLike[str], cloud: Any = None) -> None:
        """Write the segmentation to a file, and replace an existing one; after an error the file is as it was before.

        `pcgraph.load_segmentation` returns an equal segmentation.

        Parameters
        ----------
        path : str or path, ``.npz``
            The file has one array for each field, under a name such as ``graph/edges`` (docs/files.md lists them). All
            other values are JSON in the array ``header``. Nothing is pickled or compressed.
        cloud : Cloud, or anything else that `as_cloud` takes, optional
            The cloud that was segmented, after an update the last scan. It is stored, too, under ``cloud/points``,
            ``cloud/columns/intensity`` and the like, and `pcgraph.read_cloud` reads it from the same file.

        Raises
        ------
        CloudWriteError
            The name does not end in ``.npz``, the place cannot be written, or the cloud's columns are no arrays of
            numbers, one row for each point.
        ValueError
            The points have another shape than those that were segmented.

        Examples
        --------
        >>> import numpy as np, pcgraph, tempfile
        >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 64), np.linspace(-1.0, 1.0, 64))
        >>> wall = np.stack((x, y, np.full_like(x, 2.0)), axis=-1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     pcgraph.segment(wall).save(f"{folder}/wall.npz", wall)
        ...     print(pcgraph.load_segmentation(f"{folder}/wall.npz").labels.shape)
        (64, 64)
        """
        path = Path(path)
        if path.suffix.lower() != ".npz":
            raise CloudWriteError(f"expected the name of a file ending in .npz, got {path.name!r}")
        write_file(path, self.to_bytes(cloud), CloudWriteError)

    def to_bytes(self, cloud: Any = None) -> bytes:
        """Bytes of the file that `save` writes."""
        archive = Archive()
        for name in field_names(Segmentation):
            value = getattr(self, name)
            try:
                archive.flatten(value, name)
            except TypeError:
                if name not in ("method", "linkage"):
                    raise
                archive.values[name] = class_name(type(value)) + NOT_STORED
        if cloud is not None:
            archive.flatten(plain_cloud(segmented_cloud(cloud, self)), "cloud")
        return encode_archive(archive, {"format": SAVED_FORMAT, "version": SAVED_VERSION}, SAVED_MARK)

    def _in_input_shape(self, values: NDArray[Any], missing: float) -> NDArray[Any]:
        """Values of the points that have a supervoxel, in the input's shape."""
        full = np.full(self.supervoxels.shape, missing, values.dtype)
        full[self.supervoxels >= 0] = values
        return full


def segmented_cloud(cloud: Any, segmentation: Segmentation) -> Cloud:
    """The cloud that was segmented, from anything that `as_cloud` takes; ValueError if it has another shape."""
    found, shape = as_cloud(cloud), segmentation.supervoxels.shape
    if np.shape(found.points) != (*shape, 3):
        expected = f"the points that were segmented, of shape {(*shape, 3)}"
        raise ValueError(f"expected {expected}, got {np.shape(found.points)}; give the cloud of this segmentation")
    return found


def check_segmentation(given: object) -> None:
    """Raise ValueError unless this is a `Segmentation`."""
    if not isinstance(given, Segmentation):
        raise ValueError(f"expected a Segmentation, as pcgraph.segment returns it, got {type(given).__name__}")


def _refusal(argument: str, family: str, given: object) -> str:
    from pcgraph.families import refusal  # it loads the module inspect, which no valid argument needs

    return refusal(argument, family, given)
