"""Artefact files: one HDF5 header checked when opened, written whole or not at all, same input same bytes."""

import contextlib
import hashlib
import importlib.metadata
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from metalens.errors import StoreError

Array = np.ndarray[Any, np.dtype[Any]]
Attribute = str | int | float | bool
_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError, AttributeError)
_FORMAT = ("v110", "v110")  # of HDF5: every block of metadata carries a checksum, files can still be edited
_SMALL = 4096  # bytes of an array that is kept in its header, under the checksum of the header
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
    versions: Mapping[str, str] = field(default_factory=lambda: dict(package_versions()))


@dataclass(frozen=True, eq=False, slots=True)
class Stored:
    """The content of an artefact file: ``arrays`` by name (``group/name``), ``attributes`` of the header."""

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
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a scratch path beside ``path``; flush it and rename it over ``path`` only if the block succeeds.

    Whatever ends the block early (error, Ctrl-C, disk full), the old file stays and the scratch file goes.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        with open(part, "rb+") as file:
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) whole or not at all."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    with replacing(path) as part:
        part.write_bytes(content)


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
    """Write an artefact: header (kind, version, units), arrays, provenance. Same input gives the same bytes.

    Args:
        path: target, replaced atomically.
        arrays: by name; ``a/b`` makes group ``a``.
        compress: gzip level 1 with byte shuffle for arrays above 64 KiB.

    Raises:
        OSError: the target cannot be written (the old file stays).
    """
    with replacing(path) as part:
        try:
            _write(part, kind, version, attributes or {}, arrays, provenance or Provenance(), compress)
        except RuntimeError as error:  # the HDF5 library, when a full disk shows only at the closing of the file
            raise OSError(f"{path}: cannot be written: {error}") from error


def load(path: str | Path, kind: str | None = None, *, version: int = 1) -> Stored:
    """Read an artefact and check its header.

    Args:
        kind: the kind that is needed; None takes any (``metalens info``).

    Arrays and header are under checksums of HDF5: a file that was cut or damaged is refused, not read wrongly, and one
    that was edited with an HDF5 library is read as it now stands.

    Raises:
        StoreError: no such file, not HDF5, truncated, damaged, or of another kind or version; also where an entry
            that is asked for later is not in the file.
    """
    path = Path(path)
    if not path.is_file():
        raise StoreError(f"{path}: no such file; need a {kind or 'toolchain'} file")
    try:
        with h5py.File(path, "r") as file:
            return _read(path, file, kind, version)
    except StoreError:
        raise
    except _DAMAGE as error:
        raise StoreError(f"{path}: truncated or not an HDF5 file of this toolchain ({error})") from error


def _read(path: Path, file: h5py.File, kind: str | None, version: int) -> Stored:
    found = _plain(file.attrs.get("kind"))
    if found is None:
        raise StoreError(f"{path}: an HDF5 file without 'kind', not made by this toolchain")
    if kind is not None and (found != kind or int(file.attrs["version"]) != version):
        raise StoreError(
            f"{path} holds {found!r} version {int(file.attrs['version'])}, need {kind!r} version {version}; "
            "make it again with this release or give another file"
        )
    arrays: dict[str, Array] = _Held(path)
    file.visititems(
        lambda name, item: (
            arrays.__setitem__(name, item[...])
            if isinstance(item, h5py.Dataset) and not name.startswith("provenance/")
            else None
        )
    )
    attributes: dict[str, Any] = _Held(path)
    attributes |= {k: _plain(v) for k, v in file.attrs.items() if k not in ("kind", "version", "units")}
    return Stored(str(found), int(file.attrs["version"]), arrays, attributes, _read_provenance(file))


class _Held(dict[str, Any]):
    """Entries of a file; one that is not there is a refusal that names the file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def __missing__(self, name: str) -> Any:
        raise StoreError(f"{self.path}: holds no {name!r}; made by another release or damaged: make it again")


def _write(
    path: Path,
    kind: str,
    version: int,
    attributes: Mapping[str, Attribute],
    arrays: Mapping[str, Array],
    provenance: Provenance,
    compress: bool,
) -> None:
    with h5py.File(path, "w", track_order=False, libver=_FORMAT) as file:
        header: dict[str, Attribute] = {"kind": kind, "version": version, "units": "um, rad"}
        for name, value in (header | dict(sorted(attributes.items()))).items():
            _write_attribute(file, name, value)
        for name in sorted(arrays):
            _write_array(file, name, np.asarray(arrays[name]), compress)
        _write_provenance(file, provenance)


def _write_array(file: h5py.File, name: str, array: Array, compress: bool) -> None:
    if array.dtype.kind == "U":
        encoded = np.char.encode(array, "utf-8")
        array = encoded.astype(h5py.string_dtype("utf-8", max(encoded.dtype.itemsize, 1)))
    if array.nbytes <= _SMALL:
        inside = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        inside.set_layout(h5py.h5d.COMPACT)
        file.create_dataset(name, data=array, track_times=False, dcpl=inside)
        return
    packing = (
        {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compress and array.nbytes > 65536 else {}
    )
    file.create_dataset(name, data=array, track_times=False, chunks=True, fletcher32=True, **packing)


def _write_attribute(item: h5py.Group, name: str, value: Attribute) -> None:
    """Text goes in at its own length, inside the header; text of any length would lie apart, without a checksum."""
    if isinstance(value, str):
        encoded = value.encode()
        item.attrs.create(name, encoded, dtype=h5py.string_dtype("utf-8", max(len(encoded), 1)))
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
    inputs, versions = ({k: str(_plain(v)) for k, v in group[p].attrs.items()} for p in ("inputs", "versions"))
    return Provenance(str(_plain(group.attrs["config"])), inputs, int(group.attrs["seed"]), versions)


def _plain(value: Any) -> Any:
    """A number or text of Python."""
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
