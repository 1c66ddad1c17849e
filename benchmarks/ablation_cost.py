# SPDX-License-Identifier: Apache-2.0
"""What a part of pcgraph costs in code: the lines, constants and kernels that would go with it, read off the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pcgraph

PACKAGE = Path(pcgraph.__file__).parent
KERNELS = {"kernel", "routine", "summing_routine", "inlined"}
"""Decorators of compiled functions (`pcgraph.parallel`)."""
_UNCOUNTED = ("__init__.py", "all_kernels.py")  # they name what others use, and keep nothing alive
_CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*|\w+Constants\.\w+|\w*Thresholds\.\w+")  # fields of these are constants, too


class Code(NamedTuple):
    """Something that a module defines: its file in the package, and its name there, such as `Class.method`."""

    file: str
    name: str


class CodeCost(NamedTuple):
    """How many lines go with a part, and how many constants and compiled functions."""

    lines: int
    constants: int
    kernels: int


@dataclass
class _Definition:
    nodes: list[ast.stmt]
    names: set[str] = field(default_factory=set)  # that it reads
    is_function: bool = False

    @property
    def is_kernel(self) -> bool:
        """Whether it is compiled."""
        node = self.nodes[0]
        return isinstance(node, ast.FunctionDef) and any(
            isinstance(one, ast.Name) and one.id in KERNELS for one in node.decorator_list
        )


class Source:
    """All definitions of the package, and which of them use which."""

    def __init__(self) -> None:
        self.trees = {
            path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
            for path in sorted(PACKAGE.rglob("*.py"))
        }
        self.definitions: dict[Code, _Definition] = {}
        self._imports: dict[str, dict[str, Code]] = {}
        for file, tree in self.trees.items():
            self._imports[file] = dict(_imported(tree))
            for node in tree.body:
                self._define(file, node, "")

    def _define(self, file: str, node: ast.stmt, prefix: str) -> None:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found = self.definitions[Code(file, prefix + node.name)] = _Definition([node])
            if isinstance(node, ast.FunctionDef):
                found.names, found.is_function = _names(node), True
                return
            for inner in node.body:
                self._define(file, inner, f"{node.name}.")
            found.names = {name for base in (*node.bases, *node.decorator_list) for name in _names(base)}
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in (one for every in targets for one in ast.walk(every)):
                if isinstance(target, ast.Name):
                    found = self.definitions.setdefault(Code(file, prefix + target.id), _Definition([]))
                    found.nodes.append(node)
                    found.names |= _names(node.value) if node.value is not None else set()

    @cached_property
    def users(self) -> dict[Code, set[Code]]:
        """The definitions that use each one, but for itself; methods are known by their names alone."""
        users: dict[Code, set[Code]] = {code: set() for code in self.definitions}
        by_last: dict[str, list[Code]] = {}
        for code in self.definitions:
            if "." in code.name:
                by_last.setdefault(code.name.rpartition(".")[2], []).append(code)
        for user, definition in self.definitions.items():
            if user.file.endswith(_UNCOUNTED):
                continue
            for name in definition.names:
                own = Code(user.file, name)
                used = [own if own in users else self._imports[user.file].get(name, own), *by_last.get(name, ())]
                for code in used:
                    if code in users and code != user:
                        users[code].add(user)
        return users

    def removed_with(self, listed: Iterable[str]) -> set[Code]:
        """What goes with some files, definitions ("file.py:name") or both: these, and all that nothing else uses."""
        gone = {code for one in listed for code in self._listed(one)}
        public = set(self._imports["__init__.py"].values())
        while True:
            classes = {(code.file, code.name) for code in gone}
            more = {
                code
                for code, users in self.users.items()
                if code not in gone
                and code not in public
                and ((users and users <= gone) or (code.file, code.name.partition(".")[0]) in classes)
                and (users or "." in code.name)
            }
            if not more:
                return gone
            gone |= more

    def _listed(self, one: str) -> Iterator[Code]:
        file, _, name = one.partition(":")
        if not name:
            yield from (code for code in self.definitions if code.file == file)
        elif Code(file, name) in self.definitions:
            yield Code(file, name)
        else:
            raise KeyError(f"nothing is called {one}")

    def cost(self, listed: Iterable[str]) -> CodeCost:
        """Lines, constants and kernels that go with what is listed.

        With a constant go the shortest statements that read it, as the `if` whose condition it is in.
        """
        listed = tuple(listed)
        gone = self.removed_with(listed)
        lines = {(code.file, n) for code in gone for node in self.definitions[code].nodes for n in _lines(node)}
        for one in listed:
            for code in self._listed(one):
                if not self.definitions[code].is_function and ":" in one:
                    lines |= {(code.file, n) for n in self._lines_reading(code)}
        constants = {code for code in gone if _CONSTANT.fullmatch(code.name) and not self.definitions[code].is_function}
        return CodeCost(len(lines), len(constants), sum(self.definitions[code].is_kernel for code in gone))

    def _lines_reading(self, code: Code) -> Iterator[int]:
        name = code.name.rpartition(".")[2]
        for statement in ast.walk(self.trees[code.file]):
            if isinstance(statement, ast.stmt) and not isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
                inner = [child for child in ast.iter_child_nodes(statement) if not isinstance(child, ast.stmt)]
                if any(name in _names(child) for child in inner):
                    yield from _lines(statement)

    def kernels_reading(self, code: Code) -> list[Code]:
        """Compiled functions that hold a constant: they keep its value once they are compiled."""
        return [user for user in self.users.get(code, ()) if self.definitions[user].is_kernel]


def _imported(tree: ast.Module) -> Iterator[tuple[str, Code]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pcgraph."):
            file = node.module.replace(".", "/").removeprefix("pcgraph/") + ".py"  # type: ignore[union-attr]
            yield from ((name.asname or name.name, Code(file, name.name)) for name in node.names)


def _names(node: ast.AST) -> set[str]:
    """Names that are read somewhere below a node, and attributes."""
    found = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    return found | {one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute)}


def _lines(node: ast.stmt) -> range:
    first = min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", ()))])
    return range(first, (node.end_lineno or node.lineno) + 1)
