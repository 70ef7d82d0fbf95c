"""Tables and figures of the co-design study: paired bootstrap over test scenes and over
runs.

python -m benchmarks.codesign_report --work DIR                  # writes benchmarks/results and docs/codesign
python -m benchmarks.codesign_report --work DIR --only p18blur   # writes benchmarks/results/codesign_study_p18blur.json
"""

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import kept_lines
from benchmarks.codesign_study import BASELINES
from metalens.ground import report, store
from metalens.ground.arrays import Array

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
HEAD = """# Results of the study

Mean absolute error of the axial slippage on 512 test frames in 256 pairs that share a pupil position. The depth of
each frame is scaled to one that has nothing to do with its picture (by a factor within 1 +- 0.2); knowing nothing
scores 1.67 mm. Equal frames, network, noise and schedule for every lens.

- `hyperF`: hyperbolic, focused at F mm (20 is mid-range). `helixN`: double helix of N zones, focused at 20 mm.
  `obliqueF`: focused at F mm and free of aberrations at the field angle of its case.
- `jointF`, `swiftF`, `rushF`: trained with the network from `hyperF`, at three learning rates of the phase (0.02, 0.05
  and 0.15 rad). `swiftobliqueF`: from `obliqueF`.
- `p9`, `p18`: pixels of 9 and 18 um, 2000 electrons from white in 9 um. `p18long`: three times the frames. `p18dim`:
  100 electrons. `p9dim`: 400 electrons. `p9field`: 10 degrees off axis. `p18small`: `p18long` with half the width.
  `p18nvgaze`, `p18popovic`, `p18de2gaze`: `p18long` with the networks of those papers in place of ours. `p9wide`:
  networks of `p9` tested on four times as many frames. `p18blur`, `p18blurlong`: `p18` and `p18long` with the
  branch that reads blur and half the backbone's width, in steps of 8 frames that are each rendered anew (`p18blur16`:
  16); other cases: networks without the branch, and a pool of 4096 frames.

Ratios with 95 % intervals of a paired bootstrap over pairs of frames and over runs; with one seed, over frames alone.
The best focus is the fixed lens of one focus (`hyperF`, `obliqueF`) of least error on natural frames. Made by
`python -m benchmarks.codesign_study run --work DIR` and `python -m benchmarks.codesign_report --work DIR`.

![axial error of every run](study.png)

"""


@dataclass(frozen=True, eq=False, slots=True)
class Runs:
    """All runs of one lens under one set of conditions.

    lines: of the study, by seed. errors: {test: (seeds, frames, 3)} absolute slippage
    errors, mm.
    """

    lens: str
    lines: list[dict[str, Any]]
    errors: dict[str, Array]

    def axial(self, test: str = "ambiguous") -> Array:
        """(seeds, frames) mm."""
        return self.errors[test][..., 2]

    def slip(self) -> Array:
        """(seeds, frames) mm, mean over the three axes."""
        return np.asarray(self.errors["ambiguous"].mean(-1))

    def means(self) -> dict[str, Any]:
        """What every table says of the runs; no ``iou`` of a network that draws no
        mask.
        """
        iou, response = (
            float(np.mean([line[part][key] for line in self.lines]))
            for part, key in (("ambiguous", "iou"), ("depth_response", "mm_per_mm"))
        )
        return {
            "seeds": len(self.lines),
            "mmacs": self.lines[0]["mmacs"],
            "axial_mm": float(self.axial().mean()),
            "axial_by_seed_mm": [round(float(e), 4) for e in self.axial().mean(1)],
            "lateral_mm": float(self.errors["ambiguous"][..., :2].mean()),
            "iou": iou if iou == iou else None,
            "response_mm_per_mm": response,
        }


def load(work: Path) -> dict[str, dict[str, Runs]]:
    """{case: {lens: runs}} of the lines there are."""
    lines: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for line in kept_lines(work / "runs.jsonl"):
        if not line.get("skipped"):
            case, lens, _ = line["run"].split("/")
            lines[case, lens].append(line)
    found: dict[str, dict[str, Runs]] = defaultdict(dict)
    for (case, lens), mine in lines.items():
        mine.sort(key=lambda line: int(line["run"].rsplit("/", 1)[1]))
        kept = [
            np.load(work / (line["run"].replace("/", "-") + ".npz")) for line in mine
        ]
        errors = {
            test: np.stack([k[test] for k in kept]) for test in ("ambiguous", "natural")
        }
        found[case][lens] = Runs(lens, mine, errors)
    return found


