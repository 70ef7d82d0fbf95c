"""Hidden lenses for the fit: designs with the library's own proxy, truths wider and
elsewhere than assumed.
"""

import functools
import math

import numpy as np

from metalens import design
from metalens.design import profiles
from metalens.library.record import DEFAULT_CELL
from tests.referees import pillar_table
from tests.referees.pillar_bench import Session

DEPTHS = (380.0, 470.0, 590.0, 640.0, 800.0, 1150.0)
# (middle, standard deviation) of the truths; the fit assumes 0 and 15, 10 nm ..., 0.5
# nm, 1 rad, 0.3 px about 0.2
TRUTHS = {
    "bias_nm": (2.5, 8.0),
    "bias_x_nm": (-0.7, 2.5),
    "bias_y_nm": (0.9, 2.5),
    "bias_r_nm": (1.1, 3.0),
    "height_nm": (-3.0, 9.0),
    "wavelength_nm": (0.1, 0.5),
    "distance_um": (0.8, 2.5),
    "decentre_x_um": (0.4, 1.2),
    "decentre_y_um": (-0.3, 1.2),
    "stage_zero_um": (7.0, 14.0),
    "stage_scale": (0.001, 0.005),
    "astigmatism_rad": (0.05, 0.17),
    "oblique_astigmatism_rad": (-0.04, 0.17),
    "coma_x_rad": (0.03, 0.17),
    "coma_y_rad": (-0.05, 0.17),
    "trefoil_x_rad": (0.02, 0.12),
    "trefoil_y_rad": (-0.03, 0.12),
    "spherical_rad": (0.06, 0.17),
    "crosstalk_px": (0.29, 0.05),
}
PLANE = {"background_e": 23.0, "background_x_e": 2.6, "background_y_e": -1.7}
LIMITS = {"bias_nm": 24.0, "height_nm": 24.0, "crosstalk_px": 0.5}


@functools.lru_cache
def lens(aperture_um=40.0, focal_um=110.0, object_um=600.0):
    """A hyperbolic lens of the default cell, its phase by the library's proxy."""
    table = pillar_table.load()
    focus = profiles.Focus(0.85, focal_um, object_um)
    phase = design.phase_of(None, focus, radius_um=aperture_um / 2)
    return design.make(
        phase, focus, aperture_um=aperture_um, cell=DEFAULT_CELL, proxy=table.proxy
    )[0]


def hidden(seed, *, scale=1.0):
    """True parameters of a seed; ``scale``: of the stage and distance errors, for
    larger lenses.
    """
    rng = np.random.default_rng([seed, 2024])
    values = {
        name: middle + sigma * float(rng.standard_normal())
        for name, (middle, sigma) in TRUTHS.items()
    }
    for name in ("stage_zero_um", "distance_um"):
        values[name] *= scale
    for name, limit in LIMITS.items():
        values[name] = float(
            np.clip(values[name], 0.1 if name == "crosstalk_px" else -limit, limit)
        )
    return values | PLANE


def session(seed, **changes):
    """A session with the hidden values of a seed."""
    return Session(
        **({"depths_um": DEPTHS, "values": hidden(seed), "seed": seed} | changes)
    )


# what a fit reckons with where nobody states it, kind by kind
UNSTATED = {
    "glass": ("glass_um",),
    "write fields": ("stitching_nm",),
    "side wall": ("sidewall_deg",),
    "pixel pitch": ("pixel_percent",),
    "source": ("pinhole_um",),
    "light": ("light_x", "light_y", "light_r"),
    "saddles": ("bias_a_nm", "bias_o_nm"),
}
# that this bench lacks; a tilt of the glass shows as shifts from frame to frame, and is
# refused
LEFT_OUT = (
    "bandwidth_nm",
    "camera_turn_deg",
    "glass_tilt_x_deg",
    "glass_tilt_y_deg",
    "index",
    "tilt_x_deg",
    "tilt_y_deg",
)


def unstated(seed):
    """(kind, faults of that kind, names to state as absent) of a seed: one kind is
    there and nobody says so.

    As large as the fit reckons with, drawn. Of what acts by its square (source, wall)
    that square is drawn, of what
    cannot be negative its size.
    """
    kind = tuple(UNSTATED)[seed % len(UNSTATED)]
    a, b, c = np.random.default_rng([seed, 4711]).standard_normal(3).tolist()
    faults = {
        "glass": {"glass_um": 100 * abs(a)},
        "write fields": {"stitch_nm": 60.0},
        "side wall": {"sidewall_deg": 2 * math.sqrt(abs(a))},
        "pixel pitch": {"pixel_error": 0.01 * a},
        "source": {"source_um": 5 * math.sqrt(abs(a))},
        "light": {
            "gradient": math.exp(0.1 * a) - 1,
            "light_y": 0.2 * b,
            "light_r": 0.2 * c,
        },
        "saddles": {"saddle_nm": 10 * a, "oblique_nm": 10 * b},
    }[kind]
    others = (name for one, names in UNSTATED.items() if one != kind for name in names)
    return kind, faults, (*LEFT_OUT, *others)
