"""Hidden lenses, one after another: what retraining on the fit wins back of the error
that the made lens costs.

    python -m benchmarks.retrain_study base --work DIR               # a small network on a 1 mm lens, and its design
    python -m benchmarks.retrain_study run --work DIR --cases 100    # every case that has no line yet
    python -m benchmarks.retrain_study run --work DIR --complete 5   # the same through capture and fit
    python -m benchmarks.retrain_study report --work DIR             # the table, kept in benchmarks/results

A hidden lens is drawn from the spread of process and assembly. A *complete* case takes
captures of it on the virtual
bench and fits them. A *quick* case draws the result of that fit from the truth and a
covariance: that of the first
complete case, or the Cramer-Rao bound of the bench before there is one; the complete
ones tell whether that is fair.
One JSON line a case; a stopped study goes on where it was.
"""

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import keep_line, kept_lines
from benchmarks.loop_runs import Recipe, finished
from characterize.bench import bench
from characterize.bench.bench import Camera, Truth
from characterize.captures import capture
from characterize.commands import capture as command_capture
from characterize.inference import asbuilt
from characterize.inference.asbuilt import AsBuilt
from characterize.inference.estimate import Options, fit
from characterize.model.parameters import PARAMETERS, Known, vector
from codesign.adapt import train as retraining
from codesign.adapt.settings import RetrainConfig
from codesign.adapt.train import Held, Lenses, Source
from codesign.optics import stack as trained
from codesign.optics.built import OF_LENS, MadeLens, psf_error
from codesign.optics.stack import Stack
from metalens import lens
from metalens.ground import store
from metalens.made import sensitivity

BASE = Recipe(33.0, moves=True, steps=3000)
SPREAD = {
    "bias_nm": 4.0,
    "bias_x_nm": 3.0,
    "bias_y_nm": 3.0,
    "bias_r_nm": 2.0,
    "height_nm": 7.0,
    "distance_um": 15.0,
}
SPREAD |= {
    f"{name}_rad": 0.1
    for name in ("astigmatism", "oblique_astigmatism", "coma_x", "coma_y", "spherical")
}
DEPTHS_UM = (12e3, 15e3, 19e3, 24e3, 31e3, 42e3, 60e3)
CONFIG = RetrainConfig(steps=200, rate=1.5e-3, draws=6, judge=1, test_batches=16)
KNOWN_EVERY = 5
PEAK_E = 8000.0
LINES, RESULT = "cases.jsonl", Path(__file__).parent / "results" / "retrain_study.json"


def hidden(case: int) -> dict[str, float]:
    """The true parameters of a case."""
    rng = np.random.default_rng([case, 2026])
    return {name: float(s * rng.standard_normal()) for name, s in SPREAD.items()}


def truth_of(case: int) -> Truth:
    """The hidden lens on its bench."""
    camera = Camera(pixel_um=3.0, pixels=48)
    known = (
        *(Known(n, v) for n, v in hidden(case).items()),
        Known("background_e", 10.0),
    )
    return Truth(DEPTHS_UM, parameter=known, camera=camera, seed=case)


def captured(work: Path, made: lens.Lens, case: int) -> AsBuilt:
    """The fit of captures of a case; kept, so that its covariance serves the quick
    cases.
    """
    path = work / f"asbuilt_{case}.h5"
    if not path.exists():
        folder, truth = work / f"capture_{case}", truth_of(case)
        if not folder.exists():
            command_capture.write(
                folder, bench.shoot(made, truth, sensitivity(made)), truth, made
            )
        asbuilt.save(path, fit(capture.load(folder), made, Options(insist=True)))
    return asbuilt.load(path)


