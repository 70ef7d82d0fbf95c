"""Pictures of a mask for its report: the whole die, single pillars, diameters, margins."""

from typing import Any

import numpy as np

from layout.drc import DrcReport
from layout.formats import DxfWindow, sites_in
from layout.mask import MaskPlan, PillarLattice
from layout.verify import ExposureReport
from metalens.core import report
from metalens.core.arrays import Array

_FILLED = ("marks", "label")


def whole_die(plan: MaskPlan, found: DrcReport) -> bytes:
    """Everything on the die; each lattice as the share of the area that its pillars
    cover; violations as crosses.
    """
    figure, axes = report.make_figure(size=(7.2, 6.6))
    axes.grid(False)
    images = [_thumbnail(plan, lattice) for lattice in plan.lattices]
    low, high = (
        float(f([f(image[np.isfinite(image)], initial=50) for image in images]))
        for f in (np.min, np.max)
    )
    shown = None
    for lattice, image in zip(plan.lattices, images, strict=True):
        shown = axes.imshow(
            image,
            extent=_extent(plan, lattice),
            vmin=low,
            vmax=high,
            cmap="viridis",
            interpolation="nearest",
        )
    _draw_figures(axes, plan)
    if found.violations:
        x, y = (
            np.array([violation.centre for violation in found.violations]).T
            * plan.unit_nm
            * 1e-3
        )
        axes.plot(x, y, "x", color="red", ms=4, mew=1, label="violations")
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, 1.09),
            ncols=6,
            frameon=False,
            fontsize=8,
        )
    reach = (
        max((float(np.abs(p).max()) for p in _polygons(plan)), default=0.0)
        * plan.unit_nm
        * 1e-3
    )
    reach = 1.03 * (reach or max(map(abs, _extent(plan, plan.lattices[0]))))
    axes.set(
        xlim=(-reach, reach),
        ylim=(-reach, reach),
        aspect="equal",
        xlabel="x / µm",
        ylabel="y / µm",
    )
    if shown is not None:
        figure.colorbar(shown, ax=axes, label="area that pillars cover / %", shrink=0.8)
    return report.figure_png(figure)


def plot_pillars(plan: MaskPlan, windows: tuple[DxfWindow, ...]) -> bytes:
    """The drawn polygons in some windows."""
    from matplotlib.collections import PolyCollection

    figure, axes = report.make_figure(
        1, len(windows), size=(4.0 * len(windows), 4.0), squeeze=False
    )
    scale = plan.unit_nm * 1e-3
    low, high = (f(made.diameter_nm for made in plan.classes) for f in (min, max))
    for ax, window in zip(axes[0], windows, strict=True):
        shapes, sizes = [], []
        for k, x, y in (
            site
            for lattice in plan.lattices
            for site in sites_in(plan, lattice, window)
        ):
            for corners in plan.classes[k - 1].polygons:
                shapes.append((corners + np.array([x, y])) * scale)
                sizes.append(plan.classes[k - 1].diameter_nm)
        drawn = PolyCollection(
            shapes,
            array=np.array(sizes),
            cmap="viridis",
            edgecolors="#222",
            linewidths=0.4,
        )
        drawn.set_clim(low, high)
        ax.grid(False)
        ax.add_collection(drawn)
        half = window.size_um / 2
        ax.set(
            xlim=(window.x_um - half, window.x_um + half),
            ylim=(window.y_um - half, window.y_um + half),
        )
        ax.set(aspect="equal", xlabel="x / µm", ylabel="y / µm")
        ax.set_title(f"{window.size_um:g} µm at ({window.x_um:.6g}, {window.y_um:.6g})")
    return report.figure_png(figure)


