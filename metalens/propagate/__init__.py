"""Light from a point source through the pillars to the sensor window: the exact sum,
and faster ways to the same field.

``exact`` is the referee, ``angular_spectrum`` the textbook, ``windowed`` the fast way;
``choose`` picks by error.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.propagate import paths as paths
    from metalens.propagate.blocks import SHARE as SHARE
    from metalens.propagate.choice import Choice as Choice
    from metalens.propagate.choice import choose as choose
    from metalens.propagate.direct import field_at as field_at
    from metalens.propagate.direct import field_exact as field_exact
    from metalens.propagate.estimate import SAFETY as SAFETY
    from metalens.propagate.estimate import Sample as Sample
    from metalens.propagate.estimate import draw as draw
    from metalens.propagate.estimate import pupil_error as pupil_error
    from metalens.propagate.estimate import relative_error as relative_error
    from metalens.propagate.estimate import scan as scan
    from metalens.propagate.estimate import square_error as square_error
    from metalens.propagate.geometry import Case as Case
    from metalens.propagate.geometry import axis as axis
    from metalens.propagate.geometry import check_aperture as check_aperture
    from metalens.propagate.paths import apart as apart
    from metalens.propagate.paths import chief_path as chief_path
    from metalens.propagate.paths import cosines as cosines
    from metalens.propagate.paths import kernel as kernel
    from metalens.propagate.pillars import Pupils as Pupils
    from metalens.propagate.pillars import mixed as mixed
    from metalens.propagate.sincos import turns32 as turns32
    from metalens.propagate.verbs import angles as angles
    from metalens.propagate.verbs import angular_spectrum as angular_spectrum
    from metalens.propagate.verbs import case as case
    from metalens.propagate.verbs import chief as chief
    from metalens.propagate.verbs import exact as exact
    from metalens.propagate.verbs import windowed as windowed
    from metalens.propagate.wide import light_wide as light_wide
    from metalens.propagate.window import Moving as Moving
    from metalens.propagate.window import field_windowed as field_windowed
    from metalens.propagate.window import light_windowed as light_windowed
    from metalens.propagate.window import plan as plan
    from metalens.propagate.window import plan_wide as plan_wide

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Case": "geometry",
        "Choice": "choice",
        "Moving": "window",
        "Pupils": "pillars",
        "SAFETY": "estimate",
        "SHARE": "blocks",
        "Sample": "estimate",
        "angles": "verbs",
        "angular_spectrum": "verbs",
        "apart": "paths",
        "axis": "geometry",
        "case": "verbs",
        "chief": "verbs",
        "check_aperture": "geometry",
        "chief_path": "paths",
        "choose": "choice",
        "cosines": "paths",
        "draw": "estimate",
        "exact": "verbs",
        "field_at": "direct",
        "field_exact": "direct",
        "field_windowed": "window",
        "kernel": "paths",
        "light_wide": "wide",
        "light_windowed": "window",
        "mixed": "pillars",
        "paths": "",
        "plan": "window",
        "plan_wide": "window",
        "pupil_error": "estimate",
        "relative_error": "estimate",
        "scan": "estimate",
        "square_error": "estimate",
        "turns32": "sincos",
        "windowed": "verbs",
    },
)
