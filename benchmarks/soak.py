"""The chain over random small designs: no crash, no number that is not finite, no
failure without a word.

    python -m benchmarks.soak --designs 200 --seed 0 --work DIR      # goes on where it stopped

Every design draws its cell, profile, size, distances, PSF window, process, hidden
errors and light, and goes through
design, PSF, mask, captures and fit as a user would send it. A verb may end in success
(0), say that its result fails
its own check (1) or refuse its input with a reason (2). Found at fault are: any other
end, numbers that are not finite
behind a success, artefacts that cannot be read, files left behind by a refusal, a
refusal without a reason.
"""

import argparse
import collections
import contextlib
import io
import json
import math
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import Row, keep_line, kept_lines
from characterize.bench import bench
from characterize.bench.bench import Truth
from characterize.captures import capture
from characterize.commands import capture as command_capture
from characterize.inference import asbuilt
from characterize.inference.estimate import Options, fit
from metalens import lens
from metalens.cli import main as run_verb
from metalens.ground import config, store
from metalens.ground.errors import MetalensError
from metalens.made import sensitivity

RESULT = Path(__file__).parent / "results" / "soak_study.json"
# (wavelength in nm, text): silicon in the near infrared, titania in green, nitride in
# red
CELLS = (
    (850, 'pitch_um = 0.30\nheight_um = 0.7\npillar = {n = 3.6}\nsubstrate = "SiO2"'),
    (
        850,
        "pitch_um = 0.28\nheight_um = 0.8\npillar = {n = 3.6, k = 0.001}\nsubstrate = {n = 1.45}",
    ),
    (
        532,
        "pitch_um = 0.25\nheight_um = 0.85\npillar = {n = 2.4}\nsubstrate = {n = 1.46}",
    ),
    (
        633,
        "pitch_um = 0.32\nheight_um = 1.4\npillar = {n = 2.0}\nsubstrate = {n = 1.46}",
    ),
)
ALLOWED = (0, 1, 2)


def _text(entries: dict[str, Any]) -> str:
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in entries.items())


def files(work: Path, seed: int, number: int) -> dict[str, str]:
    """The settings of a design, by name of the file."""
    rng = np.random.default_rng([seed, number, 31])
    kind = int(rng.integers(len(CELLS)))
    aperture = float(np.exp(rng.uniform(np.log(8), np.log(60))))  # um
    sensor = aperture * rng.uniform(1.0, 6.0)
    source = sensor * np.exp(rng.uniform(np.log(1.5), np.log(40)))
    profile = str(rng.choice(["hyperbolic", "hyperbolic", "double-helix", "cubic"]))
    design = {
        "profile": profile,
        "aperture_mm": aperture * 1e-3,
        "wavelength_nm": CELLS[kind][0],
        "sensor_distance_mm": sensor * 1e-3,
        "source_distance_mm": source * 1e-3,
        "library": str(library(work, kind)),
    }
    near, far = np.sort(source * rng.uniform(0.5, 2.0, 2)) * 1e-3
    psf = {
        "depths_mm": [
            float(near),
            float(far),
            float(max(far - near, 1e-4) / rng.integers(1, 4)),
        ],
        "angles_deg": rng.uniform(-25, 25, int(rng.integers(1, 3))).tolist(),
        "window_um": float(aperture * rng.uniform(0.2, 1.5)),
        "samples": int(rng.integers(8, 65)),
        "tolerance": float(10 ** rng.uniform(-4, -1.5)),
    }
    least, gap = int(rng.integers(50, 76)), int(rng.integers(30, 70))
    limits = f"[limits]\nmin_diameter_nm = {least}\nmin_gap_nm = {gap}\n"
    return {
        "design.toml": _text(design) + limits,
        "psf.toml": _text(psf),
        **_bench(rng, source, least, gap),
    }


