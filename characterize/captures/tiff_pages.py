"""The images of a TIFF file, refused where it is damaged, lossy or claims more than it
holds.
"""

import importlib.util
import math
import struct
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from characterize.captures.colour import red_first
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

DENSEST = 1040  # values' bytes for a byte of the file, at best
_MOST_BYTES = 1 << 34  # largest size of all frames of a file
_LOSSY = (6, 7, 33003, 33005, 34712)  # compressions: JPEG, JPEG 2000
_CFA = 32803  # photometric interpretation of a raw mosaic of colours
_REFUSED = {
    0: "says that white is 0 (photometric 0)",
    3: "holds places in a table of colours",
}
_OPENCV_CODECS = {
    5: "LZW",
    32773: "PackBits",
}  # what OpenCV's reader unpacks and tifffile leaves to a package of its own
_IMAGECODECS_ONLY = {34925: "LZMA", 50000: "Zstandard"}  # only that package
_ORIENTATION_TAG = 274  # the tag that says which way up an image is


def read_tiff(path: Path, *, coloured: bool = False, mosaic: bool = False) -> Array:
    """(n, y, x) images of a file, or (n, y, x, colours).

    Args:
        path: the file.
        coloured: separate planes are the colours of an image; else they are images,
            since some writers take a stack of three or four for colours.
        mosaic: whether the layout of a raw mosaic of colours is stated.

    Raises:
        CaptureError: truncated, no TIFF file, JPEG inside, a compression that cannot be
            read, values packed without gaps, pages of different size or type; inverted
            values, colour tables (except of greys in order), a raw mosaic without its
            layout.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _check_pages(path, file)
            _check_meaning(path, file, mosaic=mosaic)
            images = _read_images(path, file)
            planar = file.pages.first.planarconfig == 2
            if planar and coloured and images.ndim == 4:
                return np.moveaxis(images, 1, -1)
            return np.asarray(
                images.reshape(-1, *images.shape[-2:]) if planar else images
            )
    except CaptureError:
        raise
    except (
        tifffile.TiffFileError,
        *store.DAMAGE,
        IndexError,
        ArithmeticError,
        struct.error,
        zlib.error,
    ) as error:
        raise CaptureError(f"{path}: truncated or not a TIFF file ({error})") from error


def count_images(file: Any) -> int:
    """Number of images of a file: its pages, or of a one-page ImageJ file (stacks above
    4 GB) the number in its metadata.
    """
    metadata = (file.imagej_metadata or {}) if file.is_imagej else {}
    return (
        max(int(str(metadata.get("images", 1))), 1)
        if len(file.pages) == 1
        else len(file.pages)
    )


def page_order(path: Path) -> str | None:
    """Order of the axes of a file's images, where it is certain.

    "nyx" for pages written one by one, as cameras and image programs do. An array that
    tifffile wrote at once may have any order: that of its metadata, else None.

    Args:
        path: the file.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        metadata = file.shaped_metadata or ({},)
        is_array = (
            str(file.pages.first.tags.valueof(305, "")).startswith("tifffile")
            or file.is_shaped
        )
        axes = str(metadata[0].get("axes", ""))
        if not is_array or (len(axes) > 2 and axes.endswith("YX")):
            return "nyx"
        return "yxn" if axes[:2] == "YX" and len(axes) == 3 else None


def _read_images(path: Path, file: Any) -> Array:
    """(n, ...) images of all pages, or of ImageJ's large stacks the values after the
    head of the only page.
    """
    count = count_images(file)
    first = file.pages.first
    if count == len(file.pages):
        return np.stack(_check_equal(_page_images(path, file), path))
    offset = first.dataoffsets[0]
    size = path.stat().st_size
    if int(first.compression) != 1 or offset + count * first.nbytes > size:
        raise CaptureError(
            f"{path}: says {count} images, as ImageJ writes large stacks, and has room "
            "for "
            f"{max((size - offset) // first.nbytes, 1)} ({size} bytes): truncated, or "
            "cut out of a stack; save it anew"
        )
    dtype = first.dtype.newbyteorder(file.byteorder)
    values = np.fromfile(path, dtype, count * math.prod(first.shape), offset=offset)
    return values.astype(first.dtype, copy=False).reshape(count, *first.shape)


