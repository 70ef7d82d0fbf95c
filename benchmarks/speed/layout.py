"""Mask files and their check: a 1 mm lens of 4.9 million free-form pillars in 101
diameters, and far larger ones.

Errors: pillars or sites that differ from the plan when the file is read back, or the
worst area error of a class.
"""

import contextlib
import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import layout
from benchmarks import Row, fastest
from layout.drc.lattice import check_plan
from layout.formats import compare, gdsii_write, oasis_write
from layout.mask.plan import MaskPlan, PillarArray, pillar_classes
from layout.process.process import DesignRules
from metalens.core import store
from metalens.core.arrays import Array

if TYPE_CHECKING:
    from metalens.lens import Lens

PITCH = 400
SIZES = np.arange(100, 302, 2)
RULES = DesignRules(minimum_gap_nm=70, minimum_feature_nm=80)
NAN = float("nan")


@functools.cache
def sites(*, freeform: bool) -> Array:
    """(2501, 2501) classes 1..101 of a focusing lens, with or without a strong
    free-form phase added; 0 outside.
    """
    x = (np.arange(2501) - 1250) * 0.4
    r2 = x**2 + x[:, None] ** 2
    phase = -2 * np.pi / 0.94 * (np.sqrt(r2 + 2000.0**2) - 2000)
    if freeform:
        u, v = x / 500, x[:, None] / 500
        rng = np.random.default_rng(0)
        phase = phase + 40 * (u**3 + v**3)
        for _ in range(12):
            a, fx, fy, shift = (
                3 * rng.normal(),
                *12 * rng.normal(size=2),
                rng.uniform(0, 6.28),
            )
            phase += a * np.sin(fx * u + fy * v + shift)
    turn = np.remainder(phase, 2 * np.pi) / (2 * np.pi)
    classes = np.round(100 * turn**0.8).astype(np.uint8) + np.uint8(1)
    return np.where(r2 <= 499.85**2, classes, np.uint8(0))


@functools.cache
def plan(*, freeform: bool = True) -> MaskPlan:
    """The mask of the lens alone."""
    return lens_of(
        PillarArray.of(
            "LENS",
            sites(freeform=freeform),
            pitch=PITCH,
            x0=-1250 * PITCH,
            y0=1250 * PITCH,
        )
    )


def lens_of(lattice: PillarArray) -> MaskPlan:
    """A mask of one lattice of the bench's sizes."""
    classes = pillar_classes(SIZES, layer=(1, 0), grid=1, unit_nm=1.0, vertices=32)
    return MaskPlan("TOP", classes, (lattice,), layer_names={(1, 0): "pillar"})


def large(diameter_mm: float) -> MaskPlan:
    """A lens too large for memory: its classes are computed row block by row block."""
    count = int(diameter_mm * 1e6 / PITCH)
    x = (np.arange(count, dtype=np.float32) - (count - 1) / 2) * (PITCH * 1e-3)
    focus, reach = 2000 * diameter_mm, (diameter_mm * 500) ** 2

    def rows(first: int, end: int) -> Array:
        out = np.zeros((end - first, count), np.uint8)
        for row in range(first, end):
            r2 = x**2 + x[row] ** 2
            phase = (np.sqrt(r2 + focus**2) - focus) / 0.94
            out[row - first] = np.where(
                r2 <= reach, 1 + (101 * (1 - phase % 1)).astype(np.uint8) % 101, 0
            )
        return out

    half = (count - 1) * PITCH // 2
    return lens_of(PillarArray("LENS", count, count, PITCH, -half, half, rows))


@contextlib.contextmanager
def peak_mb() -> Iterator[list[float]]:
    """Growth of the resident memory above what it is now, as the kernel keeps it."""
    grown = [NAN]
    status = Path("/proc/self/status")
    reset = Path("/proc/self/clear_refs")
    with contextlib.suppress(OSError):
        reset.write_text("5")
    before = _resident(status, "VmRSS")
    yield grown
    grown[0] = _resident(status, "VmHWM") - before


def _resident(status: Path, key: str) -> float:
    if not status.exists():
        return NAN
    return next(
        float(line.split()[1]) / 1024
        for line in status.read_text().splitlines()
        if line.startswith(key)
    )


def measured(work: Callable[[], object], *, repeats: int = 3) -> tuple[float, float]:
    """(seconds, MB above the inputs)."""
    seconds = fastest(work, repeats=repeats)
    with peak_mb() as grown:
        work()
    return seconds, grown[0]


