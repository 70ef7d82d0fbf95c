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
# text of the command line, for locks and manifests
COMMAND: ContextVar[str] = ContextVar("COMMAND", default="")
# HDF5 versions (least, most): every block of metadata carries a checksum
_FORMAT = ("v110", "v110")
_UNITS = "um, rad"
# largest array in bytes that is stored in its header, under the header's checksum
_SMALL = 4096
_RECORDED = ("numpy", "scipy", "torch", "h5py")


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of an artefact.

    config: its settings, as TOML text.
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
    """Content of an artefact file.

    kind, version: from its header.
    arrays: by name (``group/name``).
    attributes: of the header.
    provenance: of the artefact.
    """

    kind: str
    version: int
    arrays: dict[str, Array]
    attributes: dict[str, Any]
    provenance: Provenance


def package_versions() -> Iterator[tuple[str, str]]:
    """(name, version) of Python, this package and the libraries that affect its
    numbers.
    """
    yield "python", ".".join(map(str, sys.version_info[:3]))
    for name in ("metalens-toolchain", *_RECORDED):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            yield name, importlib.metadata.version(name)


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Args:
        path: of the file.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def replace_atomically(path: str | Path) -> Iterator[Path]:
    """Context of a scratch path in the folder of ``path``; it is synced and renamed
    over ``path`` only if the block succeeds.

    Whatever ends the block early (error, Ctrl-C, full disk, kill), the old file stays.
    Writers of one file wait for each other. A scratch file that a killed process left
    is overwritten by the next writer.

    Args:
        path: file to write.
    """
    path = Path(path)
    scratch = path.with_name(f".{path.name}.part")
    with hold_lock(path, wait=True):
        try:
            yield scratch
            sync_file(scratch)
            scratch.replace(path)
            sync_file(path.parent)
        finally:
            scratch.unlink(missing_ok=True)


@contextlib.contextmanager
def hold_lock(target: Path, *, wait: bool = False) -> Iterator[None]:
    """Context that holds the lock file ``.NAME.lock`` in the folder of an output; the
    kernel frees it when its owner dies.

    Args:
        target: the output; its folder exists.
        wait: wait for another owner instead of raising.

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
    """Flush a file, or the directory entries of a folder, at ``path`` to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8), whole or not at all.

    Args:
        path: of the file.
        text: its content.
    """
    write_bytes(path, reading.to_valid_utf8(text).encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file, whole or not at all.

    Args:
        path: of the file.
        content: bytes of the file.
    """
    with replace_atomically(path) as scratch, open(scratch, "wb") as file:
        file.write(content)


