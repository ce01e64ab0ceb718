"""Damage to a file, decided by a number: bytes, words and sizes that nobody counts to, with sound checksums or not."""

from __future__ import annotations

import gzip
import io
import random
import re
import struct
import zipfile
import zlib

_INTEGERS = (0, 1, -1, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1, -(2**63))
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, 1e308, float("inf"), float("-inf"), float("nan"))
_WORDS = (
    *(
        "-1",
        "0",
        "1",
        "2",
        "999999999999999999999",
        "1e999",
        "-1e-999",
        "nan",
        "inf",
        "NaN",
        "Infinity",
        "null",
        "true",
    ),
    *("[]", "{}", '""', '"x"', "[[1]]", "\0", "\x1b[2J", "\ufffd", "é", "../../etc/passwd", "/", "", " ", "\n", "#"),
    *("OPENCV", "PINHOLE", "9" * 400, "[" * 3000, "x" * 5000, "0x10", "1_000", "١", "1,5"),
)

_EDGES = re.compile(r'[ \n\t,:\[\]{}"]')


def mutated(data: bytes, layer: str, rng: random.Random) -> bytes:
    """Change a file; in half of the cases what lies inside its compression, which is put on again.

    Args:
        data: the file.
        layer: "plain", "text", "gzip", "zip" or "glb".
        rng: decides.
    """
    if layer == "gzip" and rng.random() < 0.7:
        return gzip.compress(_several(gzip.decompress(data), False, rng), 1, mtime=0)
    if layer == "zip" and rng.random() < 0.7:
        return _in_a_zip(data, rng)
    if layer == "glb" and rng.random() < 0.7:
        return _in_a_glb(data, rng)
    return _several(data, layer == "text" and rng.random() < 0.8, rng)


def _several(data: bytes, words: bool, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        data = _word(data, rng) if words else _bytes(data, rng)
    return data


def _in_a_zip(data: bytes, rng: random.Random) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(written, "w") as new:
        names = old.namelist()
        chosen, how = rng.choice(names), rng.random()
        for name in names:
            content = old.read(name)
            if name == chosen:
                if how < 0.1:
                    continue
                content = _several(content, name.endswith(".json") and how < 0.8, rng)
            new.writestr(zipfile.ZipInfo(name), content)
            if name == chosen and how > 0.95:
                new.writestr(zipfile.ZipInfo(name + "x"), content)
    return written.getvalue()


def _in_a_glb(data: bytes, rng: random.Random) -> bytes:
    """Change the JSON or the binary chunk of a glTF file, with the lengths that they then have."""
    at, chunks = 12, list[tuple[bytes, bytes]]()
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 8 + length
    chosen = rng.randrange(len(chunks))
    made = b""
    for place, (kind, content) in enumerate(chunks):
        if place == chosen:
            content = _several(content, kind == b"JSON", rng)
        content += b" " * (-len(content) % 4)
        made += struct.pack("<I", len(content)) + kind + content
    return data[:8] + struct.pack("<I", 12 + len(made)) + made


def _bytes(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    if not changed:
        return rng.randbytes(rng.randrange(64))
    at = rng.randrange(min(len(changed), 64) if rng.random() < 0.4 else len(changed))
    match rng.randrange(8):
        case 0:
            changed[at] ^= 1 << rng.randrange(8)
        case 1:
            changed[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        case 2:
            form = rng.choice("hiq")
            size = struct.calcsize(form)
            value = rng.choice(_INTEGERS) % 2 ** (8 * size)
            changed[at : at + size] = value.to_bytes(size, rng.choice(("little", "big")))
        case 3:
            form = rng.choice(("<f", "<d", ">d"))
            number = rng.choice(_FLOATS)
            number = (
                number
                if form != "<f" or abs(number) <= 3e38 or abs(number) == float("inf") or number != number
                else 0.0
            )
            packed = struct.pack(form, number)
            changed[at : at + len(packed)] = packed
        case 4:
            del changed[at:]
        case 5:
            del changed[at : at + rng.choice((1, 4, 8, 40))]
        case 6:
            changed[at:at] = rng.randbytes(rng.choice((1, 2, 8, 64)))
        case _:
            other = rng.randrange(len(changed))
            changed[at : at + 8] = changed[other : other + 8]
    # a PNG's chunk is read on only with a sound checksum
    return _sound_png(bytes(changed)) if rng.random() < 0.5 else bytes(changed)


def _sound_png(data: bytes) -> bytes:
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return data
    made, at = bytearray(data[:8]), 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        if at + 12 + length > len(data):
            break
        chunk = data[at + 4 : at + 8 + length]
        made += data[at : at + 4] + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        at += 12 + length
    return bytes(made) + data[at:]


def _word(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    # what stands between white space, brackets, commas and quotes
    edges = [0, *(found.start() for found in _EDGES.finditer(text)), len(text)]
    place = rng.randrange(len(edges) - 1)
    start, end = edges[place], edges[place + 1]
    match rng.randrange(4):
        case 0 | 1:
            text = text[: start + 1] + rng.choice(_WORDS) + text[end:]
        case 2:
            text = text[:start] + text[end:]
        case _:
            other = rng.randrange(len(edges) - 1)
            text = text[:start] + text[edges[other] : edges[other + 1]] + text[start:]
    return text.encode("utf-8", "surrogateescape")
