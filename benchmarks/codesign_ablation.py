"""Ablations: whole co-design runs of one config with optics, pitch or architecture
frozen, against nothing frozen.

    python -m benchmarks.codesign_ablation run --work DIR       # every run that has no line yet
    python -m benchmarks.codesign_ablation report --work DIR    # benchmarks/results and docs/codesign

Each is what ``metalens codesign RUN.toml --freeze PART`` does: joint training, search
under the budget, fine-tuning.
"""

import argparse
import json
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import keep_line, kept_lines
from benchmarks.codesign_report import ROOT, ratio
from codesign.batches.scenes import TEST
from codesign.train import ambiguity, assess, evolution, finish, run
from codesign.train.run import RunConfig
from codesign.train.words import Part
from metalens.ground import config, store

LINES = "ablation.jsonl"
VARIANTS: dict[str, tuple[Part, ...]] = {
    "nothing frozen": (),
    "optics frozen": ("optics",),
    "pitch frozen": ("pitch",),
    "architecture frozen": ("architecture",),
}
MEANS = ("ambiguous_iou", "mmacs", "pitch_um", "effective_pitch_um")
TABLE: dict[str, Any] = {
    "preset": "laptop",
    "ambiguity_pairs": 256,
    "scenes": {"pool": 4096},
    "space": {"resolution": [0.3, 1.0]},
    "optics": {"focus_mm": 33.0},
    "sensor": {"exposure_e": 2000.0, "full_well_e": 4000.0},
    "inner": {
        "steps": 1200,
        "optics_weight": 0.0,
        "budget_mmacs": 4.0,
        "pitch": {"rate": 0.005},
    },
    "run": {"pitch_um": 14.0, "budgets_mmacs": [4.0], "finetune_steps": 300},
}
HEAD = """# Ablations

Whole co-design runs under one budget of 4 MMACs, from a hyperbolic lens in focus at 33 mm and pixels of 14 um: 1200
joint steps of 32 frames, search over 24 architectures, 300 steps of fine-tuning. Errors on the
frames of [the study](results.md), where blur alone tells depth. Ratios with 95 % intervals of a paired bootstrap over
pairs of frames and over runs. A frozen architecture is the largest one, trained alone, at the resolution that the
budget leaves it: its last column says why it reads no depth. Knowing nothing scores 1.67 mm. Made by
`python -m benchmarks.codesign_ablation run --work DIR` and `report --work DIR`.

"""


def settings_of(variant: str, seed: int) -> RunConfig:
    """The config of one run."""
    table = config.merged(run.preset_table("laptop"), TABLE)
    made = config.from_table(table, RunConfig, where="the ablations")
    return replace(
        made,
        inner=replace(made.inner, seed=seed),
        run=replace(made.run, frozen=VARIANTS[variant]),
    )


def run_one(work: Path, variant: str, seed: int) -> dict[str, Any]:
    """Train, search, fine-tune and test one run; its line, the error of every frame
    beside it.
    """
    begun = time.perf_counter()
    settings = settings_of(variant, seed)
    going, path = run.start(settings), work / "going.safetensors"
    for record in run.train(going, path):
        if record.step % 100 == 0:
            print(
                f"{variant}-{seed} step {record.step}: {record.task:.3f}, {record.pitch_um:.2f} um",
                flush=True,
            )
    for _ in run.search(going, path):
        pass
    ((row, model),) = finish.finished(going)
    best = evolution.best(going.searches[0].history)
    pairs = ambiguity.ambiguous(
        replace(going.scenes(TEST), seed=0), settings.ambiguity_pairs, 17
    )
    seen = assess.frames(
        going.trainer, pairs, max(1, len(pairs) // settings.inner.batch)
    )
    answers = assess.predict(model.net, best.architecture, seen, settings.inner)
    error = (answers.slip_mm - seen.slip_mm).abs().numpy()
    np.savez_compressed(stem(work, variant, seed), ambiguous=error)
    pitch = float(going.trainer.model.pitch_um.detach())
    line = {"variant": variant, "seed": seed, "pitch_um": pitch}
    return line | {"seconds": time.perf_counter() - begun} | row


def stem(work: Path, variant: str, seed: int) -> Path:
    """Errors of every frame of a run."""
    return work / f"{variant.replace(' ', '-')}-{seed}.npz"


def report(work: Path) -> None:
    """JSON and table of the runs there are."""
    lines: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in kept_lines(work / LINES):
        lines[line["variant"]].append(line)
    errors = {
        v: np.stack(
            [np.load(stem(work, v, line["seed"]))["ambiguous"] for line in mine]
        )
        for v, mine in lines.items()
    }
    text = (
        HEAD
        + "| frozen | runs | axial / mm | to nothing frozen | lateral / mm | IoU | MMACs | pitch / um "
    )
    text += (
        "| pixels that the network sees / um |\n|---|---|---|---|---|---|---|---|---|\n"
    )
    rows = []
    for variant, mine in lines.items():
        means = {k: float(np.mean([m[k] for m in mine])) for k in MEANS}
        axial, lateral = errors[variant][..., 2], float(errors[variant][..., :2].mean())
        against = ratio(axial, errors["nothing frozen"][..., 2])
        by_seed = [round(float(e), 4) for e in axial.mean(1)]
        rows.append(
            {
                "variant": variant,
                "axial_by_seed_mm": by_seed,
                "to_nothing_frozen": against,
                **means,
            }
        )
        text += f"| {variant} | {len(mine)} | {axial.mean():.3f} | {against[0]:.2f} [{against[1]:.2f}, {against[2]:.2f}] "
        text += f"| {lateral:.3f} | {means['ambiguous_iou']:.3f} | {means['mmacs']:.2f} | {means['pitch_um']:.1f} "
        text += f"| {means['effective_pitch_um']:.1f} |\n"
    store.write_text(
        ROOT / "benchmarks" / "results" / "codesign_ablation.json",
        json.dumps(rows, indent=1) + "\n",
    )
    store.write_text(ROOT / "docs" / "codesign" / "ablations.md", text)
    print(text)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=["run", "report"])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    options = parser.parse_args()
    if options.verb == "report":
        report(options.work)
        return
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    there = {
        (line["variant"], line["seed"]) for line in kept_lines(options.work / LINES)
    }
    for seed in options.seeds:
        for variant in (v for v in VARIANTS if (v, seed) not in there):
            line = run_one(options.work, variant, seed)
            keep_line(options.work / LINES, line)
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
