# SPDX-License-Identifier: Apache-2.0
"""Detectors, which turn radiance into digital numbers: their noise, and the ambient light behind their filter."""
