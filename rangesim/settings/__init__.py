# SPDX-License-Identifier: Apache-2.0
"""Settings as frozen dataclasses: bounds of their fields, and their way to and from plain data."""
