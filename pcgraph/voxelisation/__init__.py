# SPDX-License-Identifier: Apache-2.0
"""From points to voxels: how large voxels are, and which points are noise."""
