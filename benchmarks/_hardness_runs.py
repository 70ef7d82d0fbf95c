"""Commands that are killed, run twice at once, or given too little room; what they leave behind is judged.

Two sets of settings of different size take turns, so that a result made of both would show.
"""

import hashlib
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SEED = 5
TOLD = ("manifest.json", "layout.json", "report.html", "measure.html", "out.html")  # hold times, commands, own names
CELL = "[cell]\npitch_um = {}\npillar = {{n = 3.6}}\n[sweep]\nwavelengths_um = [0.85]\nsamples = 40\ntolerance = 0.05\n"
DESIGN = "aperture_mm = {}\nlibrary = 'library.h5'\n"
FRAME = "frames = 1\npixels = {}\npitch_um = 60.0\n"
TRUTH = "depths_um = [18000.0, 20000.0]\nseed = {}\ndark_frames = 2\nflat_frames = 2\n[camera]\npixels = 32\n"
VERBS = {
    "design": ("design design{}.toml -o out.h5 --skip-focus-check", "out.h5"),
    "psf": ("psf lens{}.h5 --config psf.toml -o out.h5", "out.h5"),
    "layout": ("layout lens{}.h5 -o out", "out"),
    "scene": ("scene scene{}.toml -o out", "out"),
    "library": ("library cell{}.toml -o out.h5 --accept-partial-turn", "out.h5"),
    "capture": ("capture lens0.h5 --truth truth{}.toml -o out", "out"),
    "measure": ("measure shots{} -o out", "out"),
    "check": ("check mask{}/mask.gds -o out.lyrdb", "out.lyrdb"),
    "view": ("view lens{}.h5 -o out.html", "out.html"),
}  # verb: words for each of two settings, and the output
State = dict[str, str]


