# SPDX-License-Identifier: Apache-2.0
"""PLY and PCD files made by hand: of any fields, and such that promise more than they hold."""

from __future__ import annotations

import struct

import numpy as np

from pcgraph.io.ply import encode_ply

CODES = ("ascii", "binary", "binary_compressed")
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
KINDS = {"F": "f", "I": "i", "U": "u"}
PLY_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
PLY_TYPES |= {"f4": "float", "f8": "double"}


# --- files by hand ----------------------------------------------------------------------------------------------------


def text_of(number) -> str:
    return repr(number.item()) if number.dtype.kind == "f" else str(number)


def lzf(plain: bytes) -> bytes:
    """LZF stream of literals, and of copies where the last 8 bytes repeat."""
    stream, at = b"", 0
    while at < len(plain):
        if at >= 8 and plain[at : at + 8] == plain[at - 8 : at]:
            stream, at = stream + bytes([6 << 5, 7]), at + 8
        else:
            piece = plain[at : at + 8]
            stream, at = stream + bytes([len(piece) - 1]) + piece, at + len(piece)
    return stream


def pcd(code: str, fields, width: int, height: int) -> bytes:
    """PCD file of fields (name, dtype, (n, count) array)."""
    words = {
        "FIELDS": [name for name, _, _ in fields],
        "SIZE": [dtype[1] for _, dtype, _ in fields],
        "TYPE": [dtype[0].upper() for _, dtype, _ in fields],
        "COUNT": [str(values.shape[1]) for _, _, values in fields],
        "WIDTH": [str(width)],
        "HEIGHT": [str(height)],
        "VIEWPOINT": ["1 2 3 1 0 0 0"],
        "POINTS": [str(width * height)],
        "DATA": [code],
    }
    header = "# made by hand\nVERSION 0.7\n" + "".join(f"{key} {' '.join(value)}\n" for key, value in words.items())
    columns = [values.astype("<" + dtype) for _, dtype, values in fields]
    if code == "ascii":
        rows = [" ".join(text_of(number) for column in columns for number in column[i]) for i in range(width * height)]
        return header.encode() + "\n".join(rows).encode() + b"\n"
    if code == "binary":
        return header.encode() + b"".join(column[i].tobytes() for i in range(width * height) for column in columns)
    plain = b"".join(column.tobytes() for column in columns)
    stream = lzf(plain)
    return header.encode() + struct.pack("<II", len(stream), len(plain)) + stream


