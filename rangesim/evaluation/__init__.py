# SPDX-License-Identifier: Apache-2.0
"""Errors of range images against the ground truth, and how much of their noise is the renderer's."""
