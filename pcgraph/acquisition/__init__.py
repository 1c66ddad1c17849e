# SPDX-License-Identifier: Apache-2.0
"""Acquisition of a cloud: the sensor, its place, and the evidence for both."""
