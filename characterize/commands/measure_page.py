"""Pages of ``metalens measure``: frames with their numbers, and a micrograph with every
pillar drawn on it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from characterize.measure import frames, metrics, overlay, sem
from metalens.core import report
from metalens.core.arrays import Array

CURVES = "Modulation transfer along x up to the pixel's Nyquist frequency, and light within a radius; one line a frame."
_NAMED = 8  # lines that a legend holds


def frames_page(
    path: Path, quality: frames.CaptureQuality, rows: Sequence[Mapping[str, object]]
) -> None:
    """Write the page of captures: numbers of every frame, curves of MTF and encircled
    energy, field curvature, distortion.

    Args:
        path: the page to write.
        quality: quality of the frames.
        rows: numbers of every frame; columns without one are left out.
    """
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    stated = {
        report.in_words(key): column
        for key, column in columns.items()
        if any(value == value for value in column)  # not nan
    }
    sections = [
        report.Section(
            "Frames",
            "",
            [report.Table(tuple(stated), list(zip(*stated.values(), strict=True)))],
        ),
        report.Section(
            "Curves", "", [report.Figure(_curves(quality), CURVES, wide=True)]
        ),
    ]
    for title, column, values in (
        ("Field curvature", "depth of the sharpest frame / µm", quality.best_depth_um),
        ("Distortion", "distortion", quality.distortion),
    ):
        if values:
            head = ("angle along x / deg", "angle along y / deg", column)
            by_field = [(x, y, value) for (x, y), value in values.items()]
            sections.append(report.Section(title, "", [report.Table(head, by_field)]))
    sections.append(
        report.Section("Put right or assumed on the way", "\n\n".join(quality.notes))
    )
    report.write_report(path, "Image quality of the captures", sections)


def _curves(quality: frames.CaptureQuality) -> bytes:
    """PNG of two panels: MTF along x over spatial frequency, and encircled energy over
    the radius, one line a frame.
    """
    figure, (mtf, energy) = report.make_figure(1, 2)
    radius = np.linspace(0, min(quality.light.shape[1:]) / 2 * quality.step_um, 60)
    for row, image in zip(quality.frames, quality.light, strict=True):
        curve = metrics.mtf_of_psf(image, step_um=quality.step_um)
        keep = curve.frequency_per_um <= 0.5 / quality.step_um
        mtf.plot(curve.frequency_per_um[keep], curve.modulation[keep], linewidth=0.8)
        energy.plot(
            radius,
            metrics.encircled_energy(image, step_um=quality.step_um, radius_um=radius),
            label=row.name,
        )
    mtf.set_xlabel("cycles / µm")
    mtf.set_ylabel("modulation along x")
    energy.set_xlabel("radius / µm")
    energy.set_ylabel("share of the light")
    if len(quality.frames) <= _NAMED:
        energy.legend(fontsize=7)
    return report.figure_png(figure)


def edge_page(
    path: Path, image: Array, edge_mtf: metrics.EdgeMtf, *, pixel_um: float
) -> None:
    """Write the page of a slanted edge: the picture and the MTF across it.

    Args:
        path: the page to write.
        image: (y, x) picture.
        edge_mtf: modulation across the edge.
        pixel_um: pitch of the pixels, um.
    """
    figure, (picture, curve) = report.make_figure(1, 2)
    picture.imshow(image, cmap="gray")
    picture.set_axis_off()
    curve.plot(edge_mtf.frequency_per_um, edge_mtf.modulation)
    curve.axvline(0.5 / pixel_um, color="0.6", linestyle=":")
    curve.set_xlabel("cycles / µm")
    curve.set_ylabel("modulation")
    caption = f"Modulation one half at {edge_mtf.mtf50_per_um:.4g} cycles per µm; dotted: Nyquist's frequency of the pixels."
    report.write_report(
        path,
        "Slanted edge",
        [
            report.Section(
                "Edge", "", [report.Figure(report.figure_png(figure), caption)]
            )
        ],
    )


def micrograph_page(
    path: Path,
    image: Array,
    measured: sem.MeasuredDiameters,
    overlay_fit: overlay.MaskOverlay | None,
    table: overlay.Table,
    *,
    pixel_nm: float,
) -> None:
    """Write the page of a micrograph: the picture with a circle on every pillar,
    coloured by its error, and the bias table.

    Args:
        path: the page to write.
        image: (y, x) picture.
        measured: measured pillars.
        overlay_fit: the micrograph's pillars on the mask.
        pixel_nm: size of a pixel, nm.
    """
    caption = "Circles: measured edges, coloured by the error against the design (diameter where there is none); "
    caption += "crosses: missing; squares: collapsed; thick: outliers."
    sections = [
        report.Section(
            "Pillars",
            "",
            [
                report.Figure(
                    _pillars_figure(image, measured, overlay_fit, pixel_nm),
                    caption,
                    wide=True,
                )
            ],
        )
    ]
    if table:
        head = (
            "drawn / nm",
            "measured less drawn / nm",
            "standard error / nm",
            "pillars",
        )
        sections.append(
            report.Section(
                "Bias table", "", [report.Table(head, [tuple(row) for row in table])]
            )
        )
    report.write_report(path, "Diameters of the pillars", sections)


def _pillars_figure(
    image: Array,
    pillars: sem.MeasuredDiameters,
    on_mask: overlay.MaskOverlay | None,
    pixel_nm: float,
) -> bytes:
    """PNG of the micrograph with a circle on every good pillar, coloured by its error
    in nm (by its diameter without a design); missing and collapsed pillars are marked.
    """
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    figure, axis = report.make_figure(size=(6.5, 6.0))
    axis.imshow(image, cmap="gray")
    axis.set_axis_off()
    good = np.isfinite(pillars.diameter_nm)
    places = zip(
        pillars.column[good],
        pillars.row[good],
        pillars.diameter_nm[good] / (2 * pixel_nm),
        strict=True,
    )
    rings = PatchCollection(
        [Circle((x, y), radius) for x, y, radius in places],
        facecolors="none",
        cmap="coolwarm",
        linewidths=1.0 if on_mask is None else np.where(on_mask.outlier[good], 3, 1),
    )
    rings.set_array(
        (pillars.diameter_nm if on_mask is None else on_mask.error_nm)[good]
    )
    axis.add_collection(rings)
    for state, mark in (("missing", "x"), ("collapsed", "s")):
        chosen = getattr(pillars, state)
        axis.plot(
            pillars.column[chosen],
            pillars.row[chosen],
            mark,
            color="yellow",
            fillstyle="none",
        )
    label = "diameter / nm" if on_mask is None else "error / nm"
    figure.colorbar(rings, ax=axis, label=label, shrink=0.8)
    return report.figure_png(figure)
