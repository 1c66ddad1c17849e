# SPDX-License-Identifier: Apache-2.0
"""Inputs made by hand: what no mutation finds, by name. Bombs are made when they are asked for, and never stored."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from functools import cache, partial

import numpy as np

from fuzz.inputs import Content, Fifo, Folder, Input, Link, Sparse
from fuzz.mutation import npz_of, png_of

Made = dict[str, Callable[[], Input]]
NONSENSE = "nonsense, "
"""Inputs whose names start with it must be refused; of the others either answer is right."""

NAMES = (
    "a b.{}", "-rf.{}", "caf\u00e9 \U0001f600.{}", "a" * 200 + ".{}", "two\nlines.{}", "\x1b[31mred.{}",
    "bytes\udcff.{}", "quote'\".{}", "%s{{0}}.{}", "<b>.{}", "\u202ertl.{}", "CAPS.{}",
)  # fmt: skip


def any_file(seed: Input, target: str) -> Made:
    """One file of an input as something else: empty, a part, another encoding, endless, a pipe, a loop, a directory."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    short = target.rpartition("/")[2]
    text = whole.decode("latin-1")
    changed: dict[str, Callable[[], Content]] = {
        "empty": lambda: b"",
        "one byte": lambda: whole[:1],
        "one zero": lambda: b"\0",
        "half": lambda: whole[: len(whole) // 2],
        "all but one byte": lambda: whole[:-1],
        "zeros": lambda: bytes(10_000),
        "ones": lambda: b"\xff" * 10_000,
        "byte order mark": lambda: b"\xef\xbb\xbf" + whole,
        "utf-16": lambda: text.encode("utf-16"),
        "line ends of Windows": lambda: whole.replace(b"\n", b"\r\n"),
        "line ends of old": lambda: whole.replace(b"\n", b"\r"),
        "twice": lambda: whole + whole,
        "a word of a megabyte": lambda: whole[:20] + b"a" * 1_000_000,
        "directory": Folder,
        "pipe": Fifo,
        "link to itself": lambda: Link(short),
        "dangling link": lambda: Link("nowhere"),
        "endless": lambda: Link("/dev/zero"),
        "64 GB": lambda: Sparse(1 << 36, whole),
    }
    made = _changed(seed, target, changed)
    made[f"{short}: missing"] = lambda: seed.without(target)
    return made


def _changed(seed: Input, target: str, contents: Mapping[str, Callable[[], Content]]) -> Made:
    """Inputs with other contents of one file, made when they are asked for."""

    def with_content(make: Callable[[], Content]) -> Input:
        return seed.with_file(target, make())

    short = target.rpartition("/")[2]
    return {f"{short}: {name}": partial(with_content, make) for name, make in contents.items()}


def any_name(seed: Input) -> Made:
    """The entry under hostile names."""
    suffix = seed.entry.rpartition(".")[2]
    names = {name.format(suffix) for name in NAMES}
    return {f"name {ascii(name)[:40]}": partial(seed.renamed, name) for name in sorted(names)}


def json_trees(seed: Input, target: str) -> Made:
    """JSON that parsers stumble on."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    data = json.loads(whole)

    def with_first_number(word: str) -> Content:
        text = json.dumps(data)
        at = next(i for i, c in enumerate(text) if c.isdigit() and text[i - 1] in " [")
        end = next(i for i in range(at, len(text)) if text[i] in ",}]")
        return (text[:at] + word + text[end:]).encode()

    def all_numbers(value: object, like: type = float) -> Content:
        def walk(x: object) -> object:
            if isinstance(x, dict):
                return {k: walk(v) for k, v in x.items()}
            if isinstance(x, list):
                return [walk(v) for v in x]
            return value if type(x) is like else x

        return json.dumps(walk(data)).encode()

    changed: dict[str, Callable[[], Content]] = {
        "100 000 brackets": lambda: b"[" * 100_000,
        "100 000 closed brackets": lambda: b"[" * 100_000 + b"]" * 100_000,
        "100 000 braces": lambda: b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
        "nested value": lambda: json.dumps(data).replace(": ", ": " + "[" * 900 + "]" * 900 + ', "x": ', 1).encode(),
        "deeply nested value": lambda: whole.rstrip()[:-1] + b', "x": ' + b"[" * 50_000 + b"]" * 50_000 + b"}",
        "nonsense, number of 5000 digits": lambda: with_first_number("9" * 5000),
        "number of 4000 digits": lambda: with_first_number("9" * 4000),
        "not a number": lambda: with_first_number("NaN"),
        "infinite": lambda: with_first_number("Infinity"),
        "all floats infinite": lambda: all_numbers(float("inf")),
        "all floats not a number": lambda: all_numbers(float("nan")),
        "all floats 1e308": lambda: all_numbers(1e308),
        "all floats 1e-300": lambda: all_numbers(1e-300),
        "all floats true": lambda: all_numbers(True),
        "all integers true": lambda: all_numbers(True, int),
        "all integers 2^31": lambda: all_numbers(2**31, int),
        "all integers 10^30": lambda: all_numbers(10**30, int),
        "all strings null": lambda: all_numbers(None, str),
        "all strings scripts": lambda: all_numbers("<img src=x onerror=alert(1)>", str),
        "all strings escapes": lambda: all_numbers("\x1b]0;x\x07\n", str),
        "all strings surrogates": lambda: all_numbers("\ud800", str),
        "keys twice": lambda: whole.rstrip()[:-1] + b", " + whole.strip()[1:],
        "a list": lambda: b"[]",
        "a string": lambda: b'"x"',
        "null": lambda: b"null",
        "empty object": lambda: b"{}",
        "comment": lambda: b"// comment\n" + whole,
        "zero bytes in a string": lambda: whole.replace(b'": "', b'": "\\u0000', 1),
        "a million keys": lambda: json.dumps({f"key{i}": i for i in range(200_000)}).encode(),
    }
    return _changed(seed, target, changed)


# --- bombs ------------------------------------------------------------------------------------------------------------


def _zeros(n_bytes: int, wbits: int) -> bytes:
    """A deflate stream of `n_bytes` zeros; made from one block that is repeated."""
    block = bytes(1 << 24)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    last = zlib.compressobj(9, zlib.DEFLATED, -15)
    stream = first * (n_bytes >> 24) + last.compress(bytes(n_bytes & ((1 << 24) - 1))) + last.flush()
    if wbits < 0:
        return stream
    # Adler-32 of n zeros: a stays 1, b counts them
    return b"\x78\xda" + stream + struct.pack(">I", ((n_bytes % 65521) << 16) | 1)


@cache
def png_bomb(width: int, height: int, bits: int, color: int = 0) -> bytes:
    """A valid PNG of black pixels."""
    channels = {0: 1, 2: 3, 3: 1, 6: 4}[color]
    stream = _zeros(height * (1 + (width * bits * channels + 7) // 8), 15)
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return png_of([(b"IHDR", header), (b"IDAT", stream), (b"IEND", b"")])


@cache
def png_text_bomb() -> bytes:
    """A PNG of one pixel with a compressed text of 1 GB."""
    text = _zeros(1 << 30, 15)
    header = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
    pixel = zlib.compress(b"\0\0")
    return png_of([(b"IHDR", header), (b"zTXt", b"x\0\0" + text), (b"IDAT", pixel), (b"IEND", b"")])


def npz_bomb(names: tuple[str, ...], shape: tuple[int, ...], dtype: str) -> bytes:
    """A valid archive whose members are arrays of zeros of this shape."""
    return _zip({f"{name}.npy": _npy_bomb(shape, dtype) for name in names})


@cache
def _npy_bomb(shape: tuple[int, ...], dtype: str) -> tuple[bytes, int, int]:
    """An .npy file of zeros as a deflate stream, its CRC-32 and its size."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype, "fortran_order": False, "shape": shape})
    start = header.getvalue()
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    # The header goes as a stored block before the zeros; crc over both.
    stored = b"\x00" + struct.pack("<HH", len(start), len(start) ^ 0xFFFF) + start
    crc = zlib.crc32(start)
    block = bytes(1 << 24)
    for at in range(0, size, len(block)):
        crc = zlib.crc32(block[: size - at], crc)
    return stored + _zeros(size, -15), crc, len(start) + size


def _zip(members: Mapping[str, tuple[bytes, int, int]]) -> bytes:
    """An archive of members that are deflated already: stream, CRC-32 and size."""
    files, directory = b"", b""
    for name, (stream, crc, size) in members.items():
        encoded = name.encode()
        common = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 33, crc, len(stream), size, len(encoded), 0)
        directory += b"PK\x01\x02\x14\x00" + common + struct.pack("<HHHII", 0, 0, 0, 0, len(files)) + encoded
        files += b"PK\x03\x04" + common + encoded + stream
    end = struct.pack("<HHHHIIH", 0, 0, len(members), len(members), len(directory), len(files), 0)
    return files + directory + b"PK\x05\x06" + end


