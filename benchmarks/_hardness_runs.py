"""Commands that are killed, run twice at once, or given too little room; what they
leave behind is judged.

Two sets of settings of different size take turns, so that a result made of both would
show. Half of the deaths come at
a random moment, half at a random file operation, where the putting in place is. Every
trial has a number and is drawn
from it, so it can be had again.
"""

import contextlib
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks import _hardness_commands as commands
from benchmarks import _hardness_kept as kept
from benchmarks import _hardness_mounts as mounts
from benchmarks._hardness_commands import RESUMABLE, VERBS, Child, Ended
from metalens.ground import manifest, transaction
from metalens.ground.errors import MetalensError

SEED = 5
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
DISK = 192 << 20  # bytes of the small file system
_OPEN = (
    transaction.UNFINISHED,
    ".resume",
)  # what an interrupted run may leave for the next
State = dict[str, str]


@dataclass(eq=False)
class Bench:
    """A folder of inputs, and what the two settings of every verb make.

    known: {verb: states}, each {name: SHA-256}, '' for what differs from run to run
    (times). seconds, operations: of
    the verb. fills: whether the folder is a small file system of its own, which can be
    filled.
    """

    folder: Path
    aside: Path
    verbs: tuple[str, ...]
    fills: bool = False
    known: dict[str, list[State]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    operations: dict[str, int] = field(default_factory=dict)
    times: dict[str, list[float]] = field(default_factory=dict)
    found: list[str] = field(default_factory=list)

    def begin(self, words: str, each: commands.Each = bool) -> Child:
        """Start a command in the folder."""
        return commands.begin(self.folder, self.aside, words, each)

    def prepare(self) -> None:
        """Inputs, and the two whole results of every verb, kept aside; what an earlier
        bench made is taken from it.
        """
        texts = commands.settings(self.folder)
        sources = kept.sources(texts)
        cached = kept.inputs(sources)
        for words in commands.inputs(self.verbs):
            output = words.partition(" -o ")[2].split()[0]
            if not (self.folder / output).exists() and not kept.taken(
                cached / output, self.folder / output
            ):
                self._must(words)
                kept.put(self.folder / output, cached / output)
        commands.found(self.folder, self.verbs)
        commands.load(kept.modules())
        for verb in [verb for verb in self.verbs if verb not in self.known]:
            about = kept.results(sources, verb, VERBS[verb][0])
            if not kept.taken(about, self.aside / verb):
                self._make(verb)
                kept.put(self.aside / verb, about)
            told = json.loads((self.aside / verb / kept.TOLD).read_text("utf-8"))
            self.known[verb], self.times[verb] = told["known"], told["times"]
            self.operations[verb], self.seconds[verb] = (
                len(told["times"]) - 1,
                told["seconds"],
            )
            commands.load(told["modules"])

    def _make(self, verb: str) -> None:
        """The two results of a verb; what differs between two runs of the same settings
        tells of times and words.
        """
        words, output = VERBS[verb]
        states, aside = [], self.aside / verb
        for i, more in ((0, ""), (1, ""), (1, " --force")):
            self.clear(output) if not more else None
            end = self._must(words.format(i) + more)
            states.append(self.state(output))
            if len(states) == 1:
                aside.mkdir()
                for path in self._left(output):
                    kept.copied(path, aside / path.name)
        first, one, other = states
        if one.keys() != other.keys() or first == one:
            raise RuntimeError(
                f"{verb}: other names from the same settings, or the same from both: {states}"
            )
        varying = {name for name, found in one.items() if found != other[name]}
        known = [
            {name: "" if name in varying else found for name, found in state.items()}
            for state in (first, one)
        ]
        told = {
            "known": known,
            "times": end.times,
            "seconds": end.seconds,
            "modules": sorted(sys.modules),
        }
        (aside / kept.TOLD).write_text(json.dumps(told), "utf-8")
        self.clear(output)

    def _must(self, words: str) -> Ended:
        end = self.begin(words).wait()
        if end.status not in (0, 1):
            raise RuntimeError(f"{words}: {end.status}, {end.told}")
        return end

    def _left(self, output: str) -> list[Path]:
        """An output and what lies beside it under its name."""
        return sorted(self.folder.glob(Path(output).stem + "*"))

    def state(self, output: str) -> State:
        """{name: SHA-256} of an output and its companions."""
        found = {}
        for top in self._left(output):
            for path in [top, *top.rglob("*")] if not top.name.endswith(_OPEN) else []:
                if path.is_file():
                    name = path.relative_to(self.folder).as_posix()
                    found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    def clear(self, output: str) -> None:
        """Remove an output and all that belongs to it."""
        for path in [
            *self._left(output),
            *(p for p in self.folder.iterdir() if p.name.startswith(".")),
        ]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def restore(self, verb: str) -> None:
        """Put the result of the first settings in place."""
        output = VERBS[verb][1]
        self.clear(output)
        for path in (self.aside / verb).iterdir():
            if path.name != kept.TOLD:
                kept.copied(path, self.folder / path.name)

    def scratch(self, *, unfinished: bool = False) -> list[str]:
        """Names that no run may leave."""
        ends = () if unfinished else _OPEN
        return [
            p.name
            for p in self.folder.iterdir()
            if p.name.startswith(".") or p.name.endswith(ends)
        ]

    def which(self, verb: str, *, companions: bool = True) -> int:
        """0 or 1: the settings whose whole result stands; -1 where it is mixed, changed
        or lost.

        companions: whether those of a file must be there; a kill may come before them.
        """
        output = VERBS[verb][1]
        state = self.state(output)
        with contextlib.suppress(MetalensError):
            if not Path(output).suffix:
                manifest.check(self.folder / output)
            for i, one in enumerate(self.known[verb]):
                here = state.keys() == one.keys() or (
                    not companions and output in state and state.keys() <= one.keys()
                )
                if here and all(
                    one[name] in ("", found) for name, found in state.items()
                ):
                    return i
        return -1

    def trial(self, kind: str, verb: str, number: int) -> list[str]:
        """What went wrong in one trial of a kind."""
        self.found = []
        work = {"kills": self._kill, "writers": self._pair, "disks": self._fill}[kind]
        work(verb, random.Random(f"{SEED} {kind} {verb} {number}"))
        self.clear(VERBS[verb][1])
        return [f"{verb} {number}: {words}" for words in self.found]

    def _kill(self, verb: str, chance: random.Random) -> None:
        """End a command over a good result by a signal; then run it again."""
        words = VERBS[verb][0].format(1)
        self.restore(verb)
        number = chance.choice(SIGNALS)
        if chance.random() < 0.5:
            at = chance.randint(1, self.operations[verb])
            child = self.begin(
                words + " --force", commands.at(at, commands.signalled(number))
            )
            how = f"{number.name} at operation {at}"
        else:
            child, after = (
                self.begin(words + " --force"),
                self.seconds[verb] * chance.uniform(0, 1.1),
            )
            time.sleep(after)
            os.kill(child.process, number)
            how = f"{number.name} after {after:.3f} s"
        end = child.wait()
        self.expect(
            end.status in (0, 1, 130, -number),
            f"{how}: ended with {end.status}, {end.told[-300:]}",
        )
        killed = end.status == -signal.SIGKILL
        self.expect(
            self.which(verb, companions=not killed) >= 0,
            f"{how}: mixed or lost: {sorted(self.state('out'))}",
        )
        self.expect(
            killed or not self.scratch(unfinished=True), f"{how}: left {self.scratch()}"
        )
        self.again(verb, words, how)

    def again(self, verb: str, words: str, how: str) -> None:
        """The next run is as if nothing had been: a resumed one too."""
        begun = (
            verb in RESUMABLE
            and transaction.unfinished(self.folder / VERBS[verb][1]).is_dir()
        )
        more = " --resume" if begun else " --force"
        end = self.begin(words + more).wait()
        if begun and end.status == 2:  # killed before there was anything to resume from
            end = self.begin(words + " --force").wait()
        good = end.status in (0, 1) and self.which(verb) == 1
        self.expect(
            good,
            f"{how}, then{more}: {end.status}, {end.told[-300:]}, {sorted(self.state('out'))}",
        )
        self.expect(not self.scratch(), f"{how}, then{more}: left {self.scratch()}")

    def _pair(self, verb: str, chance: random.Random) -> None:
        """Two commands write one output at about once: one result whole, the other
        refused or later.
        """
        words, force = VERBS[verb][0], chance.random() < 0.5
        if force:
            self.restore(verb)
        first = self.begin(words.format(0) + " --force" * force)
        time.sleep(self.seconds[verb] * chance.choice((0, 0, 0.1, 0.5, 0.9, 1.0)))
        second = self.begin(words.format(1) + " --force" * force)
        ends = [first.wait(), second.wait()]
        told = f"force {force}, ends {[e.status for e in ends]}: {' '.join(e.told[-300:] for e in ends)}"
        statuses = sorted(e.status for e in ends)
        self.expect(0 <= statuses[0] <= 1 and 0 <= statuses[1] <= 2, told)
        self.expect(
            self.which(verb) >= 0 and not self.scratch(),
            f"mixed, or left {self.scratch()}: {told}",
        )

    def _fill(self, verb: str, chance: random.Random) -> None:
        """The disk is full from some file operation on, or no file may grow beyond a
        size; a good result stands.
        """
        words = VERBS[verb][0].format(1)
        self.restore(verb)
        if self.fills and chance.random() < 0.7:
            at, spare = (
                chance.randint(1, self.operations[verb]),
                int(10 ** chance.uniform(2, 5.5)),
            )
            act, how = self.filler(spare), f"{spare} bytes left from operation {at}"
        else:
            at, most = 1, int(10 ** chance.uniform(2, 5))
            act, how = _limited(most), f"{most} bytes a file"
        end = self.begin(words + " --force", commands.at(at, act)).wait()
        (self.folder / "filler").unlink(missing_ok=True)
        stands = self.which(verb)
        self.expect(
            end.status in (0, 1, 2) and "not foreseen" not in end.told,
            f"{how}: {end.status}, {end.told[-300:]}",
        )
        self.expect(
            stands == (1 if end.status < 2 else 0),
            f"{how}: part of a result, {end.told[-300:]}",
        )
        self.expect(not self.scratch(unfinished=True), f"{how}: left {self.scratch()}")
        self.again(verb, words, how)

    def filler(self, spare: int, folder: Path | None = None) -> Callable[[], None]:
        """Takes all room of the small file system but ``spare`` bytes."""
        path = (folder or self.folder) / "filler"

        def fill() -> None:
            room = shutil.disk_usage(path.parent).free - spare
            with open(path, "wb") as file:
                if room > 0:
                    os.posix_fallocate(file.fileno(), 0, room)

        return fill

    def expect(self, good: bool, words: str) -> None:
        """Note what went wrong."""
        if not good:
            self.found.append(words)


def _limited(most: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY)
    )


@contextlib.contextmanager
def bench(verbs: tuple[str, ...]) -> Iterator[Bench]:
    """A bench on a small file system of this process alone, or in a plain folder where
    none can be made.
    """
    with tempfile.TemporaryDirectory() as root, tempfile.TemporaryDirectory() as aside:
        fills = mounts.own() and mounts.memory(Path(root), DISK)
        folder = Path(root) / "main"
        folder.mkdir()
        try:
            yield Bench(folder, Path(aside), verbs, fills)
        finally:
            if fills:
                mounts.gone(Path(root))
