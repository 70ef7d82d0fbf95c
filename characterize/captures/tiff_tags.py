"""Stage positions and pixel from the tags of a TIFF file: ImageJ (spacing, resolution)
and OME-XML.
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
    """Stage and pixel of a TIFF file.

    position_um: (n,) of the frames, empty where not stated. pixel_um: nan where not
    stated. notes: where they come from, in words.
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
            return _imagej_tags(
                path,
                file.imagej_metadata,
                _pixel_width(file.pages[0]),
                tiff_pages.count_images(file),
            )
        if file.is_ome and file.ome_metadata:
            return _ome_tags(path, file.ome_metadata, len(file.pages))
    return TiffTags()


def _ome_tags(path: Path, xml: str, pages: int) -> TiffTags:
    """Tags of OME-XML: stage positions of the planes, else multiples of the voxel's
    height; a note alone where it is no XML.

    Args:
        path: the file, for messages.
        xml: OME-XML text.
        pages: number of pages of the file.
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
    _check_channels(path, int(pixels.get("SizeC", 1)) // int(samples))
    pixel = _ome_size(pixels, "X")
    step = _ome_size(pixels, "Z")
    position = stage.ome_positions(xml)
    planes, times = (max(int(pixels.get(f"Size{axis}", 1)), 1) for axis in "ZT")
    if len(position) or not math.isfinite(step) or step == 0 or planes == 1 < pages:
        return TiffTags(position, pixel, _pixel_note(pixel))
    order = pixels.get("DimensionOrder", "XYZCT")
    page = np.arange(pages)
    plane = page % planes if order.index("Z") < order.index("T") else page // times
    note = f"stage step of {step:.4g} um from the OME tags"
    return TiffTags(plane * step, pixel, (note, *_pixel_note(pixel)))


def _ome_size(pixels: dict[str, str], axis: str) -> float:
    """Size of a voxel along an axis in um; nan where not stated or of no length."""
    name = f"PhysicalSize{axis}"
    return float(pixels.get(name, "nan")) * _UNITS.get(
        pixels.get(f"{name}Unit", "um"), math.nan
    )


def _check_channels(path: Path, channels: int) -> None:
    if channels > 1:
        raise CaptureError(
            f"{path}: {channels} channels in one file; save the one that is to be fitted"
        )


def _imagej_tags(
    path: Path, metadata: dict[str, object], per_pixel: float, pages: int
) -> TiffTags:
    """Tags of ImageJ: stage positions, pixel and notes.

    A spacing without a unit is in um; a unit that is no length (pixels) gives neither
    steps nor pixel. Each time point steps through the slices anew.

    Args:
        metadata: ImageJ's metadata.
        per_pixel: width of a pixel in the file's unit.
        pages: number of images.
    """
    _check_channels(path, int(str(metadata.get("channels", 1))))
    unit = str(metadata.get("unit", "")).lower()
    scale = _UNITS.get(unit, math.nan)
    step = float(str(metadata.get("spacing", "nan"))) * (scale if unit else 1.0)
    pixel = per_pixel * scale
    times = int(str(metadata.get("frames", 1)))
    slices = max(int(str(metadata.get("slices", pages if times == 1 else 1))), 1)
    has_steps = math.isfinite(step) and step != 0 and (slices > 1 or pages == 1)
    position = np.arange(pages) % slices * step if has_steps else np.empty(0)
    notes = (
        (f"stage step of {step:.4g} um from the ImageJ tags",) if len(position) else ()
    )
    return TiffTags(position, pixel, notes + _pixel_note(pixel))


def _pixel_width(page: object) -> float:
    """Width of a pixel in the file's unit; nan where it is not stated (1 / 1)."""
    tag = getattr(page, "tags", {}).get("XResolution")
    if tag is None or 0 in tag.value or tag.value[0] == tag.value[1]:
        return math.nan
    return float(tag.value[1] / tag.value[0])


def _pixel_note(pixel_um: float) -> tuple[str, ...]:
    return (
        (f"pixel of {pixel_um:.4g} um from the tags of the file",)
        if math.isfinite(pixel_um)
        else ()
    )
