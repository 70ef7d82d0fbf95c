"""Every file operation of a command as the moment of a kill, a signal, a refused write,
a full disk, a second writer.

The command runs once. Before each operation what lies on the disk is copied: such a
copy is what a kill leaves there.
Where the command goes on after the moment, its process is split in two, and the new one
goes on in the copy, which a
mount of its own puts in the place of the folder. So a command of minutes is struck at
all its operations in little
more than its own time. A process that was split has but one thread: where the command
has others, which it would wait
for for ever, it is run anew and struck there, some of those operations in each sweep.
Linux alone, for a user who may
mount.
"""

import errno
import inspect
import json
import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks import _hardness_commands as commands
from benchmarks import _hardness_mounts as mounts
from benchmarks._hardness_commands import RESUMABLE, VERBS, Hook, Operation
from benchmarks._hardness_runs import SEED, Bench
from metalens.ground import reading, transaction

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
REFUSALS = (errno.ENOSPC, errno.EIO, errno.EDQUOT)
SHARES = {
    "torn": 0.25,
    "signal": 1.0,
    "refused": 1.0,
    "full": 0.25,
    "second": 0.25,
}  # of the operations
# seconds of work that any trial may take; dearer ones come as seldom as they take
# longer
DEAREST = 0.6
PATIENCE = 120.0
ANEW, LEAST_ANEW = (
    40.0,
    6,
)  # seconds of runs of their own in a sweep, and the least number of them
_DISK = 16 << 20  # beside what is copied to it
Answer = dict[str, Any]
Strike = tuple[
    str, str, Callable[[], object], int
]  # kind, how, what is done, bytes left of the disk (-1: all)


