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
            return _ome(path, file.ome_metadata, len(file.pages))
    return Tags()


def _ome(path: Path, xml: str, pages: int) -> Tags:
    """Positions of the planes, else steps of the voxel's height."""
    channels, samples = (re.search(rf'{name}="(\d+)"', xml) for name in ("SizeC", "SamplesPerPixel"))
    _one_channel(path, (int(channels[1]) if channels else 1) // (int(samples[1]) if samples else 1))
    pixel, step, position = _ome_size(xml, "X"), _ome_size(xml, "Z"), stage.ome_positions(xml)
    if len(position) or not math.isfinite(step) or step == 0:
        return Tags(position, pixel, _words(pixel))
    note = f"stage step of {step:.4g} um from the OME tags"
    return Tags(np.arange(pages) * step, pixel, (note, *_words(pixel)))


def _ome_size(xml: str, axis: str) -> float:
    name = f"PhysicalSize{axis}"
    found = re.search(rf'{name}="([^"]+)"(?:[^>]*{name}Unit="([^"]+)")?', xml)
    return float(found[1]) * _UNITS.get(found[2] or "um", math.nan) if found else math.nan


def _one_channel(path: Path, channels: int) -> None:
    if channels > 1:
        raise CaptureError(f"{path}: {channels} channels in one file; save the one that is to be fitted")


def _imagej(path: Path, about: dict[str, object], per_pixel: float, pages: int) -> Tags:
    """Steps without a unit are in um; of a unit that is no length (pixels) neither steps nor a pixel are told."""
    _one_channel(path, int(str(about.get("channels", 1))))
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