def rows() -> Iterator[Row]:
    """All rows, one by one."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder)
        for some in (
            _file_rows,
            _streaming_rows,
            _certificate_rows,
            _foreign_check_rows,
            _command_rows,
        ):
            yield from some(target)
        yield from _check_rows()
        yield from _large_command_rows(target)


def _file_rows(target: Path) -> list[Row]:
    free, symmetric = plan(), plan(freeform=False)
    cases = [
        ("free-form", "GDSII", free, "m.gds", "write <= 1.3x a raw write"),
        ("free-form", "OASIS", free, "s.oas", "<= 3.0 MB (2.0), <= 1 s"),
        ("symmetric", "OASIS", symmetric, "y.oas", "<= 0.36 MB, <= 0.15 s"),
    ]
    made = []
    for case, method, mask, name, goal in cases:
        path = target / name
        write = layout.write_gdsii if path.suffix == ".gds" else layout.write_oasis
        read = layout.read_gdsii if path.suffix == ".gds" else layout.read_oasis
        seconds, peak = measured(lambda w=write, m=mask, p=path: w(m, p))
        size = path.stat().st_size
        start = time.perf_counter()
        outcome = compare.compare(mask, read(path))
        back = time.perf_counter() - start
        threads = 1 if path.suffix == ".gds" else 2
        wrong = float(
            len(outcome.differences)
            + outcome.pillars
            - np.count_nonzero(mask.lattices[0].whole())
        )
        text = f"{size / 1e6:.3f} MB; differences after reading back"
        made.append(
            Row(case, f"write {method}", seconds, wrong, text, threads, peak, goal)
        )
        made.append(
            Row(case, f"read back and compare {method}", back, wrong, text, 1, NAN, "")
        )
    return [*made, _raw_row(target)]


def _raw_row(target: Path) -> Row:
    """The same bytes as the GDSII file, written from memory in the same blocks, made
    durable in the same way.
    """
    size = (target / "m.gds").stat().st_size
    block = memoryview(bytes(gdsii_write._BLOCK))

    def raw() -> None:
        with (
            store.replace_atomically(target / "raw") as part,
            open(part, "wb", buffering=0) as file,
        ):
            for _ in range(size // len(block)):
                file.write(block)
            file.write(block[: size % len(block)])

    return Row(
        "free-form",
        "raw write of the GDSII bytes",
        fastest(raw),
        0.0,
        f"{size / 1e6:.1f} MB of zeros",
    )


def _check_rows() -> list[Row]:
    mask = plan()
    seconds, peak = measured(lambda: check_plan(mask, RULES))
    found = check_plan(mask, RULES)
    goal = "<= 0.25 s, <= 100 MB"
    text = "gap less that of the widest neighbours / nm"
    return [
        Row(
            "free-form",
            "design-rule check",
            seconds,
            found.minimum_space_nm - 100,
            text,
            1,
            peak,
            goal,
        )
    ]


def _streaming_rows(target: Path) -> list[Row]:
    made = []
    for diameter_mm, goal in ((4.0, "<= 8 s, <= 64 MB"), (10.0, "<= 60 s, <= 64 MB")):
        mask = large(diameter_mm)
        for method, write, name in (
            ("OASIS", lambda p, m=mask: oasis_write.write_oasis(m, p), "l.oas"),
        ):
            with peak_mb() as grown:
                start = time.perf_counter()
                write(target / name)
                seconds = time.perf_counter() - start
            size = (target / name).stat().st_size / 1e6
            text = f"{size:.1f} MB; the error of the 1 mm lens holds"
            made.append(
                Row(
                    f"{diameter_mm:g} mm",
                    f"stream {method}",
                    seconds,
                    NAN,
                    text,
                    2,
                    grown[0],
                    goal,
                )
            )
            os.unlink(target / name)
    return made


def _command_rows(target: Path) -> list[Row]:
    """The whole command on a lens file."""
    from benchmarks.speed.process import lens
    from layout.commands import layout as command
    from metalens import lens as lenses

    lenses.save(target / "lens.h5", lens())
    options = command.Options(
        lens=target / "lens.h5", output=target / "mask", quiet=True, force=True
    )
    seconds, peak = measured(lambda: command.run(options), repeats=1)
    error = float(command.run(options))
    goal = "<= 15 s, <= 1.5 GB"
    return [
        Row(
            "1 mm lens",
            "metalens layout, all of it",
            seconds,
            error,
            "exit status",
            2,
            peak,
            goal,
        )
    ]


def _certificate_rows(target: Path) -> list[Row]:
    """8.7 million pillars with corrected doses, written, read back and exposed again."""
    from layout.formats import job_files
    from layout.process.process import ExposureSettings, Process
    from layout.verify.exposure import verify_exposure

    process = Process(exposure=ExposureSettings(alpha_um=0.012, beta_um=30.0, eta=0.7))
    bare = layout.plan(_lens(1.0, 0.3).diameters, process, furnished=False)
    plan = layout.correct(bare, process.exposure)
    layout.write_gdsii(plan, target / "c.gds")
    job_files.write_dose_table(plan, process, target / "c.csv")
    content = layout.read_gdsii(target / "c.gds")
    table = job_files.read_dose_table(target / "c.csv")
    found = verify_exposure(content, plan, table, process)
    seconds, peak = measured(
        lambda: verify_exposure(content, plan, table, process), repeats=1
    )
    text = f"worst exposure of {found.pillars:,} pillars less 1; worst diameter {found.worst_nm:.2f} nm"
    return [
        Row(
            "1 mm lens",
            "certificate",
            seconds,
            found.worst_exposure,
            text,
            1,
            peak,
            "<= 10 s, 1 %, 1 nm",
        )
    ]


def _lens(diameter_mm: float, pitch_um: float, *, cubic_rad: float = 3.0) -> "Lens":
    """A focusing lens with a cubic phase, diameters in float32; without that it has the
    symmetry of the square.
    """
    from metalens.cell import Cell
    from metalens.lens import DiameterMap, Lens
    from metalens.library import Proxy

    count = round(diameter_mm * 1e3 / pitch_um)
    reach = 500 * diameter_mm
    x = ((np.arange(count) - (count - 1) / 2) * pitch_um).astype(np.float32)
    d = np.zeros((count, count), np.float32)
    focus = 2000 * diameter_mm
    widest = 0.7 * pitch_um
    for row in range(count):
        r2 = x**2 + x[row] ** 2
        phase = (np.sqrt(r2 + focus**2) - focus) / 0.94 + cubic_rad * (x / reach) ** 3
        d[row] = np.where(r2 < reach**2, 0.09 + (widest - 0.09) * (1 - phase % 1), 0)
    proxy = Proxy(
        np.array([[3.0, 3.0]]),
        np.array([[0.95]]),
        (0.08, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    return Lens(
        DiameterMap(d, pitch_um),
        Cell(pitch_um),
        proxy,
        0.94,
        focus,
        float("inf"),
        "map",
    )


_PEAK = """
import sys, time
from metalens import cli

