# SPDX-License-Identifier: Apache-2.0
"""Sweeps: sensors at all combinations of settings, with as few light-transport passes as can be."""