@dataclass(eq=False)
class Sweep:
    """All trials at the operations of one run of a command; the run with the second
    settings.

    fresh: over nothing, in place of a good result of the first settings. counts: trials
    of a kind. found: what went
    wrong, by the words of the trial.
    """

    bench: Bench
    verb: str
    number: int
    fresh: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    found: dict[str, tuple[str, str]] = field(default_factory=dict)
    seen: dict[str, list[str]] = field(default_factory=dict)
    chance: random.Random = field(default_factory=random.Random)
    threaded: list[int] = field(default_factory=list)

    def run(self) -> None:
        """Do them all."""
        self.chance.seed(f"{SEED} points {self.verb} {self.number}")
        words, output = VERBS[self.verb]
        self.bench.clear(output)
        if not self.fresh:
            self.bench.restore(self.verb)
        (asks, ask), (answers, answer) = os.pipe(), os.pipe()
        tracer = Tracer(
            self.bench, self.verb, f"{self.number}", ask, answers, (asks, answer)
        )
        child = self.bench.begin(
            words.format(1) + " --force" * (not self.fresh), tracer
        )
        os.close(ask)
        os.close(answers)
        with open(asks, encoding="utf-8") as requests:
            for request in requests:
                os.write(
                    answer,
                    json.dumps(self._answer(json.loads(request))).encode() + b"\n",
                )
        os.close(answer)
        end = child.wait()
        if self.bench.which(self.verb) != 1 or end.status not in (0, 1):
            self.found["the run itself"] = "kills", f"{end.status}, {end.told[-300:]}"
        self._anew()
        self.bench.clear(output)

    def _anew(self) -> None:
        """Strike a run of its own at some of the operations at which the command had
        threads.
        """
        words, output = VERBS[self.verb]
        most = max(LEAST_ANEW, int(ANEW / self.bench.seconds[self.verb]))
        for at in self.chance.sample(self.threaded, min(most, len(self.threaded))):
            self.bench.clear(output)
            if not self.fresh:
                self.bench.restore(self.verb)
            number = self.chance.choice((*SIGNALS, signal.SIGKILL))
            strike = commands.at(at, commands.signalled(number))
            end = self.bench.begin(
                words.format(1) + " --force" * (not self.fresh), strike
            ).wait()
            told = {
                "kind": "kills",
                "how": number.name,
                "place": str(self.bench.folder),
                "at": f"{at} with threads",
            }
            self._answer(told | {"status": end.status, "told": end.told})

    def _answer(self, told: Answer) -> Answer:
        """Judge a trial, or begin one of two writers; note an operation at which there
        are threads.
        """
        if told["kind"] == "threads":
            self.threaded.append(told["number"])
            return {}
        here = replace(self.bench, folder=Path(told["place"]), found=[])
        if told["kind"] == "begin":
            return self._second(here)
        self.counts[told["kind"]] = self.counts.get(told["kind"], 0) + 1
        if told["kind"] == "writers":
            self._judge_pair(here, told)
        else:
            self._judge(here, told)
        if here.found:
            self.found[f"{told['at']} {told['how']}"] = (
                told["kind"],
                "; ".join(here.found),
            )
            print(
                self.verb, self.number, told["at"], told["how"], *here.found, flush=True
            )
        return {}

    def _judge(self, here: Bench, told: Answer) -> None:
        status, words = told["status"], told["told"][-300:]
        output, killed = VERBS[self.verb][1], told["how"] in ("SIGKILL", "torn")
        nothing = self.fresh and not here.state(output)
        stands = -2 if nothing else here.which(self.verb, companions=not killed)
        here.expect(
            stands != -1,
            f"ended with {status}, mixed or lost: {sorted(here.state(output))}, {words}",
        )
        if told["kind"] == "disks":
            typed = status in (0, 1, 2) and "not foreseen" not in words
            here.expect(typed, f"ended with {status}, {words}")
            said = (stands == 1) == (
                status < 2 or f"{output}: {transaction.IN_PLACE}" in told["told"]
            )
            here.expect(said, f"ended with {status}, but {stands} stands, {words}")
        elif not killed:
            here.expect(
                status in (0, 1, 130, -signal.SIGINT), f"ended with {status}, {words}"
            )
        here.expect(
            killed or not here.scratch(unfinished=True),
            f"left {here.scratch(unfinished=True)}, {words}",
        )
        (here.folder / "filler").unlink(missing_ok=True)  # the next run has room
        here.found += self._next(here)

    def _next(self, here: Bench) -> list[str]:
        """The next run clears up: stopped as soon as it holds its output, and from time
        to time to its end.
        """
        key = _signature(here.folder, VERBS[self.verb][1])
        if key in self.seen:
            return self.seen[key]
        words, output = VERBS[self.verb]
        began, before = here.state(output), len(here.found)
        begun = (
            self.verb in RESUMABLE
            and transaction.unfinished(here.folder / output).is_dir()
        )
        more = " --resume" if begun else " --force"
        end = here.begin(words.format(1) + more, _Claimed()).wait()
        stopped = end.status in (130, -signal.SIGINT) or (begun and end.status == 2)
        here.expect(stopped, f"then{more}, stopped: {end.status}, {end.told[-300:]}")
        whole = here.which(self.verb) >= 0 or (self.fresh and not here.state(output))
        here.expect(
            whole,
            f"then{more}, stopped: mixed or lost {sorted(began)}, {sorted(here.state(output))}",
        )
        here.expect(
            not here.scratch(unfinished=True),
            f"then{more}, stopped: left {here.scratch(unfinished=True)}",
        )
        if self.chance.random() < DEAREST / self.bench.seconds[self.verb]:
            here.again(self.verb, words.format(1), "next")
        self.seen[key] = here.found[before:]
        del here.found[before:]
        return self.seen[key]

    def _second(self, here: Bench) -> Answer:
        """Begin the second of two writers; whether the first has to go on."""
        state = here.state(VERBS[self.verb][1])
        end = here.begin(
            VERBS[self.verb][0].format(0) + " --force" * (not self.fresh)
        ).wait()
        refused = end.status == 2 and "is being written by" in end.told
        same = state == here.state(VERBS[self.verb][1])
        return {
            "go": not (refused and same),
            "status": end.status,
            "told": end.told[-300:],
        }

    def _judge_pair(self, here: Bench, told: Answer) -> None:
        if not told["second"]["go"]:  # it was refused, and the first need not go on
            return
        ends = (told["status"], told["second"]["status"])
        words = f"ends {ends}: {told['told'][-300:]}"
        good = 0 <= min(ends) <= 1 and 0 <= max(ends) <= 2
        here.expect(good, words)
        here.expect(here.which(self.verb) >= 0, f"mixed: {words}")
        here.expect(not here.scratch(), f"left {here.scratch()}: {words}")