def peak_mb():  # of this program alone: getrusage counts what the one that started it held
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) / 1024
"""
_COMMAND = (
    _PEAK
    + """
start = time.perf_counter()
code = cli.main(["layout", *sys.argv[1:], "--oasis", "--quiet", "--force"])
print(code, time.perf_counter() - start, peak_mb())
"""
)


_CHECK = (
    _PEAK
    + """
start = time.process_time()
code = cli.main(["check", sys.argv[1], "--json", "--quiet"])
print(code, time.process_time() - start, peak_mb())
"""
)


def _foreign_check_rows(target: Path) -> list[Row]:
    """``metalens check`` of 8.7 million pillars from OASIS, in a process of its own:
    CPU time, peak of all memory.

    A file of the pillars alone, and the whole die that ``metalens layout`` writes of a
    round lens.
    """
    from layout.process.process import Process
    from metalens import lens as lenses

    for diameter_mm in (0.02, 1.0):  # the first compiles what the second runs
        plan = layout.plan(
            _lens(diameter_mm, 0.3).diameters, Process(), furnished=False
        )
        layout.write_oasis(plan, target / "check.oas")
        code, seconds, peak = _ran(_CHECK, str(target / "check.oas"))
    text = f"exit status of {int(plan.counts()[1:].sum()):,} pillars; CPU s, all memory"
    whole = Row(
        "1 mm lens",
        "metalens check, OASIS",
        seconds,
        code,
        text,
        1,
        peak,
        "<= 10 s, <= 1000 MB",
    )
    lenses.save(target / "round.h5", _lens(1.0, 0.3, cubic_rad=0.0))
    _ran(_COMMAND, str(target / "round.h5"), "-o", str(target / "round"))
    code, seconds, peak = _ran(_CHECK, str(target / "round" / "mask.oas"))
    text = "exit status; CPU s, all memory"
    whole_die = Row(
        "1 mm lens",
        "metalens check, OASIS of a whole die",
        seconds,
        code,
        text,
        1,
        peak,
        "<= 10 s, <= 1000 MB",
    )
    return [whole, whole_die]


def _ran(code: str, *words: str) -> tuple[float, float, float]:
    """What a program tells at its end: exit status, seconds, peak of its memory in MB."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
    )
    status, seconds, peak = map(float, done.stdout.split()[-3:])
    return status, seconds, peak


def _large_command_rows(target: Path) -> Iterator[Row]:
    """The whole command in a process of its own, with the peak of all its memory."""
    from metalens import lens as lenses

    process = target / "process.toml"
    process.write_text(
        "[exposure]\nalpha_um = 0.010\nbeta_um = 31.0\neta = 0.6\n", encoding="utf-8"
    )
    ways = (("", []), (", doses corrected and certified", ["--process", str(process)]))
    goals = (
        (0.02, ""),
        (1.0, "<= 8 s"),
        (2.0, ""),
        (4.0, "<= 60 s"),
        (10.0, "<= 300 s, <= 1000 MB"),
    )
    for diameter_mm, goal in goals:
        lenses.save(target / "large.h5", _lens(diameter_mm, 0.4))
        for said, more in ways if diameter_mm not in (2.0, 4.0) else ways[:1]:
            code, seconds, peak = _ran(
                _COMMAND, str(target / "large.h5"), "-o", str(target / "large"), *more
            )
            method = f"metalens layout, OASIS{said}"
            if diameter_mm > 0.02:  # the smallest compiles what the others run
                yield Row(
                    f"{diameter_mm:g} mm lens",
                    method,
                    seconds,
                    code,
                    "exit status; all memory",
                    2,
                    peak,
                    goal,
                )


def peer_rows() -> list[Row]:
    """gdstk and KLayout on the same pillars."""
    from benchmarks.peers import _layout_peers

    with tempfile.TemporaryDirectory() as folder:
        return _layout_peers.measured(Path(folder))
