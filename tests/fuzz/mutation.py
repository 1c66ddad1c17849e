# SPDX-License-Identifier: Apache-2.0
"""Mutators: a valid file becomes a damaged, lying or absurd one; the same random stream gives the same bytes.

Those of bytes work on any file; those of structure know JSON, TOML, XML, NumPy archives, PNG and words of a text, so
that the damage gets past the parser, to where values are believed.
"""

from __future__ import annotations

import copy
import datetime
import io
import json
import math
import re
import struct
import tomllib
import warnings
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

Mutator = Callable[[bytes, Random], bytes]

MAX_BYTES = 1 << 20
"""Mutators that copy stop here; larger files are made by hand."""

INTEGERS = (0, 1, 2, 3, 4, 7, 8, 127, 128, 255, 256, 4096, 32767, 65535, 65536, 10**6, 10**9, 2**31 - 1, 2**31, 2**32)
INTEGERS += (2**32 + 1, 10**12, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 10**30, 10**400)
FLOATS = (0.0, -0.0, 0.5, 1.5, 1e-9, 1e-300, 5e-324, 1e9, 1e38, 1e39, 1e150, 1e300, 1e308, math.inf, math.nan)
STRINGS = (
    *("", " ", ".", "..", "/", "../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "a/b", "x", "1", "-1"),
    *("nan", "inf", "1e999", "0x10", "1_000", "None", "true", "%s%n", "{0}", "${x}", "<script>alert(1)</script>"),
    *("two\nlines", "tab\t", "\x00", "\x1b[31mred\x1b[0m", "\u202ertl", "\u0661\u0662", "\ufeff", "\U0001f600", "é"),
    *("a" * 300, "a" * 70_000, "_arg_0", "type", "__class__", "AUX", "-rf", "*", "?", "~", "'", '"', "<", "&amp;"),
)
WORDS = (*(str(n) for n in INTEGERS), *(f"-{n}" for n in INTEGERS[:20]), *(repr(x) for x in FLOATS), *STRINGS)
WORDS += ("9" * 4299, "9" * 4301, "1,5", "--1", "1e", "+2", "-nan", "F", "I", "U", "list", "uchar", "double", "vertex")
WORDS += ("face", "element", "property", "end_header", "ascii", "binary", "binary_compressed", "DATA", "WIDTH", "COUNT")


# --- bytes ------------------------------------------------------------------------------------------------------------


def mutate_bytes(content: bytes, rng: Random) -> bytes:
    """`content` with bits flipped, bytes lost, doubled, moved, inserted or overwritten by telling integers."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        at = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 64, 1000)), len(data) - at)
        match rng.randrange(7):
            case 0 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                del data[at : at + length]
            case 2 if len(data) < MAX_BYTES:
                data[at:at] = data[at : at + length] * rng.choice((1, 2, 10))
            case 3:
                start = rng.randrange(len(data) + 1)
                data[at : at + length] = data[start : start + length]
            case 4:
                data[at:at] = rng.randbytes(rng.choice((1, 4, 32)))
            case 5:
                del data[at:]
            case _:
                size, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
                number = rng.choice(
                    (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
                )
                data[at : at + size] = (number % 256**size).to_bytes(size, order)  # type: ignore[arg-type]
    return bytes(data)


def mutate_start(content: bytes, rng: Random) -> bytes:
    """`content` with its first 200 bytes mutated: there are the headers, whose lies cost the most."""
    return mutate_bytes(content[:200], rng) + content[200:]


def mutate_words(content: bytes, rng: Random) -> bytes:
    """A text with words replaced by hostile ones, lost, doubled or swapped."""
    words = re.split(rb"([\s,;=<>\"'(){}\[\]:]+)", content[:MAX_BYTES])
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, other = rng.randrange(len(words)), rng.randrange(len(words))
        word = rng.choice(WORDS).encode("utf-8", "surrogateescape")
        match rng.randrange(5):
            case 0 | 1:
                words[at] = word
            case 2:
                words[at] = b""
            case 3:
                words[at] = words[at] + b" " + words[at]
            case _:
                words[at], words[other] = words[other], words[at]
    return b"".join(words)


def mutate_lines(content: bytes, rng: Random) -> bytes:
    """A text with lines lost, doubled, many times repeated or swapped."""
    lines = content.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        match rng.randrange(4):
            case 0 if len(lines) > 1:
                del lines[at]
            case 1:
                lines.insert(other, lines[at])
            case 2 if len(lines[at]) < 1000:
                lines[at:at] = [lines[at]] * rng.choice((10, 1000))
            case _:
                lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)


# --- trees of JSON and TOML -------------------------------------------------------------------------------------------


def hostile_value(rng: Random, like: Any = None) -> Any:
    """A value that is seldom expected; often of the type of `like`."""
    if isinstance(like, bool):
        kinds: tuple[str, ...] = ("int", "other", "string")
    elif isinstance(like, (int, float)):
        kinds = ("int", "int", "float", "float", "float", "other", "string")
    elif isinstance(like, str):
        kinds = ("string", "string", "string", "int", "other")
    else:
        kinds = ("int", "float", "string", "other")
    match rng.choice(kinds):
        case "int":
            return rng.choice(INTEGERS) * rng.choice((1, 1, -1))
        case "float":
            return rng.choice(FLOATS) * rng.choice((1, 1, -1))
        case "string":
            return rng.choice(STRINGS)
    deep: Any = 0
    for _ in range(50):
        deep = [deep]
    return rng.choice((None, True, False, [], {}, [[]], [{}], {"": 0}, {"type": "x"}, deep, [0] * 1000, [1, "x", None]))


def mutate_tree(tree: Any, rng: Random) -> Any:
    """Plain data with one leaf, key or branch replaced, lost, renamed, doubled or put where another was."""
    places = list(_places(tree))
    if not places:
        return hostile_value(rng, tree)
    holder, key = rng.choice(places)
    match rng.randrange(8):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[rng.choice((key + "s", key.upper(), "", "type", rng.choice(STRINGS)))] = holder.pop(key)
        case 2 if isinstance(holder, list) and len(holder) < 100_000:
            holder[key:key] = [holder[key]] * rng.choice((1, 1, 3, 1000))
        case 2 if isinstance(holder, dict):
            holder[f"{key}_2"] = holder[key]
        case 3:
            other, its_key = rng.choice(places)
            holder[key] = copy.deepcopy(other[its_key]) if its_key in _keys(other) else None
        case 4:
            holder[key] = [holder[key]]
        case _:
            holder[key] = hostile_value(rng, holder[key])
    return tree


def mutate_json(content: bytes, rng: Random) -> bytes:
    """JSON with values of its tree mutated; now and then with a key twice."""
    tree = json.loads(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        tree = mutate_tree(tree, rng)
    text = json.dumps(tree, indent=1)
    if rng.random() < 0.03:
        text = re.sub(r'("\w+": [^\n]*?),?\n', r"\1,\n\1,\n", text, count=1)
    return text.encode()


def mutate_toml(content: bytes, rng: Random) -> bytes:
    """TOML with values of its tree mutated."""
    tree = tomllib.loads(content.decode())
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        tree = mutate_tree(tree, rng)
    if not isinstance(tree, dict):
        return _toml(tree).encode()
    return "".join(f"{json.dumps(key)} = {_toml(value)}\n" for key, value in tree.items()).encode()


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    if value is None:  # TOML knows no null, but dates
        value = datetime.date(1979, 5, 27)
    return value.isoformat() if hasattr(value, "isoformat") else json.dumps(value)


def _keys(holder: Any) -> Any:
    return range(len(holder)) if isinstance(holder, list) else holder


def _places(tree: Any) -> Any:
    """Every (container, key) of a tree."""
    stack = [tree]
    while stack:
        holder = stack.pop()
        if isinstance(holder, (dict, list)):
            for key in list(_keys(holder)):
                yield holder, key
                stack.append(holder[key])


# --- XML --------------------------------------------------------------------------------------------------------------


def _words(text: str) -> list[str]:
    return text.split()


PLUGINS = _words(
    """
    rectangle sphere cube cylinder disk obj ply stl serialized instance shapegroup merge sdfgrid bsplinecurve
    linearcurve ellipsoids diffuse dielectric thindielectric roughdielectric conductor roughconductor plastic
    roughplastic principled principledthin twosided mask bumpmap normalmap blendbsdf null hair measured
    retroreflector perspective thinlens orthographic radiancemeter distant batch irradiancemeter point constant
    area spot projector envmap directional sunsky sky directionalarea hdrfilm specfilm bitmap checkerboard
    mesh_attribute volume homogeneous heterogeneous gridvolume constvolume hg isotropic uniform d65 blackbody
    regular irregular srgb independent stratified gaussian box path volpath scene nothing
    """
)
TAGS = _words(
    """
    scene sensor shape bsdf emitter film sampler integrator texture medium phase volume rfilter spectrum rgb float
    integer string boolean point vector transform translate rotate scale lookat matrix ref include default alias
    path spectra x
    """
)
NAMES = _words(
    """
    reflectance radiance to_world fov width height filename material int_ior ext_ior alpha eta k radius center p0
    p1 id type name value interior material_class specular_reflectance near_clip far_clip focal_length
    principal_point_offset_x crop_width film size_multiplier face_normals version
    """
)


def mutate_xml(content: bytes, rng: Random) -> bytes:
    """XML with attributes, tags and branches of its tree mutated."""
    root = ET.fromstring(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        _mutate_element(root, rng)
    text = ET.tostring(root, encoding="unicode")
    return text.encode("utf-8", "surrogatepass")


def _mutate_element(root: ET.Element, rng: Random) -> None:
    parents = [(parent, child) for parent in root.iter() for child in parent]
    parent, one = rng.choice(parents) if parents else (root, root)
    keys = list(one.attrib)
    key = rng.choice(keys) if keys else "name"
    match rng.randrange(12):
        case 0 if one is not root:
            parent.remove(one)
        case 1 if keys:
            del one.attrib[key]
        case 2:
            one.tag = rng.choice(TAGS)
        case 3:
            one.set("type", rng.choice(PLUGINS))
        case 4:
            one.set("name", rng.choice(NAMES))
        case 5 if len(parents) < 2000:
            parent.extend([one] * rng.choice((1, 1, 5, 50)))
        case 6 if len(parents) < 2000:
            _, other = rng.choice(parents) if parents else (root, root)
            if one not in other.iter():  # never into itself
                one.append(other) if other is not one and one not in set(other.iter()) else None
        case 7:
            ET.SubElement(one, rng.choice(TAGS), {"type": rng.choice(PLUGINS), "name": rng.choice(NAMES), "value": "1"})
        case 8 if one.text is not None:
            one.text = _some_number(one.text, rng)
        case _:
            value = one.get(key, "")
            one.set(key, _some_number(value, rng) if re.search(r"\d", value) and rng.random() < 0.7 else _text(rng))


def _some_number(text: str, rng: Random) -> str:
    """A text in which one number is replaced by a hostile word."""
    found = list(re.finditer(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", text))
    if not found:
        return _text(rng)
    one = rng.choice(found)
    return text[: one.start()] + _text(rng, numbers=True) + text[one.end() :]


def _text(rng: Random, numbers: bool = False) -> str:
    word = rng.choice(WORDS[: len(INTEGERS) + 20 + len(FLOATS)] if numbers or rng.random() < 0.5 else WORDS)
    return re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f]", "?", word)  # XML has no place for control characters


# --- NumPy archives ---------------------------------------------------------------------------------------------------


def mutate_npz(content: bytes, rng: Random) -> bytes:
    """A NumPy archive with members lost, renamed, reshaped, of another type, of hostile values, or lying headers."""
    with np.load(io.BytesIO(content)) as data:
        arrays = {name: data[name] for name in data.files}
    raw: dict[str, bytes] = {}
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if not arrays:
            break
        name = rng.choice(sorted(arrays))
        array = arrays[name]
        match rng.randrange(8):
            case 0:
                del arrays[name]
            case 1:
                arrays[rng.choice((name + "s", "", "../x", "a" * 300, "é"))] = arrays.pop(name)
            case 2:
                arrays[name] = reshaped(array, rng)
            case 3:
                arrays[name] = retyped(array, rng)
            case 4 | 5:
                arrays[name] = filled(array, rng)
            case 6:
                raw[name] = lying_npy(array, rng)
            case _:
                arrays[name] = arrays[rng.choice(sorted(arrays))]
    return npz_of(arrays, raw)


def reshaped(array: np.ndarray, rng: Random) -> np.ndarray:
    """The array in another shape."""
    shapes: tuple[Callable[[], np.ndarray], ...] = (
        lambda: array.T,
        lambda: array[..., None],
        lambda: array[None],
        lambda: array.reshape(-1),
        lambda: array.reshape(-1)[:0],
        lambda: array.reshape(-1)[:1].reshape(()) if array.size else array,
        lambda: array[1:] if array.ndim else array,
        lambda: array[:, 1:] if array.ndim > 1 else array,
        lambda: np.concatenate([array, array]) if array.ndim else array,
        lambda: np.zeros((0, 7), dtype=array.dtype),
        lambda: np.asfortranarray(array),
    )
    return rng.choice(shapes)()


def retyped(array: np.ndarray, rng: Random) -> np.ndarray:
    """The array with elements of another type, Python objects among them."""
    kind = rng.choice(
        ("f2", "f4", "f8", ">f8", "i1", "u1", "i4", "i8", "u8", "?", "c16", "U8", "S4", "M8[s]", "O", "V8")
    )
    if kind == "V8":
        return np.zeros(array.shape, dtype=[("a", "f4"), ("b", "i4")])
    if kind == "O":
        return np.full(array.shape, {"a": 1}, dtype=object)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return array.astype(kind)
        except (ValueError, TypeError):
            return np.zeros(array.shape, dtype=kind)


def filled(array: np.ndarray, rng: Random) -> np.ndarray:
    """The array with some or all elements replaced by hostile numbers."""
    result = array.copy()
    if result.dtype.kind not in "fiu" or not result.size:
        return result
    values = (*FLOATS, -math.inf, -1e30) if result.dtype.kind == "f" else (0, 1, 255, 2**31 - 1, 2**63 - 1)
    value = rng.choice(values)
    if result.dtype.kind != "f":
        info = np.iinfo(result.dtype)
        value = rng.choice((min(int(value), info.max), info.min, -1 if info.min else info.max))
    with np.errstate(all="ignore"):
        if rng.random() < 0.4:
            result[...] = value
        else:
            flat = result.reshape(-1)
            for _ in range(rng.choice((1, 5, 100))):
                flat[rng.randrange(flat.size)] = value
            result = flat.reshape(result.shape)
    return result


def lying_npy(array: np.ndarray, rng: Random) -> bytes:
    """An .npy file whose header promises another shape or type than follows."""
    if array.dtype.kind == "O":
        array = np.zeros(3)
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    content = stream.getvalue()
    lies = (
        b"(10000000000000,)",
        b"(1000000000,)",
        b"(-1,)",
        b"(0,)",
        b"()",
        b"(2, 10000000000)",
        b"(1e3,)",
        b"'x'",
        b"[",
    )
    if rng.random() < 0.6:
        return re.sub(rb"\([\d, ]*\)(?=, })", rng.choice(lies), content, count=1)
    kinds = (b"'|O'", b"'<f16'", b"'<U1000000000'", b"[('a', '<f4')]", b"'x'", b"'|V2147483647'", b"'<M8[Y]'")
    return re.sub(rb"'[<>|=][\w\[\]]+'", rng.choice(kinds), content, count=1)


def npz_of(arrays: dict[str, np.ndarray], raw: dict[str, bytes] | None = None) -> bytes:
    """Bytes of an archive of arrays; `raw` replaces the bytes of a member. The same arrays give the same bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array), allow_pickle=True)
            archive.writestr(
                zipfile.ZipInfo(f"{name}.npy"), (raw or {}).get(name, member.getvalue()), zipfile.ZIP_DEFLATED
            )
    return stream.getvalue()


