"""lens.h5 for other programs: arrays with axes (.npz, .mat), or the smooth phase of ray
tracers (Zemax .dat, Binary 2).
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens import lens
from metalens.commands.common import CommonOptions, Output
from metalens.core.errors import LensError
from metalens.lens import export


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens export``.

    Attributes:
        lens: the lens file.
        output: file to write; its ending says the format: .npz, .mat (x, y, diameter,
            phase, transmission of every
            pillar) or .dat (Zemax OpticStudio grid phase, unwrapped, in mm; other ray
            tracers read it too), or .json (Binary 2: even polynomial of the radius).
        samples: points across the aperture of a .dat.
    """

    lens: tyro.conf.Positional[Path]
    output: Output = Path("lens.npz")
    samples: int = 501


def run(options: Options) -> int:
    """Write the file; exit 0.

    Args:
        options: of the command line.
    """
    is_grid = options.output.suffix.lower() == export.GRID
    if options.samples != Options.samples and not is_grid:
        raise LensError(
            "--samples counts the points of a .dat; other files hold every pillar"
        )
    with options.claim(options.output) as draft:
        device = lens.load(options.lens)
        error = export.export_lens(draft.path, device, samples=options.samples)
    values = {
        "file": options.output.name,
        "bytes": options.output.stat().st_size,
        "phase_error_rad": error,
    }
    return options.console.report(f"{options.output}", values)
