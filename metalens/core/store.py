"""Files: artefacts in HDF5 and text, written whole or not at all."""

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import importlib.metadata
import io
import os
import sys
import types
import typing
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from metalens.core import config, reading
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE as DAMAGE
from metalens.core.errors import MetalensError, OutputError, StoreError

Attribute = str | int | float | bool
Record = TypeVar("Record")
# words of the command line, for locks and manifests
COMMAND: ContextVar[str] = ContextVar("COMMAND", default="")
# of HDF5: every block of metadata carries a checksum, files can still be edited
_FORMAT = ("v110", "v110")
_UNITS = "um, rad"
_MOST_BYTES = 1 << 36  # of all arrays of a file
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
    """Give a scratch path in the folder of ``path``; sync it and rename it over
    ``path`` only if the block succeeds.

    Whatever ends the block early (error, Ctrl-C, full disk, kill), the old file stays.
    Writers of one file wait for each other; the next one overwrites a scratch file that
    a killed process left.

    Args:
        path: file to write.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    with hold_lock(path, wait=True):
        try:
            yield part
            sync_file(part)
            part.replace(path)
            sync_file(path.parent)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def hold_lock(target: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold ``.NAME.lock`` in the folder of an output; the kernel frees it when its
    owner dies.

    Args:
        target: the output; its folder exists.
        wait: for another owner, in place of a refusal.

    Raises:
        OutputError: another process writes this output; the message names it.
        OSError: the folder cannot be written.
    """
    path = target.with_name(f".{target.name}.lock")
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.exists(path) and os.path.samestat(
                os.stat(path), os.fstat(handle)
            ):
                break
        except BlockingIOError:
            process, _, command = os.pread(handle, 4096, 0).decode().partition(" ")
            owner = (
                f"process {process} (metalens {command})" if process else "another one"
            )
            os.close(handle)
            raise OutputError(
                f"{target} is being written by {owner}; wait for it or give another name"
            ) from None
        os.close(handle)  # its last owner removed the file in between
    try:
        os.ftruncate(handle, 0)
        os.pwrite(
            handle, reading.to_valid_utf8(f"{os.getpid()} {COMMAND.get()}").encode(), 0
        )
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)


