# SPDX-License-Identifier: Apache-2.0
"""Instruments: what they are, how many light paths their readings need, and the light that reaches them."""
