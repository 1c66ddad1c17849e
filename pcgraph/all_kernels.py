# SPDX-License-Identifier: Apache-2.0
"""Compiling the kernels of `pcgraph.segment` ahead of its first call.

Without this, each kernel is compiled when it is first called. Either way it is done once per installation
(`pcgraph.kernel_cache`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
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
from pcgraph.scan import segment
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.tree import segmentation_tree
from pcgraph.voxels import virtual_viewpoints
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.grading import Grading
from pcgraph.voxels.grid import VoxelGrid, at_ends, voxel_grid, with_means
from pcgraph.voxels.outliers import outlier_voxels
from pcgraph.voxels.sampling import some_blocks, thinned
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import visible_fraction, visible_sides
from pcgraph.voxels.warp import CameraWarp, Warp

_EDGE = 24
"""Count of points along each edge of the small clouds. Chosen by eye; not varied."""
_SPACING = 0.01
"""Distance of neighbouring points, metres. Chosen by eye; not varied."""


@cache
def compile_kernels() -> None:
    """Compile what `pcgraph.segment` would otherwise compile in its first calls, with its defaults.

    A process does so once; further calls do nothing. It segments two small clouds, one as a camera's image and one as a
    list, and calls what these two do not reach.
    Results are the same without it.
    """
    image, normals = _image_of_a_step()
    segment(image, np.full(image.shape, 0.5), normals, (0.0, 0.0, 0.0))
    segment(image.reshape(-1, 3))
    _compile_voxels()
    _compile_graph_and_tree()
    _compile_pixels()
    _compile_levels()


def _image_of_a_step() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An image of a plane with a step in depth, so that there are edges, and its normals."""
    steps = _SPACING * np.arange(_EDGE)
    x, y = np.meshgrid(steps, steps)
    depth = np.where((x > steps[8]) & (y > steps[8]), 0.9, 1.0)  # metres
    return np.stack((x, y, depth), axis=-1), np.broadcast_to(np.array([0.0, 0.0, -1.0]), (_EDGE, _EDGE, 3))


def _compile_voxels() -> None:
    """Compile what larger clouds take from points to oriented voxels."""
    points = _image_of_a_step()[0].reshape(-1, 3)
    grid = with_means(voxel_grid(points, 3.5 * _SPACING, CameraWarp(np.zeros(3), 1.0)), np.full(points.shape, 0.5))
    some_blocks(points)
    spacing_law(points)
    outlier_voxels(grid)
    at_ends(grid, np.zeros(1, np.int64), np.zeros(grid.n_voxels, np.int64))
    visible_fraction(grid, np.zeros(3))
    visible_sides(grid, np.zeros((grid.n_voxels, 3)))
    virtual_viewpoints._agreements(np.ones((1, 1), np.float32), np.ones((1, 1), np.float32))


def _compile_graph_and_tree() -> None:
    """Compile what it takes from supervoxels to objects, where gaps and bridges join them."""
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


def _compile_pixels() -> None:
    """Compile what asks lists of points, of some size, for the pixels they are, and images for points that fly."""
    points = _image_of_a_step()[0].reshape(-1, 3)
    even_steps(points, thinned(points, len(points) // 2, bounding_box(points)), 0, -1)  # x is even
    pixel_lattice._find_near(0, 1, points, points[0], _SPACING)
    pixel_lattice._sharpness(points[:_EDGE], points[:1])
    pixel_lattice._sharpen(points[:_EDGE], np.array([0.0, 0.0, 1.0]))
    pixels._find_pixels(0, 1, points, np.eye(3, 4), np.empty((2, 1), np.int64))
    seen = clean_cloud(points.reshape(_EDGE, _EDGE, 3), None, None).points
    DepthImage.of(seen, Pixels((len(seen), 1), np.arange(len(seen))), np.zeros(3), None).flying()


def _compile_levels() -> None:
    """Compile what voxels of several sizes take beside."""
    everywhere = Grading(np.array(list(np.ndindex(3, 3, 3))) - 1.0, np.ones(27, np.int8))
    grid = voxel_grid(_image_of_a_step()[0].reshape(-1, 3), 3.5 * _SPACING, Warp(), everywhere)
    at_ends(grid, np.zeros(1, np.int64), np.zeros(grid.n_voxels, np.int64))
