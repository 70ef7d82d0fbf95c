"""Damage to files: cut, flipped, doubled or odd bytes, and damage under checksums that
are good again.
"""

import functools
import math
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np

ODD_BYTES = (
    b"\xff" * 4,
    b"\0" * 4,
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\0" * 8,
    b"\xff" * 8,
)
ODD_WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e20", b"1e400", b"99999999999999999999", b'""', b"[]", b"{}", b"true",
    b"\0", b"\x1b[2J", b"[" * 3000, b"{a=" * 400, b"9" * 5000, "ä€".encode(), b"\xef\xbb\xbf", b"\xff\xfe", b"'", b'"',
    b"1979-05-27", b"..", b"/", b"&a *a", b"!!python/object", b"\r\n", b"," * 300, b"#",
)  # fmt: skip
ODD_VALUES: tuple[Any, ...] = (
    -1, 0, 10**18, math.nan, math.inf, 1e300, 1j, True, "x", "", b"\xff", [1.0, 2.0], np.zeros((2, 2)),
    np.zeros((0,)), np.zeros((1, 1, 1, 1, 1)), np.array(["a"], "S1"), np.full(3, np.nan), np.arange(5), "9" * 5000,
    h5py.Empty("f8"),
)  # fmt: skip
_HEADS = (b"OHDR", b"OCHK", b"FRHP", b"FHDB", b"FHIB", b"BTHD", b"BTIN", b"BTLF", b"FSHD", b"FSSE", b"SMTB", b"FAHD",
          b"FADB", b"EAHD", b"EAIB", b"EASB", b"EADB")  # fmt: skip


def text(whole: bytes, chance: random.Random) -> bytes:
    """A text with odd words in place of words, lines lost or doubled, or bytes of no
    text.
    """
    if chance.random() < 0.3:
        return plain(whole, chance)
    words = (
        whole.split(b" ") if chance.random() < 0.5 else whole.splitlines(keepends=True)
    )
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(words))
        how = chance.randrange(5)
        if how == 0:
            del words[at]
        elif how == 1:
            words.insert(at, words[at])
        elif how == 2:
            other = chance.randrange(len(words))
            words[at], words[other] = words[other], words[at]
        elif how == 3 and b"=" in words[at]:
            words[at] = (
                words[at].partition(b"=")[0] + b"= " + chance.choice(ODD_WORDS) + b"\n"
            )
        else:
            words[at] = chance.choice(ODD_WORDS) + (
                b"\n" if words[at].endswith(b"\n") else b""
            )
        if not words:
            return b""
    return (b" " if b"\n" not in words[0] else b"").join(words)


def plain(whole: bytes, chance: random.Random) -> bytes:
    """Bytes cut, flipped, doubled, or replaced by extreme numbers."""
    data = bytearray(whole)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(max(1, len(data)))
        how = chance.randrange(5)
        if how == 0 and chance.random() < 0.4:
            data = data[:at]
        elif how == 1:
            data[at : at + 1] = bytes([chance.randrange(256)])
        elif how == 2:
            data[at:at] = data[at : at + chance.randint(1, 64)] * chance.randint(1, 4)
        elif how == 3:
            odd = chance.choice(ODD_BYTES)
            data[at : at + len(odd)] = odd
        elif data:
            data[min(at, len(data) - 1)] ^= 1 << chance.randrange(8)
    return bytes(data)


def head(whole: bytes, chance: random.Random) -> bytes:
    """As :func:`plain`, mostly in the first two kilobytes, where a file says what it
    holds.
    """
    size = min(len(whole), chance.choice((64, 512, 2048, len(whole))))
    return plain(whole[:size], chance) + whole[size:]


def png(whole: bytes, chance: random.Random) -> bytes:
    """Damage inside the blocks of a PNG, whose CRCs are made good again."""
    if chance.random() < 0.3:
        return plain(whole, chance)
    at, blocks = 8, []
    while at + 8 <= len(whole):
        size = int.from_bytes(whole[at : at + 4], "big")
        blocks.append((whole[at + 4 : at + 8], whole[at + 8 : at + 8 + size]))
        at += 12 + size
    k = chance.randrange(len(blocks))
    kind, body = blocks[k]
    if kind == b"IDAT" and chance.random() < 0.5:
        body = zlib.compress(plain(zlib.decompress(body), chance))
    else:
        body = plain(body, chance) if body else body
    blocks[k] = (kind, body)
    if chance.random() < 0.2:
        blocks.insert(chance.randrange(len(blocks)), chance.choice(blocks))
    return whole[:8] + b"".join(
        len(b).to_bytes(4, "big") + kind + b + zlib.crc32(kind + b).to_bytes(4, "big")
        for kind, b in blocks
    )


def oasis(whole: bytes, chance: random.Random) -> bytes:
    """Damage in an OASIS file, its CRC-32 made good again where it has one."""
    data = plain(whole, chance)
    if len(data) > 260 and chance.random() < 0.8:
        body = data[:-5] + b"\x01"
        data = body + zlib.crc32(body).to_bytes(4, "little")
    return data