def ratio(
    one: Array, other: Array, *, draws: int = 4000, seed: int = 0
) -> tuple[float, float, float]:
    """Ratio of mean errors with its 95 % interval; scenes (in pairs that share a pupil)
    and runs drawn anew.

    Scenes are the same for both lenses, so they are drawn together; so are runs, as far
    as both have the same seeds.

    Args:
        one, other: (seeds, frames), the same frames.
    """
    generator = np.random.default_rng(seed)
    both = min(len(one), len(other))
    one, other = one[:both], other[:both]
    a, b = (
        e.reshape(both, -1, 2).mean(-1) for e in (one, other)
    )  # pairs of frames are no two scenes
    values = np.empty(draws)
    for i in range(draws):
        runs = generator.integers(0, both, both)
        scenes = generator.integers(0, a.shape[1], a.shape[1])
        values[i] = a[runs][:, scenes].mean() / b[runs][:, scenes].mean()
    low, high = np.percentile(values, [2.5, 97.5])
    return float(one.mean() / other.mean()), float(low), float(high)


def best_focus(runs: dict[str, Runs]) -> str:
    """The fixed lens of one focus and least axial error on natural frames: the
    ambiguous ones do not choose it.
    """
    fixed = [name for name in runs if name.startswith(("hyper", "oblique"))]
    return min(fixed, key=lambda name: float(runs[name].axial("natural").mean()))


def summaries(runs: dict[str, Runs]) -> list[dict[str, Any]]:
    """One row a lens, least axial error first."""
    best, out = best_focus(runs), []
    for lens, mine in runs.items():
        row = {"lens": lens, "frames": mine.lines[0]["frames"], **mine.means()}
        row["slip_mm"] = float(mine.slip().mean())
        row["natural_axial_mm"] = float(mine.axial("natural").mean())
        for name, reference in (("mid_range", "hyper20"), ("best_focus", best)):
            if reference in runs and lens != reference:
                row[f"to_{name}"] = ratio(mine.axial(), runs[reference].axial())
        if lens != best:
            row["slip_to_best_focus"] = ratio(mine.slip(), runs[best].slip())
        out.append(row)
    return sorted(out, key=lambda row: float(row["axial_mm"]))


def table(
    found: dict[str, list[dict[str, Any]]], runs: dict[str, dict[str, Runs]]
) -> str:
    """Markdown."""
    parts = []
    for case, mine in found.items():
        best = best_focus(runs[case])
        references = {
            "to_mid_range": "hyper20",
            "to_best_focus": best,
            "slip_to_best_focus": best,
        }
        line = f"## {case}: {mine[0]['mmacs']:.1f} MMACs, {mine[0]['frames']} training frames a run, best focus: "
        parts.append(line + f"`{best}`\n")
        parts.append(
            "| lens | seeds | axial / mm | to mid-range (20 mm) | to best focus | lateral / mm | all axes, to best "
            "focus | IoU | mm per mm of PSF depth |\n|---|---|---|---|---|---|---|---|---|"
        )
        for row in mine:
            ratios = [
                "1" if row["lens"] == name else _interval(row.get(key))
                for key, name in references.items()
            ]
            parts.append(
                f"| {row['lens']} | {row['seeds']} | {row['axial_mm']:.3f} | {ratios[0]} | {ratios[1]} | "
                f"{row['lateral_mm']:.3f} | {ratios[2]} | {_share(row['iou'])} | {row['response_mm_per_mm']:.2f} |"
            )
        parts.append("")
    return "\n".join(parts)


def _share(value: float | None) -> str:
    return "no mask" if value is None else f"{value:.3f}"


def _interval(value: tuple[float, float, float] | None) -> str:
    return "-" if value is None else f"{value[0]:.3f} [{value[1]:.3f}, {value[2]:.3f}]"


def matched(
    runs: dict[str, dict[str, Runs]], *, small: str = "p18", large: str = "p9"
) -> dict[str, Any]:
    """The best trained lens before the small network against the mid-range lens before
    the large one.

    Slippage error: mean over the three axes. Both saw equally many frames; the test
    frames are the same.
    """
    trained = [
        r
        for name, r in runs[small].items()
        if name.startswith(("joint", "swift", "rush"))
    ]
    one, other = (
        min(trained, key=lambda r: float(r.errors["natural"].mean())),
        runs[large]["hyper20"],
    )
    share = one.lines[0]["mmacs"] / other.lines[0]["mmacs"]
    slips = [float(r.slip().mean()) for r in (one, other)]
    seeds = [len(r.lines) for r in (one, other)]
    against = ratio(one.slip(), other.slip())
    return {
        "lens": one.lens,
        "cases": [small, large],
        "macs": share,
        "seeds": seeds,
        "slip_mm": slips,
        "ratio": against,
    }


