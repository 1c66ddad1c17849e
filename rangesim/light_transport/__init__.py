# SPDX-License-Identifier: Apache-2.0
"""Light transport: the only part of the package that needs Mitsuba and Dr.Jit, besides scenes."""

import rangesim.environment.backend  # noqa: F401  (chooses the LLVM before Dr.Jit is imported)
