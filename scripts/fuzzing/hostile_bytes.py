"""Sound bytes that are changed where it hurts, and checksums that fit again: what `fuzz.py` feeds."""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

from gmmtorch.files import with_checksum

HOSTILE = (
    b"../../../tmp/x", b"\x1b[31mred\x1b]0;title\x07", b"\0", b"\r\n\t", b"a" * 3000, "\u202e".encode(),
    b"%s%n", b"..", b"/etc/passwd", b"CON", b"\xff\xfe",
    b"nan", b"-inf", b"1e999", b"9" * 40, b"-1", b"0", b"0x10", b"1_0", b"1,5", b"{{}}", b"!!python/object:x",
    b"&a [*a, *a]", b"<<: *a", b"[" * 2000, b"{a: " * 500, b"? ", b"--- ", b"- " * 500,
)  # fmt: skip
SIZES = (0, 1, 2, 127, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1)
_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2**31, 2**53, 2**63, 2**64, 10**400, -(2**63), 1e308, 1e-320, float("nan"),
    float("inf"), "", "nan", "../../x", "\x1b[31m", [], {}, [[]], [0] * 5000, "9" * 50, {"$tensor": "0"},
    {"$tensor": "x"},
)  # fmt: skip
_TYPES = {
    "BOOL": 1,
    "U8": 1,
    "I16": 2,
    "I32": 4,
    "F32": 4,
    "I64": 8,
    "F64": 8,
    "F16": 2,
    "BF16": 2,
    "F8_E4M3": 1,
}
_MOST_BYTES = 4 << 20

Change = Callable[[bytes, list[bytes], random.Random], bytes]


def changed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Sound bytes with one to four changes. others: sound ones from which parts are taken."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(found)) if found else 0
        kind = rng.randrange(9)
        if kind == 0 and found:
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            form = rng.choice("BHIQ")
            size = struct.calcsize(form)
            number = (rng.choice(SIZES) + rng.choice((-1, 0, 0, 1))) % (1 << 8 * size)
            found[at : at + size] = struct.pack(rng.choice("<>") + form, number)
        elif kind == 2:
            del found[at : at + rng.choice((1, 2, 4, 8, 100, 5000))]
        elif kind == 3:
            end = at + rng.choice((1, 4, 8, 64, 1000))
            found[at:at] = found[at:end] * rng.choice((1, 1, 2, 50))
        elif kind == 4:
            del found[at:]
        elif kind == 5:
            other = rng.choice(others)
            begin = rng.randrange(len(other)) if other else 0
            found[at : at + rng.choice((4, 64, 1000))] = other[begin : begin + rng.choice((4, 64, 1000))]
        elif kind == 6:
            words = list(re.finditer(rb"[A-Za-z0-9_./+-]{1,40}", found[max(0, at - 200) : at + 200]))
            if words:
                word, start = rng.choice(words), max(0, at - 200)
                found[start + word.start() : start + word.end()] = rng.choice(HOSTILE)
        elif kind == 7:
            found[at : at + rng.choice((8, 100, 4096))] = rng.randbytes(rng.choice((8, 100, 4096)))
        else:
            found[at : at + rng.choice((4, 8))] = struct.pack(
                rng.choice(("<f", "<d")),
                rng.choice((float("nan"), float("inf"), -1e308 * 10, 1e38, -0.0, 1e-40)),
            )
    return bytes(found[:_MOST_BYTES])


# -- formats with parts ------------------------------------------------------------------------------


