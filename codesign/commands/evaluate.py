"""What a lens, a run or the paper's claims are worth: ``metalens evaluate optics |
...``, a module each.

``metalens evaluate lens.h5...`` is ``optics``, and ``metalens evaluate RUN_DIR...`` is
``paper``.
"""

from collections.abc import Sequence
from pathlib import Path

from metalens.core import reading

# sub-verb: (module that holds ``Options`` and names that of ``run``, one line of help)
PARTS: dict[str, tuple[str, str]] = {
    "optics": (
        "codesign.commands.options.optics",
        "LENS... -> axial information, PSF slices and scene sensitivity of lenses (Tables 1 and 3, Figs. 5 and 7)",
    ),
    "experiment": (
        "codesign.commands.options.experiment",
        "RUN_DIR... -> gaze and slippage of synthetic subjects on a bench (Sec. 5, Figs. 10 and 11)",
    ),
    "paper": (
        "codesign.commands.options.paper",
        "RUN_DIR... -> every table and figure of the paper with our measurement",
    ),
}


def part_of(word: str) -> str | None:
    """The sub-verb that a first word is meant for: optics for a file, paper for a
    folder, None for anything else.
    """
    path = Path(word)
    if path.is_dir():
        return "paper"
    return "optics" if path.suffix == ".h5" or path.is_file() else None


def distinct_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of runs or lenses, numbered where they repeat.

    Args:
        names: stems of files and names of folders.
    """
    valid = [reading.to_valid_utf8(name) for name in names]
    return tuple(
        name if valid.count(name) == 1 else f"{name} {number}"
        for number, name in enumerate(valid, 1)
    )
