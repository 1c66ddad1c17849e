# SPDX-License-Identifier: Apache-2.0
"""Additive features of groups of points, for nodes of the graph and of the tree alike."""
