"""Captures -> MTF, Strehl, spot sizes, distortion; an edge -> MTF; a micrograph ->
every diameter and a bias table.
"""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from characterize.captures import capture as captures
from characterize.commands import measure_page
from characterize.measure import frames, metrics, overlay, picture, sem
from metalens import lens as lenses
from metalens.cell.shapes import Circle
from metalens.commands import CommonOptions, Output
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, ConfigError
from metalens.lens import DiameterMap


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens measure``: a micrograph or an edge where its pixel is
    given, else captures.

    Attributes:
        source: capture folder or stack; or one picture of pillars from above (TIFF,
            PNG), with --pixel-nm or --bar-nm;
            or one of a straight edge tilted by 2 to 20 degrees, with --edge-um.
        output: folder to write: measure.json, a table of frames or pillars, a page; of
            a micrograph that clearly lies
            in one place of a design the bias table of PROCESS.toml too.
        design: lens.h5: aperture for the Strehl ratio; the drawn diameters for a
            micrograph.
        reference_e: electrons of the beam through an empty aperture of the lens's size,
            for the focusing efficiency.
        edge_um: pixel of a picture of a slanted edge, on the sensor: the modulation
            transfer across it (ISO 12233).
        pixel_nm: size of a micrograph's pixel; by default that of the instrument's
            tag, where a TIFF of Zeiss or FEI has one.
        bar_nm: length of a micrograph's white scale bar, where the pixel is unknown.
        pitch_nm: distance of neighbouring pillars; found in the picture without it.
        edge_bias_nm: by which edges appear outside the true ones, from a calibration
            sample.
        crop: rows and columns of the picture to look at (top, bottom, left, right), to
            leave out what is no pillar
            (a strip of writing below the picture is left out by itself).
    """

    source: tyro.conf.Positional[Path]
    output: Output
    design: Path | None = None
    reference_e: float = math.nan
    edge_um: float | None = None
    pixel_nm: float | None = None
    bar_nm: float | None = None
    pitch_nm: float = 0.0
    edge_bias_nm: float = 0.0
    crop: tuple[int, int, int, int] | None = None


def run(options: Options) -> int:
    """Measure and write; exit 0, or 1 where no pillar could be measured or most sites
    hold no round pillar.

    Args:
        options: options of the command.
    """
    if options.pixel_nm is None and options.bar_nm is None and options.edge_um is None:
        options = dataclasses.replace(
            options, pixel_nm=sem.instrument_pixel_nm(options.source)
        )
    is_micrograph = options.pixel_nm is not None or options.bar_nm is not None
    if is_micrograph and options.edge_um is not None:
        raise ConfigError(
            "give --edge-um (a slanted edge), or --pixel-nm or --bar-nm (pillars), not both"
        )
    if options.edge_um is not None and not 0 < options.edge_um < math.inf:
        raise ConfigError(f"--edge-um {options.edge_um}: need the pixel in um, above 0")
    measure = (
        _micrograph if is_micrograph else _frames if options.edge_um is None else _edge
    )
    with options.claim_folder(options.output) as draft:
        values, text, failures = measure(options, draft.path)
    return options.console.judged(values, text, failures)


def _frames(options: Options, folder: Path) -> tuple[dict[str, object], str, list[str]]:
    """Measure captures and write frames.csv, measure.json and measure.html into the
    folder.

    Returns:
        Numbers for JSON, text for the console, no failures.
    """
    capture = captures.load(options.source)
    design = lenses.load(options.design) if options.design else None
    quality = frames.measure_frames(
        capture, design=design, reference_e=options.reference_e
    )
    rows = [_frame_row(row) for row in quality.frames]
    values: dict[str, object] = {
        "frames": rows,
        "best_depth": _by_field(quality.best_depth_um, "depth_um"),
        "distortion": _by_field(quality.distortion, "distortion"),
        "notes": list(quality.notes),
    }
    store.write_text(folder / "frames.csv", _table(rows))
    store.write_text(folder / "measure.json", _json(values))
    measure_page.frames_page(folder / "measure.html", quality)
    lines = [f"{options.output}: {len(rows)} frames"]
    lines += [
        f"  {r.name}: FWHM {r.spot.fwhm_um:.3g} um, EE80 {r.spot.ee80_um:.3g} um, MTF50 {r.mtf50_x_per_um:.3g} / "
        f"{r.mtf50_y_per_um:.3g} per um, Strehl {r.strehl:.3f}"
        for r in quality.frames
    ]
    lines += [
        f"  sharpest at {x:g}, {y:g} deg: {z:.5g} um"
        for (x, y), z in quality.best_depth_um.items()
    ]
    lines += [
        f"  distortion at {x:g}, {y:g} deg: {d:+.3%}"
        for (x, y), d in quality.distortion.items()
    ]
    lines += [f"  note: {words}" for words in quality.notes]
    return values, "\n".join(lines), []


def _by_field(values: dict[frames.Field, float], name: str) -> list[dict[str, float]]:
    """Records of both field angles in degrees and a value under ``name``."""
    return [
        {"angle_deg": x, "angle_y_deg": y, name: value}
        for (x, y), value in values.items()
    ]


def _edge(options: Options, folder: Path) -> tuple[dict[str, object], str, list[str]]:
    """Measure the MTF across an edge and write edge.csv, measure.json and measure.html
    into the folder.

    Returns:
        Numbers for JSON, text for the console, no failures.
    """
    image = _cropped(picture.read_picture(options.source), options.crop)
    pixel = float(options.edge_um or 0)
    mtf = metrics.mtf_of_edge(image, pixel_um=pixel)
    curve = np.stack([mtf.frequency_per_um, mtf.modulation], 1)
    keep = mtf.frequency_per_um <= 1 / pixel
    values: dict[str, object] = {
        "mtf50_per_um": mtf.mtf50_per_um,
        "nyquist_per_um": 0.5 / pixel,
        "pixel_um": pixel,
    }
    rows: list[dict[str, object]] = [
        {"frequency_per_um": f, "modulation": m}
        for f, m in curve[keep].round(6).tolist()
    ]
    store.write_text(folder / "edge.csv", _table(rows))
    store.write_text(folder / "measure.json", _json(values))
    measure_page.edge_page(folder / "measure.html", image, mtf, pixel_um=pixel)
    text = f"{options.output}: modulation one half at {mtf.mtf50_per_um:.4g} per um (Nyquist {0.5 / pixel:.4g})"
    return values, text, []


def _micrograph(
    options: Options, folder: Path
) -> tuple[dict[str, object], str, list[str]]:
    """Measure the pillars of a micrograph and write pillars.csv, measure.json,
    measure.html and, where it is certain, bias.toml into the folder.

    Returns:
        Numbers for JSON, text for the console, failures.
    """
    whole = picture.read_picture(options.source)
    pixel = options.pixel_nm or sem.scale_from_bar(whole, float(options.bar_nm or 0))
    image = (
        _cropped(whole, options.crop) if options.crop else picture.without_strip(whole)
    )
    pillars = sem.measure_diameters(
        image, sem.SemMicrograph(pixel, options.pitch_nm, options.edge_bias_nm)
    )
    on_mask: overlay.MaskOverlay | None = None
    table: overlay.Table = []
    scale = 1.0
    if options.design is not None:
        design = _round_design(options.design)
        on_mask = overlay.overlay_design(pillars, design)
        scale = overlay.lattice_scale(pillars, pixel, design)
        is_certain = (
            on_mask.clearly and abs(scale - 1) < overlay.SCALE
        )  # another place or scale has other drawn diameters
        table = overlay.bias_table(on_mask) if is_certain else []
        pillars = overlay.register_to_mask(pillars, on_mask)
    values = _summary(pillars, on_mask, table, pixel) | (
        {"pitch_over_design": scale} if on_mask is not None else {}
    )
    store.write_text(folder / "pillars.csv", _table(_pillars(pillars, on_mask)))
    store.write_text(folder / "measure.json", _json(values))
    if table:
        pairs = ", ".join(f"[{drawn:.3f}, {bias:.3f}]" for drawn, bias, *_ in table)
        store.write_text(folder / "bias.toml", f"[bias]\ntable_nm = [{pairs}]\n")
    measure_page.micrograph_page(
        folder / "measure.html", image, pillars, on_mask, table, pixel_nm=pixel
    )
    lines = [
        _pillars_text(pillars, on_mask, table, options.output),
        *_scale_text(scale, pixel),
    ]
    if not options.crop and len(image) < len(whole):
        lines.append(
            f"  {len(whole) - len(image)} rows of writing below the picture left out; --crop says otherwise"
        )
    if table and not options.edge_bias_nm:
        lines.append(
            "  edges as they appear: without --edge-bias-nm the table's mean holds what the microscope adds"
        )
    return values, "\n".join(lines), _unmeasured(pillars, pixel)


def _unmeasured(pillars: sem.MeasuredDiameters, pixel_nm: float) -> list[str]:
    """Failures of a micrograph in words: most sites without a round pillar, or no
    diameter; empty otherwise.
    """
    if float((pillars.collapsed | pillars.oval).mean()) > sem.MOST:
        return [
            f"most sites hold no round pillar: is the lattice of {pillars.lattice.pitch_px * pixel_nm:.4g} nm right? "
            "--pitch-nm states it (tops may be dark, but rims must stand out from the ground by more than noise and "
            "blur leave)"
        ]
    return (
        []
        if np.isfinite(pillars.diameter_nm).any()
        else ["no pillar could be measured"]
    )


def _round_design(path: Path) -> DiameterMap:
    """Diameters drawn on the mask of a lens file; refuses pillars that are not round."""
    design = lenses.load(path)
    if not isinstance(design.cell.shape, Circle) or design.cell.shape.hole:
        raise CaptureError(
            f"{path}: {design.cell.described}; --design takes round pillars, whose diameter is measured"
        )
    return design.diameters


def _cropped(image: Array, crop: tuple[int, int, int, int] | None) -> Array:
    """The picture cut to (top, bottom, left, right) pixels; whole without ``crop``."""
    if crop is None:
        return image
    top, bottom, left, right = crop
    part = image[top:bottom, left:right]
    if min(part.shape) < 20:
        raise ConfigError(
            f"crop {crop} of a picture of {image.shape} leaves {part.shape}; need 20 pixels or more"
        )
    return part


def _summary(
    pillars: sem.MeasuredDiameters,
    on_mask: overlay.MaskOverlay | None,
    table: overlay.Table,
    pixel: float,
) -> dict[str, object]:
    """Numbers of a micrograph for measure.json: counts by state, lattice, mean and 3
    sigma of the diameters in nm; place on the mask and bias table with a design.
    """
    values: dict[str, object] = {
        "pillars": len(pillars.diameter_nm),
        "missing": int(pillars.missing.sum()),
        "collapsed": int(pillars.collapsed.sum()),
        "oval": int(pillars.oval.sum()),
        "lattice": pillars.lattice.kind,
        "pixel_nm": pixel,
        "pitch_nm": pillars.lattice.pitch_px * pixel,
        "mean_nm": pillars.mean_nm,
        "three_sigma_nm": pillars.three_sigma_nm,
    }
    if on_mask is not None:
        values |= {
            "mask_row": on_mask.row,
            "mask_column": on_mask.column,
            "place_is_clear": on_mask.clearly,
            "outliers": int(on_mask.outlier.sum()),
            "bias_nm": [list(row) for row in table],
        }
    return values


def _pillars(
    pillars: sem.MeasuredDiameters, on_mask: overlay.MaskOverlay | None
) -> list[dict[str, object]]:
    """One record a pillar for pillars.csv: site, place in pixels, diameter and standard
    error in nm, state; drawn diameter and error with a design.
    """
    state = np.full(len(pillars.row), "good", dtype=object)
    for word in ("oval", "collapsed", "missing"):
        state[getattr(pillars, word)] = word
    columns: dict[str, Array] = {
        "site_row": pillars.site[:, 0],
        "site_column": pillars.site[:, 1],
        "row_px": pillars.row.round(3),
        "column_px": pillars.column.round(3),
        "diameter_nm": pillars.diameter_nm.round(3),
        "sigma_nm": pillars.sigma_nm.round(3),
        "state": state,
    }
    if on_mask is not None:
        columns |= {
            "designed_nm": on_mask.designed_nm.round(3),
            "error_nm": on_mask.error_nm.round(3),
            "outlier": on_mask.outlier,
        }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def _pillars_text(
    pillars: sem.MeasuredDiameters,
    on_mask: overlay.MaskOverlay | None,
    table: overlay.Table,
    target: Path,
) -> str:
    """Text for the console: counts by state, mean diameter, place on the mask, bias
    table.
    """
    missing = int(pillars.missing.sum())
    collapsed = int(pillars.collapsed.sum())
    lines = [
        f"{target}: {len(pillars.diameter_nm)} sites of a {pillars.lattice.kind} lattice, {missing} missing, "
        f"{collapsed} collapsed; mean {pillars.mean_nm:.2f} nm, 3 sigma {pillars.three_sigma_nm:.2f} nm"
    ]
    if pillars.oval.any():
        lines.append(
            f"  {int(pillars.oval.sum())} are oval, longer than wide by more than 15 %: not measured"
        )
    if on_mask is not None:
        unsure = " (not clear: other places fit nearly as well; no bias table; take a wider picture)"
        lines.append(
            f"  on the mask from row {on_mask.row}, column {on_mask.column}{'' if on_mask.clearly else unsure}"
        )
        lines += [
            f"  drawn {d:7.2f} nm: {b:+.2f} +- {s:.2f} nm ({n} pillars)"
            for d, b, s, n in table
        ]
    return "\n".join(lines)


def _scale_text(scale: float, pixel_nm: float) -> list[str]:
    """Advice where the lattice constants of picture and mask differ by more than
    :data:`overlay.SCALE`; empty otherwise.
    """
    if abs(scale - 1) < overlay.SCALE:
        return []
    return [
        f"  the lattice is {scale - 1:+.2%} off the mask's, and so are all diameters: no bias table; if the mask was "
        f"written true to scale, measure again with --pixel-nm {pixel_nm / scale:.5g}"
    ]


def _frame_row(row: frames.FrameMetrics) -> dict[str, object]:
    """Metrics of a frame as one flat record."""
    values: dict[str, object] = dataclasses.asdict(row)
    del values["spot"]
    spot: dict[str, object] = dataclasses.asdict(row.spot)
    del spot["d4sigma_um"], spot["centroid_um"]
    (major, minor), (cx, cy) = row.spot.d4sigma_um, row.spot.centroid_um
    widths = {"d4sigma_major_um": major, "d4sigma_minor_um": minor}
    return values | spot | widths | {"centroid_x_um": cx, "centroid_y_um": cy}


def _json(values: dict[str, object]) -> str:
    return json.dumps(values, indent=1, default=float) + "\n"


def _table(rows: Sequence[dict[str, object]]) -> str:
    """CSV text of records with equal keys."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