def ply(code: str, fields, n: int) -> bytes:
    """PLY file of fields (name, dtype, (n, 1) array), with an element before the vertices and faces behind."""
    order = ORDERS[code]
    lines = ["ply", f"format {code} 1.0", "comment end_header comes later", "element camera 1", "property short id"]
    lines += [f"element vertex {n}", *(f"property {PLY_TYPES[dtype]} {name}" for name, dtype, _ in fields)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    columns = [values.astype(order + dtype)[:, 0] for _, dtype, values in fields]
    if code == "ascii":
        rows = ["7", *(" ".join(text_of(column[i]) for column in columns) for i in range(n)), "3 0 1 2", ""]
        return "\n".join(lines[:-1] + rows).encode()
    body = b"".join(column[i : i + 1].tobytes() for i in range(n) for column in columns)
    face = struct.pack(order + "Biii", 3, 0, 1, 2)
    return "\n".join(lines).encode() + struct.pack(order + "h", 7) + body + face


def ply_with_lists(code: str, n: int = 4) -> bytes:
    """PLY file with faces before the vertices, and lists among the vertices' properties: `seen` differs in length."""
    order = ORDERS[code]
    lines = ["ply", f"format {code} 1.0", "element face 2", "property uchar material"]
    lines += ["property list uchar int vertex_indices", f"element vertex {n}", "property float x"]
    lines += ["property list ushort int seen", "property double y", "property list uchar float descriptor"]
    lines += ["property float z", "property uchar intensity", "end_header", ""]
    faces = [(1, [0, 1, 2]), (2, [3, 2, 1, 0])]
    rows = [(i + 0.5, list(range(i % 3)), -1.0 * i, [i / 4, 1.0], i * 2.0, 10 * i) for i in range(n)]
    if code == "ascii":
        texts = [f"{material} {len(indices)} {' '.join(map(str, indices))}" for material, indices in faces]
        for x, seen, y, descriptor, z, intensity in rows:
            words = [x, len(seen), *seen, y, 2, *descriptor, z, intensity]
            texts.append(" ".join(map(str, words)))
        return "\n".join([*lines[:-1], *texts, ""]).encode()
    body = b"".join(struct.pack(f"{order}BB{len(i)}i", material, len(i), *i) for material, i in faces)
    for x, seen, y, descriptor, z, intensity in rows:
        body += struct.pack(f"{order}fH{len(seen)}idB2ffB", x, len(seen), *seen, y, 2, *descriptor, z, intensity)
    return "\n".join(lines).encode() + body


def fields_of(rng, n, counts=True):
    """Fields x y z with others before, between and behind, of all types."""
    names = ["x", "y", "z", *rng.permutation(["label", "rgb", "nx", "ny", "nz", "red", "green", "blue", "t"])[:4]]
    fields = []
    for name in rng.permutation(names).tolist():
        kinds = ["f4", "f8", "i2", "u1", "i4"] if name in "xyz" or name[0] == "n" else ["u4", "i4", "f4", "u1"]
        dtype = "u4" if name == "rgb" else str(rng.choice(kinds))
        values = rng.integers(0, 100, (n, int(rng.integers(1, 4)) if counts and name == "t" else 1)).astype(float)
        if dtype[0] == "f" and len(values):
            values[rng.integers(0, n)] = rng.choice([np.nan, np.inf, -np.inf, 1e-30, 0.1])
        fields.append((name, dtype, values))
    return fields


def corpus():
    """Valid files by name, which starts with their format."""
    rng = np.random.default_rng(3)
    files = {}
    for code in CODES:
        files[f"pcd {code}"] = pcd(code, fields_of(rng, 6), 3, 2)
    for code in ORDERS:
        files[f"ply {code}"] = ply(code, fields_of(rng, 5, counts=False), 5)
    points = rng.random((20, 3))
    columns = {name: points[:, i] for i, name in enumerate("xyz")}
    files["ply of our own"] = encode_ply(columns | {"labels": np.arange(20, dtype=np.int32)})
    return files


CORPUS = corpus()


# --- lies -------------------------------------------------------------------------------------------------------------

XYZ = [(name, "f4", np.arange(4.0)[:, None]) for name in "xyz"]


def lies():
    """Names, which start with the format, and contents of files that promise more than they hold."""
    many = ("9" * 4290, "9" * 5000, str(10**18), str(10**15), str(10**12), "2147483648", "-4", "4.0", "four", "")
    for code in CODES:
        whole = pcd(code, XYZ, 4, 1)
        for number in many:
            for width, height in ((number, "1"), ("1", number), (number, number), (number, "0"), ("0", number)):
                lie = whole.replace(b"WIDTH 4", b"WIDTH " + width.encode())
                lie = lie.replace(b"HEIGHT 1", b"HEIGHT " + height.encode()).replace(b"POINTS 4\n", b"")
                yield f"pcd {code} {width[:20]} x {height[:20]}", lie
        for number in (*many, "4097", "0"):
            yield f"pcd {code} count {number[:20]}", whole.replace(b"COUNT 1", b"COUNT " + number.encode())
    for code in ORDERS:
        whole = ply(code, XYZ, 4)
        for number in many:
            for element in (b"vertex 4", b"camera 1"):
                lie = whole.replace(element, element[:7] + number.encode())
                yield f"ply {code} {element[:6].decode()} {number[:20]}", lie
    sizes = pcd("binary_compressed", XYZ, 4, 1)
    at = sizes.index(b"compressed\n") + 11
    for packed in (0, 1, 8, 2**31, 2**32 - 1):
        for unpacked in (0, 47, 48, 49, 2**31, 2**32 - 1):
            content = sizes[:at] + struct.pack("<II", packed, unpacked) + sizes[at + 8 :]
            yield f"pcd sizes {packed} {unpacked}", content
    bomb = sizes[:at].replace(b"WIDTH 4", b"WIDTH 300000000").replace(b"POINTS 4\n", b"")
    yield "pcd bomb", bomb + struct.pack("<II", 1000, 3_600_000_000) + b"\x00a" + b"\xe0\xff\x00" * 300
    text = pcd("ascii", XYZ, 4, 1)
    start = text.index(b"ascii\n") + 6
    wide = text[:start].replace(b"WIDTH 4", b"WIDTH 100000").replace(b"POINTS 4\n", b"")
    yield "pcd one gigantic word", wide + b"1 " * 299_999 + b"1" * 1_000_000
    yield "pcd one gigantic line", wide + b"1 " * 300_000 + b"x" * 1_000_000
    yield "pcd a gigantic word that is none", wide + b"1 " * 299_999 + b"x" * 1_000_000
    yield "pcd gigantic header line", text.replace(b"VERSION 0.7", b"VERSION " + b"7" * 1_000_000)
    fields = " ".join(f"f{i}" for i in range(5000))
    yield "pcd many fields", text.replace(b"FIELDS x y z", b"FIELDS x y z " + fields.encode())
    plywood = ply("ascii", XYZ, 4)
    yield "ply gigantic comment", plywood.replace(b"comment", b"comment " + b"c" * 1_000_000)
    yield "ply no end", plywood.replace(b"end_header\n", b"")
    yield "ply lists first", plywood.replace(b"property float y", b"property list int float y")
    yield "ply twice", plywood.replace(b"float y", b"float x")
    yield "ply types", plywood.replace(b"float y", b"float128 y")
    yield "ply empty", b""
    yield "pcd empty", b""
    yield "pcd zeros", bytes(100_000)