def sync_file(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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
    goes first.

    Args:
        path: of the journal.
        line: text without a line break.
    """
    with open(path, "ab+") as file:
        if file.tell() and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        file.write(reading.to_valid_utf8(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def whole_lines(path: Path) -> list[str]:
    """Lines of a journal but one that was cut short; none without a file.

    Args:
        path: of the journal.
    """
    if not path.is_file():
        return []
    return path.read_text(encoding="utf-8", errors="replace").split("\n")[:-1]


def open_journal(path: Path, title: str) -> list[str]:
    """Whole lines of a journal after its title, its first line; the journal of other
    work is begun afresh.

    Args:
        path: of the journal.
        title: one line of JSON, a list that begins with the version.

    Raises:
        StoreError: a file that is no journal stands there.
    """
    lines = whole_lines(path)
    if lines and lines[0] == title:
        return lines[1:]
    begun = path.read_bytes()[:2] if path.is_file() else b""
    if path.is_dir() or begun not in (b"", b'["'):
        raise StoreError(
            f"{path} is in the way of what is kept for an interruption, and no journal of metalens; move it"
        )
    write_text(path, title + "\n")
    return []


class CheckedFile(io.FileIO):
    """A file for the HDF5 library, which may crash the process where a write fails, as
    on a full disk: the first refusal is kept for :meth:`check`, nothing is written
    from then on.
    """

    refused: BaseException | None = None

    def check(self) -> None:
        """Raise what a write was refused with."""
        if self.refused is not None:
            raise self.refused

    def write(self, content: Any) -> int:
        """All of ``content``."""
        view = memoryview(content)
        try:
            while view and self.refused is None:
                view = view[super().write(view) :]
        except (OSError, KeyboardInterrupt, SystemExit) as error:
            self.refused = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of what is still written."""
        return 0 if self.refused is not None else super().truncate(size)


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
    with replace_atomically(path) as part, CheckedFile(part, "wb+") as file:
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
        with h5py.File(path, "r") as file:
            return _read(path, file, kind, version, without)
    except StoreError:
        raise
    except DAMAGE as error:
        found = reading.foreign_format(path)
        raise StoreError(
            f"{path}: {found}, need an HDF5 file of this toolchain"
            if found
            else f"{path}: truncated or not an HDF5 file of this toolchain ({error})"
        ) from error


def kind_of(path: str | Path) -> str:
    """The kind that an artefact file says it is; '' for any other file.

    Args:
        path: of the file.
    """
    if not os.path.isfile(path):
        return ""
    try:
        with h5py.File(path, "r") as file:
            found, units = (_plain(file.attrs.get(k)) for k in ("kind", "units"))
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
    # deflate packs 1040 bytes into one at best
    if item.nbytes > 1040 * item.id.get_storage_size() + _SMALL:
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
    through: CheckedFile,
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
    elsewhere, without a checksum.
    """
    if isinstance(value, str):
        encoded = reading.to_valid_utf8(value).encode()
        name = reading.to_valid_utf8(name)
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


def save_record(path: str | Path, kind: str, record: Any) -> None:
    """Write a record with its provenance as an artefact file.

    Args:
        path: target, replaced atomically.
        kind: of the artefact, checked when it is read.
        record: a dataclass with a field ``provenance``.
    """
    arrays, attributes = flatten_record(record)
    save(path, kind, arrays, attributes=attributes, provenance=record.provenance)


def load_record(path: str | Path, kind: str, record_type: type[Record]) -> Record:
    """Read what :func:`save_record` wrote, as a ``record_type``.

    Args:
        path: of the file.
        kind: of artefact that is needed.
        record_type: the dataclass.

    Raises:
        StoreError: not such a file, or an entry is missing.
    """
    stored = load(path, kind)
    return build_record(
        record_type,
        stored.arrays,
        stored.attributes,
        where=str(path),
        provenance=stored.provenance,
    )


def flatten_record(
    record: Any, group: str = ""
) -> tuple[dict[str, Array], dict[str, Attribute]]:
    """(arrays, attributes) of a record; fields that are None are left out.

    Args:
        record: a dataclass of arrays, numbers, text, tuples, dictionaries of arrays or
            numbers, and other records.
        group: stands before every name.
    """
    arrays: dict[str, Array] = {}
    attributes: dict[str, Attribute] = {}
    for entry in dataclasses.fields(record):
        value, name = getattr(record, entry.name), group + entry.name
        value = value.item() if isinstance(value, np.generic) else value
        if not entry.init or isinstance(value, Provenance):
            continue
        if isinstance(value, bool | int | float | str):
            attributes[name] = value
        elif isinstance(value, tuple):
            arrays[name] = np.array(value)
        elif isinstance(value, Mapping):
            arrays |= {f"{name}/{key}": np.array(one) for key, one in value.items()}
        elif _holds_arrays(type(value)):
            inner = flatten_record(value, _group(entry, group))
            arrays |= inner[0]
            attributes |= inner[1]
        elif dataclasses.is_dataclass(value):
            attributes[name] = config.dumps(value)
        elif value is not None:
            arrays[name] = value
    return arrays, attributes


def build_record(
    record_type: type[Record],
    arrays: Mapping[str, Array],
    attributes: Mapping[str, Any],
    *,
    where: str,
    group: str = "",
    **given: Any,
) -> Record:
    """Inverse of :func:`flatten_record`.

    Args:
        record_type: the dataclass; a field without an entry takes its default.
        arrays: by name.
        attributes: by name.
        where: names the file in errors.
        group: stands before every name.
        given: fields that do not come from the entries.

    Raises:
        StoreError: an entry is missing whose field has no default.
    """
    hints = typing.get_type_hints(record_type)
    for entry in dataclasses.fields(record_type):  # type: ignore[arg-type]
        name = group + entry.name
        kind = _without_none(hints[entry.name])
        if entry.name in given or not entry.init:
            continue
        if _holds_arrays(kind):
            inner = _group(entry, group)
            if any(n.startswith(inner) for n in (*arrays, *attributes)):
                given[entry.name] = build_record(
                    kind, arrays, attributes, where=where, group=inner
                )
        elif typing.get_origin(kind) is dict:
            of_arrays = typing.get_args(kind)[1] is Array
            given[entry.name] = {
                n.removeprefix(f"{name}/"): array if of_arrays else array.item()
                for n, array in arrays.items()
                if n.startswith(f"{name}/")
            }
        elif name in attributes:
            value = attributes[name]
            settings = dataclasses.is_dataclass(kind)
            given[entry.name] = (
                config.loads(value, kind, where=f"{where}: {name}")
                if settings
                else value
            )
        elif name in arrays or _is_required(entry):
            value = arrays[name]  # where it is missing, a refusal that names it
            is_tuple = typing.get_origin(kind) is tuple
            given[entry.name] = _to_tuple(value.tolist()) if is_tuple else value
    return record_type(**given)


def _group(field: dataclasses.Field[Any], group: str) -> str:
    """What stands before the names of a record's entries."""
    return group if field.metadata.get("flat") else f"{group}{field.name}/"


def _holds_arrays(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind) and kind.__eq__ is object.__eq__


def _without_none(hint: Any) -> Any:
    """The type of ``X`` or ``X | None``."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint
    return next(kind for kind in typing.get_args(hint) if kind is not type(None))


def _is_required(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _to_tuple(value: Any) -> Any:
    """Nested lists as tuples, bytes as text."""
    if isinstance(value, list):
        return tuple(_to_tuple(one) for one in value)
    return value.decode() if isinstance(value, bytes) else value


def typed_reader(load: Callable[..., Record]) -> Callable[..., Record]:
    """A ``load(path, ...)`` whose every failure on a damaged or edited file is a
    StoreError that names the file.
    """

    @functools.wraps(load)
    def checked(path: str | Path, *more: Any, **about: Any) -> Record:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "error", np.exceptions.ComplexWarning
                )  # complex numbers where real ones belong
                made = load(path, *more, **about)
            _check_types(made)
        except MetalensError:
            raise
        except (
            *DAMAGE,
            IndexError,
            ArithmeticError,
            np.exceptions.ComplexWarning,
        ) as error:
            raise StoreError(
                f"{path}: entries of the wrong kind ({error}); edited or damaged: make it again"
            ) from None
        return made

    return checked


def _check_types(record: Any) -> None:
    """Numbers, words and arrays where the fields of a record say so.

    Raises:
        TypeError: naming the field.
    """
    if not dataclasses.is_dataclass(record):
        return
    hints = typing.get_type_hints(type(record))
    needed = {
        float: int | float | np.number,
        int: int | np.integer,
        str: str,
        bool: bool | np.bool_,
    }
    for entry in dataclasses.fields(record):
        value, hint = getattr(record, entry.name), hints[entry.name]
        if hint in needed and (
            not isinstance(value, needed[hint])
            or (isinstance(value, bool) and hint is not bool)
        ):
            raise TypeError(
                f"{entry.name} is {type(value).__name__}, need {hint.__name__}"
            )
        if isinstance(value, np.ndarray) and value.dtype.kind not in "biufcSU":
            raise TypeError(f"{entry.name} holds {value.dtype}, need numbers")
        _check_types(value)
