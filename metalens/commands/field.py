"""CELL.toml to field.h5: E and H in and around one pillar, on cuts along its axis and
across it, with a picture.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from metalens.cell import Cell, Incidence, Polarization
from metalens.commands.common import CommonOptions, Output
from metalens.commands.library import CellFile
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.report import figure_png, make_figure
from metalens.core.units import nm
from metalens.library import workers
from metalens.rcwa import FieldGrid, NearField, near_fields

CUTS = ("xz", "yz", "xy")
SOUGHT = 0.1  # relative error of a field that is aimed at without a tolerance
UNKNOWN = 0.5  # largest relative error of a field, and largest tolerance
MOST_SAMPLES = 400  # along the pitch


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens field``.

    Attributes:
        config: CELL.toml, of which [cell] and the first wavelength of [sweep] are
            taken.
        diameter_um: of the pillar (of other shapes their size).
        output: the file to write; NAME.png next to it.
        wavelength_nm: in vacuum; left out, the first of [sweep].
        angle_deg: of the light outside, in air.
        azimuth_deg: of the plane of incidence, from +x to +y.
        polarization: x or y: E along that axis; p or s: in the plane of incidence, or
            across it.
        heights_um: of the maps across the pillar, above its foot; left out, a quarter,
            half and three
            quarters of it.
        around_um: how far the cuts reach below and above pillar and films; left out,
            half a wavelength.
        samples: points along the pitch.
        tolerance: of the relative root-mean-square error of E over the points of a cut,
            up to 0.5; left out, 0.1 is
            sought, and what is reached is reported.
    """

    config: tyro.conf.Positional[Path]
    diameter_um: float
    output: Output = Path("field.h5")
    wavelength_nm: float | None = None
    angle_deg: float = 0.0
    azimuth_deg: float = 0.0
    polarization: Polarization = "x"
    heights_um: tuple[float, ...] | None = None
    around_um: float | None = None
    samples: int = 96
    tolerance: float | None = None


@dataclass(frozen=True, slots=True)
class NearFieldRequest:
    """What a field is computed for, kept in the file; see ``Options``."""

    cell: Cell
    diameter_um: float
    wavelength_um: float
    angle_deg: float
    azimuth_deg: float
    polarization: Polarization
    heights_um: tuple[float, ...]
    around_um: float
    samples: int
    tolerance: float

    @property
    def light(self) -> Incidence:
        """The plane wave."""
        angle_rad = math.radians(self.angle_deg)
        azimuth_rad = math.radians(self.azimuth_deg)
        return Incidence(self.wavelength_um, angle_rad, self.polarization, azimuth_rad)

    @property
    def step_um(self) -> float:
        """Spacing of the points."""
        return self.cell.pitch_um / self.samples

    def grids(self) -> list[FieldGrid]:
        """Grids of the cuts (x, z) at y = 0 and (y, z) at x = 0, and of the maps (x,
        y).

        Points are the middles of square pixels over a period. z is 0 at the foot of the
        pillar; the cuts reach ``around_um`` beyond pillar and films.
        """
        step = self.step_um
        x, y = (
            (np.arange(n) - (n - 1) / 2) * (period / n)
            for period in self.cell.lattice.periods_um(self.cell.pitch_um)
            for n in [max(2, round(period / step))]
        )
        over = sum(film.thickness_um for film in self.cell.over)
        low = -sum(film.thickness_um for film in self.cell.under) - self.around_um
        high = self.cell.height_um + over + self.around_um
        z = low + (np.arange(math.ceil((high - low) / step)) + 0.5) * step
        return [
            FieldGrid(x, [0.0], z),
            FieldGrid([0.0], y, z),
            FieldGrid(x, y, self.heights_um),
        ]


def near_field_request(options: Options) -> NearFieldRequest:
    """The request of the options, with what they leave out from CELL.toml.

    Defaults: the first wavelength of the sweep, maps at a quarter, half and three
    quarters of the height, and half a wavelength around pillar and films.

    Args:
        options: of the command line.

    Raises:
        ConfigError: samples, heights or lengths out of range.
    """
    settings = config.load(options.config, CellFile, empty=False)
    cell = settings.cell
    wavelength = (
        settings.sweep.wavelengths_um[0]
        if options.wavelength_nm is None
        else options.wavelength_nm / 1e3
    )
    around = wavelength / 2 if options.around_um is None else options.around_um
    quarters = tuple(part * cell.height_um for part in (0.25, 0.5, 0.75))
    heights = quarters if options.heights_um is None else options.heights_um
    if not 8 <= options.samples <= MOST_SAMPLES:
        raise ConfigError(
            f"samples = {options.samples}: need 8 to {MOST_SAMPLES} points along the pitch"
        )
    if not (
        0 <= around < 1e3
        and heights
        and all(math.isfinite(h) and abs(h) < 1e3 for h in heights)
    ):
        raise ConfigError(
            f"around_um = {around:g}, heights_um = {list(heights)}: need lengths below 1000 um, at least one height"
        )
    if options.tolerance is not None and not 0 < options.tolerance <= UNKNOWN:
        raise ConfigError(
            f"tolerance = {options.tolerance:g}: need an error above 0 and up to {UNKNOWN:g}"
        )
    return NearFieldRequest(
        cell,
        options.diameter_um,
        wavelength,
        options.angle_deg,
        options.azimuth_deg,
        options.polarization,
        tuple(heights),
        around,
        options.samples,
        SOUGHT if options.tolerance is None else options.tolerance,
    )