def npz_files(seed: Input, target: str) -> Made:
    """Archives that lie, that burst, or that hold what is no array."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)

    def arrays() -> dict[str, np.ndarray]:
        with np.load(io.BytesIO(whole)) as data:
            return {name: data[name] for name in data.files}

    def each(change: Callable[[np.ndarray], np.ndarray]) -> bytes:
        return npz_of({name: change(array) for name, array in arrays().items()})

    def many_members() -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for i in range(20_000):
                archive.writestr(zipfile.ZipInfo(f"{i}.npy"), b"")
        return stream.getvalue()

    names = lambda: tuple(arrays())  # noqa: E731
    changed: dict[str, Callable[[], Content]] = {
        "bomb of 1.6 GB": lambda: npz_bomb(names(), (200_000_000,), "<f8"),
        "bomb of 20000 x 20000": lambda: npz_bomb(names(), (20_000, 20_000), "<f4"),
        "pickled": lambda: each(lambda a: np.full(a.shape, {"a": 1}, dtype=object)),
        "strings": lambda: each(lambda a: a.astype("U10")),
        "transposed": lambda: each(lambda a: a.T),
        "flat": lambda: each(np.ravel),
        "empty": lambda: each(lambda a: a.reshape(-1)[:0]),
        "all zero-dimensional": lambda: each(lambda a: np.zeros((), dtype=a.dtype)),
        "complex": lambda: each(lambda a: a.astype("c16") if a.dtype.kind in "fiub" else a),
        "not a number": lambda: each(lambda a: np.full_like(a, np.nan) if a.dtype.kind == "f" else a),
        "infinite": lambda: each(lambda a: np.full_like(a, np.inf) if a.dtype.kind == "f" else a),
        "largest": lambda: each(lambda a: np.full_like(a, np.iinfo(a.dtype).max) if a.dtype.kind in "iu" else a),
        "smallest": lambda: each(lambda a: np.full_like(a, np.iinfo(a.dtype).min) if a.dtype.kind in "iu" else a),
        "larger image": lambda: each(lambda a: np.concatenate([a, a]) if a.ndim else a),
        "no members": lambda: npz_of({}),
        "20 000 members": many_members,
        "an npy file": lambda: _npy(np.zeros(3)),
        "a pickle": lambda: b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00]\x94(K\x01K\x02e.",
        "lying shape": lambda: npz_of(arrays(), {n: _npy(a, b"(10000000000000,)") for n, a in arrays().items()}),
        "negative shape": lambda: npz_of(arrays(), {n: _npy(a, b"(-1,)") for n, a in arrays().items()}),
        "code for a header": lambda: npz_of(arrays(), {n: _npy(a, b"__import__('os')") for n, a in arrays().items()}),
    }
    return _changed(seed, target, changed)


def _npy(array: np.ndarray, shape: bytes = b"") -> bytes:
    """An .npy file; `shape` stands in its header for the true one."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array if array.dtype.kind != "O" else np.zeros(3))
    content = stream.getvalue()
    if not shape:
        return content
    at = content.index(b"'shape': ") + 9
    end = content.index(b"), }", at) + 1
    return content[:at] + shape + content[end:]


