# SPDX-License-Identifier: Apache-2.0
"""Steps of clustering voxels around seeds: distance, seeds, expansion, refinement, connectivity.

A clustering is `labels`, (v,) int32: the supervoxel of each voxel, -1 if it has none yet. Initial labels are those of
an earlier scan, and do not change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import renumber, root_of
from pcgraph.parallel import in_blocks, inlined, kernel, routine
from pcgraph.rounding import NEARLY_ZERO
from pcgraph.voxels.cells import cell_keys, sorted_keys, starts_of_runs
from pcgraph.voxels.column_evidence import autocorrelation
from pcgraph.voxels.grid import MAX_NEIGHBOURS, VoxelGrid
from pcgraph.voxels.warp import NormalTransform, warped_normal

EARLY_SWEEPS = 1.8
"""Times seed size over voxel size: count of sweeps in which supervoxels take voxels from each other, as in PCL."""
_REFINEMENTS = 2
"""Count of sweeps that refine boundaries. Chosen by eye; not varied. Without any, 62 of 66 domains change, and the mean
of all scores does by 0.0008, half of its standard error."""
_MAX_AUTOCORRELATION_OF_NOISE = 0.1
"""Autocorrelation, a fraction, up to which a column counts as noise, and does not count. Chosen by eye; not varied."""
_MIN_STEP_BETWEEN_SEEDS = 1.0
"""Least distance, voxel edges, of two parallel surfaces in one seed cell that have a seed each, because planes of
voxels are known to less than an edge. From 0.7 to 1 nothing changes by more than 0.002."""
_MIN_COSINE_OF_PARALLEL = 0.7
"""Least cosine between normals of parallel surfaces, 45 degrees: a fraction. Chosen by eye; not varied."""
_SAME_SQUARE = 1e-9
"""Relative difference, a fraction, up to which two squared distances are equal, so that rounding chooses no seed."""
_FEW_TOUCHED = 32
"""Voxels over those touched in a sweep, a ratio, from which on these few are looked at in the order in which they were
touched. Of more, all voxels are looked at in their order, because what lies together then is in the cache. Chosen by
eye."""


# --- the distance of a voxel to a supervoxel ---


class Metric(NamedTuple):
    """D = normal (1 - n . n') + color |c - c'| + spatial |x - x'| + plane rho(per_slack h) + feature |f - f'|.

    n, c, x and f are normal, colour, place and features of a voxel; primed ones are means of a supervoxel. The distance
    from the supervoxel's plane is h = |n' . (x - x')|. rho is Huber's loss: rho(t) = t^2 / 2 up to 1, t - 1/2 beyond.

    Attributes
    ----------
    spatial : float, 1 / metres
    normal, color : float
    two_sided : bool
        Whether opposite normals are the same: then |n . n'| counts.
    plane : float or None
        None without distances from planes.
    per_slack : float, 1 / metres
        One over the distance from a plane that noise may be.
    feature : float or None
        None without features.
    """

    spatial: float
    normal: float
    color: float
    two_sided: bool
    plane: float | None = None
    per_slack: float = 0.0
    feature: float | None = None


class VoxelGraph(NamedTuple):
    """Voxels, their neighbours and the metric of their distances, which all steps read and none changes.

    Attributes
    ----------
    features : (v, 9 + d) float64
        Rows of place in the warped space, unit normal, colour, and the features that were given, if any.
    indptr : (v + 1,) uint64
    neighbours : (e,) uint32
        Voxels around each voxel; see `pcgraph.voxels.grid.Neighbourhood`.
    metric : Metric
    slant : NormalTransform
        Transform of normals by the warp.
    """

    features: NDArray[np.float64]
    indptr: NDArray[np.uint64]
    neighbours: NDArray[np.uint32]
    metric: Metric
    slant: NormalTransform


def voxel_graph(grid: VoxelGrid, normals: NDArray[np.float64], metric: Metric) -> VoxelGraph:
    """Voxel graph of a grid, given the voxels' unit normals, (v, 3) float64.

    Each given feature is weighted by its spatial autocorrelation, so noise does not count.
    """
    n_given = 0 if grid.features is None else grid.features.shape[1]
    metric = metric._replace(feature=metric.feature if n_given else None)
    features = np.zeros((grid.n_voxels, 9 + n_given))
    features[:, :3], features[:, 3:6] = grid.warped, normals
    if grid.colors is not None:
        features[:, 6:9] = grid.colors
    if grid.features is not None:
        noise = _MAX_AUTOCORRELATION_OF_NOISE
        signal = np.maximum(autocorrelation(grid.features, grid) - noise, 0.0) / (1.0 - noise)
        features[:, 9:] = grid.features * signal
    return VoxelGraph(features, *grid.neighbourhood, metric, grid.warp.slant)


@routine
def distance(features: NDArray[np.float64], i: int, means: NDArray[np.float64], s: int, metric: Metric) -> float:
    """Distance D of voxel i to supervoxel s, given rows of `VoxelGraph.features` and of `set_means`."""
    x, y, z = features[i, 0] - means[s, 0], features[i, 1] - means[s, 1], features[i, 2] - means[s, 2]
    cosine = features[i, 3] * means[s, 3] + features[i, 4] * means[s, 4] + features[i, 5] * means[s, 5]
    r, g, b = features[i, 6] - means[s, 6], features[i, 7] - means[s, 7], features[i, 8] - means[s, 8]
    if metric.two_sided:
        cosine = abs(cosine)
    away, tint = np.sqrt(x * x + y * y + z * z), np.sqrt(r * r + g * g + b * b)
    total = metric.spatial * away + metric.normal * (1.0 - cosine) + metric.color * tint
    total += _off_plane(x, y, z, means, s, metric.plane, metric.per_slack)
    return total + _contrast(features, i, means, s, metric.feature)


@routine
def _off_plane(
    x: float, y: float, z: float, means: NDArray[np.float64], s: int, weight: float | None, per_slack: float
) -> float:
    """Term of D for the distance from the plane of supervoxel s, at (x, y, z) from its mean place."""
    if weight is None:  # known to the compiler
        return 0.0
    across = means.shape[1] - 3
    off = per_slack * abs(x * means[s, across] + y * means[s, across + 1] + z * means[s, across + 2])
    noise = min(off, 1.0)
    return weight * noise * (off - 0.5 * noise)


@routine
def _contrast(features: NDArray[np.float64], i: int, means: NDArray[np.float64], s: int, weight: float | None) -> float:
    """Term of D for the difference of voxel i and supervoxel s in the features that were given."""
    if weight is None:  # known to the compiler, so that clouds without features do not take time for them
        return 0.0
    squares = 0.0
    for column in range(9, features.shape[1]):
        squares += (features[i, column] - means[s, column]) ** 2
    return weight * np.sqrt(squares)


class Sums(NamedTuple):
    """Sums and means over the voxels of k supervoxels.

    Attributes
    ----------
    sums : (k, 10 + d) float64
        Of their features; column 9 is their number.
    means : (k, 9 + d + 3) float64
        See `set_means`.
    """

    sums: NDArray[np.float64]
    means: NDArray[np.float64]

    @classmethod
    def zeros(cls, voxels: VoxelGraph, n_supervoxels: int) -> Sums:
        """Sums and means of supervoxels that have no voxels yet."""
        columns = voxels.features.shape[1]
        return cls(np.zeros((n_supervoxels, columns + 1)), np.zeros((n_supervoxels, columns + 3)))


@routine
def sum_features(features: NDArray[np.float64], labels: NDArray[np.int32], sums: NDArray[np.float64]) -> None:
    """Add the features of each supervoxel's voxels to its sums, in voxel order."""
    for i in range(len(labels)):
        if labels[i] >= 0:
            add_features(features, i, sums, labels[i], 1.0)


@routine
def add_features(features: NDArray[np.float64], i: int, sums: NDArray[np.float64], s: int, sign: float) -> None:
    """Update the sums as voxel i joins supervoxel s (sign 1), or leaves it (sign -1)."""
    for column in range(9):
        sums[s, column] += sign * features[i, column]
    sums[s, 9] += sign
    for column in range(9, features.shape[1]):
        sums[s, column + 1] += sign * features[i, column]


@routine
def set_means(sums: NDArray[np.float64], means: NDArray[np.float64], slant: NormalTransform) -> None:
    """Set `means`, (k, 9 + d + 3), to the supervoxels' mean rows and warped normals; rows of empty ones do not change.

    Normals have unit length. Warped normals are those of `pcgraph.voxels.warp.NormalTransform`.
    """
    across = sums.shape[1] - 1
    for s in range(len(sums)):
        if sums[s, 9] > 0.0:
            # The sum is nearly zero if the normals cancel.
            length = max(np.sqrt(sums[s, 3] ** 2 + sums[s, 4] ** 2 + sums[s, 5] ** 2), NEARLY_ZERO)
            for column in range(9):
                means[s, column] = sums[s, column] / (length if 3 <= column < 6 else sums[s, 9])
            for column in range(9, across):
                means[s, column] = sums[s, column + 1] / sums[s, 9]
            x, y, z = means[s, 0], means[s, 1], means[s, 2]
            x, y, z = warped_normal(slant, x, y, z, means[s, 3], means[s, 4], means[s, 5])
            means[s, across], means[s, across + 1], means[s, across + 2] = x, y, z


# --- where supervoxels start ---


def seed_voxels(grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, two_sided: bool) -> NDArray[np.int32]:
    """Voxels from which supervoxels expand, (k,) int32, ascending; perhaps none.

    Each seed cell with enough voxels for a surface has one: the voxel nearest to the mean of the cell's voxels, of
    equals the first. Unless `two_sided`, voxels of the cell that face away from the seed, or lie on a parallel surface
    a voxel edge off its plane, are another surface. It has a seed of its own if they are enough.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals.
    seed_size : float, metres
        Their R_seed: edge length of the seed cells.
    two_sided : bool
        Whether opposite normals are the same.

    Notes
    -----
    Source: Papon et al. 2013, section 3.2. `expand` makes supervoxels of parts of the surface without a seed.
    """
    keys, _ = cell_keys(grid.warped / seed_size, seed_size)
    ordered, order = sorted_keys(keys)
    starts = starts_of_runs(ordered)
    ratio = seed_size / grid.size
    # A cell counts with a tenth of the voxels of a plane, or half of those of a line; chosen by eye, not varied.
    enough = min(0.1 * ratio * ratio, 0.5 * ratio)
    cells = order, starts, enough
    step = _MIN_STEP_BETWEEN_SEEDS * grid.size
    return np.sort(_seeds_of_cells(grid.warped, normals, grid.warp.slant, step, *cells, two_sided))


@kernel
def _seeds_of_cells(
    places: NDArray[np.float64],
    normals: NDArray[np.float64],
    slant: NormalTransform,
    step: float,
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    enough: float,
    two_sided: bool,
) -> NDArray[np.int32]:
    """One seed per cell, or two if surfaces face away from each other, or are a step apart."""
    seeds = np.empty(2 * (len(starts) - 1), np.int32)
    used = 0
    for cell in range(len(starts) - 1):
        members = order[starts[cell] : starts[cell + 1]]
        if len(members) < enough:
            continue
        seed = _nearest_to_mean(places, members)
        seeds[used] = seed
        used += 1
        if two_sided:
            continue
        others = 0
        for at in range(len(members)):  # voxels of another surface come to the front of the list
            i = members[at]
            if _on_another_surface(places, normals, slant, step, i, seed):
                members[others], members[at] = i, members[others]
                others += 1
        if others > 0 and others >= enough:
            seeds[used] = _nearest_to_mean(places, members[:others])
            used += 1
    return seeds[:used]


@inlined
def _on_another_surface(
    places: NDArray[np.float64], normals: NDArray[np.float64], slant: NormalTransform, step: float, i: int, seed: int
) -> bool:
    """Whether voxel i faces away from a seed, or lies on a parallel surface, a step off the seed's plane."""
    cosine = normals[i, 0] * normals[seed, 0] + normals[i, 1] * normals[seed, 1] + normals[i, 2] * normals[seed, 2]
    if cosine < _MIN_COSINE_OF_PARALLEL:
        return cosine < 0.0
    return _off(places, normals, slant, seed, i) > step and _off(places, normals, slant, i, seed) > step


@inlined
def _off(
    places: NDArray[np.float64], normals: NDArray[np.float64], slant: NormalTransform, i: int, other: int
) -> float:
    """Distance of another voxel from the plane of voxel i, in the warped space."""
    x, y, z = places[i, 0], places[i, 1], places[i, 2]
    a, b, c = warped_normal(slant, x, y, z, normals[i, 0], normals[i, 1], normals[i, 2])
    return abs(a * (places[other, 0] - x) + b * (places[other, 1] - y) + c * (places[other, 2] - z))


@routine
def _nearest_to_mean(places: NDArray[np.float64], members: NDArray[np.int64]) -> int:
    """Member nearest to the mean of all; of equals, as two members always are, the one of the smallest number."""
    n = len(members)
    x = y = z = 0.0
    for at in range(n):
        i = members[at]
        x, y, z = x + places[i, 0], y + places[i, 1], z + places[i, 2]
    x, y, z = x / n, y / n, z / n
    nearest, least = -1, np.inf
    for at in range(n):
        i = members[at]
        away = (places[i, 0] - x) ** 2 + (places[i, 1] - y) ** 2 + (places[i, 2] - z) ** 2
        if away < (1.0 - _SAME_SQUARE) * least or (away <= (1.0 + _SAME_SQUARE) * least and i < nearest):
            nearest, least = i, away
    return nearest


# --- expansion from seeds over touching voxels ---


def expand(
    voxels: VoxelGraph, seeds: NDArray[np.int32], sweeps: float, initial: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Label of each voxel, (v,) int32: that of the seed that reached it first, or in early sweeps of a nearer one.

    Connected parts of the grid without a seed become one supervoxel each.

    Parameters
    ----------
    voxels : VoxelGraph of v voxels
    seeds : (k,) int32
        Distinct voxels; voxels with an initial label are no seeds.
    sweeps : float
        Number of early sweeps, in which a voxel may go over to a nearer supervoxel.
    initial : (v,) int32
        Supervoxels that exist already. They keep their voxels, but may expand; -1 elsewhere.
    """
    early_sweeps = max(1, int(min(sweeps, 1e9)) - 1)
    seeds = seeds[initial[seeds] < 0]
    labels, n_initial = initial.copy(), int(initial.max()) + 1
    labels[seeds] = np.arange(n_initial, n_initial + len(seeds), dtype=np.int32)
    sums = Sums.zeros(voxels, n_initial + len(seeds))
    _expand(voxels, initial >= 0, labels, sums, early_sweeps)
    return labels


@kernel
def _expand(
    voxels: VoxelGraph,
    fixed: NDArray[np.bool_],
    labels: NDArray[np.int32],
    of_labels: Sums,
    early_sweeps: int,
) -> None:
    """Spread labels over all voxels that they reach; each connected part that none reaches gets a label of its own.

    Early sweeps may also take a voxel from a supervoxel that is farther from it.
    """
    features, indptr, neighbours, metric, slant = voxels
    n, (sums, means) = len(features), of_labels
    claim, best, frontier, touched = np.empty(n, np.int32), np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32)
    sum_features(features, labels, sums)
    n_frontier, sweep = 0, 0
    for i in range(n):
        claim[i], best[i] = -1, np.inf
        if labels[i] >= 0:
            best[i] = -1.0 if fixed[i] else 0.0  # no distance is below -1, so fixed voxels stay
            frontier[n_frontier] = i
            n_frontier += 1
    while n_frontier > 0:
        set_means(sums, means, slant)
        n_touched = 0
        for f in range(n_frontier):
            i = frontier[f]
            s = labels[i]
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if labels[j] == s or claim[j] == s or (labels[j] >= 0 and sweep >= early_sweeps):
                    continue
                d = distance(features, np.int64(j), means, s, metric)
                if d < best[j] or (d == best[j] and claim[j] > s):
                    if claim[j] < 0:
                        touched[n_touched] = j
                        n_touched += 1
                    best[j], claim[j] = d, s
        if n_touched > n // _FEW_TOUCHED:  # in the order of voxels, so that neighbours are in the cache
            n_touched = 0
            for j in range(n):
                touched[n_touched] = j
                n_touched += claim[j] >= 0
        for t in range(n_touched):
            j = np.int64(touched[t])
            if labels[j] >= 0:
                add_features(features, j, sums, labels[j], -1.0)
            add_features(features, j, sums, claim[j], 1.0)
            labels[j], claim[j] = claim[j], -1
        frontier, touched = touched, frontier
        n_frontier, sweep = n_touched, sweep + 1
    _label_the_rest(indptr, neighbours, labels, len(sums), frontier)


@routine
def _label_the_rest(indptr, neighbours, labels, n_supervoxels, stack):  # type: ignore[no-untyped-def]
    """Make each connected part of voxels without a label a supervoxel of its own."""
    for start in range(len(labels)):
        if labels[start] >= 0:
            continue
        labels[start], stack[0], depth = n_supervoxels, start, 1
        while depth > 0:
            depth -= 1
            i = stack[depth]
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if labels[j] < 0:
                    labels[j], stack[depth] = n_supervoxels, j
                    depth += 1
        n_supervoxels += 1


# --- refinement: supervoxels compete for the voxels on their boundaries ---


def refine(voxels: VoxelGraph, labels: NDArray[np.int32], fixed: NDArray[np.bool_]) -> None:
    """Move voxels on a boundary, in a few sweeps, to the nearest supervoxel that touches them.

    The first sweep looks at all voxels on a boundary, later ones at those next to a voxel that moved. All voxels of a
    sweep choose at once, by the means before it.

    Parameters
    ----------
    voxels : VoxelGraph of v voxels
    labels : (v,) int32, >= 0
        Supervoxel of each voxel; overwritten. Supervoxels may fall into pieces.
    fixed : (v,) bool
        Whether each voxel keeps its supervoxel.
    """
    queued = fixed.copy()
    sums, means = of_labels = Sums.zeros(voxels, int(labels.max()) + 1)
    active = _boundary(voxels, labels, fixed, of_labels)
    for _ in range(_REFINEMENTS):
        chosen = np.empty_like(active)
        in_blocks(_choose, len(active), active, voxels, labels, means, chosen)
        active = _move(active, chosen, voxels, labels, sums, means, queued)
        if not len(active):
            return


@kernel
def _boundary(
    voxels: VoxelGraph, labels: NDArray[np.int32], fixed: NDArray[np.bool_], of_labels: Sums
) -> NDArray[np.int32]:
    """Voxels that are not fixed and touch another supervoxel, ascending; sets sums and means of all supervoxels."""
    features, indptr, neighbours, _, slant = voxels
    found = np.empty(len(labels), np.int32)
    used = 0
    for i in range(len(labels)):
        if fixed[i]:
            continue
        for a in range(indptr[i], indptr[i + 1]):
            if labels[neighbours[a]] != labels[i]:
                found[used] = i
                used += 1
                break
    sums, means = of_labels
    sum_features(features, labels, sums)
    set_means(sums, means, slant)
    return found[:used]


@kernel
def _choose(
    start: int,
    stop: int,
    active: NDArray[np.int32],
    voxels: VoxelGraph,
    labels: NDArray[np.int32],
    means: NDArray[np.float64],
    chosen: NDArray[np.int32],
) -> None:
    """Set `chosen` to the nearest supervoxel around each active voxel: of equals its own, else the smaller number."""
    features, indptr, neighbours, metric, _ = voxels
    around = np.empty(MAX_NEIGHBOURS + 1, np.int32)
    for q in range(start, stop):
        i = np.int64(active[q])
        own = nearest = last = labels[i]
        n = 0
        for a in range(indptr[i], indptr[i + 1]):  # without a branch, which would often be mispredicted
            around[n] = labels[neighbours[a]]
            n += (around[n] != own) & (around[n] != last)
            last = labels[neighbours[a]]
        least = distance(features, i, means, own, metric) if n > 0 else 0.0
        for b in range(n):
            s = around[b]
            for earlier in range(b):
                if around[earlier] == s:
                    break
            else:
                d = distance(features, i, means, s, metric)
                if d < least or (d == least and nearest != own and s < nearest):
                    nearest, least = s, d
        chosen[q] = nearest


@kernel
def _move(
    active: NDArray[np.int32],
    chosen: NDArray[np.int32],
    voxels: VoxelGraph,
    labels: NDArray[np.int32],
    sums: NDArray[np.float64],
    means: NDArray[np.float64],
    queued: NDArray[np.bool_],
) -> NDArray[np.int32]:
    """Move each active voxel to its choice, and return the voxels to look at next, each once.

    These are the voxels that moved and those around them, but for fixed ones, which `queued` marks from the start.
    """
    features, indptr, neighbours, _, slant = voxels
    following = np.empty(len(labels), np.int32)
    used = 0
    for q in range(len(active)):
        i = np.int64(active[q])
        if labels[i] != chosen[q]:
            add_features(features, i, sums, labels[i], -1.0)
            add_features(features, i, sums, chosen[q], 1.0)
            labels[i] = chosen[q]
            first = np.int64(indptr[i])
            for a in range(first - 1, np.int64(indptr[i + 1])):
                j = i if a < first else np.int64(neighbours[a])
                if not queued[j]:
                    queued[j] = True
                    following[used] = j
                    used += 1
    for q in range(used):
        queued[following[q]] = False
    set_means(sums, means, slant)
    return following[:used]


# --- connectivity: every supervoxel in one piece ---


def enforce_connectivity(
    voxels: VoxelGraph, labels: NDArray[np.int32], initial: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Connected supervoxels, (v,) int32, renumber in the order of their first voxel.

    Each supervoxel keeps its initial piece, or else its largest. Voxels of other pieces go, ring by ring, to the
    nearest supervoxel that touches them.

    Parameters
    ----------
    voxels : VoxelGraph of v voxels
    labels : (v,) int32, >= 0
        Supervoxels, which may be in pieces.
    initial : (v,) int32
        Supervoxels that exist already, each in one piece. They keep their numbers and voxels; -1 elsewhere.
    """
    names = np.full(int(labels.max()) + 1, -1, np.int32)
    n_initial = int(initial.max()) + 1
    names[:n_initial] = np.arange(n_initial)
    n, n_supervoxels = len(labels), len(names)
    pieces = _Pieces(
        np.arange(n, dtype=np.int32), np.empty(n, np.int32), np.zeros(n, np.int64), np.full(n_supervoxels, -1)
    )
    _connect(voxels, labels, initial >= 0, pieces, Sums.zeros(voxels, n_supervoxels), names, n_initial)
    return pieces.of_voxel


class _Pieces(NamedTuple):
    """Connected pieces of supervoxels; each is known by its first voxel.

    Attributes
    ----------
    links : (v,) int32
        Voxels, each its own piece at first; see `pcgraph.disjoint_sets`.
    of_voxel : (v,) int32
        The piece, and later the label, of each voxel.
    sizes : (v,) int64
        Of pieces, zero at first.
    largest : (k,) int64
        Piece of each supervoxel, -1 at first.
    """

    links: NDArray[np.int32]
    of_voxel: NDArray[np.int32]
    sizes: NDArray[np.int64]
    largest: NDArray[np.int64]


@kernel
def _connect(
    voxels: VoxelGraph,
    labels: NDArray[np.int32],
    fixed: NDArray[np.bool_],
    pieces: _Pieces,
    of_labels: Sums,
    names: NDArray[np.int32],
    used: int,
) -> None:
    """Set connected labels by their names, (n_supervoxels,) int32; the `used` first have one, the others, -1, get the
    next in the order of voxels."""
    connected = pieces.of_voxel
    _set_largest_pieces(voxels, labels, fixed, pieces)
    _adopt(voxels, connected, of_labels)
    renumber(connected, names, used)


@routine
def _set_largest_pieces(
    voxels: VoxelGraph, labels: NDArray[np.int32], fixed: NDArray[np.bool_], pieces: _Pieces
) -> None:
    """Set the label of each voxel in its supervoxel's fixed piece, or largest one (the first of equals); else -1."""
    indptr, neighbours = voxels.indptr, voxels.neighbours
    links, piece, sizes, largest = pieces
    n = len(labels)
    for i in range(n):
        root = i
        for a in range(indptr[i], indptr[i + 1]):
            if neighbours[a] > i:
                break
            if labels[neighbours[a]] == labels[i] and links[neighbours[a]] != root:
                other = root_of(links, np.int64(neighbours[a]))
                links[max(root, other)] = min(root, other)
                root = min(root, other)
    for i in range(n):
        piece[i] = root_of(links, i)
        sizes[piece[i]] += n if fixed[i] else 1  # a fixed voxel outweighs all others
    for i in range(n):
        s = labels[i]
        if piece[i] == i and (largest[s] < 0 or sizes[i] > sizes[largest[s]]):
            largest[s] = i
    for i in range(n):
        piece[i] = labels[i] if piece[i] == largest[labels[i]] else -1


@routine
def _adopt(voxels: VoxelGraph, labels: NDArray[np.int32], of_labels: Sums) -> None:
    """Give every voxel without a label, ring by ring, the nearest label around it."""
    features, indptr, neighbours, metric, slant = voxels
    sums, means = of_labels
    sum_features(features, labels, sums)
    set_means(sums, means, slant)
    waiting, adopted = np.empty(len(labels), np.int32), np.empty(len(labels), np.int32)
    n_waiting = 0
    for i in range(len(labels)):
        if labels[i] < 0:
            waiting[n_waiting] = i
            n_waiting += 1
    while n_waiting > 0:
        for w in range(n_waiting):
            adopted[w] = _nearest_label(np.int64(waiting[w]), features, metric, indptr, neighbours, labels, means)
        left = 0
        for w in range(n_waiting):
            if adopted[w] >= 0:
                labels[waiting[w]] = adopted[w]
            else:
                waiting[left] = waiting[w]
                left += 1
        n_waiting = left


@routine
def _nearest_label(i, features, metric, indptr, neighbours, labels, means):  # type: ignore[no-untyped-def]
    """Nearest label around voxel i, of equals the smaller; -1 if there is none."""
    nearest, least = -1, np.inf
    for a in range(indptr[i], indptr[i + 1]):
        s = labels[neighbours[a]]
        if s >= 0:
            d = distance(features, i, means, s, metric)
            if d < least or (d == least and s < nearest):
                nearest, least = s, d
    return nearest
