"""Hidden lenses, one after another: what retraining on the fit wins back of the error that the made lens costs.

    python -m benchmarks.retrain_study base --work DIR               # a small network on a 1 mm lens, and its design
    python -m benchmarks.retrain_study run --work DIR --cases 100    # every case that has no line yet
    python -m benchmarks.retrain_study run --work DIR --complete 5   # the same through capture and fit
    python -m benchmarks.retrain_study report --work DIR             # the table, kept in benchmarks/results

A hidden lens is drawn from the spread of process and assembly. A *complete* case takes captures of it on the virtual
bench and fits them. A *quick* case draws the result of that fit from the truth and a covariance: that of the first
complete case, or the Cramer-Rao bound of the bench before there is one; the complete ones tell whether that is fair.
One JSON line a case; a stopped study goes on where it was.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from characterize import asbuilt, bench, capture, command_capture
from characterize.asbuilt import AsBuilt
from characterize.bench import Camera, Truth
from characterize.estimate import Options, fit
from characterize.parameters import PARAMETERS, Known, vector
from characterize.pillars import sensitivity
from codesign import evolution, retraining
from codesign import optics as trained
from codesign import run as runs
from codesign.architecture import largest
from codesign.built import OF_LENS, MadeLens, psf_error
from codesign.evolution import Candidate, Search
from codesign.retraining import Lenses, RetrainConfig, Source
from metalens import design, lens, library, store

BASE = """
preset = "smoke"
checkpoint_every = 100
[scenes]
pixels = 64
margin = 8
pool = 4096
[optics]
focus_mm = 28.0
depth_count = 16
polynomials = 0
[space]
widths = [0.35]
depths = [2]
expansions = [3]
kernels = [5]
resolution = [1.0, 1.0]
[inner]
steps = 1500
batch = 32
[run]
pitch_um = 18.0
budgets_mmacs = [8.0]
"""
SPREAD = {"bias_nm": 4.0, "bias_x_nm": 3.0, "bias_y_nm": 3.0, "bias_r_nm": 2.0, "height_nm": 7.0, "distance_um": 15.0}
SPREAD |= {f"{name}_rad": 0.1 for name in ("astigmatism", "oblique_astigmatism", "coma_x", "coma_y", "spherical")}
DEPTHS_UM = (12e3, 15e3, 19e3, 24e3, 31e3, 42e3, 60e3)
CONFIG = RetrainConfig(steps=150, rate=1.5e-3, draws=6, judge=1, test_batches=16)
PEAK_E = 8000.0
LINES, RESULT = "cases.jsonl", Path(__file__).parent / "results" / "retrain_study.json"


def base(folder: Path, text: str) -> None:
    """A run folder of these settings, trained with its largest architecture alone; goes on where it stopped."""
    folder.mkdir(parents=True, exist_ok=True)
    store.write_text(folder / "run.toml", text)
    settings = runs.load(folder / "run.toml")
    path = folder / "checkpoint.safetensors"
    going = runs.resume(path, settings) if path.exists() else runs.start(settings)
    chosen = largest(settings.space)
    going.trainer.architecture = chosen
    for record in runs.train(going, path):
        if record.step % 50 == 0:
            print(record.step, f"{record.task:.3f}", flush=True)
    going.searches = [Search((Candidate(chosen, 0.0, going.macs(chosen)),), {})]
    runs.save(path, going)
    row = {"budget_mmacs": 8.0, "mmacs": going.macs(chosen) / 1e6}
    row["architecture"] = json.loads(evolution.dumps(going.searches[0]))["history"][0]
    if not (folder / "lens.h5").exists():
        _design(folder / "lens.h5", settings, runs.coefficients(going).numpy())
    store.write_text(folder / "result.json", json.dumps({"rows": [row]}))


def _design(path: Path, settings: runs.RunConfig, coefficients: np.ndarray) -> None:
    made = library.sweep(library.DEFAULT_CELL, wavelengths_um=(0.85,))
    phase = trained.phase_of(settings.optics, coefficients)
    aperture = settings.optics.aperture_mm * 1e3
    shape = settings.optics.focus
    lens.save(path, design.make(phase, shape, aperture_um=aperture, cell=made.cell, proxy=library.proxy_of(made))[0])


def hidden(case: int) -> dict[str, float]:
    """The true parameters of a case."""
    rng = np.random.default_rng([case, 2026])
    return {name: float(s * rng.standard_normal()) for name, s in SPREAD.items()}


def truth_of(case: int) -> Truth:
    """The hidden lens on its bench."""
    camera = Camera(pixel_um=3.0, pixels=48)
    known = (*(Known(n, v) for n, v in hidden(case).items()), Known("background_e", 10.0))
    return Truth(DEPTHS_UM, parameter=known, camera=camera, seed=case)


def captured(work: Path, made: lens.Lens, case: int) -> AsBuilt:
    """The fit of captures of a case; kept, so that its covariance serves the quick cases."""
    path = work / f"asbuilt_{case}.h5"
    if not path.exists():
        folder, truth = work / f"capture_{case}", truth_of(case)
        if not folder.exists():
            command_capture.write(folder, bench.shoot(made, truth, sensitivity(made)), truth, made)
        asbuilt.save(path, fit(capture.load(folder), made, Options(insist=True)))
    return asbuilt.load(path)


def expected(design_lens: lens.Lens) -> AsBuilt:
    """What a fit can know of this lens at most: the Cramer-Rao bound of its frames on the bench, with the usual priors.

    For quick cases before there is a complete one. Frames have ``PEAK_E`` electrons; gain, background, decentre, stage
    and crosstalk are unknown too, and marginalised.
    """
    settings = trained.OpticsConfig(
        focus_mm=28.0, polynomials=0, sample_um=3.0, window_samples=49, depths_mm=(12.0, 60.0), depth_count=7
    )
    ready = MadeLens(design_lens, settings)
    light = ready.stack().intensity.double().numpy()
    depths = settings.depths_um.numpy()
    slopes = {}
    for name in (*SPREAD, "trefoil_x_rad", "trefoil_y_rad"):
        step = 0.02 if name.endswith("rad") else 1.0
        moved = [ready.stack(vector({name: sign * step})).intensity.double().numpy() for sign in (1, -1)]
        slopes[name] = (moved[0] - moved[1]) / (2 * step)
    near = replace(settings, depths_mm=(12.1, 60.1))
    by_depth = MadeLens(design_lens, near).stack().intensity.double().numpy() - light
    by_depth /= (near.depths_um.numpy() - depths)[:, None, None]
    slopes["stage_zero_um"] = by_depth
    slopes["stage_scale"] = by_depth * (depths - depths.mean())[:, None, None]
    slopes["decentre_x_um"], slopes["decentre_y_um"] = (np.gradient(light, 3.0, axis=a) for a in (2, 1))
    slopes["crosstalk_px"] = 0.2 * (
        np.gradient(np.gradient(light, axis=1), axis=1) + np.gradient(np.gradient(light, axis=2), axis=2)
    )
    slopes["log_gain"] = light
    scale = PEAK_E / light.max()
    slopes["background_e"] = np.ones_like(light) / scale
    names = tuple(slopes)
    table = np.stack([slopes[n].ravel() * scale for n in names])
    information = (table / (light.ravel() * scale + 10.0 + 4.0)) @ table.T
    prior = np.array([next(p.sigma for p in PARAMETERS if p.name == n) for n in names])
    covariance = np.linalg.inv(information + np.diag(1 / prior**2))
    keep = [i for i, n in enumerate(names) if n in OF_LENS]
    part, blank = covariance[np.ix_(keep, keep)], np.zeros((1, 2, 2))
    return AsBuilt(
        design_lens, sensitivity(design_lens), tuple(names[i] for i in keep), np.zeros(len(keep)), part,
        np.linalg.inv(part), {}, depths[:1], np.zeros((1, 2)), 3.0, blank, blank, blank, blank, 1.0, True,
        "Cramer-Rao bound",
    )  # fmt: skip


def template(work: Path, design_lens: lens.Lens) -> AsBuilt:
    """The fit whose covariance quick cases draw from: that of complete case 1000 where it is there, else the bound."""
    path = work / "asbuilt_1000.h5"
    return asbuilt.load(path) if path.exists() else expected(design_lens)


def quick(template: AsBuilt, case: int) -> AsBuilt:
    """What a fit of this case may say: the truth, off by a draw from the covariance."""
    true = hidden(case)
    rng = np.random.default_rng([case, 7])
    off = np.linalg.cholesky(template.covariance) @ rng.standard_normal(len(template.names))
    middle = np.array([true.get(n, 0.0) for n in template.names])
    return replace(template, value=middle + off, problems=())


def one(
    source: Source, made: MadeLens, nominal: Lenses, work: Path, case: int, *, model: AsBuilt | None
) -> dict[str, object]:
    """One case: errors before and after, and with the truth known where the case's number is even or complete."""
    start, complete = time.process_time(), model is None
    result = captured(work, made.design, case) if model is None else quick(model, case)
    config = replace(CONFIG, seed=case)
    true = made.stack(vector(hidden(case)))
    drawn = tuple(made.stack(result.parameters(row)) for row in result.samples(config.draws, seed=case))
    found = Lenses(nominal.nominal, made.stack(result.parameters()), drawn, (true,), True)
    base_net = retraining.job(source, config, found, "nominal")
    base_net.restore({**_kept(work, source), "counters": [config.steps, 0, 0]})
    cases = {"nominal": retraining.judge(base_net, source, config, (found.nominal,))}
    cases["before"] = retraining.judge(base_net, source, config, found.judges)
    for name in ("retrained", "known") if complete or case % 4 == 0 else ("retrained",):
        going = retraining.job(source, config, found, name)
        for _ in going.run():
            pass
        cases[name] = retraining.judge(going, source, config, found.judges)
    numbers = {name: value.values() for name, value in cases.items()}
    error = {"fitted": psf_error(found.best, true), "nominal": psf_error(nominal.nominal, true)}
    seconds = time.process_time() - start
    return {
        "case": case,
        "complete": complete,
        "psf_error": error,
        "cpu_s": seconds,
        "trusted": result.trusted,
        **numbers,
    }


