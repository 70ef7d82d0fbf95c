"""One transaction for every output, a file with its companions or a folder.

    claim      lock with its owner, input is not output, what exists is ours, room, permission; unique scratch beside
    write      into the scratch, by whoever asked
    commit     manifest (folders), flush, rename as one; what was there is moved aside until the new one stands
    recover    the next run on the same output ends or undoes what a killed one left

Whatever ends the work early, the output is what it was before.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from metalens.ground import lock, manifest, store
from metalens.ground.errors import OutputError

ROOM = 1 << 22  # bytes that every output may need
UNFINISHED, JOURNAL = (
    ".unfinished",
    ".resume",
)  # endings of what an interruption leaves for the next run
IN_PLACE = "the new one is in place, but the disk did not confirm it"
_READY = "ready"


@dataclass(frozen=True, slots=True)
class Draft:
    """A claimed output.

    path: where to write it; companions of a file go beside this path under their own
    names.
    target: where all appears at the end; where a link leads. resumed: whether ``path``
    holds work of an earlier run.
    """

    path: Path
    target: Path
    resumed: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Terms:
    """What a claim allows.

    force: whether what exists may be replaced, if it is ours. inputs: files and folders
    that are read.
    room: bytes that the output needs. parents: whether missing folders above it are
    made.
    """

    force: bool = False
    inputs: Sequence[Path] = ()
    room: int = ROOM
    parents: bool = False


@contextlib.contextmanager
def file(
    target: Path, *, beside: Sequence[str] = (), terms: Terms = Terms()
) -> Iterator[Draft]:
    """Claim a file and its companions, give a scratch path, and put all in place if the
    block succeeds.

    Args:
        beside: endings of the companions: ``_xz.png`` is NAME_xz.png for NAME.h5.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _real(target)
    names = [target.stem + end for end in beside]
    if target.name.lower() in (
        name.lower() for name in names
    ):  # one file where the system tells no case apart
        raise OutputError(
            f"{target}: a file of that name is written beside the result; give another ending, as .h5"
        )
    with _claimed(target, terms, is_folder=False):
        _refuse(target, names, terms, is_folder=False)
        with _scratch(target) as scratch:
            (scratch / "new").mkdir()
            yield Draft(scratch / "new" / target.name, target)
            _commit_file(scratch, target, names, terms)