def matched_text(found: dict[str, Any]) -> str:
    """The same as a paragraph."""
    small, large = found["cases"]
    return (
        f"## Compute at matched slippage error\n\n`{found['lens']}` under `{small}` (seeds: {found['seeds'][0]}) has a "
        f"slippage error, mean of three axes, of {found['slip_mm'][0]:.3f} mm; the mid-range lens under `{large}` "
        f"(seeds: {found['seeds'][1]}) {found['slip_mm'][1]:.3f} mm: {_interval(found['ratio'])} of it at "
        f"{found['macs']:.2f} of the multiply-accumulates, after equally many frames.\n"
    )


def networks(
    runs: dict[str, dict[str, Runs]], *, lens: str = "hyper33"
) -> list[dict[str, Any]]:
    """Networks behind one fixed lens after equally many frames, against the elastic
    one.
    """
    ours = runs["p18long"][lens]
    cases = {"elastic": "p18long"} | {
        name: f"p18{name}" for name in BASELINES if lens in runs.get(f"p18{name}", {})
    }
    out = []
    for name, case in cases.items():
        mine = runs[case][lens]
        row = {"network": name, **mine.means()}
        out.append(
            row
            if name == "elastic"
            else row | {"to_elastic": ratio(mine.axial(), ours.axial())}
        )
    return out


def networks_text(rows: list[dict[str, Any]]) -> str:
    """The same as a table."""
    text = "## Networks behind one lens\n\nHyperbolic, focused at 33 mm, 18 um pixels, 76800 training frames, one "
    text += "learning rate for all. The bodies are those of the papers, sizes and heads ours.\n\n"
    text += "| network | seeds | MMACs | axial / mm | to ours | lateral / mm | IoU | mm per mm of PSF depth |\n"
    text += "|---|---|---|---|---|---|---|---|\n"
    for row in rows:
        text += f"| {row['network']} | {row['seeds']} | {row['mmacs']:.1f} | {row['axial_mm']:.3f} | "
        text += f"{_interval(row['to_elastic']) if 'to_elastic' in row else '1'} | {row['lateral_mm']:.3f} | "
        text += f"{_share(row['iou'])} | {row['response_mm_per_mm']:.2f} |\n"
    return text


def figure(found: dict[str, list[dict[str, Any]]]) -> bytes:
    """Axial error of every lens, a dot a seed."""
    rows = -(-len(found) // 4)
    canvas, _ = report.canvas(size=(18.0, 3.6 * rows))
    canvas.clear()
    for k, (case, mine) in enumerate(found.items()):
        axes = canvas.add_subplot(rows, 4, k + 1)
        for i, row in enumerate(mine):
            values = row["axial_by_seed_mm"]
            axes.plot(values, [i] * len(values), "o", alpha=0.5, color="C0")
            axes.plot([row["axial_mm"]], [i], "|", markersize=18, color="k")
        axes.set_yticks(range(len(mine)), [row["lens"] for row in mine])
        axes.set(xlabel="axial slippage error / mm (ambiguity set)", title=case)
        axes.set_xlim(
            0, 1.05 * max(max(row["axial_by_seed_mm"]) for row in mine) + 0.05
        )
        axes.invert_yaxis()
    return report.png(canvas)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument(
        "--only", nargs="*", default=None, help="cases; their JSON alone is written"
    )
    options = parser.parse_args()
    runs = load(options.work)
    if options.only:
        for case in options.only:
            rows = summaries(runs[case])
            store.write_text(
                RESULTS / f"codesign_study_{case}.json",
                json.dumps(rows, indent=1) + "\n",
            )
            print(table({case: rows}, runs))
        return
    found = {case: summaries(mine) for case, mine in runs.items() if len(mine) > 1}
    folder = ROOT / "docs" / "codesign"
    folder.mkdir(parents=True, exist_ok=True)
    content, kept = table(found, runs), dict[str, Any](found)
    if "p18" in runs and "hyper20" in runs.get("p9", {}):
        kept["matched"] = matched(runs)
        content += "\n" + matched_text(kept["matched"])
    if any(f"p18{name}" in runs for name in BASELINES):
        kept["networks"] = networks(runs)
        content += "\n" + networks_text(kept["networks"])
    store.write_text(RESULTS / "codesign_study.json", json.dumps(kept, indent=1) + "\n")
    store.write_text(folder / "results.md", HEAD + content)
    store.write_bytes(folder / "study.png", figure(found))
    print(content)


if __name__ == "__main__":
    main()
