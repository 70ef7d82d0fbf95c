"""Loaders that fail by type: whatever a damaged or edited file does, the answer is one
error that names the file.

The HDF5 library ends its process on some damaged files. So a forked child with little
to lose reads a file first; and
it writes to a file that never refuses, since it may end its process on a full disk too.

An input that is replaced or edited while it is read is refused. A stamp tells, which is
the same or not: it is never
asked which of two is later, since clocks are set back.
"""

import codecs
import contextlib
import dataclasses
import faulthandler
import functools
import hashlib
import io
import os
import re
import resource
import typing
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from metalens.ground import errors
from metalens.ground.errors import DAMAGE, MetalensError, StoreError

Made = TypeVar("Made")
_ROOM, _SECONDS = (
    600 << 20,
    60,
)  # address space beyond what this process has, time of the processor, for a probe
_DENSEST = (
    1100  # more of it for a byte of the file: what deflate can do at best, and copies
)
_MOST_WORDS = 4000
_WHOLE = 1 << 26  # bytes of a file up to which a probe reads all of it
_WITH_COMMA = re.compile(r"[+-]?(\d+([.,]\d*)?|\.\d+)([eE][+-]?\d+)?")
_PLAIN = {
    1,
    2,
    3,
}  # deflate, shuffle, Fletcher's checksum: packing that the HDF5 library undoes without harm
Stamp = tuple[tuple[int, ...], ...]
_noted: ContextVar[dict[str, tuple[Stamp, str]] | None] = ContextVar(
    "_noted", default=None
)  # of inputs, by path


@contextlib.contextmanager
def remembered() -> Iterator[None]:
    """Remember inputs from their first reading on, until the block (a command) ends."""
    token = _noted.set({})
    try:
        yield
    finally:
        _noted.reset(token)


def decode_text(content: bytes) -> str:
    """Text of UTF-8, or of UTF-16 with its byte-order mark (as spreadsheets save it).

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
    """Text of a file, by :func:`decode_text`."""
    return decode_text(Path(path).read_bytes())


def parting(line: str) -> tuple[str | None, bool]:
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


def columns(line: str) -> list[str]:
    """The words of such a line, decimals with points."""
    mark, decimal = parting(line)
    line = line.replace(",", ".") if decimal else line
    return (line if mark is None else line.replace(mark, " ")).split()


def stamp(path: str | Path) -> Stamp:
    """Which file it is, its bytes and the time of its last change; of a folder, also of
    all that lies in it.

    () where there is none.
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

    Raises:
        StoreError: naming it.
    """
    if stamp(path) != before:
        raise StoreError(
            f"{path} was changed or replaced while it was being read: run again when it stands still"
        )


@contextlib.contextmanager
def steady(path: str | Path) -> Iterator[None]:
    """Refuse an input that another program writes to while the block reads it.

    Raises:
        StoreError: see :func:`check_same`, in place of what the block made of such an
            input.
    """
    before = stamp(path)
    try:
        yield
    except (*DAMAGE, IndexError, ArithmeticError):
        check_same(path, before)
        raise
    check_same(path, before)
    note(path, before)


def note(path: str | Path, before: Stamp, content: bytes | None = None) -> None:
    """Note what an input was when this command first read it; with its content, its
    hash too.
    """
    if (noted := _noted.get()) is not None:
        noted.setdefault(
            os.path.abspath(path),
            (before, hashlib.sha256(content).hexdigest() if content else ""),
        )


def sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of an input as this command has read it.

    Raises:
        StoreError: it was replaced since; OSError: it cannot be read.
    """
    before, digest = (_noted.get() or {}).get(os.path.abspath(path), (stamp(path), ""))
    if not digest:
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        check_same(path, before)
    return digest