def run(options: Options) -> int:
    """Compute near fields, write and draw them.

    Exit status 1 where an error estimate stays above the stated tolerance, or above 0.5
    without one.

    Args:
        options: of the command line.
    """
    request = near_field_request(options)
    with options.claim(options.output, companions=(".png",)) as draft:
        fields = near_fields(
            request.cell,
            request.diameter_um,
            request.light,
            request.grids(),
            tolerance=request.tolerance,
        )
        files = (options.config, *workers.material_files(request.cell))
        save_near_field(
            draft.path,
            request,
            fields,
            {file.name: store.sha256(file) for file in files},
        )
        store.write_bytes(
            draft.path.with_suffix(".png"), near_field_picture(request, fields)
        )
    by_cut = dict(zip(CUTS, fields, strict=True))
    missed = ", ".join(name for name, cut in by_cut.items() if not cut.converged)
    text = (
        f"{missed} above the tolerance {request.tolerance:g} at {fields[0].orders} "
        "orders: allow a larger one; fields at edges converge slowly"
    )
    failed = any(cut.error > (options.tolerance or UNKNOWN) for cut in fields)
    return options.console.report(
        f"{options.output}: field of {request.cell.described}, "
        f"{request.wavelength_um / nm:g} nm",
        {
            "orders": fields[0].orders,
            "tolerance": request.tolerance,
            "cuts": {
                name: {"error": cut.error, "largest_magnitude": _largest(cut)}
                for name, cut in by_cut.items()
            },
        },
        notes=[text] if missed and not failed else [],
        failures=[text] if failed else [],
    )


def _largest(field: NearField) -> float:
    """Largest |E| of a field over that of the incident light."""
    return float(field_magnitude(field.e).max())


def field_magnitude(field: Array) -> Array:
    """(…) |E| = sqrt(|Ex|² + |Ey|² + |Ez|²).

    Args:
        field: (3, …) complex components.
    """
    return np.asarray(np.sqrt((np.abs(field) ** 2).sum(axis=0)))


def save_near_field(
    path: Path,
    request: NearFieldRequest,
    fields: list[NearField],
    inputs: dict[str, str],
) -> None:
    """Write the file of kind ``near-field``: E, H and index of both cuts and the maps.

    Cuts have shape (3, rows, columns), maps (3, height, y, x), the index no first axis.

    Args:
        path: file to write.
        request: the request, stored in the file.
        fields: fields on the cuts xz and yz, and on the maps.
        inputs: SHA-256 of each input file.
    """
    xz, yz, xy = fields
    arrays: dict[str, Array] = {
        "x_um": np.asarray(xz.grid.x_um),
        "y_um": np.asarray(yz.grid.y_um),
        "z_um": np.asarray(xz.grid.z_um),
    }
    arrays["heights_um"] = np.array(request.heights_um)
    for name, near, flat in (("xz", xz, -2), ("yz", yz, -1), ("xy", xy, None)):
        for part, field in (("e", near.e), ("h", near.h), ("index", near.index)):
            squeezed = field if flat is None else field.squeeze(axis=flat)
            arrays[f"{name}/{part}"] = squeezed
    about: dict[str, store.Attribute] = {
        "wavelength_um": request.wavelength_um,
        "step_um": request.step_um,
    }
    about |= {
        f"error_{name}": near.error for name, near in zip(CUTS, fields, strict=True)
    }
    provenance = store.Provenance(config.dumps(request), inputs)
    store.save(path, "near-field", arrays, attributes=about, provenance=provenance)


def near_field_picture(request: NearFieldRequest, fields: list[NearField]) -> bytes:
    """PNG of |E| on both cuts (light goes upwards) and on the maps, with material
    edges.

    Args:
        request: the request.
        fields: fields on the cuts xz and yz, and on the maps.
    """
    xz, yz, maps = fields
    x, y = maps.grid.x_um, maps.grid.y_um
    drawn: list[tuple[Any, ...]] = [
        ("y = 0", "xz", xz.grid.x_um, xz.grid.z_um, xz.e, xz.index),
        ("x = 0", "yz", yz.grid.y_um, yz.grid.z_um, yz.e, yz.index),
    ]
    for i, height in enumerate(request.heights_um):
        drawn.append((f"z = {height:.4g} µm", "xy", x, y, maps.e[:, i], maps.index[i]))
    figure, panels = make_figure(1, len(drawn), size=(3.2 * len(drawn), 3.8))
    top = max(_largest(near) for near in fields)
    for panel, (at, names, across, up, e, index) in zip(panels, drawn, strict=True):
        panel.grid(False)
        panel.set(
            title=f"|E| at {at}", xlabel=f"{names[0]} / µm", ylabel=f"{names[1]} / µm"
        )
        magnitude = field_magnitude(e).squeeze()
        image = panel.pcolormesh(across, up, magnitude, vmin=0, vmax=top, cmap="magma")
        panel.set_aspect("equal")
        n = index.squeeze().real
        levels = np.unique(n)
        if len(levels) > 1:
            middles = (levels[1:] + levels[:-1]) / 2
            panel.contour(across, up, n, levels=middles, colors="w", linewidths=0.7)
        if names == "xy":
            panel.invert_yaxis()
    figure.colorbar(image, ax=panels, label="|E| of the light that comes", shrink=0.6)
    return figure_png(figure)
