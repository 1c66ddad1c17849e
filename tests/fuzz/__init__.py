# SPDX-License-Identifier: Apache-2.0
"""Fuzzing of every reader: mutated and hostile files in a watched process; see docs/reliability.md."""