def append_line(path: Path, line: str) -> None:
    """Append a line to a journal, synced to the disk on return; a truncated last line
    is removed first.

    Args:
        path: of the journal.
        line: text without a line break.
    """
    with open(path, "ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
        file.write(reading.to_valid_utf8(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def whole_lines(path: Path) -> list[str]:
    """Lines of a journal without a truncated last one; empty where there is no file.

    Args:
        path: of the journal.
    """
    if not path.is_file():
        return []
    return path.read_text(encoding="utf-8", errors="replace").split("\n")[:-1]


def open_journal(path: Path, title: str) -> list[str]:
    """Whole lines of a journal after its title, which is its first line; the journal of
    other work is replaced by an empty one.

    Args:
        path: of the journal.
        title: one line of JSON, a list that begins with the version.

    Raises:
        StoreError: a file that is no journal stands there.
    """
    lines = whole_lines(path)
    if lines and lines[0] == title:
        return lines[1:]
    start = path.read_bytes()[:2] if path.is_file() else b""
    if path.is_dir() or start not in (b"", b'["'):
        raise StoreError(
            f"{path} is in the way of what is kept for an interruption, and no journal of metalens; move it"
        )
    write_text(path, title + "\n")
    return []


class CheckedFile(io.FileIO):
    """A file for the HDF5 library, which may crash the process where a write fails, as
    on a full disk.

    The first write error is stored for :meth:`check`; nothing is written after it.
    """

    refused: BaseException | None = None

    def check(self) -> None:
        """Raise the stored write error, if there is one."""
        if self.refused is not None:
            raise self.refused

    def write(self, content: Any) -> int:
        """Write all of ``content``, or nothing after an error; its length is returned."""
        view = memoryview(content)
        try:
            while view and self.refused is None:
                view = view[super().write(view) :]
        except (OSError, KeyboardInterrupt, SystemExit) as error:
            self.refused = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file, unless a write failed."""
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
    """Write an artefact: header (kind, version, units), arrays and provenance. Equal
    input gives equal bytes.

    Args:
        path: target, replaced atomically.
        kind: of the artefact, checked when it is read.
        arrays: by name; ``a/b`` makes group ``a``.
        version: of the kind.
        attributes: of the file.
        provenance: of the artefact.
        compress: gzip level 1 with byte shuffle for arrays above 64 KiB.

    Raises:
        OSError: the target cannot be written (the old file stays).
    """
    about = provenance or Provenance()
    header = {"kind": kind, "version": version, "units": _UNITS, **(attributes or {})}
    groups: dict[str, Mapping[str, Attribute]] = {
        "/": header,
        "provenance": {"config": about.config, "seed": about.seed},
        "provenance/inputs": about.inputs,
        "provenance/versions": about.versions,
    }
    with replace_atomically(path) as scratch, CheckedFile(scratch, "wb+") as checked:
        with h5py.File(checked, "w", track_order=False, libver=_FORMAT) as file:
            for name in sorted(arrays):
                _write_array(file, name, np.asarray(arrays[name]), compress)
                checked.check()
            for group_name, values in groups.items():
                group = file.require_group(group_name)
                for name, value in sorted(values.items()):
                    _write_attribute(group, name, value)
        checked.check()


def load(
    path: str | Path,
    kind: str | None = None,
    *,
    version: int = 1,
    without: Collection[str] = (),
) -> StoredArtefact:
    """Read an artefact and check its header.

    Arrays and header are under checksums of HDF5: a truncated or damaged file is
    refused. A file that was edited with an HDF5 library is read as it now stands.

    Args:
        path: of the file.
        kind: the kind that is needed; None takes any (``metalens info``).
        version: of the kind that is needed.
        without: names of arrays that are not read.

    Raises:
        StoreError: no such file, not HDF5, truncated, damaged, or of another kind or
            version; also where a missing entry is asked for later.
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
        other_format = reading.foreign_format(path)
        raise StoreError(
            f"{path}: {other_format}, need an HDF5 file of this toolchain"
            if other_format
            else f"{path}: truncated or not an HDF5 file of this toolchain ({error})"
        ) from error


def kind_of(path: str | Path) -> str:
    """Kind that an artefact file states in its header; '' for any other file.

    Args:
        path: of the file.
    """
    if not os.path.isfile(path):
        return ""
    try:
        with h5py.File(path, "r") as file:
            kind, units = (_plain(file.attrs.get(name)) for name in ("kind", "units"))
    except DAMAGE:
        return ""
    return kind if isinstance(kind, str) and units == _UNITS else ""


def _read(
    path: Path,
    file: h5py.File,
    kind: str | None,
    version: int,
    without: Collection[str],
) -> StoredArtefact:
    """Artefact of an open file, after its kind and version are checked.

    Args:
        path: names the file in errors.
        file: that is read.
        kind: that is needed; None takes any.
        version: that is needed with ``kind``.
        without: names of arrays that are not read.

    Raises:
        StoreError: no header, another kind or version, or sizes that cannot be.
    """
    header = {name: _plain(value) for name, value in file.attrs.items()}
    if "kind" not in header:
        raise StoreError(
            f"{path}: an HDF5 file without 'kind', not made by this toolchain"
        )
    stored_kind = str(header.pop("kind"))
    number = header.pop("version")
    header.pop("units", None)
    if not isinstance(number, int):
        raise StoreError(
            f"{path}: version is {number!r}, need a whole number; damaged: make it again"
        )
    if kind is not None and (stored_kind, number) != (kind, version):
        raise StoreError(
            f"{path} holds {stored_kind!r} version {number}, need {kind!r} version {version}; "
            "make it again with this release or give another file"
        )
    names: list[str] = []
    file.visit(names.append)
    items = {name: file[name] for name in names}
    sets = {n: item for n, item in items.items() if isinstance(item, h5py.Dataset)}
    for name, item in sets.items():  # before any is read
        check_claim(path, item, name)
    arrays = {name: item[...] for name, item in sets.items() if name not in without}
    stated = file["provenance"].attrs
    inputs, versions = (
        {name: str(_plain(text)) for name, text in file[part].attrs.items()}
        for part in ("provenance/inputs", "provenance/versions")
    )
    provenance = Provenance(
        str(_plain(stated["config"])), inputs, int(stated["seed"]), versions
    )
    entries = _Entries(path, arrays), _Entries(path, header)
    return StoredArtefact(stored_kind, number, *entries, provenance)


def check_claim(path: Path, item: h5py.Dataset, name: str) -> None:
    """Refuse a data set without a shape, larger than its stored bytes can expand to, or
    with values in other files.

    Args:
        path: names the file in errors.
        item: the data set.
        name: of the data set.

    Raises:
        StoreError: naming what it claims and what the file holds.
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


class _Entries(dict[str, Any]):
    """Entries of a file by name; a missing one raises a StoreError that names both."""

    def __init__(self, path: Path, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self.path = path

    def __missing__(self, name: str) -> Any:
        raise StoreError(
            f"{self.path}: holds no {name!r}; made by another release or damaged: make it again"
        )


def _write_array(file: h5py.File, name: str, array: Array, compress: bool) -> None:
    """Write one array with a checksum: up to 4096 bytes inside its header, larger ones
    in chunks. Text is stored as UTF-8 of fixed length.
    """
    if array.dtype.kind == "U":
        encoded = np.array(
            [reading.to_valid_utf8(text).encode() for text in array.flat], "S"
        ).reshape(array.shape)
        array = encoded.astype(
            h5py.string_dtype("utf-8", max(encoded.dtype.itemsize, 1))
        )
    if array.nbytes <= _SMALL:
        compact = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        compact.set_layout(h5py.h5d.COMPACT)
        file.create_dataset(name, data=array, track_times=False, dcpl=compact)
        return
    compression = (
        {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        if compress and array.nbytes > 65536
        else {}
    )
    file.create_dataset(
        name, data=array, track_times=False, chunks=True, fletcher32=True, **compression
    )


def _write_attribute(item: h5py.Group, name: str, value: Attribute) -> None:
    """Write one attribute inside the header. Text has its exact length: HDF5 stores
    text of variable length elsewhere, without a checksum.
    """
    if isinstance(value, str):
        encoded = reading.to_valid_utf8(value).encode()
        name = reading.to_valid_utf8(name)
        item.attrs.create(
            name, encoded, dtype=h5py.string_dtype("utf-8", max(len(encoded), 1))
        )
    else:
        item.attrs[name] = value


def _plain(value: Any) -> Any:
    """A stored scalar as a Python number, or as text where it is bytes."""
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
    """Read a ``record_type`` that :func:`save_record` wrote.

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
    """(arrays, attributes) of a record by name; fields that are None are left out.

    Args:
        record: a dataclass of arrays, numbers, text, tuples, dictionaries of arrays or
            numbers, and other records.
        group: prefix of every name.
    """
    arrays: dict[str, Array] = {}
    attributes: dict[str, Attribute] = {}
    for entry in dataclasses.fields(record):
        name = group + entry.name
        value = getattr(record, entry.name)
        value = value.item() if isinstance(value, np.generic) else value
        if not entry.init or isinstance(value, Provenance):
            continue
        if isinstance(value, bool | int | float | str):
            attributes[name] = value
        elif isinstance(value, tuple):
            arrays[name] = np.array(value)
        elif isinstance(value, Mapping):
            arrays |= {f"{name}/{key}": np.array(item) for key, item in value.items()}
        elif _holds_arrays(type(value)):
            nested = flatten_record(value, _group(entry, group))
            arrays |= nested[0]
            attributes |= nested[1]
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
    """Record from its arrays and attributes; the inverse of :func:`flatten_record`.

    Args:
        record_type: the dataclass; a field without an entry takes its default.
        arrays: by name.
        attributes: by name.
        where: names the file in errors.
        group: prefix of every name.
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
            nested_group = _group(entry, group)
            if any(key.startswith(nested_group) for key in (*arrays, *attributes)):
                given[entry.name] = build_record(
                    kind, arrays, attributes, where=where, group=nested_group
                )
        elif typing.get_origin(kind) is dict:
            holds_arrays = typing.get_args(kind)[1] is Array
            given[entry.name] = {
                key.removeprefix(f"{name}/"): array if holds_arrays else array.item()
                for key, array in arrays.items()
                if key.startswith(f"{name}/")
            }
        elif name in attributes:
            value = attributes[name]
            is_settings = dataclasses.is_dataclass(kind)
            given[entry.name] = (
                config.loads(value, kind, where=f"{where}: {name}")
                if is_settings
                else value
            )
        elif name in arrays or config.is_required(entry):
            value = arrays[name]  # where it is missing, a refusal that names it
            is_tuple = typing.get_origin(kind) is tuple
            given[entry.name] = _to_tuple(value.tolist()) if is_tuple else value
    return record_type(**given)


def _group(field: dataclasses.Field[Any], group: str) -> str:
    """Prefix of the names of a nested record's entries."""
    return group if field.metadata.get("flat") else f"{group}{field.name}/"


def _holds_arrays(kind: Any) -> bool:
    """Whether a type is a record compared by identity, as those with arrays are."""
    return dataclasses.is_dataclass(kind) and kind.__eq__ is object.__eq__


def _without_none(hint: Any) -> Any:
    """The type X of ``X`` or ``X | None``."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint
    return next(kind for kind in typing.get_args(hint) if kind is not type(None))


def _to_tuple(value: Any) -> Any:
    """Nested lists as nested tuples, and bytes as text."""
    if isinstance(value, list):
        return tuple(_to_tuple(item) for item in value)
    return value.decode() if isinstance(value, bytes) else value


def typed_reader(load: Callable[..., Record]) -> Callable[..., Record]:
    """Decorator of ``load(path, ...)``: every failure on a damaged or edited file
    becomes a StoreError that names the file.

    Args:
        load: function whose first argument is the path.
    """

    @functools.wraps(load)
    def checked(path: str | Path, *args: Any, **options: Any) -> Record:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "error", np.exceptions.ComplexWarning
                )  # complex numbers where real ones belong
                record = load(path, *args, **options)
            _check_types(record)
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
        return record

    return checked


def _check_types(record: Any) -> None:
    """Refuse a record whose numbers, text and arrays do not have the types of its
    fields; nested records too.

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
        value = getattr(record, entry.name)
        hint = hints[entry.name]
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