def _page_images(path: Path, file: Any) -> list[Array]:
    """Image of every page, in the file's own order of colours.

    Without imagecodecs, LZW and PackBits pages are read by OpenCV.
    """
    compressed = {
        n
        for n, page in enumerate(file.pages)
        if int(page.compression) in _OPENCV_CODECS
    }
    if not compressed or importlib.util.find_spec("imagecodecs") is not None:
        return [page.asarray() for page in file.pages]
    unpacked = _opencv_images(path)
    images = []
    for number, page in enumerate(file.pages):
        if number not in compressed:
            images.append(page.asarray())
            continue
        image = unpacked[number] if len(unpacked) == len(file.pages) else np.empty(0)
        is_turned = (
            page.tags.valueof(_ORIENTATION_TAG, 1) != 1
        )  # which OpenCV turns upright
        if is_turned or image.shape != page.shape or image.dtype != page.dtype:
            raise CaptureError(
                f"{path}: frame {number} is compressed ({_OPENCV_CODECS[int(page.compression)]}) and damaged, "
                f"turned or of a kind ({page.dtype}) that is not read so; save it plain or deflated, or install imagecodecs"
            )
        images.append(red_first(image))
    return images


def _opencv_images(path: Path) -> Sequence[Array]:
    """All images of a file as OpenCV reads them, with its log switched off."""
    import cv2

    previous_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return tuple(cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)[1])
    finally:
        cv2.utils.logging.setLogLevel(previous_level)


def _check_pages(path: Path, file: Any) -> None:
    """Refuse pages that form a ring, claim more values than the file can hold, are
    truncated, lossy, or need imagecodecs that is not installed.
    """
    size = path.stat().st_size
    claimed = 0
    offsets = set[int]()
    for number, page in enumerate(file.pages):
        claimed += page.nbytes
        if page.offset in offsets:  # the library would go round for ever
            raise CaptureError(
                f"{path}: damaged: frame {number} is an earlier one, its list of frames is a ring"
            )
        offsets.add(page.offset)
        if (
            page.nbytes > DENSEST * sum(page.databytecounts) + 65536
            or claimed > _MOST_BYTES
        ):
            raise CaptureError(
                f"{path}: frame {number} claims {page.shape} values, the file has {size} bytes"
            )
        end = max(
            (
                start + length
                for start, length in zip(
                    page.dataoffsets, page.databytecounts, strict=True
                )
            ),
            default=0,
        )
        if not 0 < end <= size:
            raise CaptureError(
                f"{path}: truncated in frame {number} ({size} bytes, need {end})"
            )
        compression = int(page.compression)
        if compression in _LOSSY:
            raise CaptureError(
                f"{path}: frame {number} is JPEG-compressed, its noise says nothing; save plain"
            )
        if (
            compression in _IMAGECODECS_ONLY
            and importlib.util.find_spec("imagecodecs") is None
        ):
            raise CaptureError(
                f"{path}: frame {number} is compressed ({_IMAGECODECS_ONLY[compression]}); save it plain or "
                "deflated, or install imagecodecs"
            )
        if (
            page.bitspersample not in (8, 16, 32, 64)
            and importlib.util.find_spec("imagecodecs") is None
        ):
            raise CaptureError(
                f"{path}: values of frame {number} are {page.bitspersample} bits wide, packed without gaps; save them "
                "in words of 16 bits, or install imagecodecs"
            )


def _check_meaning(path: Path, file: Any, *, mosaic: bool) -> None:
    """Refuse pages whose values are not light (white is 0, colour tables), or a raw
    mosaic that the description does not state.
    """
    for number, page in enumerate(file.pages):
        meaning = int(getattr(page, "photometric", 1))
        if meaning in _REFUSED and not _grey_table(page):
            raise CaptureError(
                f"{path}: frame {number} {_REFUSED[meaning]}, so that its values are not light; save grey frames in "
                "which black is 0"
            )
        if meaning == _CFA and not mosaic:
            raise CaptureError(
                f"{path}: frame {number} is a raw mosaic of colours (CFA); say which is lit and how its pixels lie: "
                'channel = "green" and mosaic = "RGGB" in capture.toml'
            )


def _grey_table(page: Any) -> bool:
    """Whether a page's colour table maps every value to the grey proportional to it, as
    some microscopes write.
    """
    table = getattr(page, "colormap", None)
    if table is None:
        return False
    linear = np.arange(table.shape[1]) * (65_535 / (table.shape[1] - 1))
    return bool(
        (np.abs(table - linear) <= linear[1]).all()
    )  # 257 or 256 a step of 8 bits


def _check_equal(pages: Sequence[Array], path: Path) -> Sequence[Array]:
    """The pages; refuses pages of different size or type."""
    for number, page in enumerate(pages):
        if page.shape != pages[0].shape:
            raise CaptureError(
                f"{path}: frame {number} is {page.shape}, frame 0 {pages[0].shape}; keep one size a file"
            )
        if page.dtype != pages[0].dtype:
            raise CaptureError(
                f"{path}: frame {number} is {page.dtype}, frame 0 {pages[0].dtype}; keep one type a file"
            )
    return pages
