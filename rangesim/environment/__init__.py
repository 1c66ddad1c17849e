# SPDX-License-Identifier: Apache-2.0
"""Requirements on the machine: LLVM for Dr.Jit, the choice of a backend, and the command that checks both."""
