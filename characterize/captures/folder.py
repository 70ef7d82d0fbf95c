"""Files of a capture folder by their names: frames in order, tables, and files that are
not read.
"""

import difflib
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from metalens.core import reading
from metalens.core.errors import CaptureError

# suffixes of the description's two files, and of what is saved in their place
_TABLES = {
    "stage": ((".csv", ".json"), (".tsv", ".txt", ".dat", ".xlsx", ".xls", ".ods")),
    "capture": ((".toml", ".json"), (".yaml", ".yml", ".ini", ".cfg")),
}
_NUMPY = 'in Python: tifffile.imwrite("frames.tif", frames)'
_MATLAB = (
    'in MATLAB: imwrite(frames(:,:,k), "frames.tif", WriteMode="append") for each k'
)
_PROGRAM = "as TIFF, from the program that wrote it or from ImageJ"
_CONVERSIONS = {
    **dict.fromkeys((".npy", ".npz"), _NUMPY),
    ".mat": _MATLAB,
    **dict.fromkeys(
        (".fits", ".fit", ".fts"),
        "in Python: tifffile.imwrite of astropy's data, as uint16",
    ),
    **dict.fromkeys(
        (
            ".bmp",
            ".gif",
            ".pgm",
            ".dng",
            ".czi",
            ".nd2",
            ".lif",
            ".ims",
            ".spe",
            ".sif",
        ),
        _PROGRAM,
    ),
    **dict.fromkeys(
        (".raw", ".bin"),
        'in Python: tifffile.imwrite("frame.tif", numpy.fromfile(...).reshape(rows, columns))',
    ),
    **dict.fromkeys(
        (".nxs", ".cxi", ".he5"),
        "as HDF5 named .h5, with the frames in a data set 'frames'",
    ),
}


def conversion_hint(suffix: str) -> str:
    """How to convert a kind of file that is not read; empty for an unfamiliar suffix.

    Args:
        suffix: ending of the file's name.
    """
    return f": save it {_CONVERSIONS[suffix]}" if suffix in _CONVERSIONS else ""


def list_images(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Image files of a folder with one of ``suffixes``, in natural order of their names
    (frame_2 before frame_10).

    Hidden files (._frame.tif on a disk that a Mac wrote to) are left out.
    """
    images = (
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    )
    return sorted(
        images, key=lambda path: [part[::-1] for part in _name_parts(path.name)]
    )


def find_table(folder: Path, kind: str) -> Path | None:
    """The file ``stage`` or ``capture`` of a folder, in capital letters or small ones;
    None where there is none.

    Args:
        kind: ``stage`` or ``capture``.

    Raises:
        CaptureError: there is one in another format (``stage.xlsx``), which nothing
            would read.
    """
    suffixes, other_suffixes = _TABLES[kind]
    files = {path.name.lower(): path for path in sorted(folder.iterdir())}
    for suffix in suffixes + other_suffixes:
        table = files.get(kind + suffix)
        if table is None or not table.is_file():
            continue
        if suffix in suffixes:
            return table
        raise CaptureError(
            f"{table}: not read, and nothing else says what it may say; save it as "
            f"{kind}{suffixes[0]}"
        )
    return None


def unread_images_text(folder: Path, companions: Collection[str]) -> tuple[str, ...]:
    """What to say of images in kinds of file that are not read.

    Args:
        folder: the capture folder.
        companions: names of the dark and flat that are read.

    Raises:
        CaptureError: a dark frame or a flat is among them.
    """
    unread = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in _CONVERSIONS and not path.name.startswith(".")
    )
    for path in unread:
        if path.stem.lower() in {"dark", "flat"} - set(companions):
            raise CaptureError(
                f"{path}: cannot read {path.suffix}, and it would not be "
                f"used{conversion_hint(path.suffix.lower())}"
            )
    names = ", ".join(reading.to_valid_utf8(path.name) for path in unread[:5])
    return (
        (f"{len(unread)} files left out, of kinds that are not read: {names}",)
        if unread
        else ()
    )


def check_steps(files: Sequence[Path], folder: Path) -> None:
    """Refuse numbered frames with a gap, where the depths follow from their order.

    Args:
        files: image files in their order.
        folder: the capture folder.

    Raises:
        CaptureError: unequal steps of the numbers, in files whose names differ in one
            number alone.
    """
    parts = [_name_parts(path.stem) for path in files]
    if len({tuple(word for word, _ in name_parts) for name_parts in parts}) != 1:
        return
    numbers = np.array([[number for _, number in name_parts] for name_parts in parts])
    steps = np.diff(numbers[:, np.ptp(numbers, axis=0) > 0], axis=0)
    if steps.shape[1] == 1 and steps.max() > steps.min():
        gap = int(steps.argmax())
        raise CaptureError(
            f"{folder}: {files[gap + 1].name} is {steps[gap, 0]} numbers after "
            f"{files[gap].name}, others {steps.min()}: is a "
            "frame missing? step_um would give the next one its place; list frames and "
            "depths in stage.csv"
        )


def similar_name_hint(name: str, there: Collection[str]) -> str:
    """Hint with the most similar name of an existing file; empty without one.

    Args:
        name: name of the missing file.
        there: names of the files that exist.
    """
    lower = {other.lower(): other for other in there}
    similar = difflib.get_close_matches(name.lower(), lower, n=1)
    return f"; did you mean {lower[similar[0]]!r}?" if similar else ""


def _name_parts(name: str) -> list[tuple[str, int]]:
    """A name as words (small letters) and numbers in turn: (word, -1) or ("", number)."""
    return [
        ("", int(part)) if part.isdigit() else (part, -1)
        for part in re.split(r"(\d+)", name.lower())
    ]
