"""Ways to damage a file: its bytes, words and numbers, and the contents of JSON, zip archives and headers."""

from __future__ import annotations

import json
import re
import struct
import zipfile
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]
WORDS = (
    *b"nan inf -inf -1 0 1 1e308 -1e308 1e-320 1e59 1e400 4294967295 2147483648 9223372036854775808".split(),
    *b"99999999999999999999999 -nan(ind) 1_000 0x10 0,5 -1,25e3 ,5 5, 1;2 N/A 1.#QNAN 1.000e+00 end_header list".split(),
    *b'uchar double null true / // 1/ /1 1//2 { } [ [0.5] " <a> <!ENTITY </script> ../../etc/passwd /dev/zero'.split(),
    *rb"%2e%2e/x a%20b.png a.png?v=3 #a C:\\t\a.png \\\\host\a.png file:///etc/passwd ~nobody \ \\".split(),
    *(b"9" * 5000, b"x" * 300, b"", b"\0", b"\n", b"\r", b"\x1b]0;pwned\x07\x1b[31m", b"\xc2\x9b31m", b"\xff\xfe"),
    *(b"\xe2\x80\xae", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\xd9\xa3", b"k\xc3\xb6rper.png", b"ko\xcc\x88rper.png"),
    *(b"[" * 2000, b"{" * 2000),
)
LINES = (
    *rb"# D:\scans\|#\|Tr 1|d 0|d|Kd 0,5 0,5 0,5|map_Kd textures\T.PNG|map_d a.png|usemtl|usemtl A|newmtl a\ ".split(
        b"|"
    ),
    *b"mtllib A.MTL b.mtl|f 1 2 3 4 5 6|f 1 / 1 2 / 2 3 / 3|f 1/|#MRGB ffff0000ff00ff00|#MRGB f|vt 0,5 0,5|solid".split(
        b"|"
    ),
    *b"v 512345.678 4612345.678 120|vc 1 2 3|comment TextureFile ../a.png|comment SPACE=RAS|element tristrips 3".split(
        b"|"
    ),
    *b"property list uchar float texcoord|property int texnumber|property uchar diffuse_red|property float s".split(
        b"|"
    ),
    *b"# CoordinateSystem = 3|# columns = x,y|LM3=4|ID=a|SCALE=0,5|vertex;label|name\tx\ty\tz|//X Y Z|9|;;".split(b"|"),
    *(b"", b"nan,nan,nan", b'"a""b"', b"0,5\t1,5"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 2, 3, 255, 2**31, 2**32, 2**63, 10**30, -(2**63), 0.5, -0.5, 1e308, 1e-320, "", "x"),
    *("x" * 400, "\x1b]0;pwned\x07", "\u202e", "a\nb", "\ud800", [], {}, [[]], [1, 2], [None], {"a": 1}, [[1], [1, 2]]),
    *("C:\\a.png", "a%20b.bin?v=3", "K\u00f6.png", "0,5", "LPS", "undefined", "EXT_meshopt_compression", 512345.678),
    *(["KHR_unknown"], {"KHR_node_visibility": {"visible": False}}, {"EXT_mesh_gpu_instancing": {"attributes": {}}}),
    *(["a"], [1e308] * 4, [0.5] * 3, [[0.5] * 3] * 3, "../x", "/dev/zero", "data:,", "data:;base64,AAAA", "~nobody/x"),
)
NUMBERS = (0, 1, 2, 3, 127, 128, 255, 256, 65535, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
_KEYS = ["x", "matrix", "sparse", "uri", "extensions", "extensionsRequired", "mode", "markups", "position", "\x1b[31m"]
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[+-]?\d+)?")
_WORD = re.compile(rb"[^\s,;\"]+")


def apply_damage(data: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """Apply one to three random damages to a file's bytes; `other` are those of another file of the family."""
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.05:
            cut, resume = rng.integers(len(data) + 1), rng.integers(len(other) + 1)
            data = data[:cut] + other[resume:]
            continue
        ways = WAYS + STRUCTURED if rng.random() < 0.6 else WAYS
        data = ways[int(rng.integers(len(ways)))](data, rng)[:4_000_000]
    return data


def _position(data: bytes, rng: np.random.Generator) -> int:
    """Random position; half of the time near the beginning, where headers are."""
    limit = len(data) + 1
    return int(rng.integers(min(limit, 600) if rng.random() < 0.5 else limit))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        at = _position(data, rng)
        if at < len(changed):
            changed[at] ^= 1 << int(rng.integers(8)) if rng.random() < 0.5 else int(rng.integers(1, 256))
    return bytes(changed)


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _position(data, rng)]


def _remove(data: bytes, rng: np.random.Generator) -> bytes:
    at = _position(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 200)) :]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    at = _position(data, rng)
    end = at + int(rng.integers(1, 200))
    return data[:end] + data[at:end] * int(rng.choice([1, 2, 50, 2000])) + data[end:]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _position(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 50))) + data[at:]


def _integer(data: bytes, rng: np.random.Generator) -> bytes:
    kind = str(rng.choice(["<u2", "<u4", "<u8", ">u4", "u1"]))
    number = NUMBERS[int(rng.integers(len(NUMBERS)))] % (1 << 8 * np.dtype(kind).itemsize)
    at = _position(data, rng) // (1 if rng.random() < 0.5 else 4) * (1 if rng.random() < 0.5 else 4)
    written = np.array(number, kind).tobytes()
    return data[:at] + written + data[at + len(written) :]


def _replace_match(pattern: re.Pattern[bytes]) -> Damage:
    def change(data: bytes, rng: np.random.Generator) -> bytes:
        match = pattern.search(data, _position(data, rng))
        if match is None:
            return _flip(data, rng)
        return data[: match.start()] + WORDS[int(rng.integers(len(WORDS)))] + data[match.end() :]

    return change


