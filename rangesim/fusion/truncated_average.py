# SPDX-License-Identifier: Apache-2.0
"""Many views to one surface: the weighted truncated average of `sdf`, on sparse blocks of voxels.

Open3D's voxel-block grid (Niessner et al.: "Real-time 3D reconstruction at scale using voxel hashing", SIGGRAPH Asia
2013) holds the blocks near some view's readings and makes the mesh by marching cubes. Its own `integrate` counts all
readings alike, in front positive, and updates the blocks of each view alone, so that no view can refute another's
ghost; here a loop of our own fills the grid: weights, distortion, and every view over every block.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.extending import register_jitable

from pcgraph.parallel import in_blocks, kernel, routine
from rangesim import limits
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import AlignmentWarning
from rangesim.fusion.sdf import (
    SAME_SURFACE,
    Lookup,
    Weighting,
    check_lookup,
    placed,
    relative_weights,
)
from rangesim.rig.camera_model import appears, distort, project, to_pixel
from rangesim.settings.bounds import MAX_COORDINATE_M, Bounds, check_number
from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

LENGTH = Bounds("positive and finite", 1e-9, MAX_COORDINATE_M)
BLOCK = 8
"""Voxels along the edge of a block."""
TILE = 8
"""Pixels along the edge of the tiles whose farthest reading tells what is hidden."""
KEY = 1 << 21
"""Blocks along an axis, at most: three such numbers make one of 63 bits."""
TRUNCATION_VOXELS = 3.0
"""Truncation distance, in voxels, if none is given."""
ENOUGH = 7
"""One reading of so many tells the distance between readings."""
WIDE = 8.0
"""Voxels of truncation beyond which the points that blocks are laid around may be farther apart."""
COARSEST = 0.5
"""Of the largest extent of the readings, at most, that a voxel is."""
FINEST = 0.1
"""Of the distance between neighbouring readings, at least, that a voxel is: in smaller ones surfaces are specks."""
MIN_VIEWS = 0.05
"""Fraction of the views that must agree on a surface, in typical readings, if nothing else is said."""
MAX_MIN_WEIGHT = 1.0
"""Typical readings that are enough in any case."""


@dataclass(frozen=True, eq=False, repr=False)
class FusedSurface(ShortRepr):
    """A surface that views were fused to.

    mesh : TriangleMesh, world; its normals point to where the cameras were. voxel_m, truncation_m : metres.
    vertex_weights : (n,) float32, of each vertex the sum of its readings' weights, where 1 is a typical reading.
    min_weight : least weight of the voxels that the surface was taken from. voxels : number that were held.
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
    """Fuses range images, each with its own `T_world_camera`, to a mesh.

    The formula, with its source, is that of `rangesim.fusion.sdf`. What a sensor reads wrong on glass and
    mirrors differs from view to view: such readings are faint, or stand alone, or are refuted by views that see through
    them, so they end below `min_weight` and leave holes. The same wrong reading in many views (the table seen through
    glass, refracted a little) is a surface like any other.

    Parameters
    ----------
    images : one or more; of one view the result is its readings, smoothed to the voxel.
    voxel_m : metres, edge of a voxel: details smaller than two of them are lost.
    truncation_m : metres, at least a voxel; larger than the errors of readings, and smaller than the thinnest wall seen
        from both sides. None: three voxels.
    weights : "confidence" or "uniform", see `reading_weights`.
    min_weight : least sum of weights, 1 being a typical reading; None: a twentieth of the number of views, at most 1.
        0: every voxel that a reading says anything of.
    lookup : see `rangesim.fusion.sdf.depth_at`.

    Raises
    ------
    ValueError
        No views or readings, one without a camera or with a pose that is not rigid, voxels so small that a limit is
        passed or larger than half of what the readings extend over, or no surface that reaches `min_weight`.

    Warns
    -----
    AlignmentWarning
        Views whose readings lie farther from those of all others than they extend: a pose in millimetres, or inverted.
    """
    truncation = _checked(images, voxel_m, truncation_m, lookup)
    least = min(MIN_VIEWS * len(images), MAX_MIN_WEIGHT) if min_weight is None else min_weight
    if not least >= 0:
        raise ValueError(f"expected min_weight of 0 or more typical readings, got {shown(min_weight)}.")
    relative = relative_weights(images, weights)
    _check_fineness(images, voxel_m)
    grid = _Blocks.near(images, relative, voxel_m, truncation)
    _check_coarseness(grid.boxes, voxel_m)
    _warn_of_views_apart(grid.boxes)
    for image, weight in zip(images, relative, strict=True):
        grid.add(image, weight, truncation, lookup)
    mesh, of_vertices = grid.surface(least, truncation)
    if not len(mesh.faces):
        raise ValueError(
            f"expected a surface that readings of weight {least:g} agree on, found none in {len(images)} views; check "
            "their poses (T_world_camera), or take another voxel_m or a smaller min_weight."
        )
    return FusedSurface(mesh, float(voxel_m), truncation, of_vertices, float(least), grid.voxels)


