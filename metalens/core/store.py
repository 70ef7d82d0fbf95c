"""Artefact files: one HDF5 header checked when opened, written whole or not at all,
same input same bytes.
"""

import contextlib
import fcntl
import hashlib
import importlib.metadata
import os
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from metalens.core import lock, reading
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE as DAMAGE
from metalens.core.errors import StoreError

Attribute = str | int | float | bool
_FORMAT = (
    "v110",
    "v110",
)  # of HDF5: every block of metadata carries a checksum, files can still be edited
_UNITS = "um, rad"
_MOST_BYTES = 1 << 36  # of all arrays of a file
_DENSEST = 1040  # values' bytes for a byte in the file: what deflate can do at best
# bytes of an array that is kept in its header, under the checksum of the header
_SMALL = 4096
_RECORDED = ("numpy", "scipy", "torch", "h5py")


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where an artefact comes from.

    config: the settings that made it, as TOML text.
    inputs: {file name: SHA-256} of every file read.
    seed: of the random generator, -1 where none was used.
    versions: {package: version}.
    """

    config: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int = -1
    versions: Mapping[str, str] = field(
        default_factory=lambda: dict(package_versions())
    )


@dataclass(frozen=True, eq=False, slots=True)
class StoredArtefact:
    """The content of an artefact file: ``arrays`` by name (``group/name``),
    ``attributes`` of the header.
    """

    kind: str
    version: int
    arrays: dict[str, Array]
    attributes: dict[str, Any]
    provenance: Provenance


def package_versions() -> Iterator[tuple[str, str]]:
    """(name, version) of the packages whose numbers enter an artefact."""
    yield "python", ".".join(map(str, sys.version_info[:3]))
    for name in ("metalens-toolchain", *_RECORDED):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            yield name, importlib.metadata.version(name)


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Args:
        path: file to read or write.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def replace_atomically(path: str | Path) -> Iterator[Path]:
    """Give a scratch path beside ``path``; flush it and rename it over ``path`` only if
    the block succeeds.

    Whatever ends the block early (error, Ctrl-C, disk full), the old file stays and the
    scratch file goes; what a
    killed process left goes with the next writing of the same file. Writers at the same
    time do not meet.
    """
    path = Path(path)
    clear_scratch(path)
    handle, part = _part(path)
    try:
        os.fchmod(handle, 0o666 & ~_umask())
        yield part
        with open(part, "rb+") as file:
            os.fsync(file.fileno())
        part.replace(path)
        sync_folder(path.parent)
    finally:
        os.close(handle)
        part.unlink(missing_ok=True)


def _part(path: Path) -> tuple[int, Path]:
    """A scratch file beside ``path``, locked so that nobody clears it away."""
    while True:
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part", dir=path.parent
        )
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_SH)
        if os.path.exists(name):
            return handle, Path(name)
        os.close(handle)  # cleared away before it was locked


def clear_scratch(path: Path) -> None:
    """Remove scratch files of writers that are gone.

    Args:
        path: file to read or write.
    """
    start, end = f".{path.name}.", ".part"
    for entry in os.scandir(path.parent):
        if (
            entry.name.startswith(start)
            and entry.name.endswith(end)
            and lock.is_free(Path(entry.path))
        ):
            os.unlink(entry.path)


def _umask() -> int:
    """The process's mask of file modes; it can only be read by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) whole or not at all.

    Args:
        path: file to read or write.
    """
    write_bytes(path, reading.to_valid_utf8(text).encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Args:
        path: file to read or write.
        content: bytes of the file.
    """
    with replace_atomically(path) as part, open(part, "wb") as file:
        file.write(content)