def expected(design_lens: lens.Lens) -> AsBuilt:
    """What a fit can know of this lens at most: the Cramer-Rao bound of its frames on
    the bench, with the usual priors.

    For quick cases before there is a complete one. Frames have ``PEAK_E`` electrons;
    gain, background, decentre, stage
    and crosstalk are unknown too, and marginalised.
    """
    settings = trained.OpticsConfig(
        focus_mm=28.0, polynomials=0, sample_um=3.0, window_samples=49, depths_mm=(12.0, 60.0), depth_count=7,
        image="uniform",
    )  # fmt: skip
    ready = MadeLens(design_lens, settings)
    light = ready.stack().intensity.double().numpy()
    depths = settings.depths_um.numpy()
    slopes = {}
    for name in (*SPREAD, "trefoil_x_rad", "trefoil_y_rad"):
        step = 0.02 if name.endswith("rad") else 1.0
        moved = [
            ready.stack(vector({name: sign * step})).intensity.double().numpy()
            for sign in (1, -1)
        ]
        slopes[name] = (moved[0] - moved[1]) / (2 * step)
    near = replace(settings, depths_mm=(12.1, 60.1))
    by_depth = MadeLens(design_lens, near).stack().intensity.double().numpy() - light
    by_depth /= (near.depths_um.numpy() - depths)[:, None, None]
    slopes["stage_zero_um"] = by_depth
    slopes["stage_scale"] = by_depth * (depths - depths.mean())[:, None, None]
    slopes["decentre_x_um"], slopes["decentre_y_um"] = (
        np.gradient(light, 3.0, axis=a) for a in (2, 1)
    )
    slopes["crosstalk_px"] = 0.2 * (
        np.gradient(np.gradient(light, axis=1), axis=1)
        + np.gradient(np.gradient(light, axis=2), axis=2)
    )
    slopes["log_gain"] = light
    scale = PEAK_E / light.max()
    slopes["background_e"] = np.ones_like(light) / scale
    names = tuple(slopes)
    table = np.stack([slopes[n].ravel() * scale for n in names])
    prior = np.array([next(p.sigma for p in PARAMETERS if p.name == n) for n in names])
    variance = (
        np.maximum(light.ravel(), 0) * scale + 10.0 + 4.0
    )  # low-passed PSFs dip below 0
    precision = (table / variance) @ table.T + np.diag(1 / prior**2)
    unit = 1 / np.sqrt(np.diag(precision))  # so that the inverse keeps its digits
    covariance = np.linalg.inv(precision * np.outer(unit, unit)) * np.outer(unit, unit)
    covariance = (covariance + covariance.T) / 2
    keep = [i for i, n in enumerate(names) if n in OF_LENS]
    part, blank = covariance[np.ix_(keep, keep)], np.zeros((1, 2, 2))
    return AsBuilt(
        design_lens, sensitivity(design_lens), tuple(names[i] for i in keep), np.zeros(len(keep)), part,
        np.linalg.inv(part), {}, depths[:1], np.zeros((1, 2)), 3.0, blank, blank, blank, blank, 1.0, True,
        "Cramer-Rao bound",
    )  # fmt: skip


def template(work: Path, design_lens: lens.Lens) -> AsBuilt:
    """The fit whose covariance quick cases draw from: that of complete case 1000 where
    it is there, else the bound.
    """
    path, bound = work / "asbuilt_1000.h5", work / "bound.h5"
    if not path.exists() and not bound.exists():
        asbuilt.save(bound, expected(design_lens))
    return asbuilt.load(path if path.exists() else bound)


def quick(template: AsBuilt, case: int) -> AsBuilt:
    """What a fit of this case may say: the truth, off by a draw from the covariance."""
    true = hidden(case)
    rng = np.random.default_rng([case, 7])
    off = np.linalg.cholesky(template.within_covariance) @ rng.standard_normal(
        len(template.names)
    )
    middle = np.array([true.get(n, 0.0) for n in template.names])
    return replace(template, value=middle + off, problems=())


@dataclass(frozen=True, eq=False, slots=True)
class Ground:
    """What all cases share: the run, its lens, the frames that judge, the network
    trained on for the design.
    """

    work: Path
    source: Source
    made: MadeLens
    nominal: Stack
    frames: Held
    state: dict[str, Any]


def ground(work: Path) -> Ground:
    """Read or make it; the network that was trained on for the nominal lens is kept in
    ``nominal.pt``.
    """
    source, path = retraining.load(work / "run"), work / "nominal.pt"
    made = MadeLens(lens.load(work / "run" / "lens.h5"), source.settings.optics)
    stack = made.stack()
    if not path.exists():
        going = retraining.job(
            source, CONFIG, Lenses(stack, stack, (stack,), (stack,), True), "nominal"
        )
        for _ in going.run():
            pass
        torch.save(going.state(), path)
    return Ground(
        work,
        source,
        made,
        stack,
        retraining.held(source, CONFIG),
        torch.load(path, weights_only=True),
    )


def one(on: Ground, case: int, *, model: AsBuilt | None) -> dict[str, Any]:
    """One case: errors before and after, and with the truth known where the case's
    number is even or complete.
    """
    start, complete = time.process_time(), model is None
    result = (
        captured(on.work, on.made.design, case) if model is None else quick(model, case)
    )
    config, true = replace(CONFIG, seed=case), on.made.stack(vector(hidden(case)))
    drawn = tuple(
        on.made.stack(result.parameters(row))
        for row in result.lens_samples(config.draws, seed=case)
    )
    found = Lenses(on.nominal, on.made.stack(result.parameters()), drawn, (true,), True)
    unwarned = retraining.job(on.source, config, found, "nominal")
    unwarned.restore(on.state)
    numbers = {
        name: retraining.judge(unwarned, on.source, config, stacks, frames=on.frames)
        for name, stacks in (("nominal", (found.nominal,)), ("before", found.judges))
    }
    for name in (
        ("retrained", "known")
        if complete or case % KNOWN_EVERY == 0
        else ("retrained",)
    ):
        going = retraining.job(on.source, config, found, name)
        for _ in going.run():
            pass
        numbers[name] = retraining.judge(
            going, on.source, config, found.judges, frames=on.frames
        )
    return {
        "case": case,
        "complete": complete,
        "psf_error": {
            "fitted": psf_error(found.best, true),
            "nominal": psf_error(on.nominal, true),
        },
        "gap_sigma_mm": retraining.gap_sigma_mm(numbers["before"], numbers["nominal"]),
        "z": z_scores(result, case),
        "cpu_s": time.process_time() - start,
        "trusted": result.trusted,
        **{name: value.values() for name, value in numbers.items()},
    }