def _checked(images: Sequence[RangeImage], voxel_m: float, truncation_m: float | None, lookup: str) -> float:
    """The truncation distance; ValueError on what cannot be fused."""
    if not isinstance(images, Sequence):
        raise ValueError(f"expected a list of range images to fuse, such as `images` of a Scan, got {shown(images)}.")
    if not images:
        raise ValueError("expected one view or more to fuse, got none.")
    for number, image in enumerate(images):
        if not isinstance(image, RangeImage):
            raise ValueError(f"expected range images to fuse, got {shown(image)} as number {number}.")
        placed(image, name=f"the pose of view {number}")
    check_number("voxel_m", voxel_m, LENGTH)
    check_lookup(lookup)
    if truncation_m is not None:
        check_number("truncation_m", truncation_m, LENGTH)
    truncation = TRUNCATION_VOXELS * voxel_m if truncation_m is None else truncation_m
    if truncation < voxel_m:
        raise ValueError(f"expected truncation_m of at least a voxel of {voxel_m:g} m, got {truncation_m:g} m.")
    # Around a single reading already
    blocks = float(np.floor(2 * truncation / (BLOCK * voxel_m))) ** 3
    limits.check("voxels", int(blocks) * BLOCK**3, f"voxels of {voxel_m:g} m within {truncation:g} m of a reading")
    return float(truncation)


def _check_coarseness(boxes: np.ndarray, voxel_m: float) -> None:
    """ValueError if all readings lie within two voxels: nothing would be left of them."""
    extent = float((np.nanmax(boxes[:, 1], axis=0) - np.nanmin(boxes[:, 0], axis=0)).max())
    if voxel_m > COARSEST * extent:
        raise ValueError(
            f"expected voxel_m of at most {COARSEST * extent:.2g}, half of what the readings extend over, got "
            f"{voxel_m:g} m."
        )


