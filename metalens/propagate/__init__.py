"""Light from a point source through the pillars to the sensor window: the exact sum,
and faster ways to the same field.

``exact`` is the referee, ``angular_spectrum`` the textbook, ``windowed`` the fast way;
``choose`` picks by error.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.propagate import paths as paths
    from metalens.propagate.blocks import SHARE as SHARE
    from metalens.propagate.choice import MethodChoice as MethodChoice
    from metalens.propagate.choice import choose_method as choose_method
    from metalens.propagate.direct import field_at as field_at
    from metalens.propagate.direct import field_exact as field_exact
    from metalens.propagate.estimate import SAFETY as SAFETY
    from metalens.propagate.estimate import ErrorSample as ErrorSample
    from metalens.propagate.estimate import draw_pixels as draw_pixels
    from metalens.propagate.estimate import morton_scan as morton_scan
    from metalens.propagate.estimate import pupil_error as pupil_error
    from metalens.propagate.estimate import relative_error as relative_error
    from metalens.propagate.estimate import square_error as square_error
    from metalens.propagate.geometry import PropagationCase as PropagationCase
    from metalens.propagate.geometry import axis_positions as axis_positions
    from metalens.propagate.geometry import check_aperture as check_aperture
    from metalens.propagate.paths import chief_path as chief_path
    from metalens.propagate.paths import polarized_amplitudes as polarized_amplitudes
    from metalens.propagate.paths import ray_cosines as ray_cosines
    from metalens.propagate.paths import (
        rayleigh_sommerfeld_kernel as rayleigh_sommerfeld_kernel,
    )
    from metalens.propagate.pillars import Pupils as Pupils
    from metalens.propagate.pillars import mix_components as mix_components
    from metalens.propagate.sincos import sincos_turns32 as sincos_turns32
    from metalens.propagate.verbs import angular_spectrum as angular_spectrum
    from metalens.propagate.verbs import chief_ray_offset as chief_ray_offset
    from metalens.propagate.verbs import exact as exact
    from metalens.propagate.verbs import make_case as make_case
    from metalens.propagate.verbs import to_angle_pair as to_angle_pair
    from metalens.propagate.verbs import windowed as windowed
    from metalens.propagate.wide import light_wide as light_wide
    from metalens.propagate.window import MovingGeometry as MovingGeometry
    from metalens.propagate.window import field_windowed as field_windowed
    from metalens.propagate.window import light_windowed as light_windowed
    from metalens.propagate.window import plan_wide as plan_wide
    from metalens.propagate.window import plan_window as plan_window

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "PropagationCase": "geometry",
        "MethodChoice": "choice",
        "MovingGeometry": "window",
        "Pupils": "pillars",
        "SAFETY": "estimate",
        "SHARE": "blocks",
        "ErrorSample": "estimate",
        "to_angle_pair": "verbs",
        "angular_spectrum": "verbs",
        "polarized_amplitudes": "paths",
        "axis_positions": "geometry",
        "make_case": "verbs",
        "chief_ray_offset": "verbs",
        "check_aperture": "geometry",
        "chief_path": "paths",
        "choose_method": "choice",
        "ray_cosines": "paths",
        "draw_pixels": "estimate",
        "exact": "verbs",
        "field_at": "direct",
        "field_exact": "direct",
        "field_windowed": "window",
        "rayleigh_sommerfeld_kernel": "paths",
        "light_wide": "wide",
        "light_windowed": "window",
        "mix_components": "pillars",
        "paths": "",
        "plan_window": "window",
        "plan_wide": "window",
        "pupil_error": "estimate",
        "relative_error": "estimate",
        "morton_scan": "estimate",
        "square_error": "estimate",
        "sincos_turns32": "sincos",
        "windowed": "verbs",
    },
)
