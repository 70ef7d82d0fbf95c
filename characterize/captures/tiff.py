"""TIFF files: their images, the order of their axes, and the stage and pixel of ImageJ's
and OME's tags; damaged and lossy files are refused.
"""

import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from characterize.captures import stage
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

DENSEST = 1040  # values' bytes for a byte of the file, at best
_MOST_BYTES = 1 << 34  # largest size of all frames of a file
_LOSSY = (6, 7, 33003, 33005, 34712)  # compressions: JPEG, JPEG 2000
_PACKBITS = 32773  # whose predictor libtiff, and so all programs, ignore
_CFA = 32803  # photometric interpretation of a raw mosaic of colours
_REFUSED = {
    0: "says that white is 0 (photometric 0)",
    3: "holds places in a table of colours",
}


@dataclass(frozen=True, eq=False, slots=True)
class ImageFile:
    """Images of one file with what its tags state.

    images: (n, y, x), (y, x, n), or either with colours last.
    order: of the axes, "nyx" or "yxn"; None where the file does not say.
    position_um: (n,) of the stage, empty where not stated. pixel_um: nan where not
    stated. notes: where they come from, in words.
    """

    images: Array
    order: str | None = None
    position_um: Array = field(default_factory=lambda: np.empty(0))
    pixel_um: float = math.nan
    notes: tuple[str, ...] = ()


