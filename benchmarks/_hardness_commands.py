"""The commands that the hardness benchmark kills, and how they are begun: as forks of a
process that has loaded all.

A fork costs its work alone, not the seconds of loading, and an audit hook inside it
tells its file operations apart: so
a death can be put at any one of them, where a clock would mostly find the computing in
between.
"""

import contextlib
import importlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import _hardness_samples as samples
from characterize.inference import asbuilt
from metalens import cli, lens
from metalens.ground import reading
from metalens.made import sensitivity

CELL = "[cell]\npitch_um = {}\npillar = {{n = 3.6}}\n[sweep]\nwavelengths_um = [0.85]\nsamples = 40\ntolerance = 0.05\n"
DESIGN = "aperture_mm = {}\nlibrary = 'library.h5'\n"
FRAME = "frames = 1\npixels = {}\npitch_um = 60.0\n"
CAMERA = "dark_frames = 8\nflat_frames = 8\npeak_e = 6000.0\n[camera]\npixel_um = 16.0\npixels = 24\n"
STUDY = (
    "pitches_um = [{}]\nheights_um = [0.7]\nwavelengths_um = [0.85]\ntolerance = 0.05\n"
)
OPTICS = (
    "[axial]\ncount = 3\nangles_deg = [0.0]\nbinnings = [1]\nwindow_um = 48.0\n[scenes]\ncount = 1\npixels = 32\n"
    "window_um = 48.0\npitch_um = 12.0\n"
)
PLAN = "aperture_mm = 0.0{}\nstacks = 4\nframes = 5\n[task]\nscenes = 1\npixels = 16\nmargin = 4\n"
CHAIN = "cell = 'cell{0}.toml'\ndesign = 'design{0}.toml'\npsf = 'psf.toml'\nprocess = 'process.toml'\nbudget = false\n"
RUN = """preset = "smoke"
checkpoint_every = 1
validation_batches = 1
test_batches = 1
[scenes]
pixels = 48
margin = 4
[inner]
steps = {}
batch = 2
[search]
population = 2
tournament = 1
rounds = 2
[optics]
aperture_mm = 0.12
sensor_distance_mm = 0.3
focus_mm = 3.0
depths_mm = [2.0, 6.0]
depth_count = 3
sample_um = 3.0
window_samples = 11
polynomials = 0
[space]
widths = [0.25]
depths = [2]
[run]
budgets_mmacs = [2.0]
pitch_um = 3.0
"""
FRAMES = " --subjects 1 --grid 4 4"  # of the virtual experiment
TRAINED = "retrain run0 --asbuilt asbuilt.h5 -o out --insist --draws 2 --judge 1 --test-batches 1"
VERBS = {
    "design": ("design design{}.toml -o out.h5 --skip-focus-check", "out.h5"),
    "psf": ("psf lens{}.h5 --config psf.toml -o out.h5", "out.h5"),
    "export": ("export lens{}.h5 -o out.mat", "out.mat"),
    "layout": ("layout lens{}.h5 -o out", "out"),
    "scene": ("scene scene{}.toml -o out", "out"),
    "library": ("library cell{}.toml -o out.h5 --accept-partial-turn", "out.h5"),
    "field": (
        "field cell{}.toml --diameter-um 0.15 -o out.h5 --samples 24 --tolerance 0.3",
        "out.h5",
    ),
    "study": ("study study{}.toml -o out", "out"),
    "capture": ("capture lens0.h5 --truth truth{}.toml -o out", "out"),
    "measure": ("measure shots{} -o out", "out"),
    "fit": (
        "fit shots{} --design lens0.h5 --metrology known.toml -o out.h5 --insist",
        "out.h5",
    ),
    "check": ("check mask0/mask.gds --process rules{}.toml -o out.lyrdb", "out.lyrdb"),
    "view": ("view lens{}.h5 -o out.html", "out.html"),
    "evaluate": ("evaluate optics lens{}.h5 --config optics.toml -o out", "out"),
    "budget": ("budget wide{}.h5 -o out.h5 --depths 3" + FRAMES, "out.h5"),
    "plan": ("plan --gaze-error 5deg --config plan{}.toml -o out" + FRAMES, "out"),
    "codesign": ("codesign run{}.toml -o out", "out"),
    "retrain": (TRAINED + " --steps 1{}", "out"),
    "demo": ("demo out --config chain{}.toml", "out"),
}  # verb: words for each of two settings, and the output
RESUMABLE = ("codesign", "retrain", "demo")
_EVENTS = ("open", "os.", "shutil.", "tempfile.", "fcntl.flock")
_UNTYPED = 70


