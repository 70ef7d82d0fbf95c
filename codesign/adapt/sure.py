"""Whether an as-built lens is known well enough to correct the next mask by it, and
what would settle it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from characterize.inference import AsBuilt
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError

DRAWS = 24
# standard deviation of the table's entries beyond which it is no table: the step of
# drawn diameters
WIDE_NM = 2.0
_SETTLED = (  # word of a cause, and what states it
    ("side wall", "the side wall by a cross-section ([[known]] sidewall_deg)"),
    ("refractive index", "the index by ellipsometry ([[known]] index)"),
    (
        "pixel pitch",
        "the pixel pitch in the light by a target of known period (pixel_sigma_um of capture.toml)",
    ),
    (
        "illumination",
        "the light on the lens by a frame of the lamp alone ([[known]] light_x, light_y, light_r)",
    ),
    (
        "glass",
        "the glass in the beam (glass_um, glass_tilt_x_deg, glass_tilt_y_deg of capture.toml)",
    ),
    ("write fields", "the overlay of the write fields ([[known]] stitching_nm)"),
    ("source", "the size of the source (pinhole_um of capture.toml)"),
    ("spectrum", "the spectrum ([[known]] bandwidth_nm)"),
    (
        "tilt of the lens",
        "the tilt of the lens, by frames at opposite field angles ([[known]] tilt_x_deg, tilt_y_deg)",
    ),
    (
        "saddle",
        "diameters round the rim by micrographs ([[known]] bias_a_nm, bias_o_nm)",
    ),
)
_FRAMES = (
    "frames at source depths on both sides of focus where the spot is several pixels wide (metalens capture lens.h5 "
    "--plan lists the best), frames at a field angle, diameters from micrographs (metalens measure) or the height "
    "(AFM) as [[known]]"
)


@dataclass(frozen=True, slots=True)
class CorrectionPart:
    """A part of a correction, in words, and the parameters that it follows."""

    words: str
    names: tuple[str, ...]


TABLE = CorrectionPart(
    "the bias table", ("bias_nm", "height_nm", "index", "sidewall_deg")
)
MAP = CorrectionPart(
    "what varies over the lens",
    ("bias_x_nm", "bias_y_nm", "bias_r_nm", "bias_a_nm", "bias_o_nm"),
)


@dataclass(frozen=True, eq=False, slots=True)
class CorrectionSpread:
    """How the posterior spreads a correction.

    table_nm: (draws, knots) that of every draw. sigma_nm: (knots,) its standard
    deviation. words: why it is
    refused, and what to capture or measure; empty where it may be used.
    """

    table_nm: Array
    sigma_nm: Array
    words: str

    @property
    def usable(self) -> bool:
        """Whether the posterior is narrow enough."""
        return not self.words


def judge_correction(
    result: AsBuilt,
    table: Callable[[Array], Array],
    *,
    part: CorrectionPart = TABLE,
    wide_nm: float = WIDE_NM,
    seed: int = 5,
) -> CorrectionSpread:
    """What every draw of the posterior would ask for, and whether they agree.

    Args:
        table: (knots,) of the bias table, or of what is taken off at some places of the
            lens, nm, of all parameters of
            one lens. part: which of them.
        result: of the fit. wide_nm: largest standard deviation of a usable correction.
        seed: of the random generator.
    """
    try:
        drawn = np.array(
            [table(result.parameters(row)) for row in result.samples(DRAWS, seed=seed)]
        )
    except ConfigError as refusal:
        return CorrectionSpread(
            np.empty((0, 0)),
            np.empty(0),
            f"no correction: for lenses of the posterior {refusal}",
        )
    sigma = drawn.std(axis=0, ddof=1)
    if sigma.max() <= wide_nm:
        return CorrectionSpread(drawn, sigma, "")
    ranges = [
        (name, *result.interval(name)) for name in part.names if name in result.names
    ]
    told = ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, low, high in ranges)
    return CorrectionSpread(
        drawn,
        sigma,
        f"no correction: the posterior leaves {part.words} open by {sigma.max():.1f} nm (1 sigma, at most "
        f"{wide_nm:g} allowed; {told}). Settle it by {_settled(result, table, sigma, (part, wide_nm))}",
    )


def _settled(
    result: AsBuilt,
    table: Callable[[Array], Array],
    sigma: Array,
    wanted: tuple[CorrectionPart, float],
) -> str:
    """What would make the table narrow, the most telling first: causes to state, and
    frames where these say too little.

    By the table's slopes along every parameter that it follows; a cause moves all of
    them together, at most by the sum.
    """
    (part, wide_nm), best, place = (
        wanted,
        table(result.parameters()),
        int(np.argmax(sigma)),
    )
    slopes = np.zeros(len(result.names))
    for i, name in enumerate(result.names):
        if name in part.names:
            moved = result.value.copy()
            moved[i] += 0.1 * result.sigma[i]
            slopes[i] = (table(result.parameters(moved)) - best)[place] / (
                0.1 * result.sigma[i]
            )
    own = float(np.sqrt(slopes @ result.within_covariance @ slopes))
    by_cause = result.by_cause @ np.abs(slopes) if len(result.causes) else np.empty(0)
    worst = [
        k
        for k in np.argsort(-by_cause)
        if by_cause[k] > max(by_cause.max() / 4, 0.2 * wide_nm)
    ]
    ways = [way for k in worst for word, way in _SETTLED if word in result.causes[k]]
    more = (
        [_FRAMES]
        if own > 0.7 * wide_nm or not ways
        else ["the diameters themselves by micrographs (metalens measure)"]
    )
    return "; ".join([*dict.fromkeys(ways), *more])
