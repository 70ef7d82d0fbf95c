"""What the axial error of a run of the study is made of: noise, persons, windows that
err together, shapes of faces.

    python -m benchmarks.codesign_parts --work DIR                        # every run of case p18blur that is kept there
    python -m benchmarks.codesign_parts --work DIR --only p18blur/hyper40/0   # the others' rows stay

Ambiguous frames of which training saw none. They come in pairs of one person, one after
the other. What a reader could
know beside blur is read by ridge regression, every pair by the fit of the others.
"""

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import kept_lines
from benchmarks.codesign_study import (
    CASES,
    LINES,
    WIDE,
    Kept,
    architecture_of,
    kept,
    restored,
    scenes_of,
)
from codesign.batches.scenes import TEST
from codesign.eye.dataset import read_shard
from codesign.network import blur
from codesign.train import assess
from metalens.ground import store
from metalens.ground.arrays import Array

RESULTS = Path(__file__).parent / "results"
NOISES = 2, 5  # streams of the sensor's noise that the same frames are read with
FOLDS, RIDGE = 8, 1e-3  # of pairs; of a feature's variance
TURNS = 12  # principal components of depths and landmarks whose products are read too


@dataclass(frozen=True, slots=True)
class Parts:
    """Axial errors of a run in mm; rms but for the first.

    mean_abs_mm, rms_mm: of the network. noise_mm: what another draw of the sensor's
    noise changes. person_mm: what both
    frames of a person share. window_mm: of a window's depth. together_mm: of the mean
    depth of a frame's windows.
    together_share: of the axial variance, explained by it. told_mm: of the slippage
    from the true depths of the windows
    and landmarks. shared_mm: of the same from depths that err together as the network's
    do, and in nothing else.
    """

    mean_abs_mm: float
    rms_mm: float
    noise_mm: float
    person_mm: float
    window_mm: float
    together_mm: float
    together_share: float
    told_mm: float
    shared_mm: float


def of_errors(axial_mm: Array, depth_mm: Array) -> dict[str, float]:
    """The parts that errors alone tell.

    Args:
        axial_mm: (noises, frames) errors of the slippage, two frames a person.
            depth_mm: (frames, windows) errors of
            the windows under the first noise.
    """
    first, second = axial_mm[:2]
    together = depth_mm.mean(1)
    return {
        "mean_abs_mm": float(np.abs(first).mean()),
        "rms_mm": rms(first),
        "noise_mm": rms(first - second) / 2**0.5,
        "person_mm": float(max(np.cov(first[::2], first[1::2])[0, 1], 0.0) ** 0.5),
        "window_mm": rms(depth_mm),
        "together_mm": rms(together),
        "together_share": float(np.corrcoef(together, first)[0, 1] ** 2),
    }


def left_open(told: Array, truth: Array) -> Array:
    """(frames,) errors of ridge regression on what is told and on products of its
    principal components.

    Every pair of frames is read by the fit of the other folds' pairs.

    Args:
        told: (frames, numbers). truth: (frames,).
    """
    unit = (told - told.mean(0)) / (told.std(0) + 1e-12)
    turned = unit @ np.linalg.svd(unit, full_matrices=False)[2].T[:, :TURNS]
    products = np.einsum("ni,nj->nij", turned, turned)[
        :, *np.triu_indices(turned.shape[1])
    ]
    seen = np.concatenate(
        [unit, products / (products.std(0) + 1e-12), np.ones((len(unit), 1))], 1
    )
    fold, errors = np.arange(len(truth)) // 2 % FOLDS, np.empty(len(truth))
    for number in range(FOLDS):
        mine = fold == number
        rest = seen[~mine]
        normal = rest.T @ rest + RIDGE * len(rest) * np.eye(rest.shape[1])
        errors[mine] = (
            seen[mine] @ np.linalg.solve(normal, rest.T @ truth[~mine]) - truth[mine]
        )
    return errors


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True, eq=False, slots=True)
class Asked:
    """Test frames as the sensor gave them, once a noise, and where their landmarks lie
    (:func:`_landmarks`).
    """

    seen: list[assess.Seen]
    places: Array


def asked(work: Path, line: dict[str, Any]) -> Asked:
    """Through the lens of a run: of every run of a case whose lens stands."""
    case, test = CASES[line["run"].split("/")[0]], kept(work, "ambiguous", WIDE)
    trainer = restored(work, line, test)
    seen = [
        assess.frames(trainer, replace(test, stream=noise), WIDE // case.batch)
        for noise in NOISES
    ]
    return Asked(seen, _landmarks(work, test))


def parts(work: Path, line: dict[str, Any], given: Asked) -> Parts:
    """Of a run whose line and weights are kept."""
    trainer = restored(work, line, scenes_of(TEST))
    architecture = architecture_of(CASES[line["run"].split("/")[0]])
    answers = [
        assess.predict(trainer.model.net, architecture, seen, trainer.inner)
        for seen in given.seen
    ]
    axial = np.stack(
        [
            (a.slip_mm - s.slip_mm)[:, 2].numpy()
            for a, s in zip(answers, given.seen, strict=True)
        ]
    )
    told, vergence = answers[0].depth, given.seen[0].vergence
    if told is None or vergence is None:
        raise SystemExit(
            f"{line['run']} reads no depth of windows: need a case with the branch that sees blur"
        )
    right = vergence.flatten(1).double().numpy()
    depth = (
        (blur.depth_mm(told[:, 0]) - blur.depth_mm(vergence))
        .flatten(1)
        .double()
        .numpy()
    )
    together = (told[:, 0] - vergence).mean((1, 2)).double().numpy()
    truth = given.seen[0].slip_mm[:, 2].double().numpy()
    exact, erring = (
        left_open(np.c_[v, given.places], truth)
        for v in (right, right + together[:, None])
    )
    return Parts(**of_errors(axial, depth), told_mm=rms(exact), shared_mm=rms(erring))


def _landmarks(work: Path, test: Kept) -> Array:
    """(frames, numbers) places of the landmarks as a fraction of the image; those
    beyond it at its edge.
    """
    labels = read_shard(work / f"ambiguous_{WIDE}.h5")[2]
    size = int(test.mask.shape[-1])
    middle = size / 2 + test.margin - 0.5
    return np.asarray(
        ((labels["landmarks_px"] - middle) / size).clamp(-0.5, 0.5).flatten(1).double()
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = kept_lines(options.work / LINES)
    lines = [
        n
        for n in lines
        if (
            n["run"] in options.only
            if options.only
            else n["run"].startswith("p18blur/")
        )
    ]
    rows, given = [], dict[Any, Asked]()
    for line in sorted(lines, key=lambda n: str(n["run"])):
        lens = line["run"].split("/")[0], tuple(line["coefficients_rad"])
        if lens not in given:
            given = {lens: asked(options.work, line)}
        found = asdict(parts(options.work, line, given[lens]))
        rows.append(
            {"run": line["run"]}
            | {name: round(value, 4) for name, value in found.items()}
        )
        print(json.dumps(rows[-1]), flush=True)
    path = RESULTS / "codesign_parts.json"
    known = {row["run"]: row for row in (*json.loads(path.read_text("utf-8")), *rows)}
    store.write_text(
        path, json.dumps([known[run] for run in sorted(known)], indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