# --- formats ----------------------------------------------------------------------------------------------------------


def images(seed: Input, target: str) -> Made:
    """Images that are bombs, or none."""
    made: Made = {
        "png bomb of 30000 x 30000 bits": lambda: seed.with_file(target, png_bomb(30_000, 30_000, 1)),
        "png bomb of 12000 x 12000 bytes": lambda: seed.with_file(target, png_bomb(12_000, 12_000, 8)),
        "png text bomb": lambda: seed.with_file(target, png_text_bomb()),
        "pgm that lies": lambda: seed.with_file(target, b"P5 2147483647 2147483647 255\n"),
        "pgm of 10^5 x 10^5": lambda: seed.with_file(target, Sparse(10**10 + 20, b"P5 100000 100000 255\n")),
        "gif": lambda: seed.with_file(target, b"GIF89a\x01\x00\x01\x00\x80\x00\x00\x00\x00\x00\xff\xff\xff!\xf9"),
        "svg": lambda: seed.with_file(target, b"<svg xmlns='http://www.w3.org/2000/svg'/>"),
        "eps": lambda: seed.with_file(target, b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n"),
    }
    if target.endswith(".png") and "/" not in target:  # valid ones, long to decode: once is enough, the decoder is one
        made["png of 9000 x 9000 colours"] = lambda: seed.with_file(target, png_bomb(9000, 9000, 8, 6))
        made["png of 4000 x 4000 words"] = lambda: seed.with_file(target, png_bomb(4000, 4000, 16))
        made["png of a line of 10^8 bits"] = lambda: seed.with_file(target, png_bomb(100_000_000, 1, 1))
    return made


def toml_files(seed: Input, target: str) -> Made:
    """TOML that parsers stumble on, and settings that nobody means."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    scene = b'scene = "plane.xml"\n'
    sensor = scene + b"[[instrument]]\nname = 'one'\n[instrument.sensor]\n"
    texts = {
        "1000 brackets": scene + b"x = " + b"[" * 1000 + b"]" * 1000,
        "100 000 brackets": scene + b"x = " + b"[" * 100_000 + b"]" * 100_000,
        "100 000 open brackets": b"x = " + b"[" * 100_000,
        "20 000 braces": scene + b"x = " + b"{a=" * 20_000 + b"1" + b"}" * 20_000,
        "nonsense, 20 000 dots": b"a" + b".a" * 20_000 + b" = 1\n" + scene,
        "20 000 dotted tables": b"[a" + b".a" * 20_000 + b"]\n",
        "nonsense, number of 5000 digits": scene + b"spp = " + b"9" * 5000,
        "number of 4000 digits": scene + b"spp = " + b"9" * 4000,
        "hexadecimal of 5000 digits": scene + b"spp = 0x" + b"f" * 5000,
        "spp 10^9": scene + b"spp = 1000000000\n",
        "spp 10^30": scene + b"spp = 1" + b"0" * 30,
        "size 10^6": scene + b"width = 1000000\nheight = 1000000\n",
        "depth 10^9": scene + b"max_depth = 1000000000\n",
        "nonsense, caustics 2": scene + b"caustics = 2\n",
        "nonsense, seed 2^70": scene + b"seed = 1180591620717411303424\n",
        "nonsense, seed -1": scene + b"seed = -1\n",
        "nonsense, width true": scene + b"width = true\n",
        "nonsense, infinite period": sensor + b"type = 'structured-light'\nperiod_px = inf\n",
        "nonsense, nan period": sensor + b"type = 'structured-light'\nperiod_px = nan\n",
        "tiny period": sensor + b"type = 'structured-light'\nperiod_px = 1e-300\n",
        "nonsense, steps 10^30": sensor + b"type = 'structured-light'\ncode = 'gray-phase'\nsteps = 1" + b"0" * 30,
        "nonsense, steps 10^9": sensor + b"type = 'structured-light'\ncode = 'gray-phase'\nsteps = 1000000000",
        "nonsense, projector 10^9": sensor + b"type = 'structured-light'\nprojector_width = 1000000000\n",
        "nonsense, axes twice": sensor + b"type = 'structured-light'\naxes = ['columns', 'columns']\n",
        "10^5 axes": sensor + b"type = 'structured-light'\naxes = [" + b"'rows'," * 100_000 + b"]\n",
        "nonsense, bins 10^9": sensor + b"type = 'direct-tof'\nbins = 1000000000\n",
        "nonsense, bin 1e-300": sensor + b"type = 'direct-tof'\nbin_s = 1e-300\n",
        "nonsense, infinite pulse": sensor + b"type = 'direct-tof'\npulse_fwhm_s = inf\n",
        "frequency 2^63": sensor + b"type = 'amcw-tof'\nmodulation_hz = [9223372036854775808.0]\n",
        "frequencies close by": sensor + b"type = 'amcw-tof'\nmodulation_hz = [1e12, 1.000000001e12]\n",
        "nonsense, infinite frequency": sensor + b"type = 'amcw-tof'\nmodulation_hz = [inf]\n",
        "10^5 frequencies": sensor + b"type = 'amcw-tof'\nmodulation_hz = [" + b"1e6," * 100_000 + b"]\n",
        "nonsense, power 1e300": scene + b"[[instrument]]\nsensor = 'amcw'\npower_w = 1e300\n",
        "nonsense, power nan": scene + b"[[instrument]]\nsensor = 'amcw'\npower_w = nan\n",
        "nonsense, baseline inf": scene + b"[[instrument]]\nsensor = 'amcw'\nbaseline_m = inf\n",
        "2000 instruments": scene
        + b"".join(b"[[instrument]]\nname = 'i%d'\nsensor = 'amcw'\n" % i for i in range(2000)),
        "nonsense, names of files": scene + b"[[instrument]]\nname = '../../x'\nsensor = 'amcw'\n",
        "nonsense, name empty": scene + b"[[instrument]]\nname = ''\nsensor = 'amcw'\n",
        "nonsense, name NUL": scene + b'[[instrument]]\nname = "a\\u0000b"\nsensor = "amcw"\n',
        "scene NUL": b'scene = "a\\u0000b"\n',
        "dates": b"scene = 1979-05-27T07:32:00Z\n",
        "key twice": scene + scene,
    }
    return {name: partial(seed.with_file, target, text) for name, text in texts.items()}


def xml_files(seed: Input, target: str) -> Made:
    """Scenes that crash or fool an XML reader, and properties that nobody means."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    text = whole.decode()

    def inside(more: str) -> Content:
        return text.replace("</scene>", more + "</scene>").encode("utf-8", "surrogatepass")

    def nested(tag: str, kind: str, n: int) -> str:
        return f'<{tag} type="{kind}">' * n + f"</{tag}>" * n

    diffuse = '<bsdf type="diffuse"><{} name="reflectance" value="{}"/></bsdf>'
    sphere = '<shape type="sphere"><float name="radius" value="{}"/>{}</shape>'
    glass = '<bsdf type="dielectric"><float name="int_ior" value="{}"/></bsdf>'
    light = '<emitter type="constant"><spectrum name="radiance" value="{}"/></emitter>'
    scaled = '<shape type="cube"><transform name="to_world"><scale value="{}"/></transform></shape>'
    lol = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + "".join(
        f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9)
    )
    made = {
        "nonsense, 20 000 nested bsdf": inside(sphere.format("1", nested("bsdf", "twosided", 20_000))),
        "2000 nested bsdf": inside(sphere.format("1", nested("bsdf", "twosided", 2000))),
        "300 nested bsdf": inside(sphere.format("1", nested("bsdf", "mask", 300))),
        "200 000 nested bsdf": inside(nested("bsdf", "twosided", 200_000)),
        "20 000 nested textures": inside(nested("texture", "bitmap", 20_000)),
        "20 000 nested unknown": inside("<x>" * 20_000 + "</x>" * 20_000),
        "20 000 open": ("<scene>" * 20_000).encode(),
        "bsdf that refers to itself": inside('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>'),
        "bsdfs that refer to each other": inside(
            '<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>'
        ),
        "nonsense, includes itself": inside(f'<include filename="{target}"/>'),
        "includes a directory": inside('<include filename="."/>'),
        "nonsense, includes an endless file": inside('<include filename="/dev/zero"/>'),
        "includes a password file": inside('<include filename="/etc/passwd"/>'),
        "includes nothing": inside('<include filename=""/>'),
        "nonsense, laughs": (lol + f"]><scene version='3.0.0'>&{chr(98 + 8)};</scene>").encode(),
        "external entity": b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><scene version="3.0.0">&a;</scene>',
        "no root": b"<?xml version='1.0'?>",
        "wrong root": b"<bsdf type='diffuse'/>",
        "empty scene": b"<scene version='3.0.0'/>",
        "version of the future": text.replace('version="3.0.0"', 'version="99.0.0"').encode(),
        "version nonsense": text.replace('version="3.0.0"', 'version="x"').encode(),
        "version huge": text.replace('version="3.0.0"', f'version="{"9" * 400}.0.0"').encode(),
        "10 000 default parameters": inside("".join(f'<default name="p{i}" value="$p{i}"/>' for i in range(10_000))),
        "parameter of itself": inside('<default name="p" value="$p$p"/><float name="a" value="$p"/>'),
        "parameters double": inside(
            "".join(f'<default name="p{i}" value="$p{i + 1}$p{i + 1}"/>' for i in range(64))
            + '<string name="a" value="$p0"/>'
        ),
        "a million attributes": inside("<x " + " ".join(f'a{i}="1"' for i in range(100_000)) + "/>"),
        "attribute twice": inside('<float name="a" name="b" value="1"/>'),
        "attribute of a megabyte": inside(f'<string name="a" value="{"a" * 1_000_000}"/>'),
        "id twice": inside('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>'),
        "id hostile": inside('<bsdf type="diffuse" id="&lt;script&gt;&#10;\ud800"/>'),
        "id NUL": inside('<bsdf type="diffuse" id="&#0;"/>'),
        "name of a shape hostile": inside('<shape type="sphere" id="&lt;img src=x onerror=alert(1)&gt;"/>'),
        "name of a shape of escapes": inside('<shape type="sphere" id="a&#27;[31m"><ref id="nothing&#27;"/></shape>'),
        "encoding lies": b'<?xml version="1.0" encoding="utf-16"?>' + whole,
        "encoding unknown": b'<?xml version="1.0" encoding="klingon"?>' + whole,
        "nonsense, reflectance 2": inside(sphere.format("1", diffuse.format("spectrum", "2"))),
        "nonsense, reflectance -1": inside(sphere.format("1", diffuse.format("spectrum", "-1"))),
        "nonsense, reflectance nan": inside(sphere.format("1", diffuse.format("spectrum", "nan"))),
        "nonsense, reflectance of colour nan": inside(sphere.format("1", diffuse.format("rgb", "nan,nan,nan"))),
        "nonsense, reflectance of colour 1e30": inside(sphere.format("1", diffuse.format("rgb", "1e30,0,0"))),
        "reflectance of colour 4 numbers": inside(sphere.format("1", diffuse.format("rgb", "1,1,1,1"))),
        "reflectance of 10^5 wavelengths": inside(
            sphere.format("1", diffuse.format("spectrum", ",".join(f"{i}:0.5" for i in range(100_000))))
        ),
        "reflectance of wavelengths backwards": inside(sphere.format("1", diffuse.format("spectrum", "700:1,400:0"))),
        "nonsense, radius nan": inside(sphere.format("nan", "")),
        "nonsense, radius -1": inside(sphere.format("-1", "")),
        "radius 0": inside(sphere.format("0", "")),
        "nonsense, radius inf": inside(sphere.format("inf", "")),
        "nonsense, radius 1e12": inside(sphere.format("1e12", "")),
        "nonsense, radius 1e38": inside(sphere.format("1e38", "")),
        "nonsense, index nan": inside(sphere.format("1", glass.format("nan"))),
        "nonsense, index -1": inside(sphere.format("1", glass.format("-1"))),
        "index 0": inside(sphere.format("1", glass.format("0"))),
        "nonsense, index inf": inside(sphere.format("1", glass.format("inf"))),
        "nonsense, radiance nan": inside(light.format("nan")),
        "nonsense, radiance -1": inside(light.format("-1")),
        "nonsense, radiance 1e300": inside(light.format("1e300")),
        "scale 0": inside(scaled.format("0")),
        "nonsense, scale nan": inside(scaled.format("nan")),
        "nonsense, matrix of nan": inside(
            f'<shape type="cube"><transform name="to_world"><matrix value="{"nan " * 16}"/></transform></shape>'
        ),
        "look at itself": inside(
            '<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,0" target="0,0,0" up="0,0,1"/>'
            "</transform></sensor>"
        ),
        "nonsense, field of view nan": text.replace('name="fov" value="40"', 'name="fov" value="nan"').encode(),
        "nonsense, field of view 180": text.replace('name="fov" value="40"', 'name="fov" value="180"').encode(),
        "nonsense, film 10^9": text.replace('name="width" value="16"', 'name="width" value="1000000000"').encode(),
        "nonsense, film 2^31": text.replace('name="width" value="16"', 'name="width" value="2147483648"').encode(),
        "nonsense, film -1": text.replace('name="width" value="16"', 'name="width" value="-1"').encode(),
        "nonsense, film 0": text.replace('name="width" value="16"', 'name="width" value="0"').encode(),
        "film true": text.replace(
            '<integer name="width" value="16"/>', '<boolean name="width" value="true"/>'
        ).encode(),
        "a texture of nothing": inside(
            '<texture type="bitmap" id="t"><string name="filename" value="nowhere.png"/></texture>'
        ),
        "a texture of a directory": inside(
            '<texture type="bitmap" id="t"><string name="filename" value="."/></texture>'
        ),
        "an endless texture": inside('<texture type="bitmap"><string name="filename" value="/dev/zero"/></texture>'),
        "an endless mesh": inside('<shape type="ply"><string name="filename" value="/dev/zero"/></shape>'),
        "a mesh of nothing": inside('<shape type="obj"><string name="filename" value=""/></shape>'),
        "5000 spheres": inside("".join(sphere.format(f"0.0{i + 1}", "") for i in range(5000))),
        "a material class that is none": inside(
            '<shape type="sphere"><string name="material_class" value="x\ny"/></shape>'
        ),
        "a plugin that is none": inside('<shape type="../../x"/>'),
        "a plugin with NUL": inside('<shape type="a&#0;b"/>'),
        "a processing instruction": b"<?xml-stylesheet href='file:///etc/passwd'?>" + whole,
        "control characters": inside('<bsdf type="diffuse" id="a\x01b"/>'),
    }  # fmt: skip
    return {name: partial(seed.with_file, target, content) for name, content in made.items()}


