"""What the tags of a TIFF file say of stage and pixel: ImageJ (spacing, resolution) and
OME-XML.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from characterize.captures import stage, tiff_pages
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_MICRONS = (
    "um",
    "\u00b5m",
    "\u03bcm",
    "\\u00b5m",
    "\\u03bcm",
    "micron",
    "microns",
)  # a micro sign or a Greek letter
_UNITS = {
    "nm": 1e-3,
    **dict.fromkeys(_MICRONS, 1.0),
    "mm": 1e3,
    "cm": 1e4,
    "inch": 25400.0,
}


@dataclass(frozen=True, eq=False, slots=True)
class TiffTags:
    """position_um: (n,) of the frames, empty where not stated. pixel_um: nan where not
    stated; notes: in words.
    """

    position_um: Array = field(default_factory=lambda: np.empty(0))
    pixel_um: float = math.nan
    notes: tuple[str, ...] = ()


def read_tags(path: Path) -> TiffTags:
    """Tags of a TIFF file; nothing where it has none of these.

    Args:
        path: the file.

    Raises:
        CaptureError: several channels in one file.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        if file.is_imagej and file.imagej_metadata:
            return _imagej(
                path,
                file.imagej_metadata,
                _resolution(file.pages[0]),
                tiff_pages.count_images(file),
            )
        if file.is_ome and file.ome_metadata:
            return _ome(path, file.ome_metadata, len(file.pages))
    return TiffTags()


def _ome(path: Path, xml: str, pages: int) -> TiffTags:
    """Positions of the planes, else steps of the voxel's height; nothing of a text that
    is no XML.
    """
    try:
        pixels = next(stage.ome_entries(xml, "Pixels"), {})
    except ElementTree.ParseError:
        return TiffTags(
            notes=(
                "the OME tags are no XML: what they say of stage and pixel is not read",
            )
        )
    samples = next(stage.ome_entries(xml, "Channel"), {}).get("SamplesPerPixel", "1")
    _one_channel(path, int(pixels.get("SizeC", 1)) // int(samples))
    pixel = _ome_size(pixels, "X")
    step = _ome_size(pixels, "Z")
    position = stage.ome_positions(xml)
    planes, times = (max(int(pixels.get(f"Size{axis}", 1)), 1) for axis in "ZT")
    if len(position) or not math.isfinite(step) or step == 0 or planes == 1 < pages:
        return TiffTags(position, pixel, _words(pixel))
    order = pixels.get("DimensionOrder", "XYZCT")
    page = np.arange(pages)
    place = page % planes if order.index("Z") < order.index("T") else page // times
    note = f"stage step of {step:.4g} um from the OME tags"
    return TiffTags(place * step, pixel, (note, *_words(pixel)))


def _ome_size(pixels: dict[str, str], axis: str) -> float:
    name = f"PhysicalSize{axis}"
    return float(pixels.get(name, "nan")) * _UNITS.get(
        pixels.get(f"{name}Unit", "um"), math.nan
    )


def _one_channel(path: Path, channels: int) -> None:
    if channels > 1:
        raise CaptureError(
            f"{path}: {channels} channels in one file; save the one that is to be fitted"
        )


def _imagej(
    path: Path, about: dict[str, object], per_pixel: float, pages: int
) -> TiffTags:
    """Steps without a unit are in um; of a unit that is no length (pixels) neither
    steps nor a pixel are known.

    A stack that is seen several times steps through its slices each time; times alone
    tell no step.
    """
    _one_channel(path, int(str(about.get("channels", 1))))
    unit = str(about.get("unit", "")).lower()
    scale = _UNITS.get(unit, math.nan)
    step = float(str(about.get("spacing", "nan"))) * (scale if unit else 1.0)
    pixel = per_pixel * scale
    times = int(str(about.get("frames", 1)))
    slices = max(int(str(about.get("slices", pages if times == 1 else 1))), 1)
    stepped = math.isfinite(step) and step != 0 and (slices > 1 or pages == 1)
    position = np.arange(pages) % slices * step if stepped else np.empty(0)
    notes = (
        (f"stage step of {step:.4g} um from the ImageJ tags",) if len(position) else ()
    )
    return TiffTags(position, pixel, notes + _words(pixel))


def _resolution(page: object) -> float:
    """Width of a pixel in the file's unit; nan where it is not stated (1 / 1)."""
    tag = getattr(page, "tags", {}).get("XResolution")
    if tag is None or 0 in tag.value or tag.value[0] == tag.value[1]:
        return math.nan
    return float(tag.value[1] / tag.value[0])


def _words(pixel_um: float) -> tuple[str, ...]:
    return (
        (f"pixel of {pixel_um:.4g} um from the tags of the file",)
        if math.isfinite(pixel_um)
        else ()
    )
