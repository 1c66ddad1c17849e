# SPDX-License-Identifier: Apache-2.0
"""Fusion of many views to one surface: the weighted truncated average of `rangesim.fusion.sdf`, on sparse blocks.

Open3D's voxel-block grid (Niessner et al.: "Real-time 3D reconstruction at scale using voxel hashing", SIGGRAPH Asia
2013) stores the blocks near the readings and makes the mesh by marching cubes. Its own `integrate` weighs all readings
equally and knows no lens distortion. It updates only the blocks that the view itself reads, so no view can refute the
ghost of another. A compiled loop in this module fills the grid instead: with weights, with distortion, and with every
view over every block.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.extending import register_jitable

from pcgraph.parallel import in_blocks, kernel, routine
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import AlignmentWarning
from rangesim.fusion.sdf import (
    MAX_DEPTH_STEP,
    Lookup,
    Weighting,
    camera_and_pose,
    check_lookup,
    check_view,
    relative_weights,
)
from rangesim.fusion.virtual_cameras import pinhole_views
from rangesim.rig.camera_model import appears, distort, project, to_pixel
from rangesim.settings import limits
from rangesim.settings.bounds import MAX_COORDINATE_M, Bounds, check_number
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

LENGTH = Bounds("positive and finite", 1e-9, MAX_COORDINATE_M)
"""Bounds of `voxel_m` and `truncation_m`, in metres."""
BLOCK = 8
"""Voxels along the edge of a block, so 512 voxels in a block, as in Niessner et al. (2013). Larger blocks store more
empty voxels, smaller ones need more entries in the hash table."""
TILE = 8
"""Pixels along the edge of a tile. The farthest reading of each tile tells quickly which blocks are hidden. The value
changes only the time."""
MAX_BLOCKS = 1 << 21
"""Largest count of blocks along an axis, so that three indices of 21 bits fit into one integer of 63 bits."""
TRUNCATION_VOXELS = 3.0
"""Default truncation distance in voxels. Smaller ones cut off the noise of readings, which makes the surface rougher;
larger ones spoil thin walls that are seen from both sides."""
SPACING_STEP = 7
"""Step in pixels between the readings whose median depth gives the distance between readings. More readings would only
cost time, because the check of `voxel_m` is a coarse one."""
WIDE_TRUNCATION_VOXELS = 8.0
"""If the truncation distance is more than this number of voxels, blocks are sought around fewer points, so that the
search stays short. The search radius then grows by the distance of these points, so no block is missed."""
MAX_VOXEL_FRACTION = 0.5
"""Largest edge of a voxel, as a fraction of the extent of the readings, because less than two voxels show no shape."""
MIN_VOXEL_SPACINGS = 0.1
"""Smallest edge of a voxel, as a fraction of the distance between neighbouring readings, because in smaller voxels each
reading becomes a speck of its own."""
MIN_VIEW_FRACTION = 0.05
"""Default of `min_weight`, in typical readings, as a fraction of the number of views, see `MAX_MIN_WEIGHT`."""
MAX_MIN_WEIGHT = 1.0
"""Largest default of `min_weight`, as a count of typical readings; 20 and more views reach it. Measured among glass and
mirrors (docs/fusion.md, "Weights"): without a least weight, the mesh has 741 cm2 of ghosts and 75 % of the matte
surface; with a least weight of 1, 1.7 cm2 and 69 %; with 2, no ghosts and 61 %."""


@dataclass(frozen=True, eq=False, repr=False)
class FusedSurface(ShortRepr):
    """Surface that `fuse` made from several views.

    mesh : TriangleMesh, metres, world; normals point to the side of the cameras.
    voxel_m, truncation_m : metres, edge of a voxel and truncation distance.
    vertex_weights : (n,) float32, sum of the weights of the readings at each vertex; 1 is a typical reading.
    min_weight : least sum of weights that a voxel of the surface has.
    voxels : number of voxels in memory.
    """

    mesh: TriangleMesh
    voxel_m: float
    truncation_m: float
    vertex_weights: np.ndarray
    min_weight: float
    voxels: int


def fuse(
    images: Sequence[RangeImage],
    voxel_m: float,
    *,
    truncation_m: float | None = None,
    weights: Weighting = "confidence",
    min_weight: float | None = None,
    lookup: Lookup = "bilinear",
) -> FusedSurface:
    """Mesh of the surface that several range images show, each with its own pose `T_world_camera`.

    The formula and its sources are in `rangesim.fusion.sdf`. Wrong readings on glass and mirrors differ from view to
    view: they are faint, or no other view confirms them, or other views look through them. So their weight stays below
    `min_weight`, and the mesh has holes there. If many views have the same wrong reading, such as a table seen through
    glass, this reading becomes a surface like any other.

    Parameters
    ----------
    images : one view or more, with their poses. From one view, the result is its readings, smoothed to the voxel.
    voxel_m : metres, edge of a voxel. Details smaller than two voxels are lost.
    truncation_m : metres, truncation distance, at least a voxel. Choose it larger than the errors of readings, and
        smaller than the thinnest wall that is seen from both sides. None: three voxels.
    weights : "confidence" or "uniform", see `reading_weights`.
    min_weight : least sum of weights that a voxel of the surface has; 1 is a typical reading. None: a twentieth of the
        number of views, at most 1. 0: every voxel with any reading counts.
    lookup : rule for the depth between pixels, see `rangesim.fusion.sdf.depth_at`.

    Raises
    ------
    ValueError
        No views or readings; a view without a camera, or with a pose that is not rigid; voxels so small that a limit is
        exceeded, or larger than half of the extent of the readings; no surface that reaches `min_weight`.

    Warns
    -----
    AlignmentWarning
        The readings of a view are farther from those of all others than their own extent. Its pose may be in
        millimetres, or inverted.

    Examples
    --------
    One view of a wall 1 m away becomes a flat mesh:

    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import fuse
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> wall = RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> fused = fuse([wall], voxel_m=0.05)
    >>> bool(np.allclose(fused.mesh.vertices[:, 2], 1.0))
    True
    """
    truncation = _checked(images, voxel_m, truncation_m, lookup)
    least = min(MIN_VIEW_FRACTION * len(images), MAX_MIN_WEIGHT) if min_weight is None else min_weight
    if not least >= 0:
        raise ValueError(f"expected min_weight of 0 or more typical readings, got {shown(min_weight)}.")
    of_view = [(number, view) for number, image in enumerate(images) for view in pinhole_views(image)]
    views = [view for _, view in of_view]
    relative = relative_weights(views, weights)
    _check_fineness(views, voxel_m)
    grid = _Blocks.near(views, relative, voxel_m, truncation)
    _check_coarseness(grid.boxes, voxel_m)
    _warn_of_views_apart(_joined_boxes(grid.boxes, [number for number, _ in of_view]))
    for view, weight in zip(views, relative, strict=True):
        grid.add(view, weight, truncation, lookup)
    mesh, of_vertices = grid.surface(least, truncation)
    if not len(mesh.faces):
        raise ValueError(
            f"expected a surface that readings of weight {least:g} agree on, found none in {len(images)} views; check "
            "their poses (T_world_camera), or take another voxel_m or a smaller min_weight."
        )
    return FusedSurface(mesh, float(voxel_m), truncation, of_vertices, float(least), grid.voxels)


def _checked(images: Sequence[RangeImage], voxel_m: float, truncation_m: float | None, lookup: str) -> float:
    """Truncation distance in metres; ValueError if the arguments of `fuse` are wrong."""
    if not isinstance(images, Sequence):
        raise ValueError(f"expected a list of range images to fuse, such as `images` of a Scan, got {shown(images)}.")
    if not images:
        raise ValueError("expected one view or more to fuse, got none.")
    for number, image in enumerate(images):
        if not isinstance(image, RangeImage):
            raise ValueError(f"expected range images to fuse, got {shown(image)} as number {number}.")
        check_view(image, f"the pose of view {number}")
    check_number("voxel_m", voxel_m, LENGTH)
    check_lookup(lookup)
    if truncation_m is not None:
        check_number("truncation_m", truncation_m, LENGTH)
    truncation = TRUNCATION_VOXELS * voxel_m if truncation_m is None else truncation_m
    if truncation < voxel_m:
        raise ValueError(f"expected truncation_m of at least a voxel of {voxel_m:g} m, got {truncation_m:g} m.")
    # Number of blocks around a single reading
    blocks = float(np.floor(2 * truncation / (BLOCK * voxel_m))) ** 3
    limits.check("voxels", int(blocks) * BLOCK**3, f"voxels of {voxel_m:g} m within {truncation:g} m of a reading")
    return float(truncation)


def _check_coarseness(boxes: np.ndarray, voxel_m: float) -> None:
    """Raise ValueError if all readings lie within two voxels, because no surface would be left."""
    extent = float((np.nanmax(boxes[:, 1], axis=0) - np.nanmin(boxes[:, 0], axis=0)).max())
    if voxel_m > MAX_VOXEL_FRACTION * extent:
        raise ValueError(
            f"expected voxel_m of at most {MAX_VOXEL_FRACTION * extent:.2g}, half of the extent of the readings, got "
            f"{voxel_m:g} m."
        )


def _joined_boxes(boxes: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Box of the readings of each view (k, 2, 3), from those of its parts (n, 2, 3); NaN for parts without any.

    numbers : the view of each part, ascending.
    """
    starts = np.unique(numbers, return_index=True)[1]
    low, high = np.fmin.reduceat(boxes[:, 0], starts), np.fmax.reduceat(boxes[:, 1], starts)
    return np.stack([low, high], axis=1)


