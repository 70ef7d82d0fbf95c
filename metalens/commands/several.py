"""``metalens design`` for several wavelengths: what the others are to see, what they
get, and how it is said.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from metalens import design
from metalens.commands import design_words as words
from metalens.core.errors import ConfigError
from metalens.design import FocusCheck, Quality, WavelengthTarget
from metalens.lens import Lens
from metalens.library import PillarLibrary
from metalens.optics import Layers
from metalens.psf import FocusMetrics


@dataclass(frozen=True, slots=True)
class AdditionalWavelength:
    """Light beside the design's own that the same pillars are to serve.

    wavelength_nm: of that light. weight: of its squared errors, against 1 of the
    design's own wavelength.
    sensor_distance_mm, source_distance_mm: what is imaged onto what (inf for a
    collimated beam); left out, as at the
        design's own wavelength.
    """

    wavelength_nm: float = field(metadata={"above": 0})
    weight: float = field(default=1.0, metadata={"above": 0})
    sensor_distance_mm: float | None = field(default=None, metadata={"above": 0})
    source_distance_mm: float | None = field(
        default=None, metadata={"may_be_inf": True, "above": 0}
    )


@dataclass(frozen=True, slots=True)
class WavelengthMetrics:
    """What light beside the design's own gets."""

    light: AdditionalWavelength
    quality: Quality
    check: FocusCheck | None
    figures: FocusMetrics | None


def check_single_wavelength_profile(
    wavelengths: tuple[AdditionalWavelength, ...], profile: str
) -> None:
    """Refuse profiles that are of one wavelength."""
    if wavelengths and profile in ("fisher", "map"):
        raise ConfigError(
            f"wavelengths: profile '{profile}' is of one; need hyperbolic, double-helix or cubic"
        )


def designs_by_wavelength(
    wanted: Any, made_of: PillarLibrary
) -> Iterator[tuple[Any, float]]:
    """The design (:class:`metalens.commands.design.DesignSettings`) as each wavelength
    is to
    see it, and its weight; its own
    first. Nothing where there is no other.

    Raises:
        ConfigError: a library for circular light.
    """
    if not wanted.wavelengths:
        return
    if made_of.turned is not None:
        raise ConfigError(
            "wavelengths: turned pillars make one phase at all of them; need a library for any light"
        )
    yield wanted, 1.0
    for one in wanted.wavelengths:
        sensor = one.sensor_distance_mm or wanted.sensor_distance_mm
        source = one.source_distance_mm or wanted.source_distance_mm
        told = {
            "wavelength_nm": one.wavelength_nm,
            "sensor_distance_mm": sensor,
            "source_distance_mm": source,
        }
        yield replace(wanted, **told, wavelengths=()), one.weight


def judge_wavelengths(
    made: Lens,
    beside: Sequence[AdditionalWavelength],
    wanted: Sequence[WavelengthTarget],
    found: Sequence[Quality],
    *,
    check: bool,
) -> tuple[WavelengthMetrics, ...]:
    """Every other wavelength with its quality, and the exact sum about its focus if
    that is asked for.
    """
    out = []
    for light, one, quality in zip(beside, wanted, found, strict=True):
        seen = replace(
            made,
            wavelength_um=one.focus.wavelength_um,
            sensor_distance_um=one.focus.sensor_distance_um,
            source_distance_um=one.focus.source_distance_um,
        )
        out.append(
            WavelengthMetrics(
                light,
                quality,
                design.check_focus(seen, expected=quality.strehl) if check else None,
                words.focus_figures(seen, quality),
            )
        )
    return tuple(out)


def wavelength_values(beside: Sequence[WavelengthMetrics]) -> dict[str, object]:
    """Of the other wavelengths, for programs; nothing where there is none."""
    found = [
        {
            "wavelength_nm": one.light.wavelength_nm,
            "weight": one.light.weight,
            **words.design_values(one.quality, one.check, None, one.figures),
        }
        for one in beside
    ]
    return {"wavelengths": found} if found else {}


def wavelength_text(beside: Sequence[WavelengthMetrics], layers: Layers) -> str:
    """Of the other wavelengths, for people."""
    heads = [
        f"\n  light of {one.light.wavelength_nm:g} nm, weight {one.light.weight:g}:"
        for one in beside
    ]
    found = zip(heads, beside, strict=True)
    return "".join(
        words.design_text(
            head, layers, one.quality, one.check, None, one.figures, several=True
        )
        for head, one in found
    )