def _warn_of_views_apart(boxes: np.ndarray) -> None:
    """AlignmentWarning of views that read nothing near what any other reads: their poses are likely of another unit."""
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
    spacings = [float(np.median(i.z[i.valid][::ENOUGH])) / i.camera.fx for i in images if i.camera and i.valid.any()]
    if voxel_m < FINEST * min(spacings):
        raise ValueError(
            f"expected voxel_m of at least {FINEST * min(spacings):.2g}, a tenth of the distance between readings, got "
            f"{voxel_m:g} m."
        )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Open3D's grid with all blocks that will be needed, whose arrays are filled in place.

    origin : (3,) metres, world: where the grid has its zero, near the readings, for single precision. boxes : (n, 2, 3)
    metres, world, lowest and highest corner of what each view reads; NaN of a view without readings.
    keys : (k, 3) int32, places of the blocks. rows : (k,) where their voxels stand in `total` and `weight`,
    (capacity, 8, 8, 8) float32, indexed [block, z, y, x]; first the sums, at the end the average in Open3D's sign.
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
        """All blocks within the truncation distance of a reading that weighs something."""
        import open3d as o3d

        core, edge = o3d.core, BLOCK * voxel_m
        places, origin = [np.zeros(0, np.int64)], None
        boxes = np.full((len(images), 2, 3), np.nan)  # corners of what each view reads
        for k, (image, weight) in enumerate(zip(images, weights, strict=True)):
            camera, T = placed(image)
            rays = camera.directions(camera.pixel_centres())
            counts = (weight > 0) & np.isfinite(image.z)
            points = (rays[counts] * image.z[counts, None].astype(np.float64)) @ T[:3, :3].T + T[:3, 3]
            if not len(points):
                continue
            if origin is None:
                origin = np.round(np.median(points, axis=0) / edge) * edge
            boxes[k] = points.min(axis=0), points.max(axis=0)
            local, spread = _thinned(points - origin, voxel_m, truncation_m)
            extent = np.abs(local).max() + truncation_m
            if extent / edge >= KEY // 2 - 2:
                raise ValueError(
                    f"expected readings within {KEY // 2} blocks of {edge:g} m, got one {extent:.3g} m away."
                )
            grid = o3d.t.geometry.VoxelBlockGrid(
                ("tsdf",), (core.float32,), ((1,),), voxel_size=voxel_m, block_resolution=BLOCK, block_count=1
            )
            cloud = o3d.t.geometry.PointCloud(core.Tensor(local.astype(np.float32)))
            near = (
                grid.compute_unique_block_coordinates(cloud, (truncation_m + spread) / voxel_m).numpy().astype(np.int64)
            )
            x, y, z = near.T + KEY // 2
            places = [np.unique(np.concatenate([*places, (x * KEY + y) * KEY + z]))]
            limits.check("voxels", len(places[0]) * BLOCK**3, f"voxels of {voxel_m:g} m")
        number = places[0]
        keys = (np.stack([number // KEY**2, number // KEY % KEY, number % KEY], axis=-1) - KEY // 2).astype(np.int32)
        assert origin is not None  # some readings weigh something: see `relative_weights`
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
        """Number of voxels held."""
        return len(self.keys) * BLOCK**3

    def add(self, image: RangeImage, weight: np.ndarray, truncation_m: float, lookup: Lookup) -> None:
        """Add one view to the sums."""
        camera, T = placed(image)
        # World to camera, of the grid's coordinates
        R, t = T[:3, :3].T, T[:3, :3].T @ (self.origin - T[:3, 3])
        in_blocks(
            _add_view, len(self.keys), self.keys, self.rows, self.total, self.weight, self.voxel_m, truncation_m,
            np.ascontiguousarray(R), t, camera.model, np.ascontiguousarray(image.z), np.ascontiguousarray(weight),
            lookup == "bilinear", _farthest(image.z, weight), smallest=64,
        )  # fmt: skip

    def surface(self, least: float, truncation_m: float) -> tuple[TriangleMesh, np.ndarray]:
        """Mesh where the average is zero between voxels of weight at least `least` and above 0, and the weights of its
        vertices."""
        import open3d as o3d

        with np.errstate(divide="ignore", invalid="ignore"):
            # Open3D's sign, positive in front, and in fractions of the truncation distance
            np.divide(self.total, -truncation_m * self.weight, out=self.total)
        np.nan_to_num(self.total, copy=False)
        try:
            # Open3D takes what is larger; a voxel of weight 0 is one that no view says anything of
            above = max(float(np.nextafter(np.float32(least), np.float32(-1))), 0.0)
            made = self.grid.extract_triangle_mesh(weight_threshold=above)
        except RuntimeError as error:
            if "Tensor has shape {0}" not in str(error):
                raise
            made = o3d.t.geometry.TriangleMesh()  # it has no word for a grid without a surface
        if "indices" not in made.triangle or not made.triangle.indices.shape[0]:
            return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), np.zeros(0, np.float32)
        vertices = made.vertex.positions.numpy().astype(np.float64)
        faces = made.triangle.indices.numpy()
        corners = vertices[faces]
        has_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1) > 0
        used, number = np.unique(faces[has_area], return_inverse=True)
        order = np.lexsort(vertices[used].T)  # Open3D numbers vertices as its threads come to them
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        kept = vertices[used][order]
        triangles = place[number.reshape(-1, 3)]
        first = triangles.argmin(axis=1)  # each from its lowest vertex on
        triangles = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
        triangles = triangles[np.lexsort(triangles.T[::-1])]
        return TriangleMesh(kept + self.origin, triangles), self._weights_at(kept)

    def _weights_at(self, points: np.ndarray) -> np.ndarray:
        """(n,) float32, weight of the voxel nearest to each point (n, 3), in the grid's coordinates."""
        import open3d as o3d

        voxel = np.rint(points / self.voxel_m).astype(np.int64)
        block = np.floor_divide(voxel, BLOCK)
        rows, found = self.grid.hashmap().find(o3d.core.Tensor(block.astype(np.int32)))
        x, y, z = np.moveaxis(voxel - BLOCK * block, -1, 0)
        row, has = rows.numpy(), found.numpy()
        return np.where(has, self.weight[np.where(has, row, 0), z, y, x], 0).astype(np.float32)


def _thinned(points: np.ndarray, voxel_m: float, truncation_m: float) -> tuple[np.ndarray, float]:
    """One of the points in each cube of two voxels, roughly: more tell nothing new of the blocks; and metres by which
    blocks have to reach farther, as the cubes are larger where the truncation distance is."""
    is_wide = truncation_m > WIDE * voxel_m
    if len(points) < 10_000 and not is_wide:
        return points, 0.0
    cube = truncation_m / 4 if is_wide else 2 * voxel_m
    place = np.floor(points / cube).astype(np.int64)
    place -= place.min(axis=0)
    size = place.max(axis=0) + 1
    number = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    return np.asarray(points[np.unique(number, return_index=True)[1]]), cube * float(np.sqrt(3)) if is_wide else 0.0


def _farthest(z: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(k, l) float64, metres, largest depth of the readings that weigh something in each tile and of the pixels next to
    them, which an interpolated depth may come from; -infinity of none."""
    from scipy.ndimage import maximum_filter

    depth = np.where((weight > 0) & np.isfinite(z), z, -np.inf)
    # Their neighbours may weigh nothing and yet be interpolated with
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
    """Add w max(-t, sdf) and w of one view to the voxels of blocks `start` to `stop`."""
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
                        if distance > voxel_m:  # so truncation_m is larger, too
                            w *= (truncation_m - distance) / (truncation_m - voxel_m)
                        total[row, k, j, i] += w * max(distance, -truncation_m)
                        weight[row, k, j, i] += w


@routine
def _is_hidden(key, voxel_m, truncation_m, R, t, camera, farthest, shape):  # type: ignore[no-untyped-def]
    """Whether no reading of a view can say anything of a block: it is behind all of them by more than the truncation
    distance, or the view does not look there. By the block's sphere; False if in doubt."""
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
    # A point of the sphere is off by dx / z - x dz / z^2, with z at least z - radius
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
    """Depth at a pixel inside the image; see `rangesim.fusion.sdf.depth_at`."""
    depth = z[int(v), int(u)]
    if not interpolate:
        return float(depth)
    left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    if left < 0 or top < 0 or left >= z.shape[1] - 1 or top >= z.shape[0] - 1:
        return float(depth)
    z00, z01, z10, z11 = z[top, left], z[top, left + 1], z[top + 1, left], z[top + 1, left + 1]
    low, high = min(min(z00, z01), min(z10, z11)), max(max(z00, z01), max(z10, z11))
    if not (high - low <= SAME_SURFACE * low) or np.isnan(z00 + z01 + z10 + z11):
        return float(depth)
    a, b = u - 0.5 - left, v - 0.5 - top
    return 1 / ((1 - a) * (1 - b) / z00 + a * (1 - b) / z01 + (1 - a) * b / z10 + a * b / z11)
