# SPDX-License-Identifier: Apache-2.0
"""Compiling kernels ahead of their first use, in two processes.

Compiled kernels are kept in numba's cache, so this is done once per installation. Compiling holds the interpreter's
lock, so threads are no help; a second process compiles half of it.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numba
import numpy as np
from numba import config
from numpy.typing import NDArray

from pcgraph.acquisition import pixel_lattice, pixels
from pcgraph.acquisition.depth_image import DepthImage
from pcgraph.acquisition.kinds import Scanner, Told
from pcgraph.acquisition.pixels import even_steps
from pcgraph.acquisition.spacing_law import spacing_law
from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph import contacts
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.bridges import bridges
from pcgraph.graph.continuations import continuations
from pcgraph.graph.gaps import gaps
from pcgraph.inputs import Pixels, clean_cloud
from pcgraph.kernel_cache import is_sound
from pcgraph.supervoxels import clustering
from pcgraph.supervoxels.surface_growth import SurfaceGrowth
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.tree import segmentation_tree
from pcgraph.voxels import virtual_viewpoints
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.grading import Grading
from pcgraph.voxels.grid import VoxelGrid, at_ends, voxel_grid, with_means
from pcgraph.voxels.outliers import outlier_voxels
from pcgraph.voxels.sampling import some_blocks, thinned
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import visible_fraction, visible_sides
from pcgraph.voxels.warp import CameraWarp, Warp

_EDGE = 24  # points along the cloud's edges
_SPACING = 0.01  # metres between neighbouring points
_PATIENCE_S = 120.0  # after which the second process is given up

_lock = Lock()
_done = False


def _forget_lock() -> None:
    """Make the lock anew in a forked process, where nobody is left to give it back."""
    global _lock
    _lock = Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_lock)


def must_compile() -> bool:
    """Whether the kernels that `pcgraph.segment` needs by default are still missing in numba's cache."""
    if _done or config.DISABLE_JIT:
        return False
    return not (_is_cached(clustering._expand) and _is_cached(contacts._relate))


def compile_in_two_processes() -> None:
    """Fill numba's cache with what `pcgraph.segment` needs by default, if it is missing; once per process."""
    global _done
    with _lock:
        if not must_compile():
            _done = True
            return
        _done = True
        other = _second_process()
        if other is None:
            return  # kernels are compiled one by one as they are used
        try:
            with _no_garbage_collection():
                compile_voxels()
            with suppress(subprocess.TimeoutExpired):
                other.wait(_PATIENCE_S)
        finally:
            if other.poll() is None:
                other.kill()
                other.wait()


def compile_voxels() -> None:
    """Compile what it takes from points to supervoxels, and half of the orientation."""
    points, grid = _step_in_voxels()
    some_blocks(points)
    median_spacing(points)
    spacing_law(points)
    outlier_voxels(grid)
    at_ends(grid, np.zeros(1, np.int64), np.zeros(grid.n_voxels, np.int64))
    visible_fraction(grid, np.zeros(3))
    method = SurfaceGrowth()
    planes = method.planes(grid, np.zeros(3))
    supervoxels = method.supervoxels(grid, planes.normals, 21.0 * _SPACING, np.full(grid.n_voxels, -1, np.int32))
    method.supervoxel_of_point(points, grid, planes, supervoxels)
    seen = clean_cloud(image_of_a_step()[0], None, None).points
    every = np.arange(len(seen))
    DepthImage.of(seen, Pixels((len(seen), 1), every), np.zeros(3), None).flying()
    _compile_pixels()
    virtual_viewpoints._agreements(np.ones((1, 1), np.float32), np.ones((1, 1), np.float32))


def compile_the_rest() -> None:
    """Compile what it takes from supervoxels to objects, then the orientation.

    By then the other process has left in numba's cache what this needs of voxels.
    """
    _compile_graph_and_tree()
    grid = _step_in_voxels()[1]
    visible_sides(grid, np.zeros((grid.n_voxels, 3)))


