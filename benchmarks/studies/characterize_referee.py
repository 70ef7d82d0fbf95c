"""Hidden lenses of the referee bench, fitted with default priors: coverage by
parameter, and faults that no fit knows.

``python -m benchmarks.studies.characterize_referee small 200 --minutes 60`` fits the seeds that
are still missing of a case
(small: 40 um; fifth: 0.2 mm; whole: 1 mm; drawn: the small one with one kind of what
nobody states in turn, as large
as the fit reckons with, and all others stated as absent; faults: the small one with
every fault in turn) and keeps each
at once in ``benchmarks/results/characterize_referee``; what is there is printed by
``python -m benchmarks
characterize_referee``.

The bench (``tests/referees``) sums over every pillar in float64 with the modal
library's t(D) at five heights, has a
camera of its own, and draws its truths from wider than, and shifted against, what the
fit assumes.
"""

import functools
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import Row
from characterize.inference.estimate import FitOptions, fit
from characterize.model import KnownValue, log_response_slopes
from metalens.core import store
from metalens.core.errors import CaptureError, FitError

FOLDER = Path(__file__).parents[1] / "results" / "characterize_referee"
CASES: dict[str, dict[str, Any]] = {
    "small": {"lens": (40.0, 110.0, 600.0), "scale": 1.0, "session": {}},
    "fifth": {
        "lens": (200.0, 900.0, 6000.0),
        "scale": 8.0,
        "session": {
            "depths_um": (4300.0, 4900.0, 5600.0, 6300.0, 7400.0, 9200.0),
            "pixel_um": 2.4,
            "pixels": 32,
        },
    },
    "whole": {
        "lens": (1000.0, 2000.0, 20000.0),
        "scale": 10.0,
        "session": {
            "depths_um": tuple((1 / np.linspace(1 / 15e3, 1 / 28e3, 11)).tolist()),
            "pixel_um": 3.0,
            "pixels": 32,
            "peak_e": 8000.0,
        },
    },
    "drawn": {
        "lens": (40.0, 110.0, 600.0),
        "scale": 1.0,
        "session": {},
        "unstated": True,
    },
}
# times its sigma within the model, from which on an interval is one that reckons with
# the unstated
WIDENED = 1.3
REACH, SHARES = 1.959964, (1.0, 0.75, 0.5, 0.25, 0.15, 0.0)
FAULTS: dict[str, dict[str, float]] = {
    "cover glass 100 um": {"glass_um": 100.0},
    "cover glass 100 um, tilted 10 deg": {"glass_um": 100.0, "glass_tilt_deg": 10.0},
    "stitching 60 nm": {"stitch_nm": 60.0},
    "side wall 1.5 deg": {"sidewall_deg": 1.5},
    "2 % of the pillars missing": {"missing": 0.02},
    "wavelength drift 1.5 nm": {"drift_nm": 1.5},
    "LED of 20 nm": {"led_nm": 20.0},
    "vibration 0.7 px in every second frame": {"vibration_px": 0.7},
    "ghost 5 %": {"ghost": 0.05},
    "pixel pitch 1 % off": {"pixel_error": 0.01},
    "saturated at 4000 e": {"full_well_e": 4000.0},
    "stage 10 um a frame": {"stage_um": 10.0},
    "illumination 15 % uneven": {"gradient": 0.15},
    "source of 8 um": {"source_um": 8.0},
}


@functools.cache
def prepared(case: str) -> tuple[Any, Any]:
    """The design of a case, and its pillars under change."""
    from tests.referees import hidden_lens

    lens = hidden_lens.lens(*CASES[case]["lens"])
    return lens, log_response_slopes(lens)