@contextlib.contextmanager
def folder(target: Path, *, terms: Terms = Terms()) -> Iterator[Draft]:
    """Claim a folder, give a scratch folder to fill, and put it in place with a
    manifest if the block succeeds.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _real(target)
    with _claimed(target, terms, is_folder=True):
        _refuse(target, (), terms, is_folder=True)
        with _scratch(target) as scratch:
            new = scratch / "new"
            new.mkdir()
            yield Draft(new, target)
            _commit_folder(scratch, new, target, terms)


@contextlib.contextmanager
def long_work(
    target: Path,
    *,
    keep: Sequence[str],
    resume: bool = False,
    grow: bool = False,
    terms: Terms = Terms(),
) -> Iterator[Draft]:
    """As :func:`folder` for work of minutes to days: it is done in ``NAME.unfinished``
    beside the target.

    That folder survives an interruption if it holds a file that matches a pattern of
    ``keep``; with ``resume`` the next
    run goes on in it, or in a copy of the finished folder. What stands at ``target``
    stays until the end.

    Args:
        grow: always go on, from a copy of what stands at ``target``, and put the whole
            back; it must have a manifest,
            or hold nothing but folders that have one.

    What others put into a folder of ours goes with it, and does not become ours.

    Raises:
        OutputError: nothing to resume, or unfinished work that would be lost; see
            :func:`_refuse`.
    """
    target = _real(target)
    with _claimed(target, terms, is_folder=True), _scratch(target) as scratch:
        work = unfinished(target)
        if not (resume or grow):
            _refuse(target, (), terms, is_folder=True)
        check_room(target, terms.room)
        resumed = _open_work(scratch, target, terms, resume=resume or grow, grow=grow)
        try:
            yield Draft(work, target, resumed=resumed)
            _commit_folder(scratch, work, target, terms, whoever=resume or grow)
        except BaseException as error:
            if any(True for pattern in keep for _ in work.glob(pattern)):
                how = "the same command" if grow else "--resume"
                error.add_note(f"{work} holds what is done so far; {how} goes on")
            else:
                shutil.rmtree(work, ignore_errors=True)
            raise


def unfinished(target: Path) -> Path:
    """Where the work on a folder is done until it is finished."""
    target = _real(target)
    return target.with_name(target.name + UNFINISHED)


def _real(target: Path) -> Path:
    """What a link leads to, also where that does not stand yet: lock and scratch are
    beside it, as for who names it.
    """
    try:
        return target.resolve() if os.path.islink(target) else target
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{target}: a link that leads nowhere ({error}); give another name"
        ) from None


@contextlib.contextmanager
def _claimed(target: Path, terms: Terms, *, is_folder: bool) -> Iterator[None]:
    """The lock of an output, with leftovers of dead owners cleared."""
    if "\0" in str(target) or target.name in ("", ".", ".."):
        raise OutputError(
            f"{str(target)!r}: need the name of a {'folder' if is_folder else 'file'} to write"
        )
    if target.name.endswith((UNFINISHED, JOURNAL)):
        raise OutputError(
            f"{target}: names that end in {UNFINISHED} or {JOURNAL} are those of interrupted work"
        )
    with contextlib.ExitStack() as held:
        if terms.parents:
            held.enter_context(lock.parents(target))
        if not target.parent.is_dir():
            how = (
                "is a file: give"
                if target.parent.exists()
                else "does not exist; make it or give"
            )
            raise OutputError(f"{target}: folder {target.parent} {how} another name")
        try:
            held.enter_context(lock.held(target))
        except OSError as error:
            raise OutputError(
                f"{target}: its folder cannot be written ({error.strerror}); give another"
            ) from error
        for left in lock.left(target):
            _recover(left, target)
        store.clear(
            target.with_name(target.name + JOURNAL)
        )  # scratch of a journal whose writer was killed
        try:
            yield
        except OSError as error:
            if error.filename is None:  # a full disk
                error.add_note(
                    f"{target} could not be made; what stood there is unchanged"
                )
            raise


def _refuse(
    target: Path, beside: Iterable[str], terms: Terms, *, is_folder: bool
) -> None:
    """Refuse an output that is an input, exists without --force, is none of ours, or
    finds no room.

    Raises:
        OutputError: naming what stands there and what to do.
    """
    for path in terms.inputs:
        if path.exists() and target.exists() and path.samefile(target):
            raise OutputError(
                f"{target} is also an input ({path}): it would be replaced; give another name"
            )
        if (
            is_folder
            and path.exists()
            and target.resolve() in path.resolve().parents
            and _something(target)
        ):
            raise OutputError(
                f"{target} holds the input {path}: it would be replaced; give another name"
            )
    if os.path.ismount(target):
        raise OutputError(
            f"{target} is a mount point, which cannot be replaced whole; give another name"
        )
    if target.exists() and target.is_dir() != is_folder:
        raise OutputError(f"{target} is a {'folder' if target.is_dir() else 'file'}; need the name of a "
                          f"{'folder' if is_folder else 'file'}")  # fmt: skip
    for path in (target, *(target.with_name(name) for name in beside)):
        if not _something(path):
            continue
        if not terms.force:
            raise OutputError(f"{path} exists; give --force to overwrite it")
        why = manifest.foreign(path)
        if why:
            raise OutputError(
                f"{path} {why}: not overwritten, not even with --force; move it or give another name"
            )
    check_room(target, terms.room)


def check_room(target: Path, room: int) -> None:
    """Refuse an output of ``room`` bytes that its disk has no room for; for sizes that
    are known after the claim.

    Raises:
        OutputError: naming what is free and what is needed.
    """
    spare = shutil.disk_usage(target.parent).free
    if spare < room:
        raise OutputError(
            f"{target}: {spare / 1e6:.3g} MB free, need {room / 1e6:.3g} MB; make room first"
        )


def _something(path: Path) -> bool:
    """Whether a path is taken by more than an empty folder."""
    if path.is_dir():
        return any(path.iterdir())
    return path.exists() or path.is_symlink()


@contextlib.contextmanager
def _scratch(target: Path) -> Iterator[Path]:
    scratch = None
    try:
        with (
            lock.undisturbed()
        ):  # a signal that comes here is answered inside the block that clears up
            scratch = Path(
                tempfile.mkdtemp(prefix=f".{target.name}.part-", dir=target.parent)
            )
        yield scratch
    finally:
        with lock.undisturbed():
            if scratch is not None:
                _recover(scratch, target)


def _commit_file(
    scratch: Path, target: Path, beside: Sequence[str], terms: Terms
) -> None:
    """Companions that stand are moved aside, then the file is replaced (from here on it
    is the new one), then theirs.

    So at no moment does a companion lie beside a file that it does not belong to.
    """
    new, old = scratch / "new", scratch / "old"
    old.mkdir()
    made = sorted(p.name for p in new.iterdir())
    manifest.flush(new)
    with lock.undisturbed(), lock.folder(target.parent):
        others = {*beside, *made} - {target.name}
        _refuse(target, others, terms, is_folder=False)
        (scratch / _READY).touch()
        store.sync_folder(scratch)
        with _finished(target, lambda: not (new / target.name).exists()):
            for name in others:
                if target.with_name(name).exists():
                    target.with_name(name).rename(old / name)
            (new / target.name).replace(target)
            for name in made:
                if name != target.name:
                    (new / name).replace(target.with_name(name))
            store.sync_folder(target.parent)


def _commit_folder(
    scratch: Path, new: Path, target: Path, terms: Terms, *, whoever: bool = False
) -> None:
    """Give the folder its manifest and exchange it with what stands."""
    begun = manifest.read(new)
    manifest.write(new, lock.COMMAND.get(), others=begun["others"] if begun else ())
    manifest.flush(new)
    with lock.undisturbed(), lock.folder(target.parent):
        if not whoever:
            _refuse(target, (), terms, is_folder=True)
        number, ready, old = new.stat().st_ino, scratch / _READY, scratch / "old"
        with _finished(
            target,
            lambda: (
                old.exists() or (target.exists() and target.stat().st_ino == number)
            ),
            ready,
        ):
            store.write_bytes(
                ready, b"%d" % number
            )  # whole or not at all: an empty one is a file's
            _put(scratch, new, target)


def _put(scratch: Path, new: Path, target: Path) -> None:
    """Exchange a finished folder with what stands."""
    if not target.exists():
        new.rename(target)
    elif lock.exchange(new, target):
        new.rename(scratch / "old")
    else:
        target.rename(scratch / "old")
        new.rename(target)
    store.sync_folder(target.parent)


@contextlib.contextmanager
def _finished(
    target: Path, placed: Callable[[], bool], ready: Path | None = None
) -> Iterator[None]:
    """Where the disk refuses something: all is undone, or the new output is in place,
    and the error says so.
    """
    try:
        yield
    except OSError as error:
        if placed():
            raise OutputError(
                f"{target}: {IN_PLACE} ({error.strerror}); check it when the disk is well"
            ) from error
        if ready is not None:
            ready.unlink(
                missing_ok=True
            )  # or leaving would put the new one in place after all
        raise


def _open_work(
    scratch: Path, target: Path, terms: Terms, *, resume: bool, grow: bool
) -> bool:
    """Make or find the folder of unfinished work; whether it holds some already."""
    work = unfinished(target)
    found = manifest.read(work) if work.is_dir() else None
    if work.exists() and found is None:
        raise OutputError(
            f"{work} is in the way and was not made by metalens; move it or give another name"
        )
    if found is not None and resume:
        return True
    if found is not None and not terms.force:
        raise OutputError(
            f"{work} holds an unfinished run; give --resume to go on, or --force to start over"
        )
    if found is not None:
        work.rename(scratch / "given_up")
    fresh = scratch / "work"
    copied, others = resume and _something(target), set[str]()
    if copied:
        others = manifest.strange(target)
        if others and manifest.read(target) is None:
            raise OutputError(
                f"{target} holds {min(others)} and no {manifest.NAME}: not made by metalens"
            )
        if not grow:
            manifest.check(target)
        shutil.copytree(target, fresh, symlinks=True)
    else:
        fresh.mkdir()
    manifest.write(fresh, lock.COMMAND.get(), finished=False, others=others)
    fresh.rename(work)
    return copied


def _recover(scratch: Path, target: Path) -> None:
    """End what a killed owner had committed, undo what it had not, clear the rest."""
    new, old, ready = scratch / "new", scratch / "old", scratch / _READY
    if ready.is_file() and ready.stat().st_size:
        _recover_folder(scratch, target, int(ready.read_text(encoding="ascii")))
    elif (
        ready.is_file() and new.is_dir() and old.is_dir()
    ):  # of a file: both are made before
        done = not (new / target.name).exists()
        for path in (new if done else old).iterdir():
            if not target.with_name(path.name).exists():
                path.rename(target.with_name(path.name))
    ready.unlink(
        missing_ok=True
    )  # first: what a kill leaves of the rest is scratch and nothing more
    shutil.rmtree(scratch, ignore_errors=True)


def _recover_folder(scratch: Path, target: Path, inode: int) -> None:
    """Put a folder in place that was finished when its owner was killed, or clear what
    it had replaced.
    """
    for path in (scratch / "new", unfinished(target)):
        if path.is_dir() and path.stat().st_ino == inode:
            if not (target.exists() and manifest.foreign(target)):
                _put(scratch, path, target)
        elif path.is_dir() and target.is_dir() and target.stat().st_ino == inode:
            path.rename(scratch / "replaced")
