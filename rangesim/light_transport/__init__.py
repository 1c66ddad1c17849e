# SPDX-License-Identifier: Apache-2.0
"""Light transport: the only part of the package that needs Mitsuba and Dr.Jit, besides scenes.

Dr.Jit loads its LLVM when it is imported, so the library is chosen here, before any module of this package
imports Dr.Jit. Finding none is no error yet: a GPU may do without.
"""

from contextlib import suppress

from rangesim.errors import EnvironmentProblem
from rangesim.llvm import ensure_llvm

with suppress(EnvironmentProblem):  # raised again by `select_variant`, where LLVM is really needed
    ensure_llvm()