class Through(io.FileIO):
    """A file for the HDF5 library, which may crash the process where a write fails, as
    on a full disk.

    So no write fails before its eyes: the first refusal is kept for :meth:`check`,
    nothing is written from then on.
    """

    refused: OSError | None = None

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
        except OSError as error:
            self.refused = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of what is still written."""
        return 0 if self.refused is not None else super().truncate(size)


def reader(load: Callable[..., Made]) -> Callable[..., Made]:
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


def survived(path: str | Path, read: Callable[[Any], Made]) -> Made:
    """What ``read`` makes of an open HDF5 file, after a child process with limits has
    done the same and lived.

    What the child raised is raised here, without reading: a damaged file takes the
    child's memory alone. Of a file
    above 64 MB the child reads every header, where each block of the arrays lies, and
    their corners; all of them where
    they are packed otherwise than by gzip.

    Raises:
        StoreError: the child died, as this process would have; the file was replaced
            meanwhile; or what ``read``
            refuses (a MetalensError as it is, anything else as a RuntimeError).
    """
    import h5py

    def opened(work: Callable[[Any], Any]) -> Any:
        with h5py.File(path, "r") as file:
            return work(file)

    plain = os.path.isfile(path)
    if os.path.exists(path) and not (
        plain or os.path.isdir(path)
    ):  # a pipe that nobody writes to would be waited for
        raise StoreError(f"{path}: {absent(Path(path))}")
    size = os.path.getsize(path) if plain else 0
    with steady(path):
        _probe(
            path,
            lambda: opened(read if size <= _WHOLE else read_through),
            _ROOM + _DENSEST * size,
        )
        made: Made = opened(read)
    return made


def _probe(path: str | Path, read: Callable[[], object], room: int) -> None:
    """Call ``read`` in a forked child and raise what it raised."""
    from h5py._objects import phil

    out, into = os.pipe()
    try:
        with (
            phil,
            warnings.catch_warnings(),
        ):  # the lock of h5py: no other thread is inside the library when it is copied
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
    except OSError:  # no room for another process
        os.close(out)
        os.close(into)
        return
    if child == 0:
        _child(read, room, into)
    os.close(into)
    with open(out, "rb") as pipe:
        told = pipe.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status < 0:
        raise StoreError(
            f"{path}: damaged: reading it ended the reader with signal {-status}; make it again"
        )
    if told:
        name, _, words = told.decode("utf-8", "replace").partition("\n")
        raise getattr(errors, name, RuntimeError)(words)


def _child(read: Callable[[], object], room: int, into: int) -> None:
    """Read with limits, tell what was raised, and end."""
    try:
        _limit(room)
        read()
    except BaseException as error:  # noqa: BLE001 (told to the parent)
        os.write(into, shown(f"{type(error).__name__}\n{error}").encode()[:_MOST_WORDS])
    finally:
        os._exit(0)


def shown(text: str) -> str:
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


def _limit(room: int) -> None:
    """Of the child: memory, time, no core file, no words."""
    faulthandler.disable()
    told = Path("/proc/self/statm")  # of Linux
    have = (
        int(told.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        if told.is_file()
        else room
    )
    used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    limits = {
        resource.RLIMIT_AS: have + room,
        resource.RLIMIT_CPU: int(used) + _SECONDS,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(
            kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
        )
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def read_through(file: Any) -> None:
    """Every attribute of a file, the place of every block of its data sets, and their
    corners.
    """
    import h5py

    def visit(name: str, item: Any) -> None:
        for key in item.attrs:
            with contextlib.suppress(Exception):  # the next may yet end the reader
                item.attrs[key]
        if (
            isinstance(item, h5py.Dataset)
            and item.ndim
            and item.size
            and not (item.is_virtual or item.external)
        ):
            with contextlib.suppress(Exception):
                item[(0,) * item.ndim], item[(-1,) * item.ndim]
            with contextlib.suppress(Exception):
                _blocks(item)

    visit("/", file)
    file.visititems(visit)


def _blocks(item: Any) -> None:
    """Go through the index of a data set's blocks; read them where a rare packing is to
    be undone.
    """
    if item.chunks is None:
        return
    plan = item.id.get_create_plist()
    if {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= _PLAIN:
        item.id.chunk_iter(bool)
        return
    for block in item.iter_chunks():
        item[block]


def absent(path: Path) -> str:
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


def foreign(path: str | Path) -> str:
    """What a file is that begins as another program's, in words; empty for any other."""
    start = b""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        start = file.read(8)
    return next(
        (words for first, words in _FOREIGN.items() if start.startswith(first)), ""
    )