@dataclass(eq=False)
class Bench:
    """A folder of inputs, and what the two settings of every verb make: {name: SHA-256}, and how long it takes.

    failures: in words.
    """

    folder: Path
    verbs: tuple[str, ...] = tuple(sorted(VERBS))
    known: dict[str, list[State]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def begin(self, words: str, **more: Any) -> "subprocess.Popen[bytes]":
        """Start a command."""
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return subprocess.Popen([sys.executable, "-m", "metalens", *words.split()], cwd=self.folder, **(quiet | more))

    def run(self, words: str, **more: Any) -> tuple[int, str]:
        """Exit status and errors of a command."""
        child = self.begin(words, **more)
        told = child.communicate()[1].decode("utf-8", "replace")
        return child.returncode, told

    def prepare(self) -> None:
        """Inputs, and the two whole results of every verb."""
        texts = {"psf.toml": "depths_mm = [16.0, 18.0, 1.0]\nangles_deg = [0.0]\nsamples = 32\n"}
        for i, (pitch, aperture, pixels) in enumerate(((0.3, 0.02, 24), (0.32, 0.03, 32))):
            texts |= {f"cell{i}.toml": CELL.format(pitch), f"design{i}.toml": DESIGN.format(aperture)}
            texts |= {f"scene{i}.toml": FRAME.format(pixels), f"truth{i}.toml": TRUTH.format(i)}
        for name, text in texts.items():
            (self.folder / name).write_text(text)
        made = ["library cell0.toml -o library.h5 --accept-partial-turn"]
        made += [f"design design{i}.toml -o lens{i}.h5 --accept-partial-turn" for i in (0, 1)]
        made += [f"capture lens0.h5 --truth truth{i}.toml -o shots{i}" for i in (0, 1) if "measure" in self.verbs]
        made += [f"layout lens{i}.h5 -o mask{i}" for i in (0, 1) if "check" in self.verbs]
        for words in made:
            self._must(words)
        for verb in self.verbs:
            words, output = VERBS[verb]
            self.known[verb] = []
            for i in (0, 1):
                self.clear(output)
                start = time.perf_counter()
                self._must(words.format(i))
                self.seconds[verb] = time.perf_counter() - start
                self.known[verb].append(self.state(output))
            self.clear(output)

    def _must(self, words: str) -> None:
        status, told = self.run(words)
        if status not in (0, 1):
            raise RuntimeError(f"{words}: {told}")

    def state(self, output: str) -> State:
        """{name: SHA-256} of an output and what lies beside it; times and commands are no part of it."""
        stem = Path(output).stem
        found = {}
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder).as_posix()
            if path.is_file() and name.startswith(stem):
                told = path.name in TOLD
                found[name] = "" if told else hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    def clear(self, output: str) -> None:
        """Remove an output and its companions."""
        for path in self.folder.glob(Path(output).stem + "*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def scratch(self) -> list[str]:
        """Names that no run may leave."""
        return [p.name for p in self.folder.iterdir() if p.name.startswith(".") or p.name.endswith(".unfinished")]

    def whole(self, verb: str, state: State) -> bool:
        """Whether a state is one result: all of it, or a file whose companions are not there yet."""
        output = VERBS[verb][1]
        named = any(name == output or name.startswith(output + "/") for name in state)
        a_file = Path(output).suffix != ""
        return named and any(
            state.items() <= one.items() and (a_file or state.keys() == one.keys()) for one in self.known[verb]
        )

    def kill(self, count: int) -> int:
        """End commands over a good result at random moments by random signals; nothing mixed, lost or left."""
        chance, before = random.Random(SEED), len(self.failures)
        for turn in range(count):
            verb = self.verbs[turn % len(self.verbs)]
            words, output = VERBS[verb]
            self.clear(output)
            self._must(words.format(0))
            child = self.begin(words.format(1) + " --force")
            time.sleep(self.seconds[verb] * chance.uniform(0.3, 1.1))
            number = chance.choice([signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
            child.send_signal(number)
            child.communicate()
            self._judge(self.whole(verb, self.state(output)), f"{verb} after {number.name}: mixed or lost")
            status, told = self.run(words.format(1) + " --force")
            good = status in (0, 1) and self.state(output) == self.known[verb][1]
            self._judge(good, f"{verb} again after {number.name}: {told[-200:]}")
            self._judge(not self.scratch(), f"{verb} after {number.name}: left {self.scratch()}")
            self.clear(output)
        return len(self.failures) - before

    def pair(self, count: int) -> int:
        """Two commands write one output at once: one result whole, the other refused or later."""
        before = len(self.failures)
        for turn in range(count):
            verb = self.verbs[turn % len(self.verbs)]
            words, output = VERBS[verb]
            self.clear(output)
            pair = [self.begin(words.format(i)) for i in (0, 1)]
            ends = sorted((child.communicate(), child.returncode)[1] for child in pair)
            good = ends[0] <= 1 and ends[1] <= 2 and self.state(output) in self.known[verb] and not self.scratch()
            self._judge(good, f"two of {verb}: ends {ends}, left {self.scratch()}")
            self.clear(output)
        return len(self.failures) - before

    def fill(self, count: int) -> int:
        """No file may grow beyond a random size, as on a full disk: no right to mount one is needed."""
        chance, before = random.Random(SEED), len(self.failures)
        for turn in range(count):
            verb = self.verbs[turn % len(self.verbs)]
            words, output = VERBS[verb]
            self.clear(output)
            most = int(10 ** chance.uniform(2, 5))
            limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))  # noqa: B023, E731
            status, told = self.run(words.format(0), preexec_fn=limit)
            state = self.state(output)
            good = status in (0, 1, 2) and "Traceback" not in told and not self.scratch()
            self._judge(good, f"{verb}, {most} bytes: ends with {status}, {told[-200:]}, left {self.scratch()}")
            self._judge(not state or state == self.known[verb][0], f"{verb}, {most} bytes: part of a result")
            for path in self.folder.glob("*.resume"):
                path.unlink()
            self.clear(output)
        return len(self.failures) - before

    def _judge(self, good: bool, words: str) -> None:
        if not good:
            self.failures.append(words)
