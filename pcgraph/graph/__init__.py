# SPDX-License-Identifier: Apache-2.0
"""The adjacency graph of supervoxels and the features of its edges."""