@dataclass(eq=False)
class Tracer:
    """What the command that is struck does before each of its file operations."""

    bench: Bench
    verb: str
    seed: str
    ask: int
    answers: int
    others: tuple[int, ...]
    hook: Hook | None = None
    last: str = ""
    count: int = 0

    def meet(self, hook: Hook) -> None:
        """Begin, in the process of the command."""
        self.hook = hook
        for handle in self.others:
            os.close(handle)

    def __call__(self, operation: Operation) -> None:
        """All trials of one operation; in a process that was split off, none more."""
        chance = random.Random(f"{SEED} {self.verb} {self.seed} {operation.number}")
        about = {"at": f"{operation.number} {operation.event} {_shown(operation)}"}
        self._tell("kills", "SIGKILL", self._place(), about)
        if self.last and chance.random() < SHARES["torn"]:
            self._torn(chance, about)
        for kind, how, act, spare in self._forks(operation, chance):
            if self._fork(kind, how, act, about, spare):
                return
        if (
            operation.event == "open"
            and operation.writes
            and isinstance(operation.arguments[0], str)
        ):
            self.last = operation.arguments[0]

    def _forks(self, operation: Operation, chance: random.Random) -> Iterator[Strike]:
        """Trials in which the command goes on; none where a process that is split off
        could not.
        """
        pipe = bool(operation.arguments) and isinstance(operation.arguments[0], int)
        if (
            operation.event == "os.fork" or pipe or _removes()
        ):  # its pipe has another end; a folder's number is told
            return
        if threading.active_count() > 1:
            self._asked({"kind": "threads", "number": operation.number})
            return
        times = self.bench.times[self.verb]
        left = times[-1] - times[min(operation.number, len(times)) - 1]
        cheap = chance.random() < DEAREST / max(left, 1e-9)
        wanted = {name: chance.random() < share for name, share in SHARES.items()}
        number, code, spare = (
            chance.choice(SIGNALS),
            chance.choice(REFUSALS),
            int(10 ** chance.uniform(2, 5.5)),
        )
        if wanted["signal"]:
            yield "kills", number.name, commands.signalled(number), -1
        numbered = (
            operation.event in ("os.rename", "fsync")
            and any(
                ready.stat().st_size
                for ready in self.bench.folder.glob(".*.part-*/ready")
            )
        )  # a folder that is known by its number, which its copy has not: tests of transactions refuse these
        if wanted["refused"] and operation.writes and cheap and not numbered:
            yield "disks", errno.errorcode[code], lambda: _raise(code), -1
        if wanted["full"] and cheap:
            yield "disks", f"{spare} bytes left", bool, spare
        held = (self.bench.folder / f".{VERBS[self.verb][1]}.lock").exists()
        if wanted["second"] and (
            cheap if held else chance.random() < DEAREST / (times[-1] + left)
        ):
            yield "writers", "second", bool, -1

    def _place(self, spare: int = -1) -> Path:
        """A copy of the folder as it lies now; on a file system of its own with so many
        bytes left.
        """
        self.count += 1
        place = self.bench.folder.with_name(f"place{self.count}")
        place.mkdir()
        if spare >= 0:
            mounts.memory(place, _DISK + mounts.size(self.bench.folder))
        mounts.copied(
            self.bench.folder, place, Path(VERBS[self.verb][1]).stem, linked=spare < 0
        )
        if spare >= 0:
            self.bench.filler(spare, place)()
        return place

    def _torn(self, chance: random.Random, about: Answer) -> None:
        """The file that was written last, cut short."""
        place = self._place()
        path = place / Path(self.bench.folder, self.last).relative_to(self.bench.folder)
        if path.is_file() and VERBS[self.verb][1] not in (path.name, path.parent.name):
            os.truncate(path, chance.randint(0, path.stat().st_size))
        self._tell("kills", "torn", place, about)

    def _fork(
        self, kind: str, how: str, act: Callable[[], object], about: Answer, spare: int
    ) -> bool:
        """Go on in a copy, where ``act`` is called at this operation; whether this
        process is the one that does.
        """
        place = self._place(spare)
        told, (wait, go) = self.bench.aside / f"{place.name}.txt", os.pipe()
        child = self._split(place, told)
        if child == 0:
            os.close(go)
            os.read(wait, 1)
            act()
            return True
        os.close(wait)
        second = (
            self._asked({"kind": "begin", "place": str(place)})
            if kind == "writers"
            else {"go": True}
        )
        if not second["go"]:
            os.kill(child, signal.SIGKILL)
        os.close(go)
        ended = _ended(child, told)
        if kind == "writers":
            ended["told"] += f" second: {second['told']}"
        self._tell(
            kind, how, place, about | ended | {"second": second}, mounted=spare >= 0
        )
        return False

    def _split(self, place: Path, told: Path) -> int:
        """As os.fork, without what modules do in a new process: locks stay held. The
        new one lives in ``place``.
        """
        told.touch()
        child = mounts.fork()
        if child == 0 and self.hook is not None:
            self.hook.each, self.hook.told, self.hook.process = bool, told, os.getpid()
            mounts.enter(place, self.bench.folder)
            reading.check_same = _no_check
            os.dup2(os.open(told, os.O_WRONLY | os.O_APPEND), 2)
        return child

    def _tell(
        self, kind: str, how: str, place: Path, about: Answer, *, mounted: bool = False
    ) -> None:
        """Have a trial judged."""
        self._asked(
            {
                "kind": kind,
                "how": how,
                "place": str(place),
                "status": -signal.SIGKILL,
                "told": "",
            }
            | about
        )
        if mounted:
            mounts.gone(place)
        shutil.rmtree(place, ignore_errors=True)

    def _asked(self, words: Answer) -> Answer:
        os.write(self.ask, json.dumps(words).encode() + b"\n")
        found = b""
        while not found.endswith(b"\n"):
            found += os.read(self.answers, 65536)
        answer: Answer = json.loads(found)
        return answer


