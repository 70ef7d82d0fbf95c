"""What a process prints, as limits on designed diameters: the inverse of bias, steps
and polygons.
"""

from pathlib import Path

import numpy as np

from layout.process.process import load_process
from layout.shapes import convex, polygon
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_MOST_STEPS = 4000


def printable_limits(
    path: Path, *, pitch_um: float, height_um: float
) -> tuple[float, float]:
    """Thinnest pillar and least gap, nm, of designed pillars that a process can print.

    All drawn sizes are tested for width, gap and gap at the foot. The limits are the
    designed sizes of the thinnest and of the widest that keep the rules.

    Args:
        path: of PROCESS.toml.
        pitch_um: of the lattice.
        height_um: of the pillars.

    Raises:
        ConfigError, ProcessError: the file cannot be used; ProcessError: no diameter
            keeps both rules on this pitch.
    """
    process = load_process(path)
    rules = process.rules
    pitch_nm = pitch_um / nm
    smallest_nm = max(4 * rules.grid_nm, rules.diameter_step_nm)
    step = rules.diameter_step_nm
    first = -(-smallest_nm // step)
    drawn_nm = np.arange(first, min(first + _MOST_STEPS, pitch_nm / step)) * step
    drawn_nm = drawn_nm[
        (drawn_nm >= 0.5 * rules.minimum_feature_nm) & (drawn_nm < pitch_nm)
    ]
    shapes = [
        polygon.pillar_polygon(float(diameter) / rules.grid_nm, vertices=rules.vertices)
        for diameter in drawn_nm
    ]
    half_width_nm = np.array([points[:, 0].max() for points in shapes]) * rules.grid_nm
    width_nm = (
        np.array([convex.least_width(points) for points in shapes]) * rules.grid_nm
    )
    _, foot_nm = process.top_foot_nm(
        process.made_diameter_nm(drawn_nm) + max(0.0, process.bias.isolated_nm),
        height_um / nm,
    )
    is_wide_enough = np.logical_and.accumulate(
        (width_nm >= rules.minimum_feature_nm)[::-1]
    )[::-1]  # and every wider one
    has_gap = (pitch_nm - 2 * half_width_nm >= rules.minimum_gap_nm) & (
        pitch_nm - foot_nm >= rules.minimum_foot_gap_nm
    )
    is_printable = is_wide_enough & np.logical_and.accumulate(
        has_gap
    )  # and every thinner one
    if not is_printable.any():
        raise ProcessError(
            f"{path}: no pillar keeps {rules.minimum_feature_nm:g} nm and leaves {rules.minimum_gap_nm:g} nm on a "
            f"pitch of {pitch_nm:.4g} nm; widen the pitch or change the process"
        )
    isolated_nm = process.bias.isolated_nm
    low = float(
        process.made_diameter_nm(drawn_nm[is_printable][0] - 0.45 * step)
    ) + max(0.0, isolated_nm)
    high = float(
        process.made_diameter_nm(drawn_nm[is_printable][-1] + 0.45 * step)
    ) + min(0.0, isolated_nm)
    return low, pitch_nm - high
