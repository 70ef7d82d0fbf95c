"""lens.h5 for other programs: arrays with axes (.npz, .mat), or the smooth phase of ray
tracers (Zemax .dat).
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
            tracers read it too).
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
    export.check_export_format(options.output)
    is_array = options.output.suffix.lower() in export.ARRAYS
    if options.samples != Options.samples and is_array:
        raise LensError(
            "--samples counts the points of a .dat; arrays hold every pillar"
        )
    with options.claim(options.output) as draft:
        device = lens.load(options.lens)
        error = export.export_lens(draft.path, device, samples=options.samples)
    values = {
        "file": options.output.name,
        "bytes": options.output.stat().st_size,
        "interpolation_error_rad": error,
    }
    return options.console.report(f"{options.output}", values)