def changed_tensors(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A safetensors file with changes behind its checksums: in its facts, its layout or its tensors."""
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    names = [name for name in header if name != "__metadata__"]
    for _ in range(rng.choice((1, 1, 2))):
        entry = header[rng.choice(names)] if names else {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]}
        begin, end = entry["data_offsets"]
        kind = rng.randrange(6)
        if kind <= 1:
            about = json.loads(header["__metadata__"]["gmmtorch"])
            _change_value(about["facts"], rng)
            header["__metadata__"]["gmmtorch"] = json.dumps(about, sort_keys=True, separators=(",", ":"))
        elif kind == 2:  # another type or shape of as many bytes
            entry["dtype"] = rng.choice(list(_TYPES))
            n = max(end - begin, 0) // _TYPES[entry["dtype"]]
            entry["shape"] = rng.choice(
                ([n], [n, 1], [1, n], [n // 2, 2], [n // 3, 3], [0, n], [n], [1] * 70, [])
            )
        elif kind == 3 and names:
            header[rng.choice((*names, "x" * 200, "\x1b[31m"))] = header.pop(rng.choice(names))
            names = [name for name in header if name != "__metadata__"]
        else:
            part = changed(bytes(body[begin:end]), [bytes(body)], rng)
            if entry["dtype"] == "U8" and rng.random() < 0.5:  # a stream, which may have another length
                body[begin:end] = part
                _move(header, end, len(part) - (end - begin))
                entry["data_offsets"] = [begin, begin + len(part)]
                entry["shape"] = [len(part)]
            else:
                body[begin:end] = part[: end - begin].ljust(end - begin, b"\0")
    for name in names:  # the blocks of a map end with checksums of their own
        begin, end = header[name]["data_offsets"]
        if header[name]["dtype"] == "U8" and end - begin > 4 and rng.random() < 0.9:
            body[end - 4 : end] = zlib.crc32(body[begin : end - 4]).to_bytes(4, "little")
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + bytes(body)


def _move(header: dict[str, Any], begin: int, by: int) -> None:
    for name, entry in header.items():
        if name != "__metadata__" and entry["data_offsets"][0] >= begin:
            entry["data_offsets"] = [place + by for place in entry["data_offsets"]]


def _change_value(tree: Any, rng: random.Random) -> None:
    """Another value at a random place of nested dicts and lists, or none."""
    while True:
        keys = list(tree) if isinstance(tree, dict) else range(len(tree))
        if not keys:
            return
        key = rng.choice(keys)
        if isinstance(tree[key], dict | list) and tree[key] and rng.random() < 0.8:
            tree = tree[key]
        elif rng.random() < 0.15:
            del tree[key]
            return
        else:
            tree[key] = rng.choice(_VALUES)
            return


def mended_tensors(data: bytes) -> bytes:
    try:
        return with_checksum(data)
    except ValueError:
        return data


def changed_yaml(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Changed YAML; now and then with aliases that stand for billions of entries."""
    found = changed(data, others, rng)
    if rng.random() > 0.1:
        return found
    form = rng.choice(("a{n}: &a{n} [{many}]", "a{n}: &a{n}\n  k{n}: 1\n  <<: [{many}]"))
    lines = [form.format(n=n, many=",".join([f"*a{n - 1}"] * 9)) for n in range(1, 12)]
    return "\n".join(["a0: &a0 {k0: 1}", *lines, ""]).encode() + found


def changed_zip(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A ZIP file, as NPZ, with changed members whose checksums fit; or with zeros that fill the memory."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        target = rng.choice(names)
        for name in names:
            content = old.read(name)
            if name == target:
                content = changed(content, [content], rng)
                if rng.random() < 0.003:
                    content += bytes(_MOST_BYTES << 4)
            if name != target or rng.random() < 0.95:
                new.writestr(
                    name if rng.random() < 0.97 else rng.choice(("../x.npy", "\x1b[31m.npy")), content
                )
    return packed.getvalue()


# -- checksums ---------------------------------------------------------------------------------------


def mended_png(data: bytes) -> bytes:
    found, at = bytearray(data), 8
    while at + 12 <= len(found):
        (length,) = struct.unpack_from(">I", found, at)
        if at + 12 + length > len(found):
            break
        struct.pack_into(">I", found, at + 8 + length, zlib.crc32(found[at + 4 : at + 8 + length]))
        at += 12 + length
    return bytes(found)


def mended_e57(data: bytes) -> bytes:
    """Pages of 1024 bytes, of which the last four are a CRC-32C."""
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import crc32c

    pages = [data[begin : begin + 1020] for begin in range(0, len(data) - 1023, 1024)]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


def mended_datagram(data: bytes) -> bytes:
    """A datagram of a team; the checksum of components is their batch's own."""
    begin = 1 if data[:1] == b"\x11" else 0
    return data[:-4] + zlib.crc32(data[begin:-4]).to_bytes(4, "little")


def mended_mcap(data: bytes) -> bytes:
    """The chunks of an MCAP file (mcap.dev/spec) without compression get the CRC-32 of their content."""
    found, at = bytearray(data), 8
    with contextlib.suppress(struct.error):
        while at + 9 < len(found):
            (length,) = struct.unpack_from("<Q", found, at + 1)
            begin = at + 9
            if found[at] == 6 and begin + 40 < len(found):
                (name,) = struct.unpack_from("<I", found, begin + 28)
                if name == 0:
                    content = found[begin + 40 : min(begin + length, len(found))]
                    struct.pack_into("<I", found, begin + 24, zlib.crc32(content))
            at = begin + length
    return bytes(found)


def png() -> bytes:
    """A depth image of 4 × 3 pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + struct.pack(">4H", *range(4)) for _ in range(3))
    head = struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0)
    ends = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + ends