@dataclass(eq=False)
class _Claimed:
    """Interrupts a command at the operation after it has made its scratch folder."""

    held: bool = False

    def __call__(self, operation: Operation) -> None:
        if self.held:
            os.kill(os.getpid(), signal.SIGINT)
        self.held = operation.event == "os.mkdir" and ".part-" in str(
            operation.arguments[0]
        )


def _removes() -> bool:
    """Whether the call comes from inside shutil.rmtree."""
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_name.lstrip("_").startswith("rmtree"):
            return True
        frame = frame.f_back
    return False


def _raise(code: int) -> None:
    raise OSError(code, os.strerror(code))


def _shown(operation: Operation) -> str:
    first = operation.arguments[0] if operation.arguments else ""
    return Path(first).name if isinstance(first, str) else str(first)[:40]


def _ended(child: int, told: Path) -> Answer:
    """Status and words of a process of ours; one that does not end is killed."""
    end = time.monotonic() + PATIENCE
    while (found := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return {"status": -99, "told": "did not end"}
        time.sleep(0.002)
    words = told.read_text("utf-8", "replace")
    for path in (told, told.with_suffix(".json")):
        path.unlink(missing_ok=True)
    return {"status": os.waitstatus_to_exitcode(found[1]), "told": words}


def _signature(folder: Path, output: str) -> str:
    """All that lies at an output, random names aside."""
    found = []
    for top in sorted(folder.iterdir()):
        if top.name.startswith((Path(output).stem, ".")):
            for path in (top, *sorted(top.rglob("*"))):
                name = (
                    path.relative_to(folder)
                    .as_posix()
                    .replace(top.name, top.name.split(".part-")[0], 1)
                )
                content = (
                    path.read_bytes()
                    if path.is_file() and not name.endswith((".lock", "/ready"))
                    else b""
                )
                found.append((name, hash(content)))
    return json.dumps(found)


def _no_check(path: str | Path, before: reading.Stamp) -> None:
    """Of an input that was being read when the process was split: its copy is another
    file.
    """
