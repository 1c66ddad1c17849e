# SPDX-License-Identifier: Apache-2.0
"""Settings as frozen dataclasses: bounds of their fields, limits of sizes, seeds, and conversion to plain data."""
