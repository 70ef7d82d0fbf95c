"""LENS... to Tables 1 and 3 and Figs. 5 and 7 of the paper: information about
depth, and about whole scenes.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.evaluate_optics"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens evaluate optics``.

    Attributes:
        lenses: lens files; the first is what the others are compared with.
        output: folder for optics.json, tables.txt, axial.png, scenes.png, report.html.
        config: OPTICS.toml with the tables [axial], [scenes] and [reader]; without it
            the defaults.
        scenes: number of scenes, in place of the one in the settings.
        reader: train the reference reader behind every lens and print what it reads:
            depth of windows, slippage, with
            calibrated intervals; some minutes a lens, the same numbers every time.
    """

    lenses: tyro.conf.Positional[tuple[Path, ...]]
    output: Output = Path("optics")
    config: Path | None = None
    scenes: int | None = None
    reader: bool = False