def _compile_graph_and_tree() -> None:
    """Compile what it takes from supervoxels to objects."""
    places = np.array([[0.0, 0, 1], [0.1, 0, 1], [0.2, 0, 1], [1.2, 0.1, 1.1]])  # three in a row and one apart
    n = len(places)
    labels, each = np.arange(n, dtype=np.int32), np.arange(n)
    grid = VoxelGrid(
        size=0.1,
        warp=Warp(),
        cells=np.rint(places / 0.1),
        voxel_of_point=labels,
        order=each,
        starts=np.arange(n + 1),
        counts=np.ones(n, np.int64),
        warped=places,
        centroids=places,
        edge_lengths=np.full(n, 0.1),
        colors=None,
        indptr=np.array([0, 1, 3, 4, 4]),
        neighbours=np.array([1, 0, 2, 1], np.int32),
    )
    normals = np.tile([0.0, 0, -1], (n, 1))
    leaves = replace(moments_of_groups(places, places, labels, n), normals=normals)
    surface = Surface(grid, normals, labels)
    nodes, touching = node_features(leaves), contacts.contacts(surface)
    scanner = Scanner(Told(), np.zeros(3), 0.5)
    near = gaps(surface, nodes, touching.edges, scanner)
    hidden = continuations(surface, nodes, labels, scanner, np.zeros((1, 3)))
    graph = AdjacencyGraph(touching.edges, contacts.edge_features(nodes, touching), nodes, near, hidden)
    graph = replace(graph, bridges=bridges(surface, leaves.counts, graph.joined))
    segmentation_tree(RegionLinkage().merges(graph, leaves), leaves).cut(altitude=0.5)


def compile_levels() -> None:
    """Compile what voxels of several sizes take beside."""
    everywhere = Grading(np.array(list(np.ndindex(3, 3, 3))) - 1.0, np.ones(27, np.int8))
    grid = voxel_grid(image_of_a_step()[0].reshape(-1, 3), 3.5 * _SPACING, Warp(), everywhere)
    at_ends(grid, np.zeros(1, np.int64), np.zeros(grid.n_voxels, np.int64))


def _compile_pixels() -> None:
    """Compile what asks lists of points, of some size, for the pixels they are."""
    points = image_of_a_step()[0].reshape(-1, 3)
    even_steps(points, thinned(points, len(points) // 2, bounding_box(points)), 0, -1)  # x is even
    pixel_lattice._find_near(0, 1, points, points[0], _SPACING)
    pixel_lattice._sharpness(points[:_EDGE], points[:1])
    pixel_lattice._sharpen(points[:_EDGE], np.array([0.0, 0.0, 1.0]))
    pixels._find_pixels(0, 1, points, np.eye(3, 4), np.empty((2, 1), np.int64))


def image_of_a_step() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An image of a plane with a step in depth, so that there are edges, and its normals."""
    steps = _SPACING * np.arange(_EDGE)
    x, y = np.meshgrid(steps, steps)
    depth = np.where((x > steps[8]) & (y > steps[8]), 0.9, 1.0)  # metres
    return np.stack((x, y, depth), axis=-1), np.broadcast_to(np.array([0.0, 0.0, -1.0]), (_EDGE, _EDGE, 3))


def _step_in_voxels() -> tuple[NDArray[np.float64], VoxelGrid]:
    """The same as a list of points, and their voxels."""
    points = image_of_a_step()[0].reshape(-1, 3)
    warp = CameraWarp(np.zeros(3), 1.0)
    return points, with_means(voxel_grid(points, 3.5 * _SPACING, warp), np.full(points.shape, 0.5))


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Put the collection of cyclic garbage off: numba's many small objects make it an eighth of all compiling."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _is_cached(kernel: Any) -> bool:
    """Whether numba's cache has an index of this kernel, of this version of numba and not older than its source."""
    source = kernel.py_func.__code__
    try:
        written = Path(source.co_filename).stat().st_mtime
        names = Path(kernel.stats.cache_path).glob(f"*.{source.co_name}-{source.co_firstlineno}.*.nbi")
        return any(
            name.stat().st_mtime >= written and is_sound(name) and _version_of(name) == numba.__version__
            for name in names
        )
    except OSError:  # the source is no plain file, or another process clears the cache: nothing can be said
        return True


def _version_of(index: Path) -> object:
    """The version of numba that an index of its cache begins with."""
    with index.open("rb") as file:
        return pickle.load(file)  # as numba does


def _second_process() -> subprocess.Popen[bytes] | None:
    """The process that compiles the rest; None where there is but one thread, no interpreter to start, or where
    other processes of a pool are likely to compile too."""
    in_pool = multiprocessing.parent_process() is not None or "PYTEST_XDIST_WORKER" in os.environ
    if in_pool or config.NUMBA_NUM_THREADS < 2 or not Path(sys.executable or "").name.startswith("python"):
        return None
    code = "import gc; gc.disable(); from pcgraph.warmup import compile_the_rest; compile_the_rest()"
    paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
    quiet = subprocess.DEVNULL
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", code],
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            env={**os.environ, "PYTHONPATH": paths},
        )
    except OSError:
        return None
