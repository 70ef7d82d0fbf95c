"""The first picture of the README: ``python docs/site/tour.py DEMO docs/tour.png``.

DEMO is the folder of ``make demo``.
"""

import sys
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

INK = "#1f4e8c"


def draw_library(axes: Axes, demo: Path) -> None:
    with h5py.File(demo / "library.h5") as file:
        diameter_nm = file["diameter_um"][:] * 1e3
        t = file["t"][0, 0, 0]
        end_nm = file["proxy/domain_um"][1] * 1e3
    used = diameter_nm <= end_nm
    axes.plot(diameter_nm[used], np.unwrap(np.angle(t[used])) / (2 * np.pi), color=INK)
    axes.set(xlabel="diameter / nm", ylabel="phase / turns", title="meta-atom")


def draw_lens(axes: Axes, demo: Path) -> None:
    from metalens import lens

    made = lens.load(demo / "lens.h5")
    phase = made.phase_rad()[::8, ::8]
    edge_mm = 0.5 * phase.shape[1] * 8 * made.cell.pitch_um * 1e-3
    box = (-edge_mm, edge_mm, edge_mm, -edge_mm)
    axes.imshow(np.angle(np.exp(1j * phase)), cmap="twilight", extent=box)
    axes.set(xlabel="x / mm", title="lens: phase")


def draw_psfs(axes: Axes, demo: Path) -> None:
    with h5py.File(demo / "psf.h5") as file:
        stack, depths_um = file["intensity"][0], file["depths_um"][:]
    chosen = [0, len(depths_um) // 2, len(depths_um) - 1]
    middle = stack.shape[-1] // 2
    cut = slice(middle - 40, middle + 40)
    tiles = [np.sqrt(stack[i, cut, cut] / stack[i].max()) for i in chosen]
    axes.imshow(np.concatenate(tiles), cmap="viridis")
    for row, i in enumerate(chosen):
        axes.text(3, 80 * row + 12, f"{depths_um[i] / 1e3:.0f} mm", color="w", size=8)
    axes.set(xticks=[], yticks=[], title="PSFs over depth")


def draw_frame(axes: Axes, demo: Path) -> None:
    with h5py.File(demo / "run" / "answers.h5") as file:
        frame, pupil = file["frames"][1], file["predicted_pupil"][1, 1]
    axes.imshow(frame, cmap="gray")
    axes.contour(pupil, [0.5], colors="#ff9900", linewidths=1)
    axes.set(xticks=[], yticks=[], title="eye and pupil as read")


def draw_answers(axes: Axes, demo: Path) -> None:
    with h5py.File(demo / "run" / "answers.h5") as file:
        true_mm = file["slip_um"][:, 2] / 1e3
        read_mm = file["predicted_slip_um"][1, :, 2] / 1e3
        half_mm = file["interval_um"][1] / 1e3
    axes.errorbar(true_mm, read_mm, half_mm, fmt="o", color=INK, capsize=2, ms=4)
    span = [true_mm.min() - 0.5, true_mm.max() + 0.5]
    axes.plot(span, span, color="0.6", lw=1)
    axes.set(xlabel="true / mm", ylabel="read / mm", title="axial slippage, 90 %")


def main(demo: Path, out: Path) -> None:
    """Draw the five panels side by side."""
    panels = (draw_library, draw_lens, draw_psfs, draw_frame, draw_answers)
    widths = [1.2, 1.1, 0.4, 1.1, 1.2]
    figure, axes = plt.subplots(
        1, 5, figsize=(14, 3.0), layout="constrained", width_ratios=widths
    )
    for panel, one in zip(panels, axes, strict=True):
        panel(one, demo)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