def read_tiff(path: Path, *, coloured: bool = False, mosaic: bool = False) -> ImageFile:
    """Images of a TIFF file with the stage and pixel of its tags.

    Args:
        path: the file.
        coloured: separate planes are the colours of an image; else they are images,
            since some writers take a stack of three or four for colours.
        mosaic: whether the layout of a raw mosaic of colours is stated.

    Raises:
        CaptureError: truncated, no TIFF file, JPEG inside, pages of different size or
            type; inverted values, colour tables (except of greys in order), a raw
            mosaic without its layout; several channels.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _check_pages(path, file)
            _check_meaning(path, file, mosaic=mosaic)
            images = _read_pages(path, file)
            if file.pages.first.planarconfig == 2:
                images = (
                    np.moveaxis(images, 1, -1)
                    if coloured and images.ndim == 4
                    else images.reshape(-1, *images.shape[-2:])
                )
            tags = _read_tags(path, file, len(images))
            return ImageFile(np.asarray(images), _axis_order(file), *tags)
    except CaptureError:
        raise
    except (
        tifffile.TiffFileError,
        *store.DAMAGE,
        IndexError,
        ArithmeticError,
        RuntimeError,  # of a codec
        struct.error,
        zlib.error,
    ) as error:
        raise CaptureError(f"{path}: truncated or not a TIFF file ({error})") from error


def _axis_order(file: Any) -> str | None:
    """Order of the axes of a file's images, where it is certain.

    "nyx" for pages written one by one, as cameras and image programs do, and with the
    tags of ImageJ or OME. An array that tifffile wrote at once may have any order: that
    of its metadata, else None.
    """
    axes = str((file.shaped_metadata or [{}])[0].get("axes", ""))
    writer = str(file.pages.first.tags.valueof(305, ""))
    is_array = writer.startswith("tifffile") or file.is_shaped
    if file.is_imagej or file.is_ome or not is_array or axes[1:].endswith("YX"):
        return "nyx"
    return "yxn" if axes[:2] == "YX" and len(axes) == 3 else None


def _read_pages(path: Path, file: Any) -> Array:
    """(n, ...) images of all pages. An ImageJ file above 4 GB has one page, with all
    images behind its head.
    """
    first = file.pages.first
    metadata = (file.imagej_metadata or {}) if file.is_imagej else {}
    count = int(metadata.get("images", 1)) if len(file.pages) == 1 else 0
    if count <= 1:
        images = []
        for page in file.pages:
            if int(page.compression) == _PACKBITS:
                page.keyframe.predictor = 1
            images.append(page.asarray())
        return np.stack(images)
    offset = first.dataoffsets[0]
    size = path.stat().st_size
    if int(first.compression) != 1 or offset + count * first.nbytes > size:
        raise CaptureError(
            f"{path}: says {count} images, as ImageJ writes large stacks, and has room "
            f"for {max((size - offset) // first.nbytes, 1)} ({size} bytes): truncated, "
            "or cut out of a stack; save it anew"
        )
    dtype = first.dtype.newbyteorder(file.byteorder)
    values = np.fromfile(path, dtype, count * math.prod(first.shape), offset=offset)
    return values.astype(first.dtype, copy=False).reshape(count, *first.shape)


def _check_pages(path: Path, file: Any) -> None:
    """Refuse pages that form a ring, claim more values than the file can hold, are
    truncated, lossy, or of different size or type.
    """
    size = path.stat().st_size
    claimed = 0
    offsets = set[int]()
    for number, page in enumerate(file.pages):
        claimed += page.nbytes
        if page.offset in offsets:  # the library would go round for ever
            raise CaptureError(
                f"{path}: damaged: frame {number} is an earlier one, its list of "
                "frames is a ring"
            )
        offsets.add(page.offset)
        if (
            page.nbytes > DENSEST * sum(page.databytecounts) + 65536
            or claimed > _MOST_BYTES
        ):
            raise CaptureError(
                f"{path}: frame {number} claims {page.shape} values, the file has "
                f"{size} bytes"
            )
        end = max(
            map(sum, zip(page.dataoffsets, page.databytecounts, strict=True)), default=0
        )
        if not 0 < end <= size:
            raise CaptureError(
                f"{path}: truncated in frame {number} ({size} bytes, need {end})"
            )
        if int(page.compression) in _LOSSY:
            raise CaptureError(
                f"{path}: frame {number} is JPEG-compressed, its noise says nothing; "
                "save plain"
            )
        for name, word in (("shape", "size"), ("dtype", "type")):
            here, there = getattr(page, name), getattr(file.pages.first, name)
            if here != there:
                raise CaptureError(
                    f"{path}: frame {number} is {here}, frame 0 {there}; keep one "
                    f"{word} a file"
                )


def _check_meaning(path: Path, file: Any, *, mosaic: bool) -> None:
    """Refuse pages whose values are not light (white is 0, colour tables), or a raw
    mosaic that the description does not state.
    """
    for number, page in enumerate(file.pages):
        meaning = int(getattr(page, "photometric", 1))
        if meaning in _REFUSED and not _is_grey_table(page):
            raise CaptureError(
                f"{path}: frame {number} {_REFUSED[meaning]}, so that its values are "
                "not light; save grey frames in which black is 0"
            )
        if meaning == _CFA and not mosaic:
            raise CaptureError(
                f"{path}: frame {number} is a raw mosaic of colours (CFA); say which "
                'is lit and how its pixels lie: channel = "green" and mosaic = "RGGB" '
                "in capture.toml"
            )


def _is_grey_table(page: Any) -> bool:
    """Whether a page's colour table maps every value to the grey proportional to it, as
    some microscopes write.
    """
    table = getattr(page, "colormap", None)
    if table is None:
        return False
    linear = np.linspace(0, 65_535, table.shape[1])
    # 257 or 256 a step of 8 bits
    return bool((np.abs(table - linear) <= linear[1]).all())


def _read_tags(
    path: Path, file: Any, pages: int
) -> tuple[Array, float, tuple[str, ...]]:
    """Stage positions, pixel in um and notes, as :class:`ImageFile` has them.

    Positions are those of OME's planes, else multiples of the step between slices; each
    time point steps through the slices anew. A spacing of ImageJ without a unit is in
    um; a unit that is no length (pixels) gives neither steps nor pixel.
    """
    tags: dict[str, Any]
    positions: Array = np.empty(0)
    slow_first = False
    if file.is_imagej and file.imagej_metadata:
        source, tags = "ImageJ", file.imagej_metadata
        unit = str(tags.get("unit", ""))
        scale = stage.unit_um(unit)
        step = float(tags.get("spacing", math.nan)) * (scale if unit else 1.0)
        pixel = _pixel_width(file.pages.first) * scale
        channels, times = int(tags.get("channels", 1)), int(tags.get("frames", 1))
        slices = int(tags.get("slices", pages if times == 1 else 1))
    elif file.is_ome and file.ome_metadata:
        try:
            root = ElementTree.fromstring(file.ome_metadata)
        except ElementTree.ParseError:
            words = (
                "the OME tags are no XML: what they say of stage and pixel is not read"
            )
            return positions, math.nan, (words,)
        source, tags = "OME", next(_elements(root, "Pixels"), {})
        step, pixel = (
            float(tags.get(f"PhysicalSize{axis}", math.nan))
            * stage.unit_um(tags.get(f"PhysicalSize{axis}Unit", "um"))
            for axis in "ZX"
        )
        samples = next(_elements(root, "Channel"), {}).get("SamplesPerPixel", 1)
        channels = int(tags.get("SizeC", 1)) // int(samples)
        times, slices = int(tags.get("SizeT", 1)), int(tags.get("SizeZ", 1))
        order = tags.get("DimensionOrder", "XYZCT")
        slow_first = order.index("Z") > order.index("T")
        positions = _plane_positions(root, "TZ" if slow_first else "ZT")
    else:
        return positions, math.nan, ()
    if channels > 1:
        raise CaptureError(
            f"{path}: {channels} channels in one file; save the one that is to be "
            "fitted"
        )
    notes = []
    has_steps = math.isfinite(step) and step != 0 and (slices > 1 or pages == 1)
    if has_steps and not len(positions):
        page = np.arange(pages)
        number = page // max(times, 1) if slow_first else page % max(slices, 1)
        positions = number * step
        notes.append(f"stage step of {step:.4g} um from the {source} tags")
    if math.isfinite(pixel):
        notes.append(f"pixel of {pixel:.4g} um from the tags of the file")
    return positions, pixel, tuple(notes)


def _elements(root: ElementTree.Element, name: str) -> Iterator[dict[str, str]]:
    """Attributes of each element of a name, of whatever namespace."""
    return (e.attrib for e in root.iter() if str(e.tag).rpartition("}")[2] == name)


def _plane_positions(root: ElementTree.Element, fast_first: str) -> Array:
    """(n,) stage positions of OME's planes in um, in the order of the pages; empty
    where one has none, or one in no length ("reference frame").

    Planes carry their place in the stack (TheZ, TheT), and may be listed in any order.

    Args:
        root: OME-XML.
        fast_first: "ZT" where pages step through the slices first, else "TZ".
    """
    planes = sorted(
        _elements(root, "Plane"),
        key=lambda plane: [int(plane.get(f"The{a}", 0)) for a in fast_first[::-1]],
    )
    positions = np.array(
        [
            float(plane.get("PositionZ", math.nan))
            * stage.unit_um(plane.get("PositionZUnit", "um"))
            for plane in planes
        ]
    )
    return positions if np.isfinite(positions).all() else np.empty(0)


def _pixel_width(page: Any) -> float:
    """Width of a pixel in the file's unit; nan where it is not stated (1 / 1)."""
    tag = page.tags.get("XResolution")
    if tag is None or 0 in tag.value or tag.value[0] == tag.value[1]:
        return math.nan
    return float(tag.value[1] / tag.value[0])