def study(
    case: str, seed: int, faults: dict[str, float] | None = None
) -> dict[str, Any]:
    """One hidden lens: capture, fit, compare."""
    from tests.referees import hidden_lens, pillar_bench

    lens, response = prepared(case)
    about = CASES[case]
    values = hidden_lens.hidden(seed, scale=about["scale"])
    session = hidden_lens.session(seed, values=values, **about["session"])
    kind, drawn, absent = (
        hidden_lens.unstated(seed) if "unstated" in about else ("", faults or {}, ())
    )
    session = pillar_bench.with_faults(session, **drawn)
    known = tuple(KnownValue(name, 0.0) for name in absent)
    seen = pillar_bench.shoot(lens, session)
    start, clock = time.process_time(), time.perf_counter()
    try:
        found = fit(
            seen.capture, lens, FitOptions(known=known, insist=True), response=response
        )
    except (CaptureError, FitError) as refusal:
        return {
            "seed": seed,
            "refused": str(refusal),
            "seconds": time.process_time() - start,
        }
    seconds = time.process_time() - start
    wall = time.perf_counter() - clock
    inside, outer, error = {}, {}, {}
    for i, name in enumerate(found.names):
        if name in hidden_lens.TRUTHS:
            low, high = found.within_model(name)
            inside[name] = bool(low <= values[name] <= high)
            low, high = found.interval(name)
            outer[name] = bool(low <= values[name] <= high)
            error[name] = float(
                (found.value[i] - values[name])
                / math.sqrt(found.within_covariance[i, i])
            )
    words = [
        w
        for w in found.cautions
        if "residuals" in w
        or "saturated" in w
        or "left out" in w
        or "fitted too" in w
        or "phase of" in w
    ]
    own = np.sqrt(np.diag(found.within_covariance))
    wider = {
        n: float(found.sigma[i] / own[i])
        for i, n in enumerate(found.names)
        if n in inside
    }
    return {
        "seed": seed,
        "kind": kind,
        "seconds": seconds,
        "wall_seconds": wall,
        "inside": inside,
        "outer": outer,
        "wider": wider,
        "z": error,
        "parabolic": len(found.draws) == 0,
        "chi2_per_dof": found.chi2_per_dof,
        "problems": list(found.problems),
        "words": words,
        "verdicts": list(found.verdicts),
    }


def rows() -> list[Row]:
    """What is stored."""
    out = [
        row
        for case in CASES
        if case != "drawn"
        for row in _rows(case, list(_stored(case).values()))
    ]
    out += _drawn_rows(list(_stored("drawn").values()))
    out += [_fault_row(name, run) for name, run in _stored("faults").items()]
    return out + _sizes(*(_judged(_stored(case)) for case in ("small", "faults")))