def _warn_of_views_apart(boxes: np.ndarray) -> None:
    """Warn (AlignmentWarning) of views whose readings are far from all others; their poses are likely wrong."""
    gap = np.maximum(boxes[:, None, 0] - boxes[None, :, 1], boxes[None, :, 0] - boxes[:, None, 1]).max(axis=-1)
    extent = (boxes[:, 1] - boxes[:, 0]).max(axis=-1)
    apart = gap > np.maximum(extent[:, None], extent[None])  # False with NaN
    np.fill_diagonal(apart, True)
    has_readings = np.isfinite(extent)
    alone = np.flatnonzero((apart | ~has_readings[None]).all(axis=1) & has_readings)
    if len(alone) and has_readings.sum() > 1:
        views = ", ".join(map(str, alone))
        nearest_m = float(np.nanmin(np.where(np.eye(len(gap), dtype=bool), np.nan, gap)[alone]))
        warnings.warn(
            AlignmentWarning(
                f"the readings of view {views} lie {nearest_m:.2g} m or more from those of any other; poses are "
                "T_world_camera in metres."
            ),
            stacklevel=3,
        )


def _check_fineness(images: Sequence[RangeImage], voxel_m: float) -> None:
    """Raise ValueError if voxels are far smaller than the distance between readings."""
    spacings = [
        float(np.median(i.z[i.valid][::SPACING_STEP])) / i.pinhole.fx for i in images if i.camera and i.valid.any()
    ]
    if voxel_m < MIN_VOXEL_SPACINGS * min(spacings):
        raise ValueError(
            f"expected voxel_m of at least {MIN_VOXEL_SPACINGS * min(spacings):.2g}, a tenth of the distance between "
            f"readings, got {voxel_m:g} m."
        )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Open3D's grid with all blocks that the views need; its arrays are filled in place.

    grid : Open3D's VoxelBlockGrid.
    origin : (3,) float64, metres, world, zero of the grid. It is near the readings, because Open3D computes in single
        precision.
    voxel_m : metres, edge of a voxel.
    boxes : (n, 2, 3) float64, metres, world, lowest and highest corner of the readings of each view; NaN without any.
    keys : (k, 3) int32, place of each block, in blocks from `origin`.
    rows : (k,) int64, row of each block in `total` and `weight`.
    total, weight : (capacity, 8, 8, 8) float32, indexed [row, z, y, x]. While views are added, they are the sums
        of weighted distances and of weights. At the end, `total` is the average with Open3D's sign.
    """

    grid: Any
    origin: np.ndarray
    voxel_m: float
    boxes: np.ndarray
    keys: np.ndarray
    rows: np.ndarray
    total: np.ndarray
    weight: np.ndarray

    @classmethod
    def near(
        cls, images: Sequence[RangeImage], weights: Sequence[np.ndarray], voxel_m: float, truncation_m: float
    ) -> _Blocks:
        """All blocks within the truncation distance of readings with a positive weight."""
        import open3d as o3d

        core, edge = o3d.core, BLOCK * voxel_m
        places, origin = [np.zeros(0, np.int64)], None
        boxes = np.full((len(images), 2, 3), np.nan)
        for k, (image, weight) in enumerate(zip(images, weights, strict=True)):
            camera, T = camera_and_pose(image)
            rays = camera.directions(camera.pixel_centres())
            counts = (weight > 0) & np.isfinite(image.z)
            points = (rays[counts] * image.z[counts, None].astype(np.float64)) @ T[:3, :3].T + T[:3, 3]
            if not len(points):
                continue
            if origin is None:
                origin = np.round(np.median(points, axis=0) / edge) * edge
            boxes[k] = points.min(axis=0), points.max(axis=0)
            local, spread = _points_for_blocks(points - origin, voxel_m, truncation_m)
            extent = np.abs(local).max() + truncation_m
            if extent / edge >= MAX_BLOCKS // 2 - 2:
                raise ValueError(
                    f"expected readings within {MAX_BLOCKS // 2} blocks of {edge:g} m, got one {extent:.3g} m away."
                )
            grid = o3d.t.geometry.VoxelBlockGrid(
                ("tsdf",), (core.float32,), ((1,),), voxel_size=voxel_m, block_resolution=BLOCK, block_count=1
            )
            cloud = o3d.t.geometry.PointCloud(core.Tensor(local.astype(np.float32)))
            near = (
                grid.compute_unique_block_coordinates(cloud, (truncation_m + spread) / voxel_m).numpy().astype(np.int64)
            )
            x, y, z = near.T + MAX_BLOCKS // 2
            places = [np.unique(np.concatenate([*places, (x * MAX_BLOCKS + y) * MAX_BLOCKS + z]))]
            limits.check("voxels", len(places[0]) * BLOCK**3, f"voxels of {voxel_m:g} m")
        number = places[0]
        xyz = np.stack([number // MAX_BLOCKS**2, number // MAX_BLOCKS % MAX_BLOCKS, number % MAX_BLOCKS], axis=-1)
        keys = (xyz - MAX_BLOCKS // 2).astype(np.int32)
        assert origin is not None  # `relative_weights` has refused images without positive weights
        grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"),
            (core.float32, core.float32),
            ((1,), (1,)),
            voxel_size=voxel_m,
            block_resolution=BLOCK,
            block_count=len(keys),
        )
        rows, _ = grid.hashmap().activate(core.Tensor(keys))
        total, weight = (grid.attribute(name).numpy()[..., 0] for name in ("tsdf", "weight"))
        total[...], weight[...] = 0, 0
        return cls(grid, origin, float(voxel_m), boxes, keys, rows.numpy(), total, weight)

    @property
    def voxels(self) -> int:
        """Number of voxels in memory."""
        return len(self.keys) * BLOCK**3

    def add(self, image: RangeImage, weight: np.ndarray, truncation_m: float, lookup: Lookup) -> None:
        """Add one view with the weights (h, w) of its readings to the sums."""
        camera, T = camera_and_pose(image)
        # From the grid's coordinates to those of the camera
        R, t = T[:3, :3].T, T[:3, :3].T @ (self.origin - T[:3, 3])
        in_blocks(
            _add_view, len(self.keys), self.keys, self.rows, self.total, self.weight, self.voxel_m, truncation_m,
            np.ascontiguousarray(R), t, camera.model, np.ascontiguousarray(image.z), np.ascontiguousarray(weight),
            lookup == "bilinear", _farthest(image.z, weight), smallest=64,
        )  # fmt: skip

    def surface(self, least: float, truncation_m: float) -> tuple[TriangleMesh, np.ndarray]:
        """Mesh of the places where the average is zero, and the weights (n,) float32 of its vertices.

        It lies between voxels whose weight is at least `least` and above 0.
        """
        import open3d as o3d

        with np.errstate(divide="ignore", invalid="ignore"):
            # Open3D's distances are positive in front, and fractions of the truncation distance
            np.divide(self.total, -truncation_m * self.weight, out=self.total)
        np.nan_to_num(self.total, copy=False)
        try:
            # Open3D takes voxels with a larger weight; those of weight 0 were seen by no view
            above = max(float(np.nextafter(np.float32(least), np.float32(-1))), 0.0)
            made = self.grid.extract_triangle_mesh(weight_threshold=above)
        except RuntimeError as error:
            if "Tensor has shape {0}" not in str(error):
                raise
            made = o3d.t.geometry.TriangleMesh()  # the error means that the grid has no surface
        if "indices" not in made.triangle or not made.triangle.indices.shape[0]:
            return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), np.zeros(0, np.float32)
        vertices = made.vertex.positions.numpy().astype(np.float64)
        faces = made.triangle.indices.numpy()
        corners = vertices[faces]
        has_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1) > 0
        used, number = np.unique(faces[has_area], return_inverse=True)
        order = np.lexsort(vertices[used].T)  # Open3D's order of vertices depends on its threads
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        kept = vertices[used][order]
        triangles = place[number.reshape(-1, 3)]
        first = triangles.argmin(axis=1)  # each triangle starts at its lowest vertex
        triangles = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
        triangles = triangles[np.lexsort(triangles.T[::-1])]
        return TriangleMesh(kept + self.origin, triangles), self._weights_at(kept)

    def _weights_at(self, points: np.ndarray) -> np.ndarray:
        """Weight of the voxel nearest to each point: (n,) float32. Points (n, 3) are in the grid's coordinates."""
        import open3d as o3d

        voxel = np.rint(points / self.voxel_m).astype(np.int64)
        block = np.floor_divide(voxel, BLOCK)
        rows, found = self.grid.hashmap().find(o3d.core.Tensor(block.astype(np.int32)))
        x, y, z = np.moveaxis(voxel - BLOCK * block, -1, 0)
        row, has = rows.numpy(), found.numpy()
        return np.where(has, self.weight[np.where(has, row, 0), z, y, x], 0).astype(np.float32)


