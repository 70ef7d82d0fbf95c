"""Reading inputs: damaged or changing files end in one error that names the file."""

import codecs
import contextlib
import dataclasses
import functools
import hashlib
import io
import os
import re
import typing
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from metalens.core.errors import DAMAGE, MetalensError, StoreError

Made = TypeVar("Made")
_WITH_COMMA = re.compile(r"[+-]?(\d+([.,]\d*)?|\.\d+)([eE][+-]?\d+)?")
Stamp = tuple[tuple[int, ...], ...]
_noted: ContextVar[dict[str, tuple[Stamp, str]] | None] = ContextVar(
    "_noted", default=None
)  # of inputs, by path


@contextlib.contextmanager
def remember_inputs() -> Iterator[None]:
    """Remember inputs from their first reading on, until the block (a command) ends."""
    token = _noted.set({})
    try:
        yield
    finally:
        _noted.reset(token)


def decode_text(content: bytes) -> str:
    """Text of UTF-8, or of UTF-16 with its byte-order mark (as spreadsheets save it).

    Args:
        content: bytes of the file.

    Raises:
        UnicodeDecodeError: neither of them.
    """
    if not content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-8-sig")
    text = content.decode("utf-16")
    if len(text) and not re.search(r"[0-9A-Za-z]", text):
        raise UnicodeDecodeError("utf-16", content, 0, len(content), "no plain letter")
    return text


def read_text(path: str | Path) -> str:
    """Text of a file, by :func:`decode_text`.

    Args:
        path: file to read or write.
    """
    return decode_text(Path(path).read_bytes())


def column_separator(line: str) -> tuple[str | None, bool]:
    """What parts the columns of a line of a table (None for blanks and tabs), and
    whether its commas are decimal.

    They are where something else parts the columns: "840,5;0,3", "840,5 0,3".
    """
    if ";" in line:
        return ";", True
    words = line.split()
    apart = len(words) > 1 and not any(
        word[0] == "," or word[-1] == "," for word in words
    )
    if apart and all(_WITH_COMMA.fullmatch(word) for word in words[:2]):
        return None, True
    return ("," if "," in line else None), False


def split_columns(line: str) -> list[str]:
    """The words of such a line, decimals with points."""
    mark, decimal = column_separator(line)
    line = line.replace(",", ".") if decimal else line
    return (line if mark is None else line.replace(mark, " ")).split()


def file_stamp(path: str | Path) -> Stamp:
    """Which file it is, its bytes and the time of its last change; of a folder, also of
    all that lies in it.

    () where there is none.

    Args:
        path: file to read or write.
    """
    try:
        inside = (
            sorted(os.scandir(path), key=lambda entry: entry.name)
            if os.path.isdir(path)
            else []
        )
        about = [os.stat(one) for one in (path, *inside)]
    except OSError:
        return ()
    return tuple(
        (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)
        for found in about
    )


def check_same(path: str | Path, before: Stamp) -> None:
    """Refuse an input that is no longer what it was.

    Args:
        path: file to read or write.
        before: size and time of the file when it was opened.

    Raises:
        StoreError: naming it.
    """
    if file_stamp(path) != before:
        raise StoreError(
            f"{path} was changed or replaced while it was being read: run again when it stands still"
        )


@contextlib.contextmanager
def refuse_changes(path: str | Path) -> Iterator[None]:
    """Refuse an input that another program writes to while the block reads it.

    Args:
        path: file to read or write.

    Raises:
        StoreError: see :func:`check_same`, in place of what the block made of such an
            input.
    """
    before = file_stamp(path)
    try:
        yield
    except (*DAMAGE, IndexError, ArithmeticError):
        check_same(path, before)
        raise
    check_same(path, before)
    note_input(path, before)


def note_input(path: str | Path, before: Stamp, content: bytes | None = None) -> None:
    """Note what an input was when this command first read it; with its content, its
    hash too.

    Args:
        path: file to read or write.
        before: size and time of the file when it was opened.
    """
    if (noted := _noted.get()) is not None:
        noted.setdefault(
            os.path.abspath(path),
            (before, hashlib.sha256(content).hexdigest() if content else ""),
        )


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of an input as this command has read it.

    Args:
        path: file to read or write.

    Raises:
        StoreError: it was replaced since; OSError: it cannot be read.
    """
    before, digest = (_noted.get() or {}).get(
        os.path.abspath(path), (file_stamp(path), "")
    )
    if not digest:
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        check_same(path, before)
    return digest


class CheckedFile(io.FileIO):
    """A file for the HDF5 library, which may crash the process where a write fails, as
    on a full disk.

    So no write fails before its eyes: the first refusal is kept for :meth:`check`,
    nothing is written from then on.
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


def typed_reader(load: Callable[..., Made]) -> Callable[..., Made]:
    """A ``load(path, ...)`` whose every failure on a damaged or edited file is a
    StoreError that names the file.
    """

    @functools.wraps(load)
    def checked(path: str | Path, *more: Any, **about: Any) -> Made:
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


def read_hdf5(path: str | Path, read: Callable[[Any], Made]) -> Made:
    """What ``read`` makes of an open HDF5 file.

    Args:
        path: file to read or write.

    Raises:
        StoreError: no plain file, or it was replaced meanwhile. What ``read`` raises.
    """
    import h5py

    plain = os.path.isfile(path)
    if os.path.exists(path) and not (plain or os.path.isdir(path)):
        raise StoreError(
            f"{path}: {missing_reason(Path(path))}"
        )  # a pipe would be waited for
    with refuse_changes(path), h5py.File(path, "r") as file:
        return read(file)


def to_valid_utf8(text: str) -> str:
    """A text whose every character is one of UTF-8, of one that may hold names of files in bytes of no known locale.

    Python keeps such bytes as lone surrogates. Where they are UTF-8 they become what they stand for; others, codes.

    >>> shown("gr\\udcc3\\udcb6sse \\udcff")
    'grösse \\\\xff'
    """
    try:
        return text.encode("utf-8", "surrogateescape").decode(
            "utf-8", "backslashreplace"
        )
    except UnicodeEncodeError:  # surrogates that stand for no byte
        return text.encode("utf-8", "backslashreplace").decode()


def missing_reason(path: Path) -> str:
    """What is wrong with a path that is no plain file, in words."""
    if path.is_dir():
        return "a folder"
    if path.exists():
        return "no plain file (a pipe or a device), in which a reader could go back and forth"
    return "no such file"


_FOREIGN = {  # first bytes of what is often given in place of an artefact, in words
    b"\x93NUMPY": "an array of NumPy",
    b"PK\x03\x04": "an archive (.npz or .zip)",
    b"II*\0": "a TIFF picture",
    b"MM\0*": "a TIFF picture",
    b"\x89PNG": "a PNG picture",
    b"MATLAB 5": "a MATLAB file",
    b"\x1f\x8b": "a compressed file (gzip: unpack it)",
}


def foreign_format(path: str | Path) -> str:
    """What a file is that begins as another program's, in words; empty for any other.

    Args:
        path: file to read or write.
    """
    start = b""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        start = file.read(8)
    return next(
        (words for first, words in _FOREIGN.items() if start.startswith(first)), ""
    )
