"""Frames, stage, dark, flat -> electrons."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.captures import capture as capture
    from characterize.captures.alike import FrameSpectra as FrameSpectra
    from characterize.captures.alike import above_rim as above_rim
    from characterize.captures.alike import (
        normalized_cross_correlation as normalized_cross_correlation,
    )
    from characterize.captures.alike import shift_frames as shift_frames
    from characterize.captures.capture import Capture as Capture
    from characterize.captures.electrons import ElectronFrames as ElectronFrames
    from characterize.captures.electrons import SensorNoise as SensorNoise
    from characterize.captures.electrons import merge_brackets as merge_brackets
    from characterize.captures.electrons import to_electrons as to_electrons
    from characterize.captures.rounding import quantization_score as quantization_score
    from characterize.captures.turns import MIRRORED as MIRRORED
    from characterize.captures.turns import TURNS as TURNS
    from characterize.captures.turns import orient_frames as orient_frames
    from characterize.captures.turns import relative_orientation as relative_orientation

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Capture": "capture",
        "ElectronFrames": "electrons",
        "SensorNoise": "electrons",
        "MIRRORED": "turns",
        "FrameSpectra": "alike",
        "TURNS": "turns",
        "above_rim": "alike",
        "relative_orientation": "turns",
        "capture": "",
        "to_electrons": "electrons",
        "normalized_cross_correlation": "alike",
        "merge_brackets": "electrons",
        "shift_frames": "alike",
        "quantization_score": "rounding",
        "orient_frames": "turns",
    },
)
