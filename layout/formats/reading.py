"""Reader of GDSII and OASIS masks, distinguished by their first bytes."""

import re
from pathlib import Path

from layout.formats import gdsii_read, oasis_read
from layout.formats import oasis_records as oasis
from layout.formats.files import map_bytes, placement_limit
from layout.formats.library import MaskLibrary
from metalens.core import reading
from metalens.core.errors import MaskFileError

_OTHER_FORMATS = {  # how text formats of other programs begin: their name
    rb"\s*(0|999)\r?\n|AutoCAD Binary DXF": "a DXF drawing (convert it)",
    rb"[\t-\r -~]*;": "a CIF file (convert it)",
}


def read_mask(
    path: Path, limit: int | None = None, *, keep: int | None = None
) -> MaskLibrary:
    """A GDSII or OASIS mask.

    Args:
        path: of the file.
        limit: placements and shapes that are read; None: as its size allows.
        keep: placements of one cell that are kept, of more only their sums; None: all.

    Raises:
        MaskFileError: no such file, of another format, more than ``limit`` placements,
            or a file that cannot be read.
    """
    if not path.is_file():
        raise MaskFileError(
            f"{path}: {reading.missing_reason(path)}; need a GDSII or OASIS mask"
        )
    start = map_bytes(path)[:64].tobytes()
    texts = (name for form, name in _OTHER_FORMATS.items() if re.match(form, start))
    other = reading.foreign_format(path) or next(texts, "")
    if other:
        raise MaskFileError(f"{path}: {other}, need GDSII or OASIS")
    is_oasis = start.startswith(oasis.MAGIC)
    reader = oasis_read.read_oasis if is_oasis else gdsii_read.read_gdsii
    return reader(
        path, limit=placement_limit(path) if limit is None else limit, keep=keep
    )
