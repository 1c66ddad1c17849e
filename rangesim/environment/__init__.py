# SPDX-License-Identifier: Apache-2.0
"""What the machine must have: LLVM for Dr.Jit, and the command that looks for it."""
