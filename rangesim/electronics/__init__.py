# SPDX-License-Identifier: Apache-2.0
"""From radiance to digital numbers: detectors, noise, ambient light behind the filter."""
