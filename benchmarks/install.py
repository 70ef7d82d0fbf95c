"""A fresh install of the wheel with each extra: time, size on disk, and whether its
part of the chain runs.

    python -m benchmarks install        # some ten minutes: downloads and unpacks torch, OpenCV and a CAD kernel

Each extra gets an environment of its own, without this folder in sight. The error
counts its commands that fail.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import Row

ROOT = Path(__file__).parents[1]
# extra: (packages that it must not bring, commands that it must run)
EXTRAS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "": (
        ("torch", "OCP", "cv2", "mitsuba"),
        (
            "library cell.toml -o library.h5",
            "design design.toml -o lens.h5",
            "layout lens.h5 -o mask",
            "check mask/mask.oas",
            "export lens.h5 -o lens.npz",
            "view lens.h5",
        ),
    ),
    "optics": (
        ("cv2", "OCP"),
        ("design design.toml -o lens.h5", "psf lens.h5 -o psf.h5 --tolerance 1e-3"),
    ),
    "bench": (
        ("OCP",),
        (
            "design design.toml -o lens.h5",
            "capture lens.h5 --truth truth.toml -o shots",
            "measure shots -o measured",
        ),
    ),
    "codesign": (("OCP",), ("scene -o scene",)),
    "cad": (
        ("torch",),
        ("design design.toml -o lens.h5", "layout lens.h5 -o mask --step"),
    ),
}
CELL = "[cell]\npitch_um = 0.30\npillar = { n = 3.6 }\n[sweep]\nwavelengths_um = [0.85]\ntolerance = 1e-2\n"
DESIGN = (
    'profile = "hyperbolic"\naperture_mm = 0.02\nwavelength_nm = 850.0\n'
    "sensor_distance_mm = 0.2\nsource_distance_mm = 20.0\n"
)
TRUTH = "depths_um = [400.0, 900.0, 3000.0]\nseed = 3\n"


def rows() -> list[Row]:
    """One extra after the other."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run(
            [*pip, "wheel", "--no-deps", "-w", str(folder), str(ROOT)], check=True
        )
        wheel = next(folder.glob("*.whl"))
        return [_row(folder, wheel, extra) for extra in EXTRAS]


def _row(folder: Path, wheel: Path, extra: str) -> Row:
    forbidden, commands = EXTRAS[extra]
    home = folder / (extra or "base")
    subprocess.run([sys.executable, "-m", "venv", str(home / "venv")], check=True)
    python = home / "venv" / "bin" / "python"
    before = _megabytes(home / "venv")
    wanted = f"{wheel}[{extra}]" if extra else str(wheel)
    began = time.perf_counter()
    words = [
        str(python),
        "-m",
        "pip",
        "install",
        "--quiet",
        "-c",
        str(ROOT / "constraints.txt"),
        wanted,
    ]
    subprocess.run(words, env=_clean(), check=True)
    seconds = time.perf_counter() - began
    size = _megabytes(home / "venv") - before
    found = [
        name for name in forbidden if _run(home, [str(python), "-c", f"import {name}"])
    ]
    failed = [
        words
        for words in commands
        if not _run(home, [str(home / "venv/bin/metalens"), *words.split()])
    ]
    against = "; ".join(
        [
            f"of {len(commands)} commands run",
            *(f"{name} was brought" for name in found),
            *failed,
        ]
    )
    case = f"[{extra}]" if extra else "no extra"
    return Row(
        case,
        f"{size:.0f} MB on disk",
        seconds,
        len(failed) + len(found),
        against,
        threads=len(os.sched_getaffinity(0)),
    )


def _run(home: Path, words: list[str]) -> bool:
    """Whether a command succeeds in the folder of an environment."""
    (home / "cell.toml").write_text(CELL, encoding="utf-8")
    (home / "design.toml").write_text(DESIGN, encoding="utf-8")
    (home / "truth.toml").write_text(TRUTH, encoding="utf-8")
    return (
        subprocess.run(
            words, cwd=home, env=_clean(), capture_output=True, check=False
        ).returncode
        == 0
    )


def _clean() -> dict[str, str]:
    """The environment without a way to modules beside the installed ones."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def _megabytes(folder: Path) -> float:
    return (
        sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir())
        / 1e6
    )
