"""``metalens psf --far-field``: where the light of a lens goes over direction cosines,
the share of every beam.
"""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from metalens import lens, psf
from metalens.core import config, store
from metalens.core.errors import ConfigError
from metalens.core.report import (
    Figure,
    Section,
    figure_png,
    make_figure,
    summary_table,
    write_report,
)

if TYPE_CHECKING:
    from metalens.psf import FarField

TAKES = (
    "sources_mm",
    "angles_deg",
    "angles_y_deg",
    "wavelengths_nm",
    "samples",
    *("lens", "output", "far_field", "report", "quiet", "json", "force"),
)
CAPTION = "Light far behind the lens over direction cosines, +x right and +y down."


@dataclasses.dataclass(frozen=True, slots=True)
class FarFieldRequest:
    """What a far field is computed for; stored in the file.

    angles_deg: (x, y) of every direction of incidence. source_mm: inf for plane waves.
    wavelength_nm: in vacuum. samples: across the direction cosines.
    """

    angles_deg: tuple[tuple[float, float], ...]
    source_mm: float = dataclasses.field(metadata={"may_be_inf": True})
    wavelength_nm: float
    samples: int


def far_field_request(options: Any, built_lens: lens.Lens) -> FarFieldRequest:
    """The request of the options of ``metalens psf --far-field``.

    Args:
        options: of the command line.
        built_lens: the lens, whose wavelength is the default.

    Raises:
        ConfigError: an option that says nothing of a far field or is out of range, or
            more than one depth or wavelength.
    """
    for field in dataclasses.fields(options):
        stated = getattr(options, field.name) not in (None, False)
        if stated and field.name not in TAKES:
            raise ConfigError(
                f"{field.name}: not for a far field, which takes {', '.join(TAKES[:5])}"
            )
    settings = options.settings
    sources = settings.sources_mm or (math.inf,)
    waves = settings.wavelengths_nm or (1e3 * built_lens.wavelength_um,)
    along_x = settings.angles_deg or (0.0,)
    along_y = settings.angles_y_deg or (0.0,) * len(along_x)
    samples = 401 if options.samples is None else options.samples
    if len(sources) > 1 or len(waves) > 1 or not 3 <= samples <= 4001:
        raise ConfigError(
            f"sources_mm = {sources}, wavelengths_nm = {waves}, samples = {samples}: a "
            "far field takes one depth, one wavelength, and 3 to 4001 samples across"
        )
    angles = tuple(zip(along_x, along_y, strict=True))
    return FarFieldRequest(angles, sources[0], waves[0], samples)


def compute_far_fields(
    built_lens: lens.Lens, request: FarFieldRequest
) -> list["FarField"]:
    """One far field for each direction of incidence.

    Of pillars of two sizes for the polarisation along x.

    Args:
        built_lens: the lens.
        request: directions, source distance, wavelength and samples.
    """
    return [
        psf.far_field(
            built_lens,
            angle_rad=(math.radians(x), math.radians(y)),
            source_um=1e3 * request.source_mm,
            wavelength_um=1e-3 * request.wavelength_nm,
            samples=request.samples,
        )
        for x, y in request.angles_deg
    ]


def save_far_fields(
    path: Path,
    request: FarFieldRequest,
    fields: list["FarField"],
    *,
    inputs: dict[str, str],
    page: bool,
) -> None:
    """Write the file of kind ``far-field``, its picture, and with ``page`` its report.

    Args:
        path: file to write.
        request: the request, stored in the file.
        fields: far field of each direction.
        inputs: SHA-256 of each input file.
        page: whether to write NAME.html.
    """
    beams = [
        (i, b.sine_x, b.sine_y, b.share)
        for i, field in enumerate(fields)
        for b in field.beams
    ]
    arrays = {
        "share": np.stack([field.share for field in fields]).astype(np.float32),
        "sine": fields[0].sines,
        "rings": np.stack([field.rings for field in fields]),
        "angles_deg": np.array(request.angles_deg),
        "beams": np.array(beams, float).reshape(-1, 4),
        "beyond": np.array([field.beyond for field in fields]),
        "transmitted": np.array([field.transmitted for field in fields]),
    }
    about = {
        "wavelength_um": 1e-3 * request.wavelength_nm,
        "source_um": 1e3 * request.source_mm,
    }
    provenance = store.Provenance(config.dumps(request), inputs)
    store.save(
        path,
        "far-field",
        arrays,
        attributes=about | {"beam_sine": fields[0].beam_sine},
        provenance=provenance,
    )
    image = far_field_picture(request, fields)
    store.write_bytes(path.with_name(f"{path.stem}_far.png"), image)
    if page:
        sections = [
            Section("Directions", items=[Figure(image, CAPTION, wide=True)]),
            Section("Result", items=[summary_table(far_field_values(request, fields))]),
        ]
        write_report(path.with_suffix(".html"), "Far field", sections)


def far_field_values(
    request: FarFieldRequest, far_fields: list["FarField"]
) -> dict[str, Any]:
    """Result of the command as a dictionary for JSON.

    Args:
        request: the request.
        far_fields: far field of each direction.
    """
    fields = [
        {
            "angle_x_deg": x,
            "angle_y_deg": y,
            "transmitted": field.transmitted,
            "beyond": field.beyond,
            "within_deg": {
                f"{part:g}": math.degrees(math.asin(min(field.within_sine(part), 1.0)))
                for part in (0.5, 0.8, 0.95)
            },
            "beams": [
                dataclasses.asdict(beam)
                | {"angle_deg": beam.angle_deg, "azimuth_deg": beam.azimuth_deg}
                for beam in field.beams
            ],
        }
        for (x, y), field in zip(request.angles_deg, far_fields, strict=True)
    ]
    common = ("beam_sine", "beam_holds", "steepest")
    return {name: getattr(far_fields[0], name) for name in common} | {"fields": fields}


def far_field_picture(request: FarFieldRequest, fields: list["FarField"]) -> bytes:
    """PNG of the light over direction cosines (log scale).

    Args:
        request: the request.
        fields: far field of each direction.
    """
    from matplotlib.colors import LogNorm

    width = max(4.6, 3.6 * len(fields))
    figure, panels = make_figure(1, len(fields), size=(width, 4.4), squeeze=False)
    for panel, (x, y), field in zip(panels[0], request.angles_deg, fields, strict=True):
        edge = float(field.sines[-1] + (field.sines[1] - field.sines[0]) / 2)
        top = float(field.share.max())
        low = max(1e-6 * top, 1e-300)
        shown = panel.imshow(
            np.maximum(field.share, low),
            norm=LogNorm(low, top),
            extent=(-edge, edge, edge, -edge),
        )
        panel.grid(False)
        panel.set(
            title=f"from ({x:g}°, {y:g}°)", xlabel="sine along x", ylabel="sine along y"
        )
        figure.colorbar(
            shown, ax=panel, label="share of the light in a square", shrink=0.85
        )
    return figure_png(figure)
