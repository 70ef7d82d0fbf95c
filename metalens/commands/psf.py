"""lens.h5 or asbuilt.h5 to psf.h5: PSFs over depth, field angle and wavelength to a
stated error, with plots.

An interruption leaves what stood at the output; the same command begins anew.
"""

import importlib
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import tyro

from metalens import design, lens, psf
from metalens.cell import describe_order_loss
from metalens.commands import far_field
from metalens.commands.common import Common, MaybeOutput
from metalens.commands.psf_settings import Settings, read
from metalens.ground import config, reading, store, transaction
from metalens.ground.errors import ConfigError
from metalens.ground.report import Figure, KeyFigure, Section, Table, write
from metalens.ground.store import Provenance, write_bytes
from metalens.psf import export as psf_export

# by kind of file, the module whose ``load`` gives a :class:`Built`; filled by the
# command line
SOURCES: dict[str, str] = {}
CAPTIONS = {
    "xz": "Slice through the PSF along depth, centre row of the window, each depth at its own full scale.",
    "montage": "PSFs over depth (across) and field angle (down); square root of intensity.",
    "mtf": "Modulation transfer along x (thick) and y (thin), and the share of the window's light inside a circle.",
    "information": "I(z) of Eq. 11 under two normalisations and three binnings; the normalisation decides the ranking.",
}
BUDGET_WORDS = (
    "What computation and model are wrong by, each alone, the worst over angles: the terms of the model are those "
    "of a perfect lens of the same aperture."
)


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens psf``.

    Attributes:
        lens: lens.h5, or asbuilt.h5 for the lens that was made (its process and wave
            front included).
        output: the file to write, psf.h5 if left out: .h5 (which all other commands
            read), .tif, .mat or .fits;
            plots are written beside it as NAME_xz.png and so on.
        config: PSF.toml with any of the settings below, own_cell, [[layers.front]] and
            [[layers.behind]]. What follows
            stands in place of the file's.
        depths_mm: nearest and farthest source, and the largest step between depths;
            left out: 21 depths about the
            focus of this lens, to 1.75 waves out of focus.
        sources_mm: the depth of every source, in place of depths_mm; inf for a plane
            wave.
        angles_deg: field angles along x; the image of a positive angle lies at +x.
        angles_y_deg: field angles along y (down), one for each of angles_deg.
        window_um: full width along x of the window about the chief ray; left out: what
            the blur of this lens needs.
        samples: samples along the window's width.
        height_um: height of the window, of samples as far apart; 0 for a square.
        offset_um: x and y from the chief ray to the window's middle.
        source_um: full size of a source that is no point (diameter, side, or width at
            half maximum).
        source_deg: the same as an angle; for sources at infinity too.
        source_shape: disc, square or gaussian.
        led_fwhm_nm: width of the diode about the design wavelength, silicon's response
            included.
        spectrum: CSV files of wavelength in nm and value, whose product is the spectrum
            (LED, filter, sensor).
        wavelengths_nm: wavelengths whose intensities add.
        weights: of those wavelengths; left out: equal.
        polarisation: scalar, flux, vector or auto.
        light: of pillars of two sizes: polarised along x, along y, or both together.
        tolerance: relative L2 error.
        far_field: in place of PSFs, the light far behind the lens over direction
            cosines, with the share of every beam
            (deflectors, holograms, axicons): far_field.h5, NAME_far.png. Takes
            sources_mm (one; left out, a plane
            wave), angles_deg, angles_y_deg, wavelengths_nm (one) and samples (squares
            across all directions).
        report: also write NAME.html.
    """

    lens: tyro.conf.Positional[Path]
    output: MaybeOutput = None
    config: Path | None = None
    depths_mm: tuple[float, float, float] | None = None
    sources_mm: tuple[float, ...] | None = field(
        default=None, metadata={"may_be_inf": True}
    )
    angles_deg: tuple[float, ...] | None = None
    angles_y_deg: tuple[float, ...] | None = None
    window_um: float | None = None
    samples: int | None = None
    height_um: float | None = None
    offset_um: tuple[float, float] | None = None
    source_um: float | None = None
    source_deg: float | None = None
    source_shape: psf.SourceShape | None = None
    led_fwhm_nm: float | None = None
    spectrum: tuple[Path, ...] | None = None
    wavelengths_nm: tuple[float, ...] | None = None
    weights: tuple[float, ...] | None = None
    polarisation: psf.Polarisation | None = None
    light: Literal["both", "x", "y"] | None = None
    tolerance: float | None = None
    far_field: bool = False
    report: bool = False

    @property
    def settings(self) -> Settings:
        """Those of the file with the options in their place."""
        table: dict[str, Any] = {}
        for name in Settings.__slots__:
            value = getattr(self, name, None)
            if isinstance(value, tuple):
                value = [str(v) if isinstance(v, Path) else v for v in value]
            table[name] = value
        return read(self.config, table)


def run(options: Options) -> int:
    """Compute, write, draw; exit 1 where the error estimate stays above the tolerance
    or pillars are hardly known.
    """
    if options.far_field:
        return _far(options)
    target, settings = options.output or Path("psf.h5"), options.settings
    psf_export.check(target)
    made, built = _read(options.lens)
    made = made if settings.layers is None else replace(made, layers=settings.layers)
    settings = settings.about(made)
    view = settings.view
    pixels = (
        len(view.depths_um)
        * len(view.angles_rad)
        * settings.samples
        * settings.samples_y
    )
    ends = (*(f"_{name}.png" for name in CAPTIONS), ".html")
    with options.claim(
        target, beside=ends, room=transaction.ROOM + 4 * pixels
    ) as draft:
        stack = _make(options, settings, made, built, draft.path)
    counts = (
        ("angle", stack.angles_rad),
        ("depth", stack.depths_um),
        ("wavelength", stack.weights),
    )
    shape = " x ".join(
        f"{len(all_of)} {name}{'s' * (len(all_of) != 1)}" for name, all_of in counts
    )
    text = f"{target}: {shape}, relative error {stack.error:.2g} ({stack.reason})\n  {_budget(stack).text}"
    text += describe_order_loss(made.cell, float(stack.wavelengths_um.min()))
    above = f"the relative error {stack.error:.2g} is above the tolerance {stack.tolerance:g}: {_budget(stack).cure}"
    failures = ["" if stack.converged else above, made.proxy.doubt]
    return options.console.judged(
        _summary(stack) | {"doubt": made.proxy.doubt}, text, failures
    )


def _far(options: Options) -> int:
    """Compute, write, draw the far field of a design."""
    target = options.output or Path("far_field.h5")
    if target.suffix.lower() != ".h5":
        raise ConfigError(f"{target}: a far field is written as .h5")
    kind = store.kind_of(options.lens)
    if kind in SOURCES:
        raise ConfigError(
            f"{options.lens}: the far field of a design (lens.h5), not of a file of kind {kind}"
        )
    made = lens.load(options.lens)
    wanted, inputs = (
        far_field.asked(options, made),
        {options.lens.name: reading.sha256(options.lens)},
    )
    with options.claim(
        target,
        beside=("_far.png", ".html"),
        room=transaction.ROOM + 4 * wanted.samples**2,
    ) as draft:
        found = far_field.compute(made, wanted, options.console)
        far_field.save(draft.path, wanted, found, inputs=inputs, page=options.report)
    options.console.result(
        far_field.values(wanted, found), far_field.text(target, wanted, found)
    )
    return 0


class Built(Protocol):
    """A lens that was made, with the PSFs of what was made."""

    @property
    def design(self) -> lens.Lens:
        """What was to be made."""

    def psf_stack(self, view: "psf.View", *, tolerance: float) -> psf.PsfStack:
        """PSFs (angle, depth, y, x)."""


def _read(path: Path) -> tuple[lens.Lens, Built | None]:
    """The design of a file, and what was made of it where the file is of another kind
    that the command line knows.
    """
    kind = store.kind_of(path)
    if kind not in SOURCES:
        return lens.load(path), None
    found: Built = importlib.import_module(SOURCES[kind]).load(path)
    return found.design, found


def _make(
    options: Options,
    settings: Settings,
    made: lens.Lens,
    built: Built | None,
    path: Path,
) -> psf.PsfStack:
    """Compute, write, draw."""
    from metalens.psf import plots as psf_plots

    stack = (
        _of_design(options.lens, settings, made)
        if built is None
        else _of_made(options.lens, settings, built)
    )
    psf_export.write(path, stack)
    pictures = psf_plots.pictures(stack)
    for name, image in pictures.items():
        write_bytes(path.with_name(f"{path.stem}_{name}.png"), image)
    if options.report:
        _report(path.with_suffix(".html"), stack, pictures)
    return stack


def _of_made(path: Path, settings: Settings, given: Built) -> psf.PsfStack:
    """PSFs of a kind of file that the command line knows a source for."""
    for name in ("led_fwhm_nm", "spectrum", "wavelengths_nm", "layers", "own_cell"):
        if getattr(settings, name):
            raise ConfigError(
                f"{path}: {name} is for a design; this {store.kind_of(path)} file has the wavelength and layers that "
                "were fitted"
            )
    if settings.polarisation in ("flux", "vector"):
        words = f"polarisation = {settings.polarisation!r} is for a design; a {store.kind_of(path)} file is one scalar"
        raise ConfigError(f"{path}: {words}")
    found = given.psf_stack(settings.view, tolerance=settings.tolerance)
    return replace(found, provenance=_provenance(path, settings))


def _of_design(path: Path, settings: Settings, made: lens.Lens) -> psf.PsfStack:
    """PSFs of a lens file, for the polarisation that is asked for."""
    if (
        settings.light != "both"
        and made.pairs is None
        and made.one_light != f"light along {settings.light}"
    ):
        known = (
            f"know {made.one_light} alone" if made.one_light else "treat x and y alike"
        )
        known = "are turned, for circular light" if made.hand else known
        raise ConfigError(
            f"{path}: light = {settings.light!r} is for pillars of two sizes; these {known}"
        )
    provenance = _provenance(path, settings)
    if made.pairs is None:
        return _from_lens(made, settings, provenance)
    if settings.light != "both":
        return _from_lens(made.seen(settings.light), settings, provenance)
    x, y = made.seen("x"), made.seen("y")
    if (x.sensor_distance_um, x.source_distance_um) != (
        y.sensor_distance_um,
        y.source_distance_um,
    ):
        raise ConfigError(
            "light along x and y is focused at other distances by this lens: give light = 'x' or 'y'"
        )
    return psf.unpolarised(*(_from_lens(one, settings, provenance) for one in (x, y)))


def _from_lens(
    made: lens.Lens, settings: Settings, provenance: Provenance
) -> psf.PsfStack:
    found = _own_cell(made, settings) if settings.own_cell else None
    if found is not None and isinstance(found.neighbours, lens.Neighbours):
        made = replace(made, neighbours=found.neighbours)
    return psf.from_lens(
        made,
        settings.view,
        tolerance=settings.tolerance,
        spectrum=settings.spectrum_of(made),
        provenance=provenance,
        polarisation=settings.polarisation,
        left_out=found,
    )


def _provenance(path: Path, settings: Settings) -> Provenance:
    files = [path, *(file for file in settings.spectrum if file.is_file())]
    return Provenance(
        config.dumps(settings), {file.name: reading.sha256(file) for file in files}
    )


def _own_cell(made: lens.Lens, settings: Settings) -> psf.LeftOut:
    """Neighbours and angle of the lens's own pillars, at the largest aperture and angle
    of the view.
    """
    apertures = [psf.aperture(made, angle) for angle in settings.view.angles_rad]
    incidence = max(
        float(np.arctan(np.hypot(*np.tan(angle)))) for angle in settings.view.angles_rad
    )
    return design.left_out(made, aperture=max(apertures), incidence_rad=incidence)


def _summary(stack: psf.PsfStack) -> dict[str, object]:
    return {
        "error": stack.error,
        "budget": {
            name: None if math.isnan(v) else v
            for name, v in asdict(_budget(stack)).items()
        },
        "tolerance": stack.tolerance,
        "converged": stack.converged,
        "reason": stack.reason,
        "depths_um": [
            None if math.isinf(depth) else depth for depth in stack.depths_um.tolist()
        ],
        "angles_rad": stack.angles_rad.tolist(),
        "wavelengths_um": stack.wavelengths_um.tolist(),
    }


def _budget(stack: psf.PsfStack) -> psf.Budget:
    return stack.budget or psf.Budget(stack.error)


def _budget_table(stack: psf.PsfStack) -> Table:
    found = _budget(stack)
    rows = [
        [name, "not known" if math.isnan(v) else f"{v:.2g}"]
        for name, v in asdict(found).items()
    ]
    rows += [
        ["computed", f"{found.computed:.2g}"],
        ["of the device", f"{found.total:.2g}"],
    ]
    return Table(
        ("cause", "relative L2"),
        rows,
        "The tolerance is about what is computed; outside is a share of light.",
    )


def _key_figures(stack: psf.PsfStack) -> list[KeyFigure]:
    """What was computed, how well, and what the model leaves out of it."""
    found, shape = (
        _budget(stack),
        (len(stack.angles_rad), len(stack.depths_um), len(stack.wavelengths_um)),
    )
    counted = " × ".join(map(str, shape))
    figures = [
        KeyFigure("field angles × depths × wavelengths", counted),
        KeyFigure(
            "relative error of what is computed", f"{stack.error:.2g}", stack.converged
        ),
        KeyFigure("with what the model leaves out", f"{found.total:.2g}"),
    ]
    known = not math.isnan(found.outside)
    return figures + (
        [KeyFigure("of the light falls beside the window", f"{found.outside:.2g}")]
        if known
        else []
    )


def _report(path: Path, stack: psf.PsfStack, pictures: dict[str, bytes]) -> None:
    """One page with all pictures and the energies."""
    energy = np.asarray(stack.energy_um2)
    rows = [
        [f"{x:.3g}", f"{y:.3g}", float(e.min()), float(e.max())]
        for (x, y), e in zip(np.rad2deg(stack.angles_rad), energy, strict=True)
    ]
    table = Table(
        ("x / deg", "y / deg", "least", "most"),
        rows,
        "Light in the window for unit irradiance, µm², over depth.",
    )
    figures = [
        Figure(image, CAPTIONS[name], wide=True) for name, image in pictures.items()
    ]
    write(
        path,
        "Point spread functions",
        [
            Section("Pictures", items=figures),
            Section("Error by cause", BUDGET_WORDS, [_budget_table(stack)]),
            Section("Energy", f"Method: {stack.reason}.", [table]),
        ],
        key_figures=_key_figures(stack),
    )
