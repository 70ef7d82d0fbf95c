"""One writer for each output: an exclusive lock file beside it."""

import contextlib
import ctypes
import fcntl
import os
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from metalens.core.errors import OutputError

COMMAND: ContextVar[str] = ContextVar(
    "COMMAND", default=""
)  # words of the command line, for locks and manifests
_RENAME_EXCHANGE, _AT_FDCWD = 2, -100  # renameat2(2)


@contextlib.contextmanager
def hold_lock(target: Path) -> Iterator[None]:
    """Hold ``.NAME.lock`` beside an output; the kernel frees it when its owner dies.

    Args:
        target: the output; its folder exists.

    Raises:
        OutputError: another process writes this output; the message names it.
        OSError: the folder cannot be written.
    """
    path = target.with_name(f".{target.name}.lock")
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        while not _is_locked(handle, path, target):
            os.close(handle)  # its last owner removed the file in between
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        os.ftruncate(handle, 0)
        words = f"{os.getpid()} {COMMAND.get()}"
        os.pwrite(handle, words.encode("utf-8", "surrogateescape"), 0)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _is_locked(handle: int, path: Path, target: Path) -> bool:
    """Take the lock of an open file; whether the file still has its name.

    Raises:
        OutputError: another process holds it.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        words = os.pread(handle, 4096, 0).decode("utf-8", "surrogateescape")
        process, _, command = words.partition(" ")
        owner = f"process {process} (metalens {command})" if process else "another one"
        raise OutputError(
            f"{target} is being written by {owner}; wait for it or give another name"
        ) from None
    try:
        return os.stat(path).st_ino == os.fstat(handle).st_ino
    except FileNotFoundError:
        return False


def exchange_names(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    names = os.fsencode(one.absolute()), os.fsencode(other.absolute())
    done: int = call(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE)
    return done == 0


def is_free(path: Path) -> bool:
    """Whether no living process holds a lock on a file.

    Args:
        path: file to read or write.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True
