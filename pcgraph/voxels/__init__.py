# SPDX-License-Identifier: Apache-2.0
"""Points gathered in voxels: the grid, its spacing and warp, surface normals."""