def z_scores(result: AsBuilt, case: int) -> dict[str, float]:
    """Error of every hidden parameter in its own standard deviations."""
    true = hidden(case)
    rows = [i for i, name in enumerate(result.names) if name in true]
    return {
        result.names[i]: float(
            (result.value[i] - true[result.names[i]])
            / math.sqrt(result.within_covariance[i, i])
        )
        for i in rows
    }


def run(work: Path, cases: int, complete: int, minutes: float) -> None:
    """Cases without a line, until the time is up; quick ones from 0, complete ones from
    1000.
    """
    on = ground(work)
    done = {entry["case"] for entry in kept_lines(work / LINES)}
    end, model = time.monotonic() + minutes * 60, None
    for case in [
        c for c in (*range(1000, 1000 + complete), *range(cases)) if c not in done
    ]:
        if case < 1000 and model is None:
            model = template(work, on.made.design)
        entry = one(on, case, model=None if case >= 1000 else model)
        keep_line(work / LINES, entry)
        print(case, f"{recovered(entry):.2f}", f"{entry['cpu_s']:.0f} s", flush=True)
        if time.monotonic() > end:
            break


def _slip(entries: Sequence[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([e[name]["slip_mm"] for e in entries])


def recovered(entry: dict[str, Any], to: str = "nominal") -> float:
    """Share of the gap to the nominal lens (or to the network that knew the truth) that
    was won back; nan without one.

    A gap within two of its own standard errors over the frames is none.
    """
    before, after, goal = (
        _slip([entry], name)[0] for name in ("before", "retrained", to)
    )
    gap = before - goal
    return (
        float((before - after) / gap) if gap > 2 * entry["gap_sigma_mm"] else math.nan
    )


def summary(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts, medians and the worst tenth, for quick and complete cases, over the
    lenses that have a gap.
    """
    out: dict[str, Any] = {}
    for kind, chosen in (("quick", False), ("complete", True)):
        mine = [e for e in entries if e["complete"] == chosen]
        if mine:
            out[kind] = _summary(mine)
    return out


def _summary(mine: list[dict[str, Any]]) -> dict[str, Any]:
    told = {name: _slip(mine, name) for name in ("nominal", "before", "retrained")}
    shares = np.array([recovered(e) for e in mine])
    with_gap = np.isfinite(shares)
    knowing = [e for e in mine if "known" in e]
    won = (told["before"] - told["retrained"])[with_gap]
    gap = (told["before"] - told["nominal"])[with_gap]
    rows = np.random.default_rng(0).integers(0, max(1, len(gap)), (2000, len(gap)))
    pooled = won[rows].sum(1) / gap[rows].sum(1) if len(gap) else np.full(1, math.nan)
    out = {
        "cases": len(mine),
        "with_a_gap": int(with_gap.sum()),
        "median_gap_mm": _middle(told["before"] - told["nominal"]),
        "median_recovered": _middle(shares),
        "worst_tenth_recovered": float(np.nanquantile(shares, 0.1))
        if with_gap.any()
        else None,
        "pooled_recovered": float(won.sum() / gap.sum()) if len(gap) else None,
        "pooled_interval": [float(v) for v in np.quantile(pooled, [0.025, 0.975])],
        "median_recovered_of_what_the_truth_wins": _middle(
            np.array([recovered(e, "known") for e in knowing])
        ),
        **{f"median_{name}_mm": _middle(value) for name, value in told.items()},
        **{
            f"median_psf_error_{name}": _middle(
                np.array([e["psf_error"][name] for e in mine])
            )
            for name in ("nominal", "fitted")
        },
    }
    if mine[0]["complete"]:  # the draws of quick cases cover by construction
        z = np.abs([v for e in mine for v in e["z"].values()])
        out |= {
            "covered_95": float((z < 1.959964).mean()),
            "within_3_sigma": float((z < 3).mean()),
        }
    return out


def _middle(values: np.ndarray) -> float | None:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else None


def report(work: Path) -> None:
    """Print and keep the summary."""
    found = summary(kept_lines(work / LINES))
    print(json.dumps(found, indent=1))
    store.write_text(
        RESULT,
        json.dumps({"spread": SPREAD, "settings": str(CONFIG), **found}, indent=1)
        + "\n",
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("base", "run", "report"))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=0)
    parser.add_argument("--complete", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=600.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.work.mkdir(parents=True, exist_ok=True)
    if given.what == "base":
        finished(given.work / "run", BASE)
    elif given.what == "run":
        run(given.work, given.cases, given.complete, given.minutes)
    else:
        report(given.work)


if __name__ == "__main__":
    main()