def _kept(work: Path, source: Source) -> dict[str, object]:
    """State of the network that was trained on for the nominal lens, once for all cases."""
    path = work / "nominal.pt"
    if not path.exists():
        made = MadeLens(lens.load(work / "run" / "lens.h5"), source.settings.optics)
        stack = made.stack()
        going = retraining.job(source, CONFIG, Lenses(stack, stack, (stack,), (stack,), True), "nominal")
        for _ in going.run():
            pass
        torch.save(going.state(), path)
    state: dict[str, object] = torch.load(path, weights_only=True)
    return state


def run(work: Path, cases: int, complete: int, minutes: float) -> None:
    """Cases without a line, until the time is up; quick ones from 0, complete ones from 1000."""
    source = retraining.load(work / "run")
    made = MadeLens(lens.load(work / "run" / "lens.h5"), source.settings.optics)
    stack = made.stack()
    nominal = Lenses(stack, stack, (), (), True)
    done = {entry["case"] for entry in _lines(work)}
    end, model = time.monotonic() + minutes * 60, None
    for case in [c for c in (*range(1000, 1000 + complete), *range(cases)) if c not in done]:
        if case < 1000 and model is None:
            model = template(work, made.design)
        entry = one(source, made, nominal, work, case, model=None if case >= 1000 else model)
        with open(work / LINES, "a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
        print(case, f"{recovered(entry):.2f}", f"{entry['cpu_s']:.0f} s", flush=True)
        if time.monotonic() > end:
            break


def _lines(work: Path) -> list[dict[str, object]]:
    path = work / LINES
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []


def recovered(entry: dict[str, object], to: str = "nominal") -> float:
    """Share of the gap between the made and the nominal lens (or the network that knew the truth) that was won back."""
    error = {name: entry[name]["slip_mm"] for name in ("before", "retrained", to)}  # type: ignore[index]
    gap = error["before"] - error[to]
    return (error["before"] - error["retrained"]) / gap if gap > 0 else math.nan


def summary(entries: list[dict[str, object]]) -> dict[str, object]:
    """Counts, medians and the worst tenth, for quick and complete cases, and for gaps that are above the noise."""
    out: dict[str, object] = {}
    for kind in (False, True):
        mine = [e for e in entries if e["complete"] == kind]
        gaps = [e["before"]["slip_mm"] - e["nominal"]["slip_mm"] for e in mine]  # type: ignore[index]
        shares = np.array([recovered(e) for e, gap in zip(mine, gaps, strict=True) if gap > 0.02])
        known = np.array(
            [recovered(e, "known") for e, gap in zip(mine, gaps, strict=True) if "known" in e and gap > 0.02]
        )
        if not len(mine):
            continue
        out["complete" if kind else "quick"] = {
            "cases": len(mine),
            "with_a_gap_above_0.02_mm": len(shares),
            "median_gap_mm": float(np.median(gaps)),
            "median_recovered": float(np.median(shares)) if len(shares) else None,
            "worst_tenth_recovered": float(np.quantile(shares, 0.1)) if len(shares) else None,
            "median_of_what_the_truth_wins": float(np.median(known)) if len(known) else None,
            "median_psf_error_nominal": float(np.median([e["psf_error"]["nominal"] for e in mine])),  # type: ignore[index]
            "median_psf_error_fitted": float(np.median([e["psf_error"]["fitted"] for e in mine])),  # type: ignore[index]
            "median_before_mm": float(np.median([e["before"]["slip_mm"] for e in mine])),  # type: ignore[index]
            "median_after_mm": float(np.median([e["retrained"]["slip_mm"] for e in mine])),  # type: ignore[index]
            "nominal_mm": float(np.median([e["nominal"]["slip_mm"] for e in mine])),  # type: ignore[index]
        }
    return out


def report(work: Path) -> None:
    """Print and keep the summary."""
    found = summary(_lines(work))
    print(json.dumps(found, indent=1))
    store.write_text(RESULT, json.dumps({"spread": SPREAD, "settings": str(CONFIG), **found}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("base", "run", "report"))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=0)
    parser.add_argument("--complete", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=600.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.work.mkdir(parents=True, exist_ok=True)
    if given.what == "base":
        base(given.work / "run", BASE)
    elif given.what == "run":
        run(given.work, given.cases, given.complete, given.minutes)
    else:
        report(given.work)


if __name__ == "__main__":
    main()
