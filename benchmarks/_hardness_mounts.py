"""Copies of a folder that a process may take for the folder itself: mounts that no
other process sees (Linux).
"""

import ctypes
import fcntl
import os
import shutil
from pathlib import Path

_LIBC = ctypes.PyDLL(
    None, use_errno=True
)  # keeps the lock of the interpreter, so that a fork has it too
_NEW_NAMESPACE, _BIND, _PRIVATE, _DETACH = 0x20000, 0x1000, (1 << 18) | 0x4000, 2
_MAKING = os.O_CREAT | os.O_EXCL | os.O_TRUNC


def own() -> bool:
    """Mounts of this process are its own from here on; False where that is not allowed."""
    unshare = getattr(_LIBC, "unshare", None)
    return (
        unshare is not None
        and unshare(_NEW_NAMESPACE) == 0
        and _LIBC.mount(b"none", b"/", None, _PRIVATE, None) == 0
    )


def memory(folder: Path, size: int) -> bool:
    """Mount a file system of memory with so many bytes; False where that is not
    allowed.
    """
    return bool(
        _LIBC.mount(b"none", os.fsencode(folder), b"tmpfs", 0, f"size={size}".encode())
        == 0
    )


def gone(folder: Path) -> None:
    """Unmount."""
    _LIBC.umount2(os.fsencode(folder), _DETACH)


def fork() -> int:
    """As os.fork, but modules do not hear of it."""
    return int(_LIBC.fork())


def enter(place: Path, folder: Path) -> None:
    """Put ``place`` where ``folder`` is, for this process; its open files become those
    of the copy, locks too.

    The current folder, in it, becomes that of the copy.

    Raises:
        OSError: it cannot be mounted.
    """
    current = os.getcwd()
    if _LIBC.unshare(_NEW_NAMESPACE) or _LIBC.mount(
        os.fsencode(place), os.fsencode(folder), None, _BIND, None
    ):
        raise OSError(ctypes.get_errno(), "a copy cannot be mounted", str(folder))
    os.chdir(current)
    for name in os.listdir("/proc/self/fd"):
        link = f"/proc/self/fd/{name}"
        path = os.readlink(link) if os.path.islink(link) else ""
        if (path == str(folder) or path.startswith(f"{folder}/")) and os.path.exists(
            path
        ):
            _reopen(int(name), path)


def _reopen(handle: int, path: str) -> None:
    """The copy of an open file under the same handle, at the same place, with the same
    lock.
    """
    told = Path(f"/proc/self/fdinfo/{handle}").read_text("ascii")
    about = dict(line.split(":", 1) for line in told.splitlines())
    other = os.open(path, int(about["flags"], 8) & ~_MAKING)
    if not os.path.isdir(path):
        os.lseek(other, int(about["pos"]), os.SEEK_SET)
    if "FLOCK" in about.get("lock", ""):
        fcntl.flock(other, fcntl.LOCK_EX if "WRITE" in about["lock"] else fcntl.LOCK_SH)
    os.dup2(other, handle, inheritable=False)
    os.close(other)


def size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def copied(folder: Path, place: Path, stem: str, *, linked: bool) -> None:
    """Copy what belongs to an output; link the rest, or copy that too."""
    for path in folder.iterdir():
        ours = path.name.startswith((stem, "."))
        copy = os.link if linked and not ours else shutil.copy2
        if path.is_dir():
            shutil.copytree(path, place / path.name, symlinks=True, copy_function=copy)
        else:
            copy(path, place / path.name)
    for ready in place.glob(".*.part-*/ready"):
        _renumber(ready, folder, place)


def _renumber(ready: Path, folder: Path, place: Path) -> None:
    """A scratch folder names the folder that it puts in place by a number, which is
    another one for the copy.
    """
    number = ready.read_text("ascii")
    made = [
        folder / ready.parent.name / "new",
        *(p for p in folder.iterdir() if not p.name.startswith(".")),
    ]
    for path in made:
        if number and path.is_dir() and path.stat().st_ino == int(number):
            ready.write_text(
                str((place / path.relative_to(folder)).stat().st_ino), "ascii"
            )
