"""Frames, stage, dark, flat -> electrons."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from characterize.captures import capture as capture
    from characterize.captures.alike import Spectra as Spectra
    from characterize.captures.alike import above_rim as above_rim
    from characterize.captures.alike import likeness as likeness
    from characterize.captures.alike import shifted as shifted
    from characterize.captures.capture import Capture as Capture
    from characterize.captures.electrons import Frames as Frames
    from characterize.captures.electrons import Gain as Gain
    from characterize.captures.electrons import clean as clean
    from characterize.captures.electrons import merge_brackets as merge_brackets
    from characterize.captures.rounding import told as told
    from characterize.captures.turns import MIRRORED as MIRRORED
    from characterize.captures.turns import TURNS as TURNS
    from characterize.captures.turns import between as between
    from characterize.captures.turns import turn as turn

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Capture": "capture",
        "Frames": "electrons",
        "Gain": "electrons",
        "MIRRORED": "turns",
        "Spectra": "alike",
        "TURNS": "turns",
        "above_rim": "alike",
        "between": "turns",
        "capture": "",
        "clean": "electrons",
        "likeness": "alike",
        "merge_brackets": "electrons",
        "shifted": "alike",
        "told": "rounding",
        "turn": "turns",
    },
)