def _bench(
    rng: np.random.Generator, source: float, least: int, gap: int
) -> dict[str, str]:
    """Process and hidden errors; most processes print what the design asks for."""
    grid = rng.choice([1, 2, 5])
    process = (
        f'name = "x"\n[rules]\nminimum_feature_nm = {int(least * rng.uniform(0.5, 1.02))}\n'
        f"minimum_gap_nm = {int(gap * rng.uniform(0.5, 1.02))}\n"
        f"grid_nm = {grid}\ndiameter_step_nm = {grid * rng.integers(1, 5)}\n"
        f"[bias]\ntable_nm = [[80, {rng.uniform(-8, 3):.2f}], [200, {rng.uniform(-3, 3):.2f}]]\n"
    )
    truth = {
        "depths_um": np.sort(source * np.exp(rng.uniform(-0.6, 0.6, 4))).tolist(),
        "peak_e": float(10 ** rng.uniform(2, 4.3)),
        "seed": int(rng.integers(1000)),
    }
    hidden = {
        "bias_nm": 5.0,
        "bias_r_nm": 3.0,
        "height_nm": 8.0,
        "coma_x_rad": 0.3,
        "astigmatism_rad": 0.3,
    }
    rows = [
        f'[[parameter]]\nname = "{n}"\nvalue = {s * rng.standard_normal():.4f}\n'
        for n, s in hidden.items()
    ]
    pixel = float(rng.uniform(0.8, 2.0))
    camera = f"[camera]\npixel_um = {pixel:.3f}\npixels = {rng.integers(10, 20)}\n"
    return {
        "process.toml": process,
        "truth.toml": _text(truth) + camera + "".join(rows),
    }


def library(work: Path, kind: int) -> Path:
    """The pillar library of a cell, swept once."""
    path = work.resolve() / f"library_{kind}.h5"
    if not path.exists():
        wavelength, text = CELLS[kind]
        sweep = f"[sweep]\nwavelengths_um = [{wavelength * 1e-3}]\ntolerance = 1e-2\n"
        store.write_text(work / f"cell_{kind}.toml", f"[cell]\n{text}\n{sweep}")
        run_verb(
            ["library", str(work / f"cell_{kind}.toml"), "-o", str(path), "--quiet"]
        )
    return path


def _captured() -> tuple[int, Any]:
    """``metalens capture``, but with the pillars' response by effective index: rigorous
    slopes take a minute a cell.
    """
    design, truth = lens.load("lens.h5"), config.load(Path("truth.toml"), Truth)
    shots = bench.shoot(design, truth, sensitivity(design))
    command_capture.write(Path("captures"), shots, truth, design)
    return 0, {"peak_e": float(shots.electrons.max())}


def _fitted() -> tuple[int, Any]:
    """``metalens fit``, with the same response."""
    design = lens.load("lens.h5")
    found = fit(
        capture.load("captures"), design, Options(), response=sensitivity(design)
    )
    asbuilt.save("asbuilt.h5", found)
    values = dict(zip(found.names, found.value.tolist(), strict=True))
    return 0 if found.trusted else 1, {**values, "chi2_per_dof": found.chi2_per_dof}


STEPS: tuple[tuple[str, tuple[str, ...] | Callable[[], tuple[int, Any]], str], ...] = (
    ("design", ("design.toml", "-o", "lens.h5"), "lens.h5"),
    ("psf", ("lens.h5", "-o", "psf.h5", "--config", "psf.toml"), "psf.h5"),
    ("layout", ("lens.h5", "--process", "process.toml", "-o", "mask", "--oasis"), "mask"),
    ("capture", _captured, "captures"),
    ("fit", _fitted, "asbuilt.h5"),
)  # fmt: skip

NEEDED = ("design", "capture")  # by the verbs behind them


def one(folder: Path) -> Iterator[dict[str, Any]]:
    """Every verb on the settings in a folder, until one is refused that the rest needs:
    ends and faults.
    """
    with contextlib.chdir(folder):
        for verb, words, target in STEPS:
            start = time.process_time()
            status, values, said = _run(
                words if callable(words) else (verb, *words, "--json")
            )
            faults = list(_faults(verb, status, values, said, Path(target)))
            seconds = time.process_time() - start
            yield {
                "verb": verb,
                "status": status,
                "seconds": seconds,
                "said": said[-300:],
                "faults": faults,
            }
            if verb in NEEDED and not Path(target).exists():
                return