@dataclass(frozen=True, slots=True)
class Ended:
    """What came of a command: exit status (negative: a signal), errors in words,
    seconds, file operations.

    times: seconds of the processor at every operation, and at the end.
    """

    status: int
    told: str
    seconds: float
    operations: int
    times: tuple[float, ...] = ()


@dataclass(eq=False, slots=True)
class Child:
    """A command that runs."""

    process: int
    told: Path
    start: float

    def wait(self) -> Ended:
        """Its end."""
        status = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        seconds, report = (
            time.perf_counter() - self.start,
            self.told.with_suffix(".json"),
        )
        nothing: dict[str, Any] = {"operations": 0, "modules": [], "times": []}
        made = json.loads(report.read_text()) if report.is_file() else nothing
        load(made["modules"])
        words = self.told.read_text("utf-8", "replace")
        for path in (self.told, report):
            path.unlink(missing_ok=True)
        return Ended(status, words, seconds, made["operations"], tuple(made["times"]))


@dataclass(frozen=True, slots=True)
class Operation:
    """A file operation that is about to be done: its number from 1, the audit event and
    what it is called with.
    """

    number: int
    event: str
    arguments: tuple[Any, ...]

    @property
    def writes(self) -> bool:
        """Whether a disk without room, or one that fails, may refuse it."""
        if self.event == "open":
            return bool(self.arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        return self.event in ("os.mkdir", "os.rename", "fsync")


Each = Callable[[Operation], object]


def at(number: int, act: Callable[[], object]) -> Each:
    """Something that is done at one file operation."""
    return lambda operation: act() if operation.number == number else None


@dataclass(eq=False, slots=True)
class Hook:
    """Counts the file operations of this process in a folder, and calls ``each`` at
    every one.

    told: where the command's errors go.
    """

    folder: str
    each: Each
    told: Path
    process: int = field(default_factory=os.getpid)
    seen: int = 0
    busy: bool = False
    times: list[float] = field(default_factory=list)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.busy or not event.startswith(_EVENTS) or os.getpid() != self.process:
            return
        path = arguments[0] if arguments else ""
        named = os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else ""
        if os.path.isabs(named) and not named.startswith(self.folder):
            return
        self.reached(event, arguments)

    def reached(self, event: str, arguments: tuple[Any, ...] = ()) -> None:
        """Before one operation more."""
        self.seen += 1
        self.times.append(time.process_time())
        self.busy = True
        try:
            self.each(Operation(self.seen, event, arguments))
        finally:
            self.busy = False


def begin(folder: Path, aside: Path, words: str, each: Each = bool) -> Child:
    """Start a command in ``folder``; before every file operation it calls ``each``.

    aside: a folder for what it says.
    """
    told = aside / f"{time.monotonic_ns()}.txt"
    told.touch()
    sys.stdout.flush()
    sys.stderr.flush()
    start = time.perf_counter()
    process = os.fork()
    if process == 0:
        _child(folder, told, words, each)
    return Child(process, told, start)


def _child(folder: Path, told: Path, words: str, each: Each) -> None:
    """Run the command in this forked process and end it."""
    status, begun = _UNTYPED, time.process_time()
    hook = Hook(str(folder), each, told)
    _heard()
    try:
        os.chdir(folder)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(told, os.O_WRONLY | os.O_APPEND), 2)
        sys.argv = ["metalens", *words.split()]
        getattr(each, "meet", bool)(hook)
        _count_writes(hook)
        sys.addaudithook(hook)
        try:
            status = cli.main(words.split())
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else _UNTYPED
        hook.busy = True
        took = [*(t - begun for t in hook.times), time.process_time() - begun]
        made = {
            "operations": hook.seen,
            "modules": sorted(sys.modules) if each is bool else [],
            "times": took,
        }
        hook.told.with_suffix(".part").write_text(json.dumps(made))
        hook.told.with_suffix(".part").replace(hook.told.with_suffix(".json"))
    except BaseException:  # noqa: BLE001 (what is judged)
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _heard() -> None:
    """Signals are answered as in a terminal, also where a shell that began the
    benchmark aside let them be ignored.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _count_writes(hook: Hook) -> None:
    """Two operations that are no audit events: flushing, and a write of the HDF5
    library.
    """
    flush, write = os.fsync, reading.Through.write

    def flushed(handle: Any) -> None:
        if os.getpid() == hook.process and not hook.busy:
            hook.reached("fsync")
        flush(handle)

    def written(file: reading.Through, content: Any) -> int:
        if os.getpid() == hook.process and not hook.busy:
            hook.reached("write")
        return write(file, content)

    os.fsync = flushed
    reading.Through.write = written  # type: ignore[method-assign]


def load(names: list[str]) -> None:
    """Load what a command loaded, so that the next one finds it."""
    for name in names:
        if name not in sys.modules and not name.startswith("__mp"):
            with contextlib.suppress(Exception):
                importlib.import_module(name)


def settings(folder: Path) -> dict[str, str]:
    """Write the settings files; their text by name."""
    texts = {
        "psf.toml": "depths_mm = [16.0, 18.0, 1.0]\nangles_deg = [0.0]\nsamples = 32\n",
        "optics.toml": OPTICS,
    }
    texts |= {
        "process.toml": "",
        "known.toml": '[[known]]\nname = "height_nm"\nvalue = 0.0\nsigma = 2.0\n',
    }
    for i, (pitch, aperture, pixels) in enumerate(((0.3, 0.02, 24), (0.32, 0.03, 32))):
        texts |= {
            f"cell{i}.toml": CELL.format(pitch),
            f"design{i}.toml": DESIGN.format(aperture),
        }
        texts[f"wide{i}.toml"] = DESIGN.format(0.06 + 0.01 * i)
        texts |= {
            f"scene{i}.toml": FRAME.format(pixels),
            f"study{i}.toml": STUDY.format(pitch),
        }
        texts |= {
            f"truth{i}.toml": f"depths_um = [16000.0, 20000.0, 30000.0]\nseed = {i}\n{CAMERA}"
        }
        texts |= {
            f"plan{i}.toml": PLAN.format(5 + i),
            f"run{i}.toml": RUN.format(3 + i),
        }
        texts |= {
            f"chain{i}.toml": CHAIN.format(i),
            f"rules{i}.toml": f"[rules]\nminimum_gap_nm = {200 + i}\n",
        }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return texts


def inputs(verbs: tuple[str, ...]) -> Iterator[str]:
    """Words of the commands that make the other inputs of some verbs."""
    yield "library cell0.toml -o library.h5 --accept-partial-turn"
    yield from (
        f"design design{i}.toml -o lens{i}.h5 --accept-partial-turn" for i in (0, 1)
    )
    if {"measure", "fit"} & set(verbs):
        yield from (
            f"capture lens0.h5 --truth truth{i}.toml -o shots{i}" for i in (0, 1)
        )
    if "budget" in verbs:
        yield from (
            f"design wide{i}.toml -o wide{i}.h5 --accept-partial-turn" for i in (0, 1)
        )
    if "check" in verbs:
        yield "layout lens0.h5 -o mask0"
    if "retrain" in verbs:
        yield "codesign run0.toml -o run0"


def found(folder: Path, verbs: tuple[str, ...]) -> None:
    """Write what a fit of minutes would find of the run's lens, where a verb needs
    that.
    """
    if "retrain" in verbs and not (folder / "asbuilt.h5").exists():
        design = lens.load(folder / "run0" / "lens.h5")
        asbuilt.save(
            folder / "asbuilt.h5", samples.asbuilt_of(design, sensitivity(design))
        )


def signalled(number: int) -> Callable[[], None]:
    """A death of this process by a signal."""
    return lambda: os.kill(os.getpid(), signal.Signals(number))
