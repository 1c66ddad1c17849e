# SPDX-License-Identifier: Apache-2.0
"""What took a cloud, from where, and what tells so."""