def opencv_calibrations(seed: Input, target: str) -> Made:
    """Calibrations whose numbers no camera has."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    made: Made = {}
    for word in ("nan", "inf", "-inf", "1e308", "1e400", "-1e308", "0", "1e-300", "x", "", "1 2", "9" * 5000, "\u0661"):
        for name in ("img_shape", "cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation"):
            start, _, rest = whole.partition(f"<{name}".encode())
            before, mark, numbers = rest.partition(b"<data>")
            values, end, after = numbers.partition(b"</data>")
            changed = " ".join([word, *values.decode().split()[1:]]).encode()
            content = start + f"<{name}".encode() + before + mark + changed + end + after
            nonsense = "nonsense, " if word in ("nan", "inf", "-inf", "1e400", "x", "") else ""
            made[f"{nonsense}{name} {word[:8]}"] = partial(seed.with_file, target, content)
    deep = b"<opencv_storage>" + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</opencv_storage>"
    made["100 000 nested"] = partial(seed.with_file, target, deep)
    many = whole.replace(b"<data>", b"<data>" + b"1 " * 1_000_000, 1)
    made["10^6 numbers"] = partial(seed.with_file, target, many)
    entities = "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
    laughs = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "1 1 1 1 1 ">{entities}]>'.encode()
    made["laughs"] = partial(
        seed.with_file, target, laughs + whole.replace(b"<data>", b"<data>&j;", 1).split(b"?>")[-1]
    )
    return made


def meshes(seed: Input, target: str) -> Made:
    """Meshes that are wrong in ways of their own."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    texts: dict[str, bytes] = {}
    if target.endswith(".obj"):
        cube = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
        texts = {
            "vertex of a word": b"v x y z\n" + whole,
            "vertex of two numbers": b"v 0 0\n" + cube + b"f 1 2 3\n",
            "vertex nan": b"v nan 0 0\n" + cube + b"f 1 2 3\n",
            "vertex 1e300": b"v 1e300 0 0\n" + cube + b"f 1 2 3\n",
            "vertex 1e30": b"v 1e30 0 0\n" + cube + b"f 1 2 3\n",
            "face of itself": cube + b"f 1 1 1\n",
            "face beyond": cube + b"f 1 2 99999999\n",
            "face zero": cube + b"f 0 1 2\n",
            "face negative": cube + b"f -1 -2 -3\n",
            "face far negative": cube + b"f -1 -2 -300\n",
            "face of words": cube + b"f a b c\n",
            "face of one": cube + b"f 1\n",
            "face of 10^5": cube + b"f" + b" 1 2 3" * 30_000 + b"\n",
            "face with slashes": cube + b"f 1//// 2/ 3/x/y\n",
            "endless number": b"v " + b"9" * 100_000 + b" 0 0\n" + cube + b"f 1 2 3\n",
            "library that is endless": b"mtllib /dev/zero\nusemtl a\n" + cube + b"f 1 2 3\n",
            "library elsewhere": b"mtllib ../../../etc/passwd\nusemtl a\n" + cube + b"f 1 2 3\n",
            "no faces": cube,
            "all in a point": b"v 0 0 0\n" * 3 + b"f 1 2 3\n",
            "in a line": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
        }
    elif target.endswith(".off"):
        texts = {
            "promises 10^12": b"OFF\n1000000000000 1000000000000 0\n0 0 0\n",
            "promises -1": b"OFF\n-1 -1 0\n0 0 0\n",
            "promises words": b"OFF\na b c\n",
            "face of 10^9": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n",
        }
    elif target.endswith(".stl"):
        texts = {
            "promises 2^32": bytes(80) + b"\xff\xff\xff\xff" + bytes(50),
            "promises nothing": bytes(80) + b"\0\0\0\0",
            "solid of nothing": b"solid x\nendsolid x\n",
            "solid of words": b"solid x\nfacet normal a b c\nouter loop\nvertex a b c\nendloop\nendfacet\nendsolid\n",
            "triangle of nan": bytes(80) + b"\x01\0\0\0" + struct.pack("<12f", *[np.nan] * 12) + b"\0\0",
            "triangle of inf": bytes(80) + b"\x01\0\0\0" + struct.pack("<12f", *[np.inf] * 12) + b"\0\0",
            "triangle of 1e38": bytes(80)
            + b"\x01\0\0\0"
            + struct.pack("<12f", *range(3), *[3e38, 0, -3e38] * 3)
            + b"\0\0",
        }
    elif target.endswith(".glb"):
        deep = json.dumps({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]})
        texts = {
            "length lies": b"glTF" + struct.pack("<II", 2, 2**32 - 1) + struct.pack("<II", 2**32 - 1, 0x4E4F534A),
            "version 1": b"glTF" + struct.pack("<II", 1, 20) + whole[12:],
            "brackets": _glb(b"[" * 100_000),
            "node of itself": _glb(deep.replace("}]}", '}], "nodes": [{"children": [0]}]}').encode()),
            "no meshes": _glb(deep.encode()),
        }
    elif target.endswith(".gltf"):
        data = json.loads(whole)
        uris = {
            "nowhere": "nowhere.bin",
            "endless": "/dev/zero",
            "outside": "../../../etc/passwd",
            "the network": "http://localhost:1/x.bin",
            "no data": "data:,",
            "bad base64": "data:;base64,###",
        }
        for name, uri in uris.items():
            changed = json.loads(json.dumps(data))
            for buffer in changed.get("buffers", ()):
                buffer["uri"] = uri
            texts[f"buffer {name}"] = json.dumps(changed).encode()
    made: Made = {name: partial(seed.with_file, target, text) for name, text in texts.items()}
    return made


def _glb(content: bytes) -> bytes:
    content += b" " * (-len(content) % 4)
    chunk = struct.pack("<II", len(content), 0x4E4F534A) + content
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk


def exr_files(seed: Input, target: str) -> Made:
    """OpenEXR headers that promise more than there is."""
    whole = seed.files[target]
    assert isinstance(whole, bytes)
    made: Made = {}
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = whole.find(name)
        if at < 0:
            continue
        at += len(name) + 4
        for label, box in {
            "of 10^9": (0, 0, 10**9, 10**9),
            "of 30000": (0, 0, 29_999, 29_999),
            "backwards": (5, 5, 0, 0),
            "of all integers": (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
            "of a line of 2^30": (0, 0, 2**30, 0),
        }.items():
            content = whole[:at] + struct.pack("<4i", *box) + whole[at + 16 :]
            made[f"{name.split(bytes(1))[0].decode()} {label}"] = partial(seed.with_file, target, content)
    for kind in range(12):
        at = whole.find(b"compression\0compression\0") + 28
        made[f"compression {kind}"] = partial(seed.with_file, target, whole[:at] + bytes([kind]) + whole[at + 1 :])
    return made
