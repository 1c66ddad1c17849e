# SPDX-License-Identifier: Apache-2.0
"""The segmentation tree: linkages, cuts, and what lies between supervoxel and scene."""
