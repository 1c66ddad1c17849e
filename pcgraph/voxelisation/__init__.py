# SPDX-License-Identifier: Apache-2.0
"""Voxels of a cloud: their size, and the points that are noise."""
