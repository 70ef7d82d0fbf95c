"""One writer an output: a lock file beside it that names its owner; the lock of a dead
owner is free.
"""

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import re
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from metalens.ground.errors import OutputError

COMMAND: ContextVar[str] = ContextVar(
    "COMMAND", default=""
)  # words of the command line, for locks and manifests
_open: set[int] = set()
_EXCHANGE, _HERE = 2, -100  # of renameat2
_SIGNALS = tuple(
    s for s in ("SIGINT", "SIGTERM", "SIGHUP", "SIGALRM") if hasattr(signal, s)
)


@contextlib.contextmanager
def held(target: Path) -> Iterator[None]:
    """Hold ``.NAME.lock`` beside ``target``; the kernel frees it when its owner dies,
    and the file goes at the end.

    Raises:
        OutputError: another process writes this output; the message names it.
        OSError: the folder cannot be written.
    """
    path = target.with_name(f".{target.name}.lock")
    handle = -1
    try:
        # a signal that comes between making the file and knowing its handle is answered
        # below
        with undisturbed():
            handle = _taken(path, target)
        owner = {
            "process": os.getpid(),
            "host": socket.gethostname(),
            "command": COMMAND.get(),
        }
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(owner).encode(), 0)
        _open.add(handle)
        yield
    finally:
        with undisturbed():
            if handle >= 0:
                _open.discard(handle)
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)
                os.close(handle)


@contextlib.contextmanager
def parents(target: Path) -> Iterator[None]:
    """Missing folders above an output; those that are made here and hold nothing go
    again where the block fails.
    """
    missing = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in missing:
                folder.rmdir()
        raise


@contextlib.contextmanager
def folder(path: Path) -> Iterator[None]:
    """Hold a folder for the moment of a renaming; waits for others."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with contextlib.suppress(
            OSError
        ):  # a file system without locks: the lock file alone must do
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    done: int = call(
        _HERE,
        os.fsencode(one.absolute()),
        _HERE,
        os.fsencode(other.absolute()),
        _EXCHANGE,
    )
    return done == 0


def free(path: Path) -> bool:
    """Whether no living process holds a lock on a file."""
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


@dataclass(eq=False)
class _Heard:
    """Signals that came while they could not be answered."""

    numbers: list[int] = field(default_factory=list)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.numbers.append(number)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Answer signals only after the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, numbers = _Heard(), [getattr(signal, name) for name in _SIGNALS]
    before = {
        number: signal.signal(number, heard)
        for number in numbers
        if signal.getsignal(number) is not None
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in heard.numbers:
            signal.raise_signal(number)


def left(target: Path) -> Iterator[Path]:
    """Scratch of dead owners of an output that is held; under whatever case, where the
    system tells none apart.
    """
    for path in sorted(target.parent.glob(".*.part-*")):
        name = path.name[1:].rpartition(".part-")[0]
        if name == target.name or (
            name.lower() == target.name.lower() and _one(target.with_name(name), target)
        ):
            yield path


def _one(one: Path, other: Path) -> bool:
    """Whether two names have one lock."""
    paths = [path.with_name(f".{path.name}.lock") for path in (one, other)]
    return all(path.exists() for path in paths) and paths[0].samefile(paths[1])


def _taken(path: Path, target: Path) -> int:
    """An open handle of the lock file, locked; the file may have been removed by its
    last owner in between.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            told = _far(handle, path)
        except BlockingIOError:
            told = _words(_owner(handle))
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP):
                os.close(handle)
                raise
            told = _alive(handle, path)
        if told:
            os.close(handle)
            raise OutputError(
                f"{target} is being written by {told}; wait for it or give another name"
            )
        with contextlib.suppress(FileNotFoundError):
            if os.stat(path).st_ino == os.fstat(handle).st_ino:
                return handle
        os.close(handle)


def _far(handle: int, path: Path) -> str:
    """Who else writes, where the lock of a file tells nothing of other machines and
    another one left its name; ''.

    Where it does (a file server that keeps the locks), a lock that was had is free,
    whoever left the file.
    """
    owner = _owner(handle)
    elsewhere = bool(owner) and owner["host"] != socket.gethostname()
    return _alive(handle, path) if elsewhere and _locks_are_local(path) else ""


def _alive(handle: int, path: Path) -> str:
    """Who else writes, by the words in the lock file alone: a process that lives, or
    one of another machine; ''.
    """
    owner = _owner(handle)
    if not owner:
        return ""
    if owner["host"] != socket.gethostname():
        return (
            f"{_words(owner)}, as {path} says; if that one has ended, remove the file"
        )
    try:
        os.kill(owner["process"], 0)
    except ProcessLookupError:
        return ""
    except OSError:  # of another user
        pass
    return _words(owner)


_LOCAL = re.compile(
    r" - (fuse|9p)|\b(nolock|localflock|local_lock=(all|flock))\b"
)  # in the table of mounts


def _locks_are_local(path: Path) -> bool:
    """Whether another machine that uses the same file system does not hear of locks; by
    the table of mounts (Linux).
    """
    try:
        lines = Path("/proc/self/mountinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return False
    device = os.stat(path).st_dev
    name = f"{os.major(device)}:{os.minor(device)}"
    return any(line.split()[2] == name and _LOCAL.search(line) for line in lines)


def _owner(handle: int) -> dict[str, Any]:
    """What the lock file says of its owner; {} where it says nothing."""
    try:
        told = json.loads(os.pread(handle, 65536, 0))
        return {
            "process": int(told["process"]),
            "host": str(told["host"]),
            "command": str(told["command"]),
        }
    except (ValueError, KeyError, TypeError, OverflowError):
        return {}


def _words(owner: dict[str, Any]) -> str:
    return (
        f"process {owner['process']} on {owner['host']} (metalens {owner['command']})"
        if owner
        else "another process"
    )


def _let_go() -> None:
    """A forked child must not keep the lock when its parent dies."""
    for handle in _open:
        with contextlib.suppress(OSError):
            os.close(handle)
    _open.clear()


os.register_at_fork(after_in_child=_let_go)
