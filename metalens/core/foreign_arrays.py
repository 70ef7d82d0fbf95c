"""Numeric arrays of MATLAB files (levels 5 and 7.3) and NumPy archives."""

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE, LensError

_COMPRESSED = 15  # type of a compressed element of level 5
_COMPLEX = 0x800  # flag of a complex matrix of level 5
_STORED = dict(zip((1, 2, 3, 4, 5, 6, 7, 9, 12, 13), "bBhHiIfdqQ", strict=True))
_CLASSES = dict(zip(range(6, 16), "dfbBhHiIqQ", strict=True))
_REFUSED = (*DAMAGE, EOFError, IndexError, zlib.error, zipfile.BadZipFile)


def read_matlab(path: Path, most_bytes: int = 1 << 31) -> dict[str, Array]:
    """Numeric arrays of a MATLAB file by name; text, cells and structures are left out.

    scipy.io.loadmat ends the process on some damaged files of level 5. Here
    every size is compared with the bytes that are there before it is used. Source:
    MAT-File Format (The MathWorks), chapter 1.

    Args:
        path: of the file.
        most_bytes: that an array may take when unpacked.

    Raises:
        LensError: damaged, no such file, or larger than that.
    """
    try:
        content = path.read_bytes()
        if b"\x89HDF\r\n\x1a\n" in content[:4096]:
            with h5py.File(path, "r") as file:
                return _level_7(path, file)
        order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
        if order is None:
            raise ValueError("need level 5 or 7.3 (save -v7)")
        return dict(_level_5(content[128:], order, most_bytes))
    except _REFUSED as error:
        raise LensError(f"{path}: not a MATLAB file: {error}") from error


def read_npz(path: Path) -> dict[str, Array]:
    """Arrays of a NumPy archive by name.

    Args:
        path: of the file.

    Raises:
        LensError: damaged, or no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (*_REFUSED, SyntaxError, RecursionError) as error:
        raise LensError(f"{path}: not an NPZ file: {error}") from error


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and bytes of the data elements of a MATLAB file of level 5 in turn.

    An element is a tag of 8 bytes (type, size), the data, and zeros up to a multiple of
    8 bytes. Small ones have a tag of 4 bytes and 4 bytes of data.

    Args:
        content: bytes of the elements.
        order: byte order, "<" or ">".

    Raises:
        ValueError: an element longer than the bytes that are left.
    """
    position = 0
    while position < len(content):
        kind, size = np.frombuffer(
            content[position : position + 8], f"{order}u4"
        ).tolist()
        start = position + 8
        available = len(content) - start
        position = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if kind >> 16:  # a tag of 4 bytes (size, type), the data in the other 4
            size = kind >> 16
            kind = kind & 0xFFFF
            position = start
            start = start - 4
            available = 4
        if size > available:
            raise ValueError("cut short")
        yield kind, content[start : start + size]


def _level_5(
    content: bytes, order: str, most_bytes: int
) -> Iterator[tuple[str, Array]]:
    """Name and array of every numeric matrix of a MATLAB file of level 5.

    Args:
        content: of the file after its head of 128 bytes.
        order: byte order, "<" or ">".
        most_bytes: that an array may take.
    """
    for kind, data in _elements(content, order):
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            tag = stream.decompress(data, 8)
            size = int(np.frombuffer(tag, f"{order}u4")[1])
            if size > most_bytes:
                raise ValueError(f"holds {size:,} bytes, need at most {most_bytes:,}")
            data = stream.decompress(stream.unconsumed_tail, size + 1)
            if not stream.eof or len(data) != size:
                raise ValueError("cut short")
        parts = list(_elements(data, order))
        flags = int(np.frombuffer(parts[0][1], f"{order}u4")[0])
        if flags & 0xFF not in _CLASSES:
            continue
        shape = np.frombuffer(parts[1][1], f"{order}i4").tolist()
        values = [
            np.frombuffer(data, order + _STORED[kind]).astype(_CLASSES[flags & 0xFF])
            for kind, data in parts[3:]
        ]
        matrix = values[0] + 1j * values[1] if flags & _COMPLEX else values[0]
        yield parts[2][1].decode("latin-1"), matrix.reshape(shape, order="F")


def _level_7(path: Path, file: h5py.File) -> dict[str, Array]:
    """Arrays of a MATLAB file of level 7.3 (HDF5) by name, axes in MATLAB's order."""
    arrays = {}
    for name in file:
        if isinstance(file.get(name, getlink=True), h5py.HardLink):
            item = file[name]
            if isinstance(item, h5py.Dataset):
                store.check_claim(path, item, name)
                arrays[name] = item[...].T
    return arrays
