# SPDX-License-Identifier: Apache-2.0
"""What a reader is given: one file, or a directory of files, some of which are no files at all."""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Link:
    """A symbolic link."""

    target: str


@dataclass(frozen=True)
class Fifo:
    """A named pipe that nobody writes to: opening it for reading blocks for ever."""


@dataclass(frozen=True)
class Folder:
    """An empty directory where a file is expected."""


@dataclass(frozen=True)
class Sparse:
    """A file of `size` bytes that starts with `start`; the rest are zeros that take no space on the disk."""

    size: int
    start: bytes = b""


Content = bytes | Link | Fifo | Folder | Sparse


@dataclass(frozen=True)
class Input:
    """Files by their path relative to the case's folder, and what of it the reader is given.

    entry : path of a file or directory among `files`.
    arguments : command line; `{entry}` and `{out}` stand for paths, other words are taken as they are.
    """

    files: Mapping[str, Content]
    entry: str
    arguments: tuple[str, ...] = ()

    def with_file(self, path: str, content: Content) -> Input:
        """The same with one file replaced or added."""
        return replace(self, files={**self.files, path: content})

    def without(self, path: str) -> Input:
        """The same with one file left out."""
        return replace(self, files={name: content for name, content in self.files.items() if name != path})

    def renamed(self, name: str) -> Input:
        """The same with the entry under another name."""
        files = {
            name + path.removeprefix(self.entry) if path == self.entry or path.startswith(f"{self.entry}/") else path: c
            for path, c in self.files.items()
        }
        return replace(self, files=files, entry=name)

    def write(self, folder: Path) -> Path:
        """Path of the entry, after all files are in the empty `folder`."""
        for name, content in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            match content:
                case bytes():
                    path.write_bytes(content)
                case Link():
                    path.symlink_to(content.target)
                case Fifo():
                    os.mkfifo(path)
                case Folder():
                    path.mkdir()
                case Sparse():
                    with path.open("wb") as file:
                        file.write(content.start)
                        file.truncate(content.size)
        return folder / self.entry


def clear(folder: Path) -> None:
    """Make `folder` empty, whatever is in it."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path)
        else:
            os.unlink(entry.path)


# --- kept on disk -----------------------------------------------------------------------------------------------------


def to_json(one: Input, seeds: Mapping[str, Input]) -> dict[str, Any]:
    """Plain data of an input: whole, or as its difference to a seed where it has many files in common."""
    base = next((name for name, seed in seeds.items() if len(seed.files) > 1 and _shares(one, seed)), None)
    known = seeds[base].files if base is not None else {}
    data: dict[str, Any] = {"entry": one.entry} if base is None else {"seed": base, "entry": one.entry}
    if one.arguments:
        data["arguments"] = list(one.arguments)
    data["files"] = {name: _content_to_json(c) for name, c in one.files.items() if known.get(name) != c}
    if removed := sorted(set(known) - set(one.files)):
        data["removed"] = removed
    return data


def from_json(data: Mapping[str, Any], seeds: Mapping[str, Input]) -> Input:
    """The input that `to_json` wrote."""
    files: dict[str, Content] = dict(seeds[data["seed"]].files) if "seed" in data else {}
    for name in data.get("removed", ()):
        files.pop(name, None)
    files |= {name: _content_from_json(content) for name, content in data["files"].items()}
    return Input(files, data["entry"], tuple(data.get("arguments", ())))


def _shares(one: Input, seed: Input) -> bool:
    return one.entry == seed.entry and 2 * sum(seed.files.get(n) == c for n, c in one.files.items()) >= len(seed.files)


def _content_to_json(content: Content) -> dict[str, Any]:
    match content:
        case Link():
            return {"link": content.target}
        case Fifo():
            return {"fifo": True}
        case Folder():
            return {"folder": True}
        case Sparse():
            return {"sparse": content.size, "base64": base64.b64encode(content.start).decode()}
    try:
        text = content.decode()
        if "\r" not in text and "\0" not in text:
            return {"text": text}
    except UnicodeDecodeError:
        pass
    return {"base64": base64.b64encode(content).decode()}


def _content_from_json(data: Mapping[str, Any]) -> Content:
    if "text" in data:
        return str(data["text"]).encode()
    if "link" in data:
        return Link(data["link"])
    if "fifo" in data:
        return Fifo()
    if "folder" in data:
        return Folder()
    content = base64.b64decode(data["base64"])
    return Sparse(data["sparse"], content) if "sparse" in data else content


def dumps(data: Mapping[str, Any]) -> str:
    """JSON text with a line per entry."""
    return json.dumps(data, indent=1, sort_keys=True) + "\n"