def plot_diameters(plan: MaskPlan) -> bytes:
    """How many pillars of each drawn diameter the lens has."""
    lattice = plan.lattices[0]
    counts = np.zeros(len(plan.classes) + 1, np.int64)
    for _, block in lattice.blocks(max(1, (1 << 22) // lattice.columns)):
        counts += np.bincount(block.ravel(), minlength=len(counts))
    sizes = np.array([made.diameter_nm for made in plan.classes])
    merged, where = np.unique(sizes[counts[1:] > 0], return_inverse=True)
    total = np.bincount(where, counts[1:][counts[1:] > 0])
    figure, axes = report.make_figure(size=(7.6, 2.9))
    step = float(np.diff(merged).min()) if len(merged) > 1 else 1.0
    axes.bar(merged, total / 1e3, width=0.9 * step)
    axes.set(xlabel="drawn diameter / nm", ylabel="pillars / 1000")
    axes.set_title(
        f"{int(total.sum()):,} pillars of the lens in {len(merged)} diameters"
    )
    return report.figure_png(figure)


def plot_margins(found: DrcReport) -> bytes:
    """Each rule: what was found beside what is allowed."""
    rows = [
        ("space / nm", found.minimum_space_nm, found.limits["space"], True),
        ("width / nm", found.minimum_width_nm, found.limits["width"], True),
        (
            "density / %",
            100 * found.maximum_density,
            100 * found.limits["density"],
            False,
        ),
    ]
    figure, axes = report.make_figure(1, 3, size=(8.2, 1.9))
    for ax, (name, value, limit, at_least) in zip(axes, rows, strict=True):
        shown = value if np.isfinite(value) else 0.0
        good = value >= limit if at_least else value <= limit
        end = 1.25 * max(shown, limit, 1e-9)
        ax.axvspan(
            *((0, limit) if at_least else (limit, end)), color="#d1495b", alpha=0.15
        )
        ax.barh([0], [shown], height=0.45, color="#2a9d8f" if good else "#d1495b")
        ax.axvline(limit, color="#444", lw=1.2)
        label = f"{value:.1f}" if np.isfinite(value) else "none"
        ax.set(xlim=(0, end), ylim=(-0.6, 0.6), yticks=[])
        ax.set_title(
            f"{name}: {label}, {'at least' if at_least else 'at most'} {limit:g}"
        )
    return report.figure_png(figure)


def plot_verification(found: ExposureReport) -> bytes:
    """Where the diameters in the resist differ from the drawn ones, and how often by
    how much.
    """
    figure, (at_left, at_right) = report.make_figure(1, 2, size=(8.2, 3.6))
    left, bottom, right, top = found.box_um
    shown = at_left.imshow(
        found.map_nm, origin="lower", extent=(left, right, bottom, top), cmap="coolwarm"
    )
    at_left.grid(False)
    at_left.set(xlabel="x / µm", ylabel="y / µm", title="mean over a picture point")
    figure.colorbar(shown, ax=at_left, label="resist - drawn / nm", shrink=0.8)
    edges, pillars = found.histogram
    at_right.stairs(pillars, edges, fill=True)
    at_right.set(xlabel="resist - drawn diameter / nm", ylabel="pillars", yscale="log")
    return report.figure_png(figure)


def edge_window(plan: MaskPlan, size_um: float) -> DxfWindow:
    """A window at the rim of the lens, on the +x axis."""
    lattice = plan.lattices[0]
    middle = lattice.source(lattice.rows // 2, lattice.rows // 2 + 1)[0]
    last = int(np.flatnonzero(middle)[-1]) if middle.any() else lattice.columns // 2
    x = (lattice.x0 + last * lattice.pitch) * plan.unit_nm * 1e-3
    return DxfWindow(x - size_um / 3, 0.0, size_um)


def _thumbnail(plan: MaskPlan, lattice: PillarLattice, most: int = 700) -> Array:
    """Share of the area that pillars cover, averaged over squares of sites: what a
    microscope that coarse would see.

    (rows, columns) in per cent, NaN where there is no pillar. Every n-th pillar would
    show rings that are not there.
    """
    step = max(1, -(-max(lattice.rows, lattice.columns) // most))
    areas = np.array([0.0, *(made.twice_area / 2 for made in plan.classes)])
    table = 100 * areas / (lattice.pitch * lattice.down)
    edges = np.arange(0, lattice.columns, step)
    rows = []
    for first in range(0, lattice.rows, step):
        block = table[lattice.source(first, min(first + step, lattice.rows))]
        sites = len(block) * np.diff(np.r_[edges, lattice.columns])
        rows.append(np.add.reduceat(block.sum(0), edges) / sites)
    covered = np.array(rows)
    return np.where(covered > 0, covered, np.nan)


def _extent(
    plan: MaskPlan, lattice: PillarLattice
) -> tuple[float, float, float, float]:
    scale = plan.unit_nm * 1e-3
    left, top = lattice.x0 - lattice.pitch / 2, lattice.y0 + lattice.down / 2
    right, bottom = (
        left + lattice.columns * lattice.pitch,
        top - lattice.rows * lattice.down,
    )
    return left * scale, right * scale, bottom * scale, top * scale


def _polygons(plan: MaskPlan) -> list[Array]:
    return [
        p
        for figure in plan.figures
        for shapes in figure.polygons.values()
        for p in shapes
    ]


def _draw_figures(axes: Any, plan: MaskPlan) -> None:
    from matplotlib.collections import PolyCollection

    scale = plan.unit_nm * 1e-3
    edges = ("#d1495b", "#355070", "#1f6feb", "#888", "#2a9d8f")
    layers = sorted({layer[0] for figure in plan.figures for layer in figure.polygons})
    for n, layer in enumerate(layers):  # all doses of a layer number together
        drawn = [
            (one, p)
            for figure in plan.figures
            for one, ps in figure.polygons.items()
            for p in ps
        ]
        shapes = [p * scale for one, p in drawn if one[0] == layer]
        first = min(one for one, _ in drawn if one[0] == layer)
        name = plan.layer_names.get(first, f"layer {layer}").split("_dose_")[0]
        colour = edges[n % len(edges)]
        fill, edge = (colour, "none") if name in _FILLED else ("none", colour)
        axes.add_collection(
            PolyCollection(shapes, facecolors=fill, edgecolors=edge, linewidths=0.8)
        )
        axes.plot([], [], color=colour, label=f"{name} {layer}")
    if layers:
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, 1.09),
            ncols=5,
            frameon=False,
            fontsize=8,
        )