def append_line(path: Path, line: str) -> None:
    """Add a line to a journal, on the disk when this returns; a line that was cut short
    before it is dropped.

    Writers at the same time wait for each other: what one of them has half written is
    no line that was cut short.

    Args:
        path: file to read or write.
    """
    with open(path, "ab+") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        if file.tell() and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        file.write(reading.to_valid_utf8(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def whole_lines(path: Path) -> list[str]:
    """Lines of a journal; the last one is left out where it was cut short. None without
    a file.

    Args:
        path: file to read or write.
    """
    if not path.is_file():
        return []
    return path.read_text(encoding="utf-8", errors="replace").split("\n")[:-1]


def save(
    path: str | Path,
    kind: str,
    arrays: Mapping[str, Array],
    *,
    version: int = 1,
    attributes: Mapping[str, Attribute] | None = None,
    provenance: Provenance | None = None,
    compress: bool = True,
) -> None:
    """Write an artefact: header (kind, version, units), arrays, provenance. Same input
    gives the same bytes.

    Args:
        attributes: of the file.
        path: target, replaced atomically.
        arrays: by name; ``a/b`` makes group ``a``.
        compress: gzip level 1 with byte shuffle for arrays above 64 KiB.

    Raises:
        OSError: the target cannot be written (the old file stays).
    """
    with replace_atomically(path) as part, reading.CheckedFile(part, "wb+") as file:
        _write(
            file,
            kind,
            version,
            attributes or {},
            arrays,
            provenance or Provenance(),
            compress,
        )
        file.check()


def load(
    path: str | Path,
    kind: str | None = None,
    *,
    version: int = 1,
    without: Collection[str] = (),
) -> StoredArtefact:
    """Read an artefact and check its header.

    Args:
        path: file to read or write.
        kind: the kind that is needed; None takes any (``metalens info``).
        without: arrays that are left in the file.

    Arrays and header are under checksums of HDF5: a file that was cut or damaged is
    refused, not read wrongly, and one
    that was edited with an HDF5 library is read as it now stands.

    Raises:
        StoreError: no such file, not HDF5, truncated, damaged, or of another kind or
            version; also where an entry
            that is asked for later is not in the file.
    """
    path = Path(path)
    if not path.is_file():
        raise StoreError(
            f"{path}: {reading.missing_reason(path)}; need a {kind or 'toolchain'} file"
        )
    try:
        return reading.read_hdf5(
            path, lambda file: _read(path, file, kind, version, without)
        )
    except StoreError:
        raise
    except DAMAGE as error:
        if found := reading.foreign_format(path):
            raise StoreError(
                f"{path}: {found}, need an HDF5 file of this toolchain"
            ) from error
        raise StoreError(
            f"{path}: truncated or not an HDF5 file of this toolchain ({error})"
        ) from error


def kind_of(path: str | Path) -> str:
    """The kind that an artefact file says it is; '' for any other file.

    Args:
        path: file to read or write.
    """
    try:
        found, units = reading.read_hdf5(
            path, lambda file: [_plain(file.attrs.get(k)) for k in ("kind", "units")]
        )
    except DAMAGE:
        return ""
    return found if isinstance(found, str) and units == _UNITS else ""


def _read(
    path: Path,
    file: h5py.File,
    kind: str | None,
    version: int,
    without: Collection[str],
) -> StoredArtefact:
    found = _plain(file.attrs.get("kind"))
    if found is None:
        raise StoreError(
            f"{path}: an HDF5 file without 'kind', not made by this toolchain"
        )
    number = _plain(file.attrs["version"])
    if not isinstance(number, int):
        raise StoreError(
            f"{path}: version is {number!r}, need a whole number; damaged: make it again"
        )
    if kind is not None and (found != kind or number != version):
        raise StoreError(
            f"{path} holds {found!r} version {number}, need {kind!r} version {version}; "
            "make it again with this release or give another file"
        )
    arrays: dict[str, Array] = _Held(path)
    wanted = ((name, item) for name, item in _listed(path, file) if name not in without)
    arrays |= {
        name: item[...] for name, item in wanted if not name.startswith("provenance/")
    }
    attributes: dict[str, Any] = _Held(path)
    attributes |= {
        k: _plain(v)
        for k, v in file.attrs.items()
        if k not in ("kind", "version", "units")
    }
    return StoredArtefact(
        str(found), number, arrays, attributes, _read_provenance(file)
    )


def _listed(path: Path, file: h5py.File) -> list[tuple[str, h5py.Dataset]]:
    """Data sets of a file, refused together before any is read where they claim more
    than the file can hold.
    """
    found: list[tuple[str, h5py.Dataset]] = []
    file.visititems(
        lambda name, item: (
            found.append((name, item)) if isinstance(item, h5py.Dataset) else None
        )
    )
    claimed = 0
    for name, item in found:
        check_claim(path, item, name)
        claimed += item.nbytes
    if claimed > _MOST_BYTES:
        raise StoreError(
            f"{path}: its arrays take {claimed / 1e9:.3g} GB, more than {_MOST_BYTES / 1e9:.3g} GB"
        )
    return found


def check_claim(path: Path, item: h5py.Dataset, name: str) -> None:
    """Refuse a data set of no values, of more than its bytes in the file can hold, or
    that lies in other files.

    Args:
        path: file to read or write.
        name: of the item.

    Raises:
        StoreError: naming what it claims and what is there.
    """
    if item.shape is None:
        raise StoreError(
            f"{path}: {name!r} is empty, without even a shape: damaged, or none of ours"
        )
    if item.is_virtual or item.external:
        raise StoreError(
            f"{path}: {name!r} lies in other files; need a file that holds all of its values"
        )
    if item.nbytes > _DENSEST * item.id.get_storage_size() + _SMALL:
        raise StoreError(
            f"{path}: {name!r} claims {item.nbytes:g} bytes of shape {item.shape}, the file holds "
            f"{item.id.get_storage_size()} of them: damaged"
        )


class _Held(dict[str, Any]):
    """Entries of a file; one that is not there is a refusal that names the file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def __missing__(self, name: str) -> Any:
        raise StoreError(
            f"{self.path}: holds no {name!r}; made by another release or damaged: make it again"
        )


def _write(
    through: reading.CheckedFile,
    kind: str,
    version: int,
    attributes: Mapping[str, Attribute],
    arrays: Mapping[str, Array],
    provenance: Provenance,
    compress: bool,
) -> None:
    with h5py.File(through, "w", track_order=False, libver=_FORMAT) as file:
        header: dict[str, Attribute] = {
            "kind": kind,
            "version": version,
            "units": _UNITS,
        }
        for name, value in (header | dict(sorted(attributes.items()))).items():
            _write_attribute(file, name, value)
        for name in sorted(arrays):
            _write_array(file, name, np.asarray(arrays[name]), compress)
            through.check()
        _write_provenance(file, provenance)


def _write_array(file: h5py.File, name: str, array: Array, compress: bool) -> None:
    if array.dtype.kind == "U":
        encoded = np.array(
            [reading.to_valid_utf8(text).encode() for text in array.flat], "S"
        ).reshape(array.shape)
        array = encoded.astype(
            h5py.string_dtype("utf-8", max(encoded.dtype.itemsize, 1))
        )
    if array.nbytes <= _SMALL:
        inside = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        inside.set_layout(h5py.h5d.COMPACT)
        file.create_dataset(name, data=array, track_times=False, dcpl=inside)
        return
    packing = (
        {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        if compress and array.nbytes > 65536
        else {}
    )
    file.create_dataset(
        name, data=array, track_times=False, chunks=True, fletcher32=True, **packing
    )


def _write_attribute(item: h5py.Group, name: str, value: Attribute) -> None:
    """Text goes in at its own length, inside the header; text of any length would lie
    apart, without a checksum.
    """
    if isinstance(value, str):
        encoded, name = (
            reading.to_valid_utf8(value).encode(),
            reading.to_valid_utf8(name),
        )
        item.attrs.create(
            name, encoded, dtype=h5py.string_dtype("utf-8", max(len(encoded), 1))
        )
    else:
        item.attrs[name] = value


def _write_provenance(file: h5py.File, provenance: Provenance) -> None:
    group = file.create_group("provenance")
    _write_attribute(group, "config", provenance.config)
    _write_attribute(group, "seed", provenance.seed)
    for part in ("inputs", "versions"):
        entries = group.create_group(part)
        for name, value in sorted(getattr(provenance, part).items()):
            _write_attribute(entries, name, value)


def _read_provenance(file: h5py.File) -> Provenance:
    group = file["provenance"]
    inputs, versions = (
        {k: str(_plain(v)) for k, v in group[p].attrs.items()}
        for p in ("inputs", "versions")
    )
    return Provenance(
        str(_plain(group.attrs["config"])), inputs, int(group.attrs["seed"]), versions
    )


def _plain(value: Any) -> Any:
    """A number or text of Python."""
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
