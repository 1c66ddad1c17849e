# SPDX-License-Identifier: Apache-2.0
"""Segments of rooms as meshes, at several resolutions, against Felzenszwalb's on the normals of the 8 nearest vertices.

    python benchmarks/meshes_vs_felzenszwalb.py

Every segment of a cut into a given number takes its most frequent true label: purity, and mean IoU of the true things.
Felzenszwalb's k gives so many segments or just fewer. No constant was chosen on these meshes. The last line is JSON:
mesh -> vertices, supervoxels, covering, best nodes, and both scores of ours and theirs by number of segments.
"""

from __future__ import annotations

import json

from baselines import felzenszwalb_cut, normal_graph
from meshed_rooms import meshed
from scanned_rooms import flat, office
from scores import completed, voted

import pcgraph
from pcgraph.metrics import tree_oracle, weighted_overlap

ROOMS = {"room A": office, "room B": flat}
MESHES = ((0.03, None), (0.05, None), (0.02, 160_000), (0.02, 60_000))  # voxel, metres, and triangles if simplified
SEGMENTS = (178, 327, 600, 863)
SEED = 7


def main() -> None:
    report = {}
    for room, furnished in ROOMS.items():
        for voxel, faces in MESHES:
            scene, places = furnished()
            mesh = meshed(scene, places, SEED, voxel, faces)
            result, graph = pcgraph.segment(mesh.points), normal_graph(mesh.points)
            name = f"{room}, {100 * voxel:g} cm" + (f", {faces} triangles" if faces else "")
            row = {
                "vertices": len(mesh.points),
                "supervoxels": result.tree.n_leaves,
                "covering": float(weighted_overlap(completed(result.labels), mesh.things)),
                "best nodes": float(tree_oracle(result.tree, result.supervoxels, mesh.things)),
            }
            print(f"{name}: {', '.join(f'{key} {value:.4g}' for key, value in row.items())}")
            print("  segments    purity    mIoU    Felzenszwalb's purity    mIoU")
            for n in SEGMENTS:
                ours = voted(mesh.things, result.cut(n=min(n, result.tree.n_leaves)))
                theirs = voted(mesh.things, felzenszwalb_cut(graph, n))
                row[str(n)] = {"ours": ours, "theirs": theirs}
                scores = ours["purity"], ours["mIoU"], theirs["purity"], theirs["mIoU"]
                print("{:10d}{:10.3f}{:8.3f}{:25.3f}{:8.3f}".format(n, *scores), flush=True)
            report[name] = row
    print(json.dumps(report))


if __name__ == "__main__":
    main()
