"""lens.h5 -> error budget: every link of the chain as phase, PSF and gaze error, each
with how it was found.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference import asbuilt
from codesign.adapt import train as retraining
from codesign.budget import MEASURED, BudgetEntry, BudgetInputs, prepare_device
from codesign.budget import links as budget
from codesign.budget import page as budget_page
from codesign.commands.options.budget import Options
from codesign.optics import OpticsNumerics
from metalens import lens, library
from metalens.core import config, reading, store
from metalens.core.errors import ConfigError
from metalens.core.reading import typed_reader
from metalens.fabrication import of_process
from metalens.psf import Source, spectrum


def run(options: Options) -> int:
    """Compute, write, report; exit 1 where the error of the device's image is above its
    tolerance.
    """
    target = options.output
    if target.suffix != ".h5":
        raise ConfigError(f"{target}: need a name that ends in .h5")
    made, given = lens.load_plain(options.lens), _given(options)
    if given.fwhm_nm:
        spectrum.spectrum_points(
            Source(made.wavelength_um * 1e3, given.fwhm_nm)
        )  # refused now, not after the work
    with options.claim(target, beside=(".html", ".png")) as draft:
        origin = _provenance(options, given)
        about = prepare_device(made, given)
        links = budget.budget_entries(about)
        rows = list(options.console.track(links, total=19, label="links"))
        save_budget(draft.path, rows, origin)
        budget_page.write_budget_page(draft.path.with_suffix(".html"), rows)
        store.write_bytes(draft.path.with_suffix(".png"), budget_page.plot_budget(rows))
    values = {"rows": [dataclasses.asdict(row) for row in rows], **budget_summary(rows)}
    light = of_light(made)
    words = "\n".join(filter(None, [budget_text(rows), light]))
    return options.console.judged(_plain(values | {"light": light}), words, about.above)


def of_light(made: lens.Lens) -> str:
    """Of which light a budget is, where pillars of one size answer x and y apart; empty
    for others.
    """
    if not made.one_light:
        return ""
    return f"of {made.one_light}: these pillars ({made.cell.described}) answer x and y apart"


def budget_summary(rows: list[BudgetEntry]) -> dict[str, float]:
    """The sum, what was measured on the same frames and the ratio of the two, where a
    run was given.
    """
    found = {"gaze_error_deg": math.degrees(rows[-1].gaze_rad)}
    for row in rows:
        if row.link == MEASURED:
            found |= {
                "measured_deg": math.degrees(row.gaze_rad),
                "closure": rows[-1].gaze_rad / row.gaze_rad,
            }
    return found


def save_budget(
    path: Path, rows: list[BudgetEntry], provenance: store.Provenance
) -> None:
    """Write a budget file (kind ``budget``)."""
    numbers = {
        name: np.array([getattr(r, name) for r in rows])
        for name in ("phase_rad", "psf", "gaze_rad")
    }
    words = {
        name: np.array([getattr(r, name) for r in rows]) for name in ("link", "method")
    }
    counted = {"counted": np.array([r.counted for r in rows], np.uint8)}
    store.save(path, "budget", numbers | words | counted, provenance=provenance)


@typed_reader
def load_budget(path: Path) -> list[BudgetEntry]:
    """Read a budget file.

    Raises:
        StoreError: not a budget file.
    """
    arrays = store.load(path, "budget").arrays
    words = {
        n: [w.decode() if isinstance(w, bytes) else str(w) for w in arrays[n]]
        for n in ("link", "method")
    }
    counted = [bool(c) for c in arrays.get("counted", np.ones(len(words["link"])))]
    columns = (
        words["link"],
        *(arrays[n].tolist() for n in ("phase_rad", "psf", "gaze_rad")),
        words["method"],
        counted,
    )
    return [BudgetEntry(*row) for row in zip(*columns, strict=True)]


def budget_text(rows: list[BudgetEntry]) -> str:
    """The table for a terminal."""
    lines = [f"{'link':<30} {'phase/rad':>10} {'PSF':>9} {'gaze/deg':>10}  how"]
    for r in rows:
        numbers = [
            ("-" if math.isnan(v) else f"{v:.2g}")
            for v in (r.phase_rad, r.psf, math.degrees(r.gaze_rad))
        ]
        lines.append(
            f"{r.link:<30} {numbers[0]:>10} {numbers[1]:>9} {numbers[2]:>10}  {r.method}"
        )
    return "\n".join(lines)


def _given(options: Options) -> BudgetInputs:
    if options.led_fwhm_nm < 0:
        raise ConfigError(f"--led-fwhm-nm {options.led_fwhm_nm:g}: need 0 or more")
    wide = options.led_fwhm_nm > 0
    numerics = OpticsNumerics(
        options.depths,
        options.wavelengths if wide else 1,
        options.tolerance,
        options.kernels,
    )
    return BudgetInputs(
        numerics=numerics,
        fwhm_nm=options.led_fwhm_nm,
        mask=of_process(options.process) if options.process else None,
        library=library.load(options.library) if options.library else None,
        asbuilt=asbuilt.load(options.asbuilt) if options.asbuilt else None,
        run=retraining.load_finished_run(options.run) if options.run else None,
        frames=options.frames,
    )


def _provenance(options: Options, given: BudgetInputs) -> store.Provenance:
    weights = options.run / "checkpoint.safetensors" if options.run else None
    files = [options.lens, options.library, options.process, options.asbuilt, weights]
    return store.Provenance(
        config=config.dumps(given.numerics) + f"fwhm_nm = {given.fwhm_nm}\n",
        inputs={f.name: reading.sha256(f) for f in files if f is not None},
    )


def _plain(values: Any) -> Any:
    """JSON knows no nan: null."""
    if isinstance(values, dict):
        return {k: _plain(v) for k, v in values.items()}
    if isinstance(values, list):
        return [_plain(v) for v in values]
    return None if isinstance(values, float) and math.isnan(values) else values
