# SPDX-License-Identifier: Apache-2.0
"""From settings to results: what is carried out, and what it will cost."""
