# SPDX-License-Identifier: Apache-2.0
"""Records on the disk: each kind of directory or file has one class, one writer and one loader here."""
