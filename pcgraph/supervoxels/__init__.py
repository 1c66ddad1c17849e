# SPDX-License-Identifier: Apache-2.0
"""Supervoxels: groups of touching voxels that lie on one surface."""
