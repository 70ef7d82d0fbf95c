"""What the tags of a TIFF file say of stage and pixel: ImageJ (spacing, resolution) and OME-XML."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from characterize.captures import stage
from metalens.ground.arrays import Array
from metalens.ground.errors import CaptureError

_MICRON = dict.fromkeys(("um", "µm", "\\u00b5m", "micron", "microns"), 1.0)
_UNITS = {"nm": 1e-3, **_MICRON, "mm": 1e3, "cm": 1e4, "inch": 25400.0}


@dataclass(frozen=True, eq=False, slots=True)
class Tags:
    """position_um: (n,) of the frames, empty where not told. pixel_um: nan where not told; notes: in words."""

    position_um: Array = field(default_factory=lambda: np.empty(0))
    pixel_um: float = math.nan
    notes: tuple[str, ...] = ()


def read(path: Path) -> Tags:
    """Tags of a TIFF file; nothing where it has none of these.

    Raises:
        CaptureError: several channels in one file.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        if file.is_imagej and file.imagej_metadata:
            return _imagej(path, file.imagej_metadata, _resolution(file.pages[0]), len(file.pages))
        if file.is_ome and file.ome_metadata:
            found = re.search(r'PhysicalSizeX="([^"]+)"(?:[^>]*PhysicalSizeXUnit="([^"]+)")?', file.ome_metadata)
            pixel = float(found[1]) * _UNITS.get(found[2] or "um", math.nan) if found else math.nan
            return Tags(stage.ome_positions(file.ome_metadata), pixel, _words(pixel))
    return Tags()


def _imagej(path: Path, about: dict[str, object], per_pixel: float, pages: int) -> Tags:
    """Steps without a unit are in um; of a unit that is no length (pixels) neither steps nor a pixel are told."""
    if int(str(about.get("channels", 1))) > 1:
        raise CaptureError(f"{path}: {about['channels']} channels in one file; save the one that is to be fitted")
    unit = str(about.get("unit", "")).lower()
    scale = _UNITS.get(unit, math.nan)
    step = float(str(about.get("spacing", "nan"))) * (scale if unit else 1.0)
    pixel = per_pixel * scale
    position = np.arange(pages) * step if math.isfinite(step) and step != 0 else np.empty(0)
    notes = (f"stage step of {step:.4g} um from the ImageJ tags",) if len(position) else ()
    return Tags(position, pixel, notes + _words(pixel))


def _resolution(page: object) -> float:
    """Width of a pixel in the file's unit; nan where it is not told (1 / 1)."""
    tag = getattr(page, "tags", {}).get("XResolution")
    if tag is None or 0 in tag.value or tag.value[0] == tag.value[1]:
        return math.nan
    return float(tag.value[1] / tag.value[0])


def _words(pixel_um: float) -> tuple[str, ...]:
    return (f"pixel of {pixel_um:.4g} um from the tags of the file",) if math.isfinite(pixel_um) else ()
