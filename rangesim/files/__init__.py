# SPDX-License-Identifier: Apache-2.0
"""Files read within limits and checked against schemas (arrays, images, text, records); directories written whole."""