def _run(
    work: Sequence[str] | Callable[[], tuple[int, Any]],
) -> tuple[int | str, Any, str]:
    """(end, result, what was said) of a command line or a function; a warning about
    numbers counts as a crash.
    """
    shown, said = io.StringIO(), io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(shown),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("error", RuntimeWarning)
            if callable(work):
                return *work(), ""
            status: int | str = run_verb(list(work))
    except MetalensError as refusal:
        return 2, None, str(refusal)
    except SystemExit as end:
        return str(end), None, said.getvalue()
    except Exception as crash:  # noqa: BLE001 - a soak is there to find any
        return f"{type(crash).__name__}: {crash}", None, said.getvalue()
    text = shown.getvalue()
    return status, json.loads(text) if text.strip() else None, said.getvalue().strip()


def _faults(
    verb: str, status: int | str, values: Any, said: str, target: Path
) -> Iterator[str]:
    if status not in ALLOWED:
        yield f"crash: {status}"
    elif status == 2:
        if not said:
            yield "refused without a word"
        if target.exists():
            yield f"refused, but {target} is there"
    else:
        yield from (
            f"{verb}: {name} is not finite" for name in _odd(values) if status == 0
        )
        if target.suffix == ".h5":
            yield from (
                f"{target}: {name} is not finite" for name in _odd_arrays(target)
            )


def _odd(values: Any, name: str = "result") -> Iterator[str]:
    """Names of numbers that are not finite."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _odd(value, f"{name}.{key}")
    elif isinstance(values, list):
        for value in values:
            yield from _odd(value, name)
    elif isinstance(values, float) and not math.isfinite(values):
        yield name


def _odd_arrays(path: Path) -> Iterator[str]:
    stored = store.load(path)
    for name, array in stored.arrays.items():
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            yield name


def soak(work: Path, designs: int, seed: int) -> None:
    """Every design without a line yet; one JSON line each."""
    done = {entry["number"] for entry in kept_lines(_lines(work, seed))}
    for number in [n for n in range(designs) if n not in done]:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for file, text in files(work, seed, number).items():
                store.write_text(folder / file, text)
            entry: dict[str, Any] = {"number": number, "ends": list(one(folder))}
        keep_line(_lines(work, seed), entry)
        ends = " ".join(f"{e['verb']}:{e['status']}" for e in entry["ends"])
        print(
            number, ends, *(f for e in entry["ends"] for f in e["faults"]), flush=True
        )


def _lines(work: Path, seed: int) -> Path:
    return work / f"soak_{seed}.jsonl"


def summary(lines: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Ends of every verb, faults, and what was refused and why."""
    verbs = {}
    for verb, *_ in STEPS:
        mine = [e for line in lines for e in line["ends"] if e["verb"] == verb]
        ends = collections.Counter(
            "crash" if e["status"] not in ALLOWED else str(e["status"]) for e in mine
        )
        verbs[verb] = {
            "runs": len(mine),
            "ends": dict(ends),
            "cpu_s": sum(e["seconds"] for e in mine),
        }
    faults = [
        {"design": n["number"], "fault": f}
        for n in lines
        for e in n["ends"]
        for f in e["faults"]
    ]
    refused = collections.Counter(
        f"{e['verb']}: {e['said'].splitlines()[0][:160]}"
        for n in lines
        for e in n["ends"]
        if e["status"] == 2 and e["said"]
    )
    return {
        "designs": len(lines),
        "seed": seed,
        "verbs": verbs,
        "faults": faults,
        "refused": dict(refused.most_common(30)),
    }


def rows() -> list[Row]:
    """What the last soak kept."""
    if not RESULT.is_file():
        return []
    told = json.loads(RESULT.read_text("utf-8"))
    seconds = sum(v["cpu_s"] for v in told["verbs"].values()) / max(1, told["designs"])
    case = f"{told['designs']} random designs, seed {told['seed']}"
    return [
        Row(
            case,
            "design, psf, layout, capture, fit",
            seconds,
            len(told["faults"]),
            "faults found",
            goal="0",
        )
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--designs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, required=True)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    soak(given.work, given.designs, given.seed)
    found = summary(kept_lines(_lines(given.work, given.seed)), given.seed)
    store.write_text(RESULT, json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