def _line(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, duplicate, move or repeat a line."""
    lines = data.split(b"\n")
    at, target = (int(rng.integers(len(lines))) for _ in range(2))
    line = lines.pop(at)
    for _ in range(int(rng.choice([0, 1, 2, 3000]))):
        lines.insert(target, line)
        if len(line) > 1000:
            break
    return b"\n".join(lines)


def _insert_line(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert a line that is typical of some format or program."""
    at = data.find(b"\n", _position(data, rng)) + 1
    return data[:at] + LINES[int(rng.integers(len(LINES)))] + b"\n" + data[at:]


def _change_conventions(data: bytes, rng: np.random.Generator) -> bytes:
    """Rewrite the text in the conventions of another program or locale."""
    return _CONVENTIONS[int(rng.integers(len(_CONVENTIONS)))](data)


_CONVENTIONS: tuple[Callable[[bytes], bytes], ...] = (
    lambda data: b"\xef\xbb\xbf" + data,
    lambda data: data.decode("latin-1").encode("utf-16"),
    lambda data: b"\xfe\xff" + data.decode("latin-1").encode("utf-16-be"),
    lambda data: re.sub(rb"(\d)\.(\d)", rb"\1,\2", data),
    lambda data: re.sub(rb"(\d)\.(\d)", rb"\1,\2", data.replace(b",", b";")),
    lambda data: data.replace(b",", b"\t"),
    lambda data: data.replace(b" ", b";"),
    lambda data: data.replace(b"\n", b"\r"),
    lambda data: data.replace(b"\n", b"\r\n"),
    lambda data: data.replace(b"\n", b"\\\n"),
    lambda data: re.sub(rb"(?m)^(?=[vfmn])", rb"# C:\\\n", data),
    lambda data: data.replace(b"/", b"\\"),
    bytes.upper,
    bytes.swapcase,
)
WAYS: list[Damage] = [
    *(
        _flip,
        _cut,
        _remove,
        _repeat,
        _insert,
        _integer,
        _replace_match(_NUMBER),
        _replace_match(_WORD),
        _line,
        _insert_line,
        _change_conventions,
    )
]


def _json(data: bytes, rng: np.random.Generator) -> bytes:
    """Change or remove a value in the JSON of a file, of a glb or of a safetensors header."""
    for part in (lambda whole: (whole, bytes), _glb, _tensors):
        try:
            text, put_back = part(data)
            document = json.loads(text)
        except (ValueError, struct.error, IndexError, RecursionError):
            continue
        if isinstance(document, dict | list) and document:
            try:
                return put_back(json.dumps(_change_value(document, rng)).encode("utf-8", "surrogatepass"))
            except RecursionError:  # nested more than once
                break
    return _flip(data, rng)


def _change_value(document: Any, rng: np.random.Generator) -> Any:
    inner = document
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = keys[int(rng.integers(len(keys)))]
        below = inner[key]
        if not (isinstance(below, dict | list) and below) or rng.random() < 0.15:
            break
        inner = below
    way = rng.random()
    if way < 0.1:
        del inner[key]
    elif way < 0.2 and isinstance(inner, dict):
        inner[str(rng.choice(_KEYS))] = inner.pop(key)
    elif way < 0.25:
        for _ in range(500):
            inner[key] = [inner[key]]
    else:
        inner[key] = VALUES[int(rng.integers(len(VALUES)))]
    return document


def _glb(data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    if data[:4] != b"glTF":
        raise ValueError
    size = int.from_bytes(data[12:16], "little")
    rest = data[20 + size :]

    def put_back(text: bytes) -> bytes:
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
        return head + text + rest

    return data[20 : 20 + size], put_back


def _tensors(data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    size = int.from_bytes(data[:8], "little")
    return data[8 : 8 + size], lambda text: len(text).to_bytes(8, "little") + text + data[8 + size :]


def _archive(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a member of a zip archive, or fill it with zeros, and pack it again with the right checksum."""
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            members = [(name, archive.read(name)) for name in archive.namelist()]
    except Exception:  # not an archive, or already damaged
        return _flip(data, rng)
    chosen = int(rng.integers(max(len(members), 1)))
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, (name, content) in enumerate(members):
            if number == chosen:
                zeros, change = (
                    rng.random() < 0.05,
                    _header if rng.random() < 0.6 else WAYS[int(rng.integers(len(WAYS)))],
                )
                content = bytes(3_000_000) if zeros else change(content, rng)
            archive.writestr(name, content)
    return out.getvalue()


def _header(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the shape or dtype in the header of an npy array."""
    end = data.find(b"\n")
    if data[:6] != b"\x93NUMPY" or not 10 < end < 1000:
        return _flip(data, rng)
    kinds = ["<f8", "|i1", "<i8", "|O", "<U9", "|S3", "<c16", "|b1", "<f2", ">i4", "<M8[s]", "|V8"]
    shapes = ["(1,)", "()", "(0,)", "(2, 3)", "(-1,)", "(99999999999,)", "(300000000, 0)", "3", "(4294967296,)"]
    kind, shape = str(rng.choice(kinds)), str(rng.choice(shapes))
    old = data[10:end]
    if rng.random() < 0.6:
        new = re.sub(rb"'descr': '[^']*'", f"'descr': '{kind}'".encode(), old)
    else:
        new = re.sub(rb"'shape': \([^)]*\)", f"'shape': {shape}".encode(), old)
    new = new.strip().ljust(len(old))
    return data[:8] + len(new + b"\n").to_bytes(2, "little") + new + data[end:]


STRUCTURED: list[Damage] = [_json, _archive, _header, _json]
