# SPDX-License-Identifier: Apache-2.0
"""Readings against the ground truth, and how much of their noise is the renderer's."""
