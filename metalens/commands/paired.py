"""``metalens design`` with a library over two sizes: the second target, what both
lights see, and how it is said.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from metalens import design
from metalens.commands import design_words as words
from metalens.core import store
from metalens.core.errors import ConfigError
from metalens.design import (
    Cubic,
    DoubleHelix,
    Focus,
    FocusCheck,
    PhaseMap,
    PhaseOf,
    PolarizationMetrics,
)
from metalens.lens import Lens
from metalens.library import axes
from metalens.optics import Layers, check_gaps
from metalens.psf import FocusMetrics

BOTH: tuple[Literal["x", "y"], ...] = ("x", "y")


@dataclass(frozen=True, slots=True)
class YPolarizationTarget:
    """What light polarised along y is to see.

    profile: which phase. sensor_distance_mm, source_distance_mm: what is imaged onto
    what (inf for a collimated beam).
    double_helix, cubic, map: of the profile of that name.
    """

    profile: Literal["hyperbolic", "double-helix", "cubic", "map"] = "hyperbolic"
    sensor_distance_mm: float = field(default=2.0, metadata={"above": 0})
    source_distance_mm: float = field(
        default=20.0, metadata={"may_be_inf": True, "above": 0}
    )
    double_helix: DoubleHelix = field(default_factory=DoubleHelix)
    cubic: Cubic = field(default_factory=Cubic)
    map: PhaseMap | None = None

    def __post_init__(self) -> None:
        if self.profile == "map" and self.map is None:
            raise ConfigError(
                "along_y: profile 'map' needs a table [along_y.map] with file and pitch_um"
            )


def is_two_size_library(path: Path) -> bool:
    """Whether a file is a library over two sizes."""
    return path.is_file() and store.load(path).kind == axes.KIND


def y_polarization_phase(
    wanted: YPolarizationTarget, focus: Focus, where: Path, *, radius_um: float
) -> tuple[PhaseOf, Focus]:
    """The phase for light along y, and what it images onto what; where: the config that
    names the map.
    """
    distances = wanted.sensor_distance_mm * 1e3, wanted.source_distance_mm * 1e3
    check_gaps(focus.layers, *distances)
    other = Focus(focus.wavelength_um, *distances, focus.layers)
    shapes: dict[str, DoubleHelix | Cubic | PhaseMap | None] = {
        "double-helix": wanted.double_helix,
        "cubic": wanted.cubic,
        "map": wanted.map and replace(wanted.map, file=where.parent / wanted.map.file),
    }
    return design.phase_of(
        shapes.get(wanted.profile), other, radius_um=radius_um
    ), other


def check_both_foci(
    made: Lens, profiles: tuple[str, str], *, skip: bool
) -> list[FocusCheck | None]:
    """The exact sum about the focus of either light; None where a profile has no focus,
    or it is not asked for.
    """
    skip = skip or made.diameters.diameter_um.size > words.MOST_SUMMED
    return [
        None
        if skip or profile != "hyperbolic"
        else design.check_focus(made.seen(light))
        for light, profile in zip(BOTH, profiles, strict=True)
    ]


def figures(made: Lens, split: PolarizationMetrics) -> list[FocusMetrics | None]:
    """Of the PSF of either light."""
    return [
        words.focus_figures(made.seen(light), quality)
        for light, quality in zip(BOTH, (split.x, split.y), strict=True)
    ]


def polarization_values(
    split: PolarizationMetrics,
    found: list[FocusCheck | None],
    of_psf: list[FocusMetrics | None],
) -> dict[str, object]:
    """Of both lights, for programs."""
    told: dict[str, object] = {
        "pillars": split.x.pillars,
        "pairs_of_sizes": split.pairs,
        "multiplexed": split.multiplexed,
        "covered": split.covered,
    }
    for place, (light, quality) in enumerate(
        zip(BOTH, (split.x, split.y), strict=True)
    ):
        own = words.design_values(quality, found[place], None, of_psf[place])
        own |= {
            "wavefront_efficiency_error": split.wavefront_efficiency_error[place],
            "leaked": split.leaked[place],
        }
        del own["turns"]  # of a single diameter
        told[f"along_{light}"] = own
    return told


def polarization_text(
    head: str,
    layers: Layers,
    split: PolarizationMetrics,
    found: list[FocusCheck | None],
    of_psf: list[FocusMetrics | None],
) -> str:
    """Of both lights, for people."""
    what = "two phases" if split.multiplexed else "one phase for both polarisations"
    lines = [
        head,
        f"  pillars of {split.pairs:,} pairs of sizes make {what}; {split.covered:.0%} of the phases covered",
    ]
    for place, (light, quality) in enumerate(
        zip(BOTH, (split.x, split.y), strict=True)
    ):
        lines += words.design_text(
            f"  light polarised along {light}:",
            layers,
            quality,
            found[place],
            None,
            of_psf[place],
        ).splitlines()
        lines.append(
            f"  wave-front efficiency within {split.wavefront_efficiency_error[place]:.2g} (error bars of the pillars); "
            f"phase error {quality.rms_phase_error_rad:.2g} rad rms costs {1 - quality.strehl:.1%} of the peak; "
            f"{split.leaked[place]:.2g} of the light leaves with the other polarisation"
        )
    return "\n".join(lines)