# --- PNG --------------------------------------------------------------------------------------------------------------


def png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    """Chunks (type, data) of a PNG file, as far as they are whole."""
    chunks, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    return chunks


def png_of(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG file of chunks, with checksums that fit."""
    parts = (struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def mutate_png(content: bytes, rng: Random) -> bytes:
    """A PNG file with chunks mutated, lost, doubled or of other kinds, and valid checksums."""
    chunks = png_chunks(content)
    if not chunks:
        return mutate_bytes(content, rng)
    at = rng.randrange(len(chunks))
    kind, data = chunks[at]
    match rng.randrange(6):
        case 0:
            chunks[at] = (kind, mutate_bytes(data, rng))
        case 1:
            del chunks[at]
        case 2:
            chunks.insert(at, chunks[at])
        case 3:
            names = (b"tEXt", b"zTXt", b"iCCP", b"PLTE", b"tRNS", b"acTL", b"fcTL", b"eXIf", b"gAMA", b"IDAT", b"IEND")
            chunks.insert(at, (rng.choice(names), rng.randbytes(rng.choice((0, 1, 8, 30)))))
        case _:
            kind, data = chunks[0]
            header = bytearray(data.ljust(13, b"\0"))
            where = rng.choice((0, 4, 8, 9, 10, 11, 12))
            if where < 8:
                header[where : where + 4] = struct.pack(">I", rng.choice((0, 1, 3, 1000, 20_000, 2**31 - 1, 2**32 - 1)))
            else:
                header[where] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
            chunks[0] = (kind, bytes(header))
    return png_of(chunks)


# --- by the name of a file --------------------------------------------------------------------------------------------

TEXT = (mutate_words, mutate_words, mutate_lines, mutate_bytes)
BINARY = (mutate_bytes, mutate_start)
BY_SUFFIX: dict[str, tuple[Mutator, ...]] = {
    ".json": (mutate_json, mutate_json, mutate_json, mutate_json, *TEXT),
    ".gltf": (mutate_json, mutate_json, *TEXT),
    ".toml": (mutate_toml, mutate_toml, mutate_toml, mutate_toml, *TEXT),
    ".xml": (mutate_xml, mutate_xml, mutate_xml, mutate_xml, *TEXT),
    ".yml": (mutate_words, mutate_words, *TEXT),
    ".yaml": (mutate_words, mutate_words, *TEXT),
    ".npz": (mutate_npz, mutate_npz, mutate_npz, mutate_npz, mutate_bytes),
    ".png": (mutate_png, mutate_png, *BINARY),
    ".obj": TEXT,
    ".off": TEXT,
    ".ply": (mutate_words, *TEXT, mutate_start),
    ".pcd": (mutate_words, *TEXT, mutate_start),
    ".stl": (mutate_words, *TEXT, mutate_start),
    ".pgm": (mutate_words, *TEXT, mutate_start),
}
"""Mutators of a file by its suffix, the useful ones several times; other files are bytes."""


def mutators_of(name: str) -> tuple[Mutator, ...]:
    """Mutators that suit a file of this name."""
    return BY_SUFFIX.get("." + name.rpartition(".")[2].lower(), BINARY)


def mutate(name: str, content: bytes, rng: Random) -> bytes:
    """The content of a file of this name, mutated; bytes alone where it is of its kind no longer."""
    try:
        return rng.choice(mutators_of(name))(content, rng)
    except Exception:  # noqa: BLE001 - whatever an earlier mutation did to it
        return mutate_bytes(content, rng)


def mutate_arguments(arguments: tuple[str, ...], rng: Random) -> tuple[str, ...]:
    """A command line with values of options replaced by hostile ones, lost, doubled or joined."""
    words = list(arguments)
    for _ in range(rng.choice((1, 1, 2))):
        free = [i for i, word in enumerate(words) if "{" not in word] or [0]
        at = rng.choice(free)
        if not words[at].startswith("--") and rng.random() < 0.8:
            separator = re.search(r"[x,]", words[at])
            parts = words[at].split(separator[0]) if separator else [words[at]]
            parts[rng.randrange(len(parts))] = rng.choice(WORDS)
            joint = separator[0] if separator else ","
            words[at] = joint.join(parts + parts[:1] * (rng.random() < 0.1))
        elif rng.random() < 0.3:
            del words[at]
        else:
            words.insert(at, rng.choice((words[at], rng.choice(WORDS))))
    return tuple(word.replace("\0", "?") for word in words)  # a command line cannot hold NUL
