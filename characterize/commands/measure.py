"""Captures -> MTF, Strehl, spot sizes, distortion; an edge -> MTF; a micrograph ->
every diameter and a bias table.
"""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
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
from metalens.core.report import format_summary

STATES = ("oval", "collapsed", "missing")  # of pillars that are not measured
Outcome = tuple[dict[str, object], list[str], list[str]]  # values, lines, failures


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
        pitch_nm: distance of neighbouring pillars; from the picture without it.
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
        values, lines, failures = measure(options, draft.path)
    return options.console.judged(values, "\n".join(lines), failures)


def _frames(options: Options, folder: Path) -> Outcome:
    """Measure captures and write frames.csv, measure.json and measure.html into the
    folder.
    """
    capture = captures.load(options.source)
    design = lenses.load(options.design) if options.design else None
    quality = frames.measure_frames(
        capture, design=design, reference_e=options.reference_e
    )
    rows = [dataclasses.asdict(row) for row in quality.frames]
    values: dict[str, object] = {"frames": rows}
    for key, name, column in (
        ("best_depth", "depth_um", quality.best_depth_um),
        ("distortion", "distortion", quality.distortion),
    ):
        values[key] = [
            {"angle_deg": x, "angle_y_deg": y, name: value}
            for (x, y), value in column.items()
        ]
    values["notes"] = list(quality.notes)
    _write_tables(folder, "frames.csv", rows, values)
    measure_page.frames_page(folder / "measure.html", quality, rows)
    lines = [f"{options.output}: {len(rows)} frames"]
    lines += [
        f"  {r.name}: FWHM {r.fwhm_um:.3g} um, EE80 {r.ee80_um:.3g} um, "
        f"MTF50 {r.mtf50_x_per_um:.3g} / {r.mtf50_y_per_um:.3g} per um, "
        f"Strehl {r.strehl:.3f}"
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
    return values, lines, []


def _edge(options: Options, folder: Path) -> Outcome:
    """Measure the MTF across an edge and write edge.csv, measure.json and measure.html
    into the folder.
    """
    image = picture.crop_picture(picture.read_picture(options.source), options.crop)
    pixel = float(options.edge_um or 0)
    mtf = metrics.mtf_of_edge(image, pixel_um=pixel)
    curve = np.stack([mtf.frequency_per_um, mtf.modulation], 1).round(6)
    rows = [{"frequency_per_um": f, "modulation": m} for f, m in curve.tolist()]
    values: dict[str, object] = {
        "mtf50_per_um": mtf.mtf50_per_um,
        "nyquist_per_um": 0.5 / pixel,
        "pixel_um": pixel,
    }
    _write_tables(folder, "edge.csv", rows, values)
    measure_page.edge_page(folder / "measure.html", image, mtf, pixel_um=pixel)
    return values, [f"{options.output}: slanted edge", *format_summary(values)], []


def _micrograph(options: Options, folder: Path) -> Outcome:
    """Measure the pillars of a micrograph and write pillars.csv, measure.json,
    measure.html and, where it is certain, bias.toml into the folder.
    """
    whole = picture.read_picture(options.source)
    pixel = options.pixel_nm or sem.scale_from_bar(whole, float(options.bar_nm or 0))
    image = (
        picture.crop_picture(whole, options.crop)
        if options.crop
        else picture.without_strip(whole)
    )
    pillars = sem.measure_diameters(
        image, sem.SemMicrograph(pixel, options.pitch_nm, options.edge_bias_nm)
    )
    values: dict[str, object] = {
        "pillars": len(pillars.diameter_nm),
        **{state: int(getattr(pillars, state).sum()) for state in STATES},
        "lattice": pillars.lattice.kind,
        "pixel_nm": pixel,
        "pitch_nm": pillars.lattice.pitch_px * pixel,
        "mean_nm": pillars.mean_nm,
        "three_sigma_nm": pillars.three_sigma_nm,
    }
    on_mask: overlay.MaskOverlay | None = None
    table: overlay.Table = []
    notes: list[str] = []
    if options.design is not None:
        on_mask, scale = _place_on_mask(options.design, pillars, pixel, notes)
        # another place or scale has other drawn diameters
        table = [] if notes else overlay.bias_table(on_mask)
        pillars = dataclasses.replace(pillars, site=on_mask.site)
        values |= {
            "mask_row": on_mask.row,
            "mask_column": on_mask.column,
            "place_is_clear": on_mask.clearly,
            "outliers": int(on_mask.outlier.sum()),
            "pitch_over_design": scale,
        }
    if not options.crop and len(image) < len(whole):
        notes.append(
            f"{len(whole) - len(image)} rows of writing below the picture left out; "
            "--crop says otherwise"
        )
    if table and not options.edge_bias_nm:
        notes.append(
            "edges as they appear: without --edge-bias-nm the table's mean holds what "
            "the microscope adds"
        )
    lines = [f"{options.output}: micrograph", *format_summary(values)]
    lines += [
        f"  drawn {d:7.2f} nm: {b:+.2f} +- {s:.2f} nm ({n} pillars)"
        for d, b, s, n in table
    ]
    if on_mask:
        values["bias_nm"] = [list(row) for row in table]
    _write_tables(folder, "pillars.csv", _pillars(pillars, on_mask), values)
    if table:
        pairs = ", ".join(f"[{drawn:.3f}, {bias:.3f}]" for drawn, bias, *_ in table)
        store.write_text(folder / "bias.toml", f"[bias]\ntable_nm = [{pairs}]\n")
    measure_page.micrograph_page(
        folder / "measure.html", image, pillars, on_mask, table, pixel_nm=pixel
    )
    failures = []
    if float((pillars.collapsed | pillars.oval).mean()) > sem.MOST:
        failures.append(
            "most sites hold no round pillar: is the lattice of "
            f"{pillars.lattice.pitch_px * pixel:.4g} nm right? --pitch-nm states it "
            "(tops may be dark, but rims must stand out from the ground by more than "
            "noise and blur leave)"
        )
    elif not np.isfinite(pillars.diameter_nm).any():
        failures.append("no pillar could be measured")
    return values, [*lines, *(f"  {note}" for note in notes)], failures


def _place_on_mask(
    path: Path, pillars: sem.MeasuredDiameters, pixel_nm: float, notes: list[str]
) -> tuple[overlay.MaskOverlay, float]:
    """(pillars on the mask of a lens file, lattice constant over that of the mask);
    appends to ``notes`` why there is no bias table.
    """
    design = lenses.load(path)
    if not isinstance(design.cell.shape, Circle) or design.cell.shape.hole:
        raise CaptureError(
            f"{path}: {design.cell.described}; --design takes round pillars, whose "
            "diameter is measured"
        )
    on_mask = overlay.overlay_design(pillars, design.diameters)
    scale = overlay.lattice_scale(pillars, pixel_nm, design.diameters)
    if not on_mask.clearly:
        notes.append(
            "other places on the mask fit nearly as well: no bias table; take a wider "
            "picture"
        )
    if abs(scale - 1) >= overlay.SCALE:
        notes.append(
            f"the lattice is {scale - 1:+.2%} off the mask's, and so are all "
            "diameters: no bias table; if the mask was written true to scale, measure "
            f"again with --pixel-nm {pixel_nm / scale:.5g}"
        )
    return on_mask, scale


def _pillars(
    pillars: sem.MeasuredDiameters, on_mask: overlay.MaskOverlay | None
) -> list[dict[str, object]]:
    """One record a pillar for pillars.csv: site, place in pixels, diameter and standard
    error in nm, state; drawn diameter and error with a design.
    """
    state = np.full(len(pillars.row), "good", dtype=object)
    for word in STATES:
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


def _write_tables(
    folder: Path,
    name: str,
    rows: Sequence[Mapping[str, object]],
    values: Mapping[str, object],
) -> None:
    """Write records of equal keys as a CSV file, and the result as measure.json."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    store.write_text(folder / name, text.getvalue())
    result = json.dumps(values, indent=1, default=float) + "\n"
    store.write_text(folder / "measure.json", result)
