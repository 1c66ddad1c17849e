# SPDX-License-Identifier: Apache-2.0
"""Records on the disk: for each kind one class, one writer and one loader."""
