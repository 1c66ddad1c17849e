# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over the cells of the projector's image and the triangles that they make.

The image is divided into blocks. A block has 3 x 3 points, four cells between them, and may be divided into four blocks
of half the size. `step` is the distance between its points on the finest lattice, `columns` the number of lattice
points in a row. Landings of the same point are a linked list: `head` of the point, then `after`.
"""

from __future__ import annotations

import numpy as np

from pcgraph.kernel_cache import cached_njit

EMPTY = -1
"""Entry of a hash table that holds no key."""
HASH = -7046029254386353131
"""Factor of the hash of 64 bits: 2^64 divided by the golden ratio, rounded to an odd number, as a signed one."""
MIN_NORMAL_COSINE = 0.9
"""Smallest cosine between the normals at two points of a cell (26 degrees), so that no triangle lies across an edge of
the receiver."""
MIN_TILT_COSINE = 0.7
"""Smallest cosine between a triangle's normal and the receiver's, so that no triangle reaches from a surface to another
part of the same shape behind it."""
MIN_FOOTPRINT = 0.1
"""Smallest size of a pixel where it lands, as a fraction of its size without glass, for which cells are refined: light
in a focus is not followed any finer."""
FLAT_COSINE = 1 - 1e-6
"""Cosine between the normals at the corners of a triangle, above which its receiver counts as flat: rounding alone."""
MAX_UNEVENNESS = 0.05
"""Largest difference between the fraction of the light that is left in the middle of a line and its mean at the ends,
relative to it, within a block, so that a picture in coloured glass is as sharp as pixels."""
POINTS = 8
"""Number of points among which the area of a triangle as large as the face of a cube is dealt out, see `crowd_of`, so
that the count is right within a third."""
MAX_POINTS = 512
"""Largest number of these points for a triangle, so that a few large triangles do not take most of the time."""
MAX_DIVISIONS = 8
"""Largest number of times that a triangle is divided until it is small as seen from the projector, see
`lit_directions`: enough for one that is as large as half of the sphere of directions."""
MAX_WIDTH = 3
"""Largest difference of the cubes along an axis in which the directions to a small triangle lie."""
MAX_SPREAD = 2.0
"""Largest ratio between the areas over which equal light spreads within a block; with a smaller ratio more blocks are
divided."""


@cached_njit(nogil=True, error_model="numpy")
def place_in(table, key):  # type: ignore[no-untyped-def]
    """Place of a key in a hash table, or of the free entry where it belongs."""
    mask = len(table) - 1
    mixed = np.int64(key) * np.int64(HASH)
    i = (mixed ^ (mixed >> np.int64(29))) & mask
    while table[i] != EMPTY and table[i] != key:
        i = (i + 1) & mask
    return i


@cached_njit(nogil=True, error_model="numpy")
def new_points(table, value, x, y, step, columns, first):  # type: ignore[no-untyped-def]
    """(n,) int64, lattice points of blocks that are not in the table yet; they are put there with the numbers from
    `first` on."""
    found = np.empty(9 * len(x), np.int64)
    n = 0
    for b in range(len(x)):
        for q in range(9):
            point = (y[b] + q // 3 * step) * columns + x[b] + q % 3 * step
            i = place_in(table, point)
            if table[i] == EMPTY:
                table[i] = point
                value[i] = first + n
                found[n] = point
                n += 1
    return found[:n]


@cached_njit(nogil=True, error_model="numpy")
def larger(table, value, size):  # type: ignore[no-untyped-def]
    """A copy of a hash table with its values that has `size` entries, a power of two."""
    keys, values = np.full(size, EMPTY, np.int64), np.empty(size, np.int64)
    for i in range(len(table)):
        if table[i] != EMPTY:
            j = place_in(keys, table[i])
            keys[j] = table[i]
            values[j] = value[i]
    return keys, values


@cached_njit(nogil=True, error_model="numpy")
def linked(point, points):  # type: ignore[no-untyped-def]
    """The linked lists of the landings of each point: `head` (points,) and `after` (landings,)."""
    head, after = np.full(points, -1, np.int64), np.empty(len(point), np.int64)
    for i in range(len(point)):
        after[i] = head[point[i]]
        head[point[i]] = i
    return head, after


@cached_njit(nogil=True, error_model="numpy")
def _with_key(head, after, key, point, wanted):  # type: ignore[no-untyped-def]
    """The landing of a point that has a key; -1 if there is none."""
    i = head[point]
    while i >= 0 and key[i] != wanted:
        i = after[i]
    return i


@cached_njit(nogil=True, error_model="numpy")
def triangle_area(position, a, b, c):  # type: ignore[no-untyped-def]
    """Area of the triangle of three landings, m2."""
    ux, uy, uz = (
        position[b, 0] - position[a, 0],
        position[b, 1] - position[a, 1],
        position[b, 2] - position[a, 2],
    )
    vx, vy, vz = (
        position[c, 0] - position[a, 0],
        position[c, 1] - position[a, 1],
        position[c, 2] - position[a, 2],
    )
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return 0.5 * np.sqrt(x * x + y * y + z * z)


@cached_njit(nogil=True, error_model="numpy")
def _cosine(normal, a, b):  # type: ignore[no-untyped-def]
    return normal[a, 0] * normal[b, 0] + normal[a, 1] * normal[b, 1] + normal[a, 2] * normal[b, 2]


@cached_njit(nogil=True, error_model="numpy")
def _is_even(a, b, landings, rule):  # type: ignore[no-untyped-def]
    """Whether a receiver is so even between two landings that it is hardly higher than the line between them.

    Its height is the length of the line times the angle between the normals over 8.
    """
    cosine, line, distance = _cosine(landings.normal, a, b), 0.0, 0.0
    for k in range(3):
        line += (landings.position[a, k] - landings.position[b, k]) ** 2
        distance += (landings.position[a, k] - rule.projector_at[k]) ** 2
    return cosine >= MIN_NORMAL_COSINE and line * (2 - 2 * cosine) <= 64 * rule.sag * rule.sag * distance


@cached_njit(nogil=True, error_model="numpy")
def _off_middle(position, m, a, b):  # type: ignore[no-untyped-def]
    """Squared distance of landing m from the middle between a and b."""
    total = 0.0
    for k in range(3):
        d = position[m, k] - 0.5 * (position[a, k] + position[b, k])
        total += d * d
    return total


@cached_njit(nogil=True, error_model="numpy")
def _is_faint(r, landings, pixels, rule):  # type: ignore[no-untyped-def]
    """Whether the light of one chain over a block is faint. r : (9,) int64, landings. pixels : edge of the block."""
    area, plain = 0.0, (rule.pixel_m + rule.pixel_rad * landings.length[r[4]]) * pixels
    for q in (0, 1, 3, 4):
        area += triangle_area(landings.position, r[q], r[q + 1], r[q + 4])
        area += triangle_area(landings.position, r[q], r[q + 4], r[q + 3])
    return landings.part[r[4]] * plain * plain < rule.faint * area


@cached_njit(nogil=True, error_model="numpy")
def _is_smooth(r, landings, pixels, rule):  # type: ignore[no-untyped-def]
    """Whether light of one chain is so even over a block that triangles between its nine points describe it.

    r : (9,) int64, landings of the points, row by row.
    pixels : edge of the block in pixels. rule : Rule. Faint light only has to land on an even receiver.
    """
    position, length, part = landings.position, landings.length, landings.part
    for k in (0, 2, 6, 8):
        if not _is_even(r[k], r[4], landings, rule):
            return False
    total, low, high = 0.0, np.inf, 0.0
    for q in (0, 1, 3, 4):
        size = triangle_area(position, r[q], r[q + 1], r[q + 4]) + triangle_area(position, r[q], r[q + 4], r[q + 3])
        total += size
        low, high = min(low, size), max(high, size)
    plain = rule.pixel_m + rule.pixel_rad * length[r[4]]
    off, uneven = 0.0, 0.0
    for m, a, b in ((1, 0, 2), (3, 0, 6), (5, 2, 8), (7, 6, 8), (4, 0, 8), (4, 2, 6)):
        off = max(off, _off_middle(position, r[m], r[a], r[b]))
        uneven = max(uneven, abs(part[r[m]] - 0.5 * (part[r[a]] + part[r[b]])))
    if _is_faint(r, landings, pixels, rule):
        return np.sqrt(off) < 0.25 * np.sqrt(total)
    footprint = min(max(np.sqrt(total) / pixels, MIN_FOOTPRINT * plain), plain)
    if uneven > MAX_UNEVENNESS * part[r[4]]:
        return False
    return high <= MAX_SPREAD * low and np.sqrt(off) <= 4 * rule.tolerance * footprint  # cells are half a block


@cached_njit(nogil=True, error_model="numpy")
def _name(x, y, size, columns, key):  # type: ignore[no-untyped-def]
    """Number of a pair of a chain and a block, whose `size` is the distance of its points, or a cell, whose `size` is
    minus its edge."""
    level = 0 if size > 0 else 16
    size = abs(size)
    while size > 0:
        level += 1
        size >>= 1
    return ((np.int64(y) * columns + x) * 32 + level) << np.int64(32) | np.int64(key)


@cached_njit(nogil=True, error_model="numpy")
def is_taken(taken, x, y, step, columns, coarsest, key):  # type: ignore[no-untyped-def]
    """Whether the block with points at the distance `step` that holds a lattice point, or a block around it, has made
    triangles of a chain."""
    size = step
    while size <= coarsest:
        block = 2 * size
        if taken[place_in(taken, _name(x // block * block, y // block * block, size, columns, key))] != EMPTY:
            return True
        size *= 2
    return False


@cached_njit(nogil=True, error_model="numpy")
def _with_room(taken, used):  # type: ignore[no-untyped-def]
    """The set `taken` with room for more than its `used` entries."""
    if 2 * used < len(taken):
        return taken
    copy = np.full(2 * len(taken), EMPTY, np.int64)
    for name in taken:
        if name != EMPTY:
            copy[place_in(copy, name)] = name
    return copy


@cached_njit(nogil=True, error_model="numpy")
def _longer(array, room):  # type: ignore[no-untyped-def]
    """The array if it has so many rows, or a copy that is twice as long."""
    if room <= len(array):
        return array
    copy = np.empty((2 * len(array) + room, array.shape[1]), array.dtype)
    copy[: len(array)] = array
    return copy


@cached_njit(nogil=True, error_model="numpy")
def _write(triangles, flux, n, a, b, c, part, half_cell):  # type: ignore[no-untyped-def]
    """Write the triangle of three landings and its flux to row n; returns the number of the next row.

    `half_cell` is the area of the triangle in the image, in pixels.
    """
    triangles[n, 0], triangles[n, 1], triangles[n, 2] = a, b, c
    flux[n, 0] = half_cell * (part[a] + part[b] + part[c]) / 3
    return n + 1


@cached_njit(nogil=True, error_model="numpy")
def smooth_chains(blocks, grid, landings, rule, taken):  # type: ignore[no-untyped-def]
    """Make triangles of the chains that are smooth over a block.

    blocks : Blocks. grid : Lattice. landings : Chains. rule : Rule.
    taken : the set of names of blocks and chains that have triangles.

    Returns
    -------
    triangles : (8 p, 3) int64, landings, eight for each of p pairs of a block and a chain.
    flux : (8 p, 1) float64, pixels of the projector.
    pairs : (p, 3) int64, index of the block, key of the chain, and whether it is faint.
    parts : (p, 1) float64, fraction of the light of the block in the chain.
    rest : (n,) float64, fraction of the light of each block in all other chains.
    is_dark : (n,) bool, whether no light of the block's points lands.
    """
    x, y, step = blocks.x, blocks.y, blocks.step
    triangles, flux = np.empty((1024, 3), np.int64), np.empty((1024, 1), np.float64)
    pairs, parts = np.empty((128, 3), np.int64), np.empty((128, 1), np.float64)
    rest, is_dark, n = np.zeros(len(x)), np.ones(len(x), np.bool_), 0
    points, r = np.empty(9, np.int64), np.empty(9, np.int64)
    half_cell = 0.125 * blocks.pixels**2
    for b in range(len(x)):
        for q in range(9):
            points[q] = grid.value[place_in(grid.table, (y[b] + q // 3 * step) * grid.columns + x[b] + q % 3 * step)]
        for q in range(9):
            i = grid.head[points[q]]
            is_dark[b] &= i < 0
            while i >= 0:
                key, is_new = landings.key[i], True
                for p in range(q):
                    if _with_key(grid.head, grid.after, landings.key, points[p], key) >= 0:
                        is_new = False
                        break
                i = grid.after[i]
                if not is_new or is_taken(taken, x[b], y[b], step, grid.columns, grid.coarsest, key):
                    continue
                found, part = 0, 0.0
                for p in range(9):
                    r[p] = _with_key(grid.head, grid.after, landings.key, points[p], key)
                    if r[p] >= 0:
                        found += 1
                        part += landings.part[r[p]] / 9
                if found < 9 or not _is_smooth(r, landings, blocks.pixels, rule):
                    rest[b] += part
                else:
                    pairs, parts = _longer(pairs, n // 8 + 1), _longer(parts, n // 8 + 1)
                    pairs[n // 8, 0], pairs[n // 8, 1] = b, key
                    pairs[n // 8, 2], parts[n // 8, 0] = _is_faint(r, landings, blocks.pixels, rule), part
                    triangles, flux = _longer(triangles, n + 8), _longer(flux, n + 8)
                    for k in (0, 1, 3, 4):
                        for c, d in ((k + 1, k + 4), (k + 4, k + 3)):
                            n = _write(triangles, flux, n, r[k], r[c], r[d], landings.part, half_cell)
    return triangles[:n], flux[:n], pairs[: n // 8], parts[: n // 8], rest, is_dark


@cached_njit(nogil=True, error_model="numpy")
def with_names(pairs, x, y, size, columns, taken, used):  # type: ignore[no-untyped-def]
    """The set `taken` with the names of pairs of a block or a cell and a chain, see `_name`; and its size."""
    for pair in range(len(pairs)):
        taken = _with_room(taken, used)
        b = pairs[pair, 0]
        name = _name(x[b], y[b], size, columns, pairs[pair, 1])
        taken[place_in(taken, name)] = name
        used += 1
    return taken, used


@cached_njit(nogil=True, error_model="numpy")
def cells_of(blocks, grid, landings, rule, dropped, taken):  # type: ignore[no-untyped-def]
    """Make triangles of what is left in the cells of blocks that are not divided.

    dropped : (points,) float64, fraction of the light of each point that was not followed.

    Returns
    -------
    triangles, flux, pairs, parts : as `smooth_chains`, but two triangles for each pair of a cell and a chain.
    left : (4 n,) float64, fraction of the light of each cell that has made no triangles, as its corners tell.
    is_dark : (4 n,) bool, whether no light of the cell's corners lands.
    """
    x, y, step = blocks.x, blocks.y, blocks.step
    triangles, flux = np.empty((1024, 3), np.int64), np.empty((1024, 1), np.float64)
    pairs, parts = np.empty((128, 3), np.int64), np.empty((128, 1), np.float64)
    left, is_dark, n = np.zeros(4 * len(x), np.float64), np.ones(4 * len(x), np.bool_), 0
    corners, r = np.empty(4, np.int64), np.empty(4, np.int64)
    half_cell = 0.125 * blocks.pixels**2
    for cell in range(4 * len(x)):
        cx, cy = x[cell >> 2] + (cell & 1) * step, y[cell >> 2] + (cell >> 1 & 1) * step
        for q in range(4):
            corners[q] = grid.value[place_in(grid.table, (cy + (q >> 1) * step) * grid.columns + cx + (q & 1) * step)]
        first = n // 2
        for q in range(4):
            left[cell] += 0.25 * dropped[corners[q]]
            i = grid.head[corners[q]]
            is_dark[cell] &= i < 0
            while i >= 0:
                key = landings.key[i]
                this, i = i, grid.after[i]
                if is_taken(taken, cx, cy, step, grid.columns, grid.coarsest, key):
                    continue
                is_paired = False
                for pair in range(first, n // 2):
                    is_paired |= pairs[pair, 1] == key
                if is_paired:
                    continue
                if q == 0:
                    is_whole = True
                    for p in range(4):
                        r[p] = _with_key(grid.head, grid.after, landings.key, corners[p], key)
                        is_whole &= r[p] >= 0
                    if is_whole and _lies_flat(r, landings, rule):
                        pairs, parts = _longer(pairs, n // 2 + 1), _longer(parts, n // 2 + 1)
                        pairs[n // 2, 0], pairs[n // 2, 1] = cell, key
                        pairs[n // 2, 2] = False
                        parts[n // 2, 0] = 0.25 * landings.part[r].sum()
                        triangles, flux = _longer(triangles, n + 2), _longer(flux, n + 2)
                        for c, d in ((1, 3), (3, 2)):
                            n = _write(triangles, flux, n, r[0], r[c], r[d], landings.part, half_cell)
                        continue
                left[cell] += 0.25 * landings.part[this]
    return triangles[:n], flux[:n], pairs[: n // 2], parts[: n // 2], left, is_dark


@cached_njit(nogil=True, error_model="numpy")
def _lies_flat(r, landings, rule):  # type: ignore[no-untyped-def]
    """Whether the two triangles of the corners of a cell lie on the receiver."""
    position, normal = landings.position, landings.normal
    for k in (1, 2, 3):
        if not _is_even(r[0], r[k], landings, rule):
            return False
    for c, d in ((1, 3), (3, 2)):
        ux, uy, uz = position[r[c]] - position[r[0]]
        vx, vy, vz = position[r[d]] - position[r[0]]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        n = normal[r[0]]
        along = abs(nx * n[0] + ny * n[1] + nz * n[2])
        if not along * along > MIN_TILT_COSINE * MIN_TILT_COSINE * (nx * nx + ny * ny + nz * nz):
            return False
    return True


@cached_njit(nogil=True, error_model="numpy")
def last_ways(triangles, landings, rule, side, nearest, flat):  # type: ignore[no-untyped-def]
    """Rays along the last segment of light that lands in cells, which are pairs of triangles as `cells_of` makes them.

    The places shift from row to row and from column to column by the golden ratio, as those of `CellGrid.probes`, so
    that no line along rows or columns passes all of them by.

    Parameters
    ----------
    triangles : (2 c, 3) int64. landings : Chains. rule : Rule. side : number of rays along each side of a cell.
    nearest : fraction of the segment after which a ray starts.
    flat : largest height of a flat receiver over where light lands, as a fraction of that of a curved one.

    Returns
    -------
    rays : (c side^2, 8) float32, origin, direction, distance to where the light lands, and the largest difference to
        that of the receiver, metres.
    """
    rays, n, golden = np.empty((len(triangles) // 2 * side * side, 8), np.float32), 0, 0.6180339887498949
    weights, corners = np.empty(4), np.empty(4, np.int64)
    for cell in range(len(triangles) // 2):
        corners[0], corners[1], corners[2] = triangles[2 * cell]
        corners[3] = triangles[2 * cell + 1, 2]
        height = rule.sag
        if min([_cosine(landings.normal, corners[0], corners[k]) for k in range(1, 4)]) > FLAT_COSINE:
            height *= flat
        for k in range(side * side):
            i, j = k % side, k // side
            a, b = (i + golden * (j + cell + 1) % 1.0) / side, (j + golden * (i + 3 * cell + 2) % 1.0) / side
            weights[0], weights[1] = 1 - max(a, b), max(a - b, 0.0)
            weights[2], weights[3] = min(a, b), max(b - a, 0.0)
            way, slope, size, distance = 0.0, 0.0, 0.0, 0.0
            for axis in range(3):
                p, d, m = 0.0, 0.0, 0.0
                for corner in range(4):
                    p += weights[corner] * landings.position[corners[corner], axis]
                    d += weights[corner] * landings.direction[corners[corner], axis]
                    m += weights[corner] * landings.normal[corners[corner], axis]
                rays[n, axis], rays[n, 3 + axis] = p, d
                slope += d * m
                size += d * d
                distance += (p - rule.projector_at[axis]) ** 2
            size = np.sqrt(size)
            for corner in range(4):
                way += weights[corner] * landings.last[corners[corner]]
            way *= 1 - nearest
            for axis in range(3):
                rays[n, 3 + axis] /= size
                rays[n, axis] -= way * rays[n, 3 + axis]
            rays[n, 6], rays[n, 7] = way, height * np.sqrt(distance) * size / max(abs(slope), 1e-3)
            n += 1
    return rays


# ---- Photons ---------------------------------------------------------------------------------------------


@cached_njit(nogil=True, error_model="numpy")
def sides_of_photons(cells, step, photons, columns, coarsest, landings, taken):  # type: ignore[no-untyped-def]
    """The landings of photons whose light is in no triangle, and how their light spreads.

    Photon i belongs to cell i of `cells`, and is point 3 i of `photons`; the points 3 i + 1 and 3 i + 2 lie a little to
    the right of it and below it.

    Parameters
    ----------
    cells : (n, 2) int64, lattice coordinates. step : (n,) int64, their edges on the lattice.
    photons : Lists of the landings of the points. landings : Chains.

    Returns
    -------
    which : (m, 3) int64, landings, and those of the same chain to their right and below them; -1 if there are none.
    """
    which, n = np.empty((len(landings.key), 3), np.int64), 0
    for i in range(len(cells)):
        x, y = cells[i]
        this = photons.head[3 * i]
        while this >= 0:
            key = landings.key[this]
            name = _name(x, y, -step[i], columns, key)
            if taken[place_in(taken, name)] == EMPTY and not is_taken(taken, x, y, step[i], columns, coarsest, key):
                which[n, 0] = this
                which[n, 1] = _with_key(photons.head, photons.after, landings.key, 3 * i + 1, key)
                which[n, 2] = _with_key(photons.head, photons.after, landings.key, 3 * i + 2, key)
                n += 1
            this = photons.after[this]
    return which[:n]


# ---- Vertices and triangles ------------------------------------------------------------------------------


@cached_njit(nogil=True, error_model="numpy")
def irradiance_of(triangles, flux, position, vertices):  # type: ignore[no-untyped-def]
    """Irradiance at the vertices (vertices,) float64, what it is to be multiplied by within each triangle (t,) float64,
    and the area of each triangle (t,) float64, m2.

    A vertex has the flux of its triangles over their area. The irradiance within a triangle is interpolated between its
    vertices and multiplied by a number, so that the triangle carries exactly its flux.
    """
    at_vertex, area_of = np.zeros(vertices), np.zeros(vertices)
    scale, areas = np.empty(len(triangles)), np.empty(len(triangles))
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        area = triangle_area(position, a, b, c)
        areas[t] = area
        for k in range(3):
            at_vertex[triangles[t, k]] += flux[t]
            area_of[triangles[t, k]] += area
    for i in range(vertices):
        at_vertex[i] = at_vertex[i] / area_of[i] if area_of[i] > 0 else 0.0
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        mean = (at_vertex[a] + at_vertex[b] + at_vertex[c]) / 3
        scale[t] = flux[t] / (areas[t] * mean) if areas[t] * mean > 0 else 0.0
    return at_vertex, scale, areas


@cached_njit(nogil=True, error_model="numpy")
def uniform(number):  # type: ignore[no-untyped-def]
    """A number in 0..1 that depends on a whole number alone, as evenly spread as a random one (the last step of
    SplitMix64: Steele, Lea, Flood: Fast splittable pseudorandom number generators, OOPSLA 2014)."""
    x = np.uint64(number)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float64((x ^ (x >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0  # 2^53


@cached_njit(nogil=True, error_model="numpy")
def _names_of(triangles, key, image):  # type: ignore[no-untyped-def]
    """(t,) uint64, a number for each triangle that depends on its chain and on its place in the image alone."""
    names = np.empty(len(triangles), np.uint64)
    for t in range(len(triangles)):
        name = np.uint64(key[t])
        for k in range(2):
            name = name * np.uint64(0x9E3779B97F4A7C15) + np.uint64(image[triangles[t, k]])
        names[t] = name
    return names


@cached_njit(nogil=True, error_model="numpy")
def crowd_of(position, triangles, shape, area, edge):  # type: ignore[no-untyped-def]
    """(t,) float64, number of triangles that cover the surface around the middle of each of some triangles.

    It is the area of the triangles in a cube over that of a face. The area of a triangle that is larger than a face is
    dealt out to the cubes in which it lies. `edge` is that of the cubes in metres.
    """
    points = np.minimum(POINTS * area / (edge * edge), MAX_POINTS).astype(np.int64) + 1
    table = np.full(1 << int(np.log2(2 * points.sum() + 1) + 1), EMPTY, np.int64)
    inside, crowd = np.zeros(len(table)), np.empty(len(triangles))
    for t in range(len(triangles)):
        for p in range(points[t]):
            cube = _cube(position, triangles[t], shape[t], p, edge)
            i = place_in(table, cube)
            table[i] = cube
            inside[i] += area[t] / points[t]
    for t in range(len(triangles)):
        crowd[t] = inside[place_in(table, _cube(position, triangles[t], shape[t], 0, edge))] / (edge * edge)
    return crowd


@cached_njit(nogil=True, error_model="numpy")
def _cube(position, vertices, shape, point, edge):  # type: ignore[no-untyped-def]
    """Name of the cube that holds a point of a triangle: its middle, or one of a sequence that fills it."""
    b1, b2 = 1 / 3, 1 / 3
    if point > 0:
        b1, b2 = 0.7548776662466927 * point % 1.0, 0.5698402909980532 * point % 1.0
        if b1 + b2 > 1:
            b1, b2 = 1 - b1, 1 - b2
    name = np.int64(shape)
    for k in range(3):
        x = (1 - b1 - b2) * position[vertices[0], k] + b1 * position[vertices[1], k] + b2 * position[vertices[2], k]
        name = name * np.int64(HASH) + np.int64(np.floor(x / edge))
    return abs(name)


@cached_njit(nogil=True, error_model="numpy")
def lifted(  # type: ignore[no-untyped-def]
    sheets, scale, copies, is_shared, of_lobe, chance, salt, numbers, lift, flat_lift, offsets, middle
):
    """The triangles of light as a scene of their own, see `sheet_scene`.

    Parameters
    ----------
    sheets : Sheets, as a tuple of position, normal, triangles, shape, key, and the bits of u and v of each vertex in a
        number.
    copies : (t,) int64, number of groups in which a triangle lies, a power of 2; 0 for bright ones.
    is_shared : (t,) bool, whether neighbouring pixels share its light.
    of_lobe : (t,) int64, number of the group of a triangle of a narrow lobe that is not faint; 0 for others.
    numbers : groups, every, lobe_groups: numbers of groups of faint triangles, of samples of which one looks for them,
        and of groups of points of narrow lobes.
    chance : (t,) float64, probability with which a faint triangle is kept; it then counts for those that are not.
    salt : uint64, a random number of the pass.
    lift, flat_lift : (t,) float64, metres, largest distance of triangles in one place, where the receiver is curved and
        where it is flat.
    offsets : (1 + groups + lobe_groups, 2) float64, metres, of bright triangles, of the groups of faint ones, and of
        those of narrow lobes.
    middle : (3,) float64, metres, the place from which coordinates count.

    Returns
    -------
    corners : (3 k, 3) float32, metres. names : (k, 4) uint32, vertices and shape.
    terms : (k, 4) float32, what the irradiance at the vertices is multiplied by, height over the surface in metres, 1
        where the receiver is flat, and 1 where neighbouring pixels share the light.
    faint : (k,) bool.
    """
    position, normal, triangles, shape, key, image = sheets
    groups, every, lobe_groups = numbers
    name = _names_of(triangles, key, image)
    most = np.maximum(copies, 1).sum()
    corners, names = np.empty((3 * most, 3), np.float32), np.empty((most, 4), np.uint32)
    terms, faint, n = np.empty((most, 4), np.float32), np.empty(most, np.bool_), 0
    for t in range(len(triangles)):
        step, weight = 0, 1.0
        if copies[t] > 0:
            if uniform(np.uint64(name[t]) ^ salt) >= chance[t]:
                continue
            step, weight = groups // copies[t], groups * every / (copies[t] * chance[t])
        elif of_lobe[t] > 0:
            weight = float(lobe_groups)
        if not scale[t] > 0:
            continue
        a, b, c = triangles[t]
        bends = min(_cosine(normal, a, b), _cosine(normal, a, c)) < FLAT_COSINE
        height = (lift if bends else flat_lift)[t] * (uniform(name[t]) - 0.5)
        for copy in range(max(copies[t], 1)):
            group = 1 + ((key[t] >> 8) + copy * step) % groups if step > 0 else of_lobe[t]
            for k in range(3):
                v = triangles[t, k]
                names[n, k] = v
                for axis in range(3):
                    place = position[v, axis] - middle[axis] + height * normal[v, axis]
                    corners[3 * n + k, axis] = place + (offsets[group, axis] if axis < 2 else 0.0)
            names[n, 3] = shape[t]
            terms[n, 0], terms[n, 1], terms[n, 2] = scale[t] * weight, height, 0.0 if bends else 1.0
            terms[n, 3] = 1.0 if is_shared[t] else 0.0
            faint[n] = step > 0
            n += 1
    return corners[: 3 * n], names[:n], terms[:n], faint[:n]


@cached_njit(nogil=True, error_model="numpy")
def lit_directions(position, triangles, is_faint, cubes, reach):  # type: ignore[no-untyped-def]
    """The directions from the origin that lead to triangles, as words of 16 cubes with two bits each (uint32).

    The unit vectors lie in a cube of edge 2, which is divided into `cubes` along each edge. The lower bit of a cube
    stands for bright triangles, the upper one for faint ones.

    Parameters
    ----------
    position : (n, 3) float32, metres, vertices. triangles : (t, 3), their indices. is_faint : (t,) bool.
    reach : radians by which the direction of a point that a triangle lights may differ from those of the triangle.
    """
    words = np.zeros(cubes**3 // 16 + 1, np.uint32)
    stack = np.empty((3 * MAX_DIVISIONS + 4, 3, 3))
    depth_of = np.empty(3 * MAX_DIVISIONS + 4, np.int64)
    low, high, half = np.empty(3, np.int64), np.empty(3, np.int64), np.empty((3, 3))
    for t in range(len(triangles)):
        for k in range(3):
            stack[0, k] = position[triangles[t, k]]
        depth_of[0], n = 0, 1
        bit = np.uint32(2 if is_faint[t] else 1)
        while n:
            n -= 1
            widest = 0
            for axis in range(3):
                least, most = 2.0, -2.0
                for k in range(3):
                    x, y, z = stack[n, k]
                    d = stack[n, k, axis] / np.sqrt(x * x + y * y + z * z)
                    least, most = min(least, d), max(most, d)
                low[axis] = max(int((least - reach + 1) * 0.5 * cubes), 0)
                high[axis] = min(int((most + reach + 1) * 0.5 * cubes), cubes - 1)
                widest = max(widest, high[axis] - low[axis])
            if widest > MAX_WIDTH and depth_of[n] < MAX_DIVISIONS:
                a, b, c = stack[n, 0].copy(), stack[n, 1].copy(), stack[n, 2].copy()
                half[0], half[1], half[2] = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
                depth = depth_of[n] + 1
                for q in range(4):
                    depth_of[n + q] = depth
                stack[n, 0], stack[n, 1], stack[n, 2] = a, half[0], half[2]
                stack[n + 1, 0], stack[n + 1, 1], stack[n + 1, 2] = half[0], b, half[1]
                stack[n + 2, 0], stack[n + 2, 1], stack[n + 2, 2] = half[2], half[1], c
                stack[n + 3, 0], stack[n + 3, 1], stack[n + 3, 2] = half[0], half[1], half[2]
                n += 4
                continue
            for i in range(low[0], high[0] + 1):
                for j in range(low[1], high[1] + 1):
                    for k in range(low[2], high[2] + 1):
                        cube = (i * cubes + j) * cubes + k
                        words[cube >> 4] |= bit << np.uint32(2 * (cube & 15))
    return words
