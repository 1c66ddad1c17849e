# SPDX-License-Identifier: Apache-2.0
"""Writes the thin-walled vessels of scenes/glassware.xml: closed meshes of revolution about z, on z = 0, metres.

Usage: python scenes/glassware/vessels.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

SEGMENTS, STEPS_PER_CORNER, CORNER_M = 72, 5, 0.003
BOTTLE_M = [(0.0, 0.0), (0.031, 0.0), (0.031, 0.11), (0.014, 0.135), (0.014, 0.155)]
TUMBLER_M = [(0.0, 0.0), (0.028, 0.0), (0.038, 0.1)]
WALL_M = {"bottle": 0.0008, "tumbler": 0.0025}
"""Blown plastic, pressed glass. Outlines: radius and height of the outside, from the axis to the rim."""


def outline(outside: list[tuple[float, float]], wall_m: float) -> np.ndarray:
    """(n, 2) radius and height along the outside to the rim and back along the inside, corners rounded."""
    points = np.array(outside)
    edges = np.diff(points, axis=0)
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    inside = points + wall_m * np.vstack([normals[:1], _mitre(normals), normals[-1:]])
    inside[0, 0] = 0.0
    closed = np.vstack([points, inside[::-1]])
    corners = [closed[:1]]
    for before, corner, after in zip(closed, closed[1:], closed[2:], strict=False):
        a, b = before - corner, after - corner
        reach = min(CORNER_M, 0.4 * np.linalg.norm(a), 0.4 * np.linalg.norm(b))
        start, end = corner + reach * a / np.linalg.norm(a), corner + reach * b / np.linalg.norm(b)
        t = np.linspace(0, 1, STEPS_PER_CORNER)[:, None]
        corners.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.vstack([*corners, closed[-1:]])


def _mitre(normals: np.ndarray) -> np.ndarray:
    """Offsets at corners that keep the wall's thickness on both sides."""
    total = normals[:-1] + normals[1:]
    return np.asarray(2 * total / (total**2).sum(1, keepdims=True))


def revolve(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3), normals out of the material; both ends of the profile lie on the axis."""
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    body = profile[1:-1]
    xy = (body[:, :1, None] * ring).reshape(-1, 2)
    vertices = np.vstack([np.column_stack([xy, np.repeat(body[:, 1], SEGMENTS)]),
                          [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])  # fmt: skip
    n, first, last = len(body), len(vertices) - 2, len(vertices) - 1
    i, j = np.meshgrid(np.arange(n - 1), np.arange(SEGMENTS), indexing="ij")
    a, b = (i * SEGMENTS + j).ravel(), (i * SEGMENTS + (j + 1) % SEGMENTS).ravel()
    c, d = a + SEGMENTS, b + SEGMENTS
    j, k = np.arange(SEGMENTS), (np.arange(SEGMENTS) + 1) % SEGMENTS
    top = (n - 1) * SEGMENTS
    faces = [(a, b, d), (a, d, c), (k, j, np.full_like(j, first)), (top + j, top + k, np.full_like(j, last))]
    return vertices, np.concatenate([np.stack(f, axis=1) for f in faces])


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Binary PLY without normals; the renderer makes smooth ones."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


if __name__ == "__main__":
    for name, outside in (("bottle", BOTTLE_M), ("tumbler", TUMBLER_M)):
        write_ply(Path(__file__).parent / f"{name}.ply", *revolve(outline(outside, WALL_M[name])))
