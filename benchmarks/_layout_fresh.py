"""Build and write of the bench's pillars, each in a process of its own: what a command
pays, beside other projects.

Loading the compiled loops and planning the mask count; computing which pillar stands
where does not.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import layout
from benchmarks import Row, fastest
from benchmarks import _layout_peers as peers
from benchmarks.layout import NAN, plan, sites

_WRITERS: dict[str, Callable[[Path], object]] = {
    "GDSII": lambda path: layout.write_gdsii(plan(), path),
    "OASIS fast": lambda path: layout.write_oasis(plan(), path, form="fast"),
    "OASIS small": lambda path: layout.write_oasis(plan(), path, form="small"),
    "gdstk GDSII": lambda path: peers.gdstk_library(plan()).write_gds(path),
    "gdstk OASIS level 6": lambda path: peers.gdstk_library(plan()).write_oas(
        path, compression_level=6
    ),
    "klayout GDSII": lambda path: peers.klayout_layout(plan()).write(str(path)),
    "klayout OASIS": lambda path: peers.klayout_layout(plan()).write(str(path)),
}


def rows(target: Path) -> list[Row]:
    """A row for each format of each project that is installed; ours say how many times
    less they take.
    """
    seconds = {name: _child(name, target) for name in _WRITERS if _installed(name)}
    made = []
    for name, (took, size) in seconds.items():
        kind = "GDSII" if "GDSII" in name else "OASIS"
        others = [
            other
            for other in seconds
            if other.split()[0] in ("gdstk", "klayout") and kind in other
        ]
        ratios = [
            f"{seconds[other][0] / took:.1f}x {other.split()[0]}"
            for other in others
            if name not in others
        ]
        goal = f"{', '.join(ratios)} (10x gdstk)" if ratios else ""
        text = f"{size:.2f} MB, no comparison"
        made.append(
            Row("fresh process", f"build + write {name}", took, NAN, text, 2, goal=goal)
        )
    return [
        *made,
        *_floor_rows(target, {name: took for name, (took, _) in seconds.items()}),
    ]


_FLOOR = """
import sys, time
start = time.perf_counter()
import layout
from layout.gdsii.write import write
told = [time.perf_counter() - start]
from pathlib import Path
import numpy as np
from benchmarks.layout import PITCH, lens_of
from layout.mask.plan import Lattice
from metalens.ground import store
start = time.perf_counter()
classes = np.load(sys.argv[1])
told.append(time.perf_counter() - start)
small = lens_of(Lattice.of("LENS", classes[1200:1202, 1200:1203].copy(), pitch=PITCH, x0=0, y0=0))
start = time.perf_counter()
write(small, Path(sys.argv[2]))
told.append(time.perf_counter() - start)
block = memoryview(bytes(1 << 24))
start = time.perf_counter()
with store.replacing(Path(sys.argv[2])) as part, open(part, "wb", buffering=0) as file:
    left = int(sys.argv[3])
    while left:
        left -= file.write(block[:left])
told.append(time.perf_counter() - start)
print(*told)
"""
_FLOORS = (
    "imports of the writer",
    "classes of the sites from a file",
    "loading the compiled loops, six pillars",
    "raw bytes of the GDSII, durable",
)


def _floor_rows(target: Path, seconds: dict[str, float]) -> list[Row]:
    """What a process pays that writes as many bytes and computes nothing: each part by
    itself, in a process of its own.

    The rows above hold the last two parts alone; a command pays all of them.
    """
    np.save(target / "classes.npy", sites(freeform=True))
    size = (target / "fresh.gds").stat().st_size
    words = [
        sys.executable,
        "-c",
        _FLOOR,
        str(target / "classes.npy"),
        str(target / "floor.gds"),
        str(size),
    ]
    done = [
        subprocess.run(words, capture_output=True, text=True, check=True, cwd=_ROOT)
        for _ in range(3)
    ]
    least = (
        np.array([[float(v) for v in each.stdout.split()] for each in done])
        .min(0)
        .tolist()
    )
    start = fastest(lambda: subprocess.run([sys.executable, "-c", "pass"], check=True))
    parts = {"start of the interpreter": start} | dict(zip(_FLOORS, least, strict=True))
    made = [
        Row("fresh process", f"floor: {part}", took, NAN, "nothing computed")
        for part, took in parts.items()
    ]
    goal = (
        f"GDSII takes {seconds['GDSII'] / sum(least[2:]):.1f}x the loops and the bytes"
    )
    if "gdstk GDSII" in seconds:
        goal += f"; gdstk {seconds['gdstk GDSII'] / sum(least[2:]):.1f}x, which no program of ours can exceed"
    return [
        *made,
        Row(
            "fresh process",
            "floor: all of these",
            sum(parts.values()),
            NAN,
            f"{size} bytes",
            goal=goal,
        ),
    ]


def _installed(name: str) -> bool:
    return (
        name.split()[0] not in ("gdstk", "klayout")
        or find_spec(name.split()[0]) is not None
    )


def _child(name: str, target: Path) -> tuple[float, float]:
    """(s, MB), the faster of two processes."""
    path = target / ("fresh.gds" if "GDSII" in name else "fresh.oas")
    words = [sys.executable, "-m", "benchmarks._layout_fresh", name, str(path)]
    done = [
        subprocess.run(words, capture_output=True, text=True, check=True, cwd=_ROOT)
        for _ in range(2)
    ]
    return min(
        float(each.stdout.split()[-1]) for each in done
    ), path.stat().st_size / 1e6


_ROOT = Path(__file__).parents[1]


def main(name: str, path: Path) -> None:
    """Build and write once; the seconds go to standard output."""
    sites(freeform=True)
    start = time.perf_counter()
    _WRITERS[name](path)
    print(time.perf_counter() - start)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