def safetensors(whole: bytes, chance: random.Random) -> bytes:
    """Damage in the JSON of the head, its length made good again."""
    if chance.random() < 0.3:
        return head(whole, chance)
    (size,) = struct.unpack("<Q", whole[:8])
    told = text(whole[8 : 8 + size].replace(b",", b" ,").replace(b":", b" :"), chance)
    return struct.pack("<Q", len(told)) + told + whole[8 + size :]


def hdf5(whole: bytes, chance: random.Random) -> bytes:
    """Bytes changed inside the metadata of HDF5, Jenkins' checksums of the blocks made
    good again.
    """
    data, found = bytearray(whole), _blocks(whole)
    for _ in range(chance.randint(1, 3)):
        start, end = chance.choice(found)
        at = chance.randrange(start + 4, end)
        how = chance.randrange(3)
        if how == 0:
            data[at] = chance.randrange(256)
        elif how == 1:
            data[at] ^= 1 << chance.randrange(8)
        else:
            odd = chance.choice(ODD_BYTES)[: end - at]
            data[at : at + len(odd)] = odd
        data[end : end + 4] = lookup3(bytes(data[start:end])).to_bytes(4, "little")
    return bytes(data)


@functools.lru_cache(maxsize=8)
def _blocks(data: bytes) -> list[tuple[int, int]]:
    """(start, place of the checksum) of the blocks of metadata: where the checksum is
    good, there a block ends.
    """
    found = [(0, 44)] if lookup3(data[:44]).to_bytes(4, "little") == data[44:48] else []
    for mark in _HEADS:
        start = data.find(mark)
        while start >= 0:
            for end in range(start + 6, min(start + 6000, len(data) - 3)):
                if (
                    lookup3(data[start:end]).to_bytes(4, "little")
                    == data[end : end + 4]
                ):
                    found.append((start, end))
                    break
            start = data.find(mark, start + 4)
    return found


def lookup3(data: bytes) -> int:
    """Jenkins' hash of HDF5's metadata (hashlittle of lookup3.c, initial value 0;
    public domain).

    >>> hex(lookup3(b"Four score and seven years ago"))
    '0x17770551'
    """
    return int(
        _hash(
            np.frombuffer(data.ljust(-len(data) // 12 * -12, b"\0"), "<u4").astype(
                np.uint32
            ),
            len(data),
        )
    )


@numba.njit(cache=False)  # type: ignore[untyped-decorator]
def _hash(words: Any, length: int) -> Any:
    a = b = c = np.uint32(0xDEADBEEF + length)
    turns = len(words) // 3
    for i in range(turns):
        a, b, c = (
            np.uint32(a + words[3 * i]),
            np.uint32(b + words[3 * i + 1]),
            np.uint32(c + words[3 * i + 2]),
        )
        if i == turns - 1:
            for k in (14, 11, 25, 16, 4, 14, 24):
                c = np.uint32((c ^ b) - np.uint32((b << k) | (b >> (32 - k))))
                a, b, c = b, c, a
            return b
        for k in (4, 6, 8, 16, 19, 4):
            a = np.uint32(np.uint32(a - c) ^ np.uint32((c << k) | (c >> (32 - k))))
            c = np.uint32(c + b)
            a, b, c = b, c, a
    return c


def edited(path: Path, whole: bytes, chance: random.Random) -> None:
    """Put something of the wrong kind into an HDF5 file with the library itself, so
    with good checksums.
    """
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(chance.randint(1, 2)):
            how = chance.randrange(6)
            if how < 2 and len(file.attrs):
                key = chance.choice(sorted(file.attrs))
                del file.attrs[key]
                if chance.random() < 0.8:
                    file.attrs[key] = chance.choice(ODD_VALUES)
                continue
            if not names:
                break
            name = names.pop(chance.randrange(len(names)))
            names = [other for other in names if not other.startswith(name + "/")]
            held = file[name][...] if isinstance(file[name], h5py.Dataset) else None
            del file[name]
            _put(file, name, held, chance)


def _put(file: h5py.File, name: str, held: Any, chance: random.Random) -> None:
    """What stands in the place of an entry: nothing, an odd value, another shape or
    type, a claim, a link, a group.
    """
    choices: list[Callable[[], Any]] = [
        lambda: None,
        lambda: file.__setitem__(name, chance.choice(ODD_VALUES)),
        lambda: file.create_group(name),
        lambda: file.__setitem__(name, h5py.SoftLink("/nowhere")),
        lambda: file.__setitem__(name, h5py.SoftLink("/" + name)),
        lambda: file.__setitem__(name, h5py.ExternalLink("/dev/zero", "/x")),
        lambda: file.create_dataset(name, (22000, 22000), "f8", chunks=(100, 100)),
    ]
    if held is not None and held.size and held.dtype.kind in "iuf":
        choices += [lambda: file.__setitem__(name, _other(held, chance))] * 5
    chance.choice(choices)()


def _other(held: Any, chance: random.Random) -> Any:
    """An array with an odd number in it, of another shape or of another type."""
    how = chance.randrange(6)
    if how < 3:
        changed = np.array(held, float)
        changed.flat[chance.randrange(changed.size)] = chance.choice(
            (math.nan, math.inf, -1.0, 0.0, 1e300, 1e-300)
        )
        return changed
    return (
        held[:-1] if held.ndim else held,
        held.ravel(),
        np.asarray(held, "f4") * -1,
    )[how - 3]