def _judged(stored: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs that were not refused."""
    return [run for run in stored.values() if "inside" in run and not run["problems"]]


def _sizes(clean: list[dict[str, Any]], faulty: list[dict[str, Any]]) -> list[Row]:
    """What intervals would hold, were what is unstated reckoned with at a share: sigma²
    (1 + share² (whole² - 1)).

    By 1.96 sigma and the errors of the fits that are stored.
    """
    out = []
    for share in SHARES if clean and faulty else ():
        held = [
            float(np.mean([_holds(run, share) for run in runs]))
            for runs in (clean, faulty)
        ]
        head = f"the unstated at {share:g} of its size"
        out.append(
            Row(
                head,
                "clean benches covered",
                math.nan,
                held[0],
                "truth",
                goal="0.93 to 0.97",
            )
        )
        out.append(
            Row(
                head,
                "benches with a fault covered",
                math.nan,
                held[1],
                "truth",
                goal="none missed",
            )
        )
    return out


def _holds(run: dict[str, Any], share: float) -> list[bool]:
    """Of every parameter."""
    z, whole = (
        np.array([run[key][name] for name in run["inside"]]) for key in ("z", "wider")
    )
    return [
        bool(one) for one in np.abs(z) < REACH * np.sqrt(1 + share**2 * (whole**2 - 1))
    ]


def _rows(case: str, runs: list[dict[str, Any]]) -> list[Row]:
    good = [run for run in runs if "inside" in run and not run["problems"]]
    if not good:
        return []
    seconds = float(
        np.mean([run["seconds"] for run in good if "seconds" in run] or [math.nan])
    )
    head = f"{len(runs)} hidden lenses, {case}"
    names = list(good[0]["inside"])
    every = [run["inside"][name] for run in good for name in names]
    plain = [run["z"][name] for run in good if run["parabolic"] for name in names]
    out = [
        Row(
            head,
            "all parameters covered",
            seconds,
            float(np.mean(every)),
            "truth",
            goal="0.93 to 0.97",
        ),
        Row(head, "refused", seconds, 1 - len(good) / len(runs), "none", goal="0"),
    ]
    if told := [run["outer"][name] for run in good if "outer" in run for name in names]:
        goal = ">= 0.95"
        out.append(
            Row(
                head,
                "covered with what cannot be told",
                seconds,
                float(np.mean(told)),
                "truth",
                goal=goal,
            )
        )
    if plain:
        rms = float(np.sqrt(np.mean(np.square(plain))))
        out.append(
            Row(
                head,
                "error over sigma, parabolic ones, rms",
                seconds,
                rms,
                "truth",
                goal="<= 1.15",
            )
        )
    for name in names:
        share = float(np.mean([run["inside"][name] for run in good]))
        out.append(
            Row(head, f"{name} covered", seconds, share, "truth", goal="0.93 to 0.97")
        )
    return out


def _drawn_rows(runs: list[dict[str, Any]]) -> list[Row]:
    """Of benches that have one kind of what nobody states, as large as is reckoned
    with: the wider intervals, of all
    and by kind, of the parameters that are ``WIDENED``."""
    good = [run for run in runs if "inside" in run and not run["problems"]]
    if not good:
        return []
    head = f"{len(runs)} hidden lenses, one unstated cause each"
    out = [Row(head, "refused", math.nan, 1 - len(good) / len(runs), "none", goal="0")]
    for kind in ("", *sorted({run["kind"] for run in good})):
        some = [run for run in good if kind in ("", run["kind"])]
        z, whole, within, held = (
            _flat(some, key) for key in ("z", "wider", "inside", "outer")
        )
        wide, of = whole > WIDENED, f" by {kind}" if kind else ""
        if not kind:
            out.append(
                Row(
                    head,
                    "all parameters covered",
                    math.nan,
                    float(held.mean()),
                    "truth",
                    goal="0.93 to 0.97",
                )
            )
        if wide.any():
            rms = float(np.sqrt(np.mean((z / whole)[wide] ** 2)))
            what = f"{wide.sum()} intervals widened{of}"
            out.append(
                Row(
                    head,
                    f"{what}, covered",
                    math.nan,
                    float(held[wide].mean()),
                    "truth",
                    goal="0.93 to 0.97",
                )
            )
            out.append(
                Row(
                    head,
                    f"{what}, covered within the model",
                    math.nan,
                    float(within[wide].mean()),
                    "truth",
                )
            )
            out.append(
                Row(
                    head,
                    f"{what}, error over sigma, rms",
                    math.nan,
                    rms,
                    "truth",
                    goal="1",
                )
            )
    return out


def _flat(runs: list[dict[str, Any]], key: str) -> np.ndarray:
    """(runs times parameters,) of what is kept by parameter."""
    return np.array([float(run[key][name]) for run in runs for name in run["inside"]])


def _fault_row(name: str, run: dict[str, Any]) -> Row:
    """What is said of a fault, and the share of the parameters outside the intervals
    that reckon with the unstated.
    """
    seconds = run.get("seconds", math.nan)
    if "inside" not in run or run["problems"]:
        return Row(
            f"fault: {name}",
            "refused",
            seconds,
            0.0,
            "truth",
            goal="found, inside, or refused",
        )
    within, outside = (
        1 - float(np.mean(list(run[key].values()))) for key in ("inside", "outer")
    )
    inside = "inside with what cannot be told" if within else "inside"
    told = "found" if run["words"] else "silent" if outside else inside
    return Row(
        f"fault: {name}",
        told,
        seconds,
        outside,
        "truth",
        goal="found, inside, or refused",
    )


def _stored(case: str) -> dict[str, Any]:
    path = FOLDER / f"{case}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _keep(case: str, key: str, run: dict[str, Any]) -> None:
    FOLDER.mkdir(exist_ok=True)
    store.write_text(
        FOLDER / f"{case}.json", json.dumps(_stored(case) | {key: run}, indent=1) + "\n"
    )


def main(words: list[str]) -> None:
    """Fit what is missing until the time is up; ``--untimed`` on a busy machine:
    seconds are not kept.
    """
    drop = ("seconds", "wall_seconds") if "--untimed" in words else ()

    def keep(case: str, key: str, run: dict[str, Any]) -> None:
        _keep(
            case, key, {name: value for name, value in run.items() if name not in drop}
        )

    minutes = (
        float(words[words.index("--minutes") + 1]) if "--minutes" in words else math.inf
    )
    count = next((int(w) for w in words if w.isdigit()), 20)
    end = time.monotonic() + 60 * minutes
    if "faults" in words:
        for name, fault in FAULTS.items():
            if name not in _stored("faults") and time.monotonic() < end:
                keep("faults", name, study("small", 0, fault))
    for case in CASES:
        for seed in range(count if case in words else 0):
            if str(seed) not in _stored(case) and time.monotonic() < end:
                keep(case, str(seed), study(case, seed))


if __name__ == "__main__":
    main(sys.argv[1:])