def _points_for_blocks(points: np.ndarray, voxel_m: float, truncation_m: float) -> tuple[np.ndarray, float]:
    """One of the points in each small cube, and an addition to the search radius.

    The points in a cube need about the same blocks. A cube is two voxels wide, or a quarter of the truncation distance
    if that is many voxels. Only in the second case, the addition (metres) is above 0.
    """
    is_wide = truncation_m > WIDE_TRUNCATION_VOXELS * voxel_m
    if len(points) < 10_000 and not is_wide:
        return points, 0.0
    cube = truncation_m / 4 if is_wide else 2 * voxel_m
    place = np.floor(points / cube).astype(np.int64)
    place -= place.min(axis=0)
    size = place.max(axis=0) + 1
    number = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    return np.asarray(points[np.unique(number, return_index=True)[1]]), cube * float(np.sqrt(3)) if is_wide else 0.0


def _farthest(z: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Largest depth of the readings in each tile: (k, l) float64, metres; -infinity for a tile without readings.

    Readings with a positive weight count. The pixels next to them count too, because depths may be interpolated there.
    """
    from scipy.ndimage import maximum_filter

    depth = np.where((weight > 0) & np.isfinite(z), z, -np.inf)
    # Interpolation may also use neighbours whose weight is 0
    depth = np.where(maximum_filter(depth, 3) > -np.inf, np.nan_to_num(z, nan=-np.inf), -np.inf)
    h, w = (-(-n // TILE) * TILE for n in z.shape)
    padded = np.full((h, w), -np.inf)
    padded[: z.shape[0], : z.shape[1]] = maximum_filter(depth, 3)
    return np.asarray(padded.reshape(h // TILE, TILE, w // TILE, TILE).max(axis=(1, 3)))


# ---- One view over all blocks --------------------------------------------------------------------------------------

for _function in (distort, appears, to_pixel, project):
    register_jitable(_function)  # so that the loops below may call them
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
"""Coefficients of a pinhole without distortion."""


@kernel
def _add_view(  # type: ignore[no-untyped-def]
    start, stop, keys, rows, total, weight, voxel_m, truncation_m, R, t, camera, z, weights, interpolate, farthest
):
    """Add w r max(-t, sdf) and w r of one view to the voxels of the blocks `start` to `stop` - 1.

    The formula and its symbols are those of `rangesim.fusion.sdf`.
    """
    has_distortion = camera.coefficients != NO_DISTORTION
    for block in range(start, stop):
        if _is_hidden(keys[block], voxel_m, truncation_m, R, t, camera, farthest, z.shape):
            continue
        row = rows[block]
        for k in range(BLOCK):
            for j in range(BLOCK):
                px = keys[block, 0] * BLOCK * voxel_m
                py = (keys[block, 1] * BLOCK + j) * voxel_m
                pz = (keys[block, 2] * BLOCK + k) * voxel_m
                x0 = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
                y0 = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
                z0 = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
                for i in range(BLOCK):
                    zc = z0 + R[2, 0] * i * voxel_m
                    if zc <= 0:
                        continue
                    a = (x0 + R[0, 0] * i * voxel_m) / zc
                    b = (y0 + R[1, 0] * i * voxel_m) / zc
                    u, v = to_pixel(camera, a, b)
                    is_shown = True
                    if has_distortion:
                        u, v, is_shown = project(camera, a, b)
                    if not (is_shown and u >= 0 and u < z.shape[1] and v >= 0 and v < z.shape[0]):
                        continue
                    w = weights[int(v), int(u)]
                    if not w > 0:
                        continue
                    distance = zc - _depth(u, v, z, interpolate)
                    if distance <= truncation_m:  # False with NaN
                        if distance > voxel_m:  # truncation_m is larger, so the division is safe
                            w *= (truncation_m - distance) / (truncation_m - voxel_m)
                        total[row, k, j, i] += w * max(distance, -truncation_m)
                        weight[row, k, j, i] += w


@routine
def _is_hidden(key, voxel_m, truncation_m, R, t, camera, farthest, shape):  # type: ignore[no-untyped-def]
    """Whether no reading of a view has influence on a block; False in doubtful cases.

    Such a block is more than the truncation distance behind all readings near it, or outside the image. The test uses
    the sphere around the block.
    """
    half = (BLOCK - 1) / 2 * voxel_m
    radius = np.sqrt(3.0) * half
    px, py, pz = key[0] * BLOCK * voxel_m + half, key[1] * BLOCK * voxel_m + half, key[2] * BLOCK * voxel_m + half
    x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
    y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
    z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
    if z + radius <= 0:
        return True
    if z <= 4 * radius or camera.coefficients != NO_DISTORTION:
        return False
    a, b = x / z, y / z
    # In the image plane, a point of the sphere is off the centre by dx / z - x dz / z^2; its z is z - radius or more
    reach = radius / (z - radius)
    wide, high = camera.fx * reach * (1 + abs(a)) + 1, camera.fy * reach * (1 + abs(b)) + 1
    u, v = to_pixel(camera, a, b)
    left, right = max(u - wide, 0.0), min(u + wide, shape[1] - 1.0)
    top, bottom = max(v - high, 0.0), min(v + high, shape[0] - 1.0)
    if left > right or top > bottom:
        return True
    for i in range(int(top) // TILE, int(bottom) // TILE + 1):
        for j in range(int(left) // TILE, int(right) // TILE + 1):
            if z - radius - farthest[i, j] <= truncation_m:
                return False
    return True


@routine
def _depth(u, v, z, interpolate):  # type: ignore[no-untyped-def]
    """Depth in metres at pixel coordinates inside the image; the formula is that of `rangesim.fusion.sdf.depth_at`."""
    depth = z[int(v), int(u)]
    if not interpolate:
        return float(depth)
    left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    if left < 0 or top < 0 or left >= z.shape[1] - 1 or top >= z.shape[0] - 1:
        return float(depth)
    z00, z01, z10, z11 = z[top, left], z[top, left + 1], z[top + 1, left], z[top + 1, left + 1]
    low, high = min(min(z00, z01), min(z10, z11)), max(max(z00, z01), max(z10, z11))
    if not (high - low <= MAX_DEPTH_STEP * low) or np.isnan(z00 + z01 + z10 + z11):
        return float(depth)
    a, b = u - 0.5 - left, v - 0.5 - top
    return 1 / ((1 - a) * (1 - b) / z00 + a * (1 - b) / z01 + (1 - a) * b / z10 + a * b / z11)
