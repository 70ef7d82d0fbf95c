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
_MOST_BYTES = 1 << 34  # of all frames of a file
_LOSSY = (6, 7, 33003, 33005, 34712)  # compressions: JPEG, JPEG 2000
_CFA = 32803  # what its values mean: a raw mosaic of colours
_MEANING = {
    0: "says that white is 0 (photometric 0)",
    3: "holds places in a table of colours",
}
_OPENCV = {
    5: "LZW",
    32773: "PackBits",
}  # what OpenCV's reader unpacks and tifffile leaves to a package of its own
_ELSEWHERE = {34925: "LZMA", 50000: "Zstandard"}  # only that package
_TURNED = 274  # the tag that says which way up an image is


def read_tiff(path: Path, *, coloured: bool = False, mosaic: bool = False) -> Array:
    """(n, y, x) images of a file, or (n, y, x, colours).

    Args:
        path: the file.
        coloured: separate planes are the colours of an image; else they are images,
            since some writers take a stack of
            three or four for colours.
        mosaic: whether it is known how a raw mosaic of colours lies.

    Raises:
        CaptureError: truncated, no TIFF file, JPEG inside, a compression that cannot be
            read, values packed without
            gaps, pages of different size or type; values where more is less light,
            places in a table of colours (a
            table of greys in order gives light), a raw mosaic of which nothing is
            known.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _check(path, file)
            _check_meaning(path, file, mosaic=mosaic)
            images = _images(path, file)
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
    """How many images a file holds: its pages, or what ImageJ laid behind the head of
    one (stacks above 4 GB).
    """
    about = (file.imagej_metadata or {}) if file.is_imagej else {}
    return (
        max(int(str(about.get("images", 1))), 1)
        if len(file.pages) == 1
        else len(file.pages)
    )


def page_order(path: Path) -> str | None:
    """How the images of a file lie where that is sure: "nyx" of pages written one by
    one, as cameras and image programs
    do; None of an array that was written at once (tifffile), whose axes may be any,
    unless it says them.

    Args:
        path: the file.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        about = file.shaped_metadata or ({},)
        at_once = (
            str(file.pages.first.tags.valueof(305, "")).startswith("tifffile")
            or file.is_shaped
        )
        axes = str(about[0].get("axes", ""))
        if not at_once or (len(axes) > 2 and axes.endswith("YX")):
            return "nyx"
        return "yxn" if axes[:2] == "YX" and len(axes) == 3 else None


def _images(path: Path, file: Any) -> Array:
    count, first = count_images(file), file.pages.first
    if count == len(file.pages):
        return np.stack(_alike(_pages(path, file), path))
    begins, size = first.dataoffsets[0], path.stat().st_size
    if int(first.compression) != 1 or begins + count * first.nbytes > size:
        raise CaptureError(
            f"{path}: says {count} images, as ImageJ writes large stacks, and has room for "
            f"{max((size - begins) // first.nbytes, 1)} ({size} bytes): truncated, or cut out of a stack; save it anew"
        )
    kind = first.dtype.newbyteorder(file.byteorder)
    values = np.fromfile(path, kind, count * math.prod(first.shape), offset=begins)
    return values.astype(first.dtype, copy=False).reshape(count, *first.shape)


def _pages(path: Path, file: Any) -> list[Array]:
    """The image of every page, in the file's own order of colours."""
    packed = {
        n for n, page in enumerate(file.pages) if int(page.compression) in _OPENCV
    }
    if not packed or importlib.util.find_spec("imagecodecs") is not None:
        return [page.asarray() for page in file.pages]
    found = _unpacked(path)
    images = []
    for number, page in enumerate(file.pages):
        if number not in packed:
            images.append(page.asarray())
            continue
        image = found[number] if len(found) == len(file.pages) else np.empty(0)
        turned = page.tags.valueof(_TURNED, 1) != 1  # which OpenCV turns upright
        if turned or image.shape != page.shape or image.dtype != page.dtype:
            raise CaptureError(
                f"{path}: frame {number} is compressed ({_OPENCV[int(page.compression)]}) and damaged, turned or of a "
                f"kind ({page.dtype}) that is not read so; save it plain or deflated, or install imagecodecs"
            )
        images.append(red_first(image))
    return images


def _unpacked(path: Path) -> Sequence[Array]:
    """All images of a file as OpenCV reads them, without its own words on what it
    cannot.
    """
    import cv2

    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return tuple(cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)[1])
    finally:
        cv2.utils.logging.setLogLevel(before)


def _check(path: Path, file: Any) -> None:
    size = path.stat().st_size
    claimed, begun = 0, set[int]()
    for number, page in enumerate(file.pages):
        claimed += page.nbytes
        if page.offset in begun:  # the library would go round for ever
            raise CaptureError(
                f"{path}: damaged: frame {number} is an earlier one, its list of frames is a ring"
            )
        begun.add(page.offset)
        if (
            page.nbytes > DENSEST * sum(page.databytecounts) + 65536
            or claimed > _MOST_BYTES
        ):
            raise CaptureError(
                f"{path}: frame {number} claims {page.shape} values, the file has {size} bytes"
            )
        end = max(
            (a + b for a, b in zip(page.dataoffsets, page.databytecounts, strict=True)),
            default=0,
        )
        if not 0 < end <= size:
            raise CaptureError(
                f"{path}: truncated in frame {number} ({size} bytes, need {end})"
            )
        packed = int(page.compression)
        if packed in _LOSSY:
            raise CaptureError(
                f"{path}: frame {number} is JPEG-compressed, its noise says nothing; save plain"
            )
        if packed in _ELSEWHERE and importlib.util.find_spec("imagecodecs") is None:
            raise CaptureError(
                f"{path}: frame {number} is compressed ({_ELSEWHERE[packed]}); save it plain or deflated, or install "
                "imagecodecs"
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
    """Refuse what values are not light, or not the same light in each pixel."""
    for number, page in enumerate(file.pages):
        meaning = int(getattr(page, "photometric", 1))
        if meaning in _MEANING and not _grey_table(page):
            raise CaptureError(
                f"{path}: frame {number} {_MEANING[meaning]}, so that its values are not light; save grey frames in "
                "which black is 0"
            )
        if meaning == _CFA and not mosaic:
            raise CaptureError(
                f"{path}: frame {number} is a raw mosaic of colours (CFA); say which is lit and how its pixels lie: "
                'channel = "green" and mosaic = "RGGB" in capture.toml'
            )


def _grey_table(page: Any) -> bool:
    """Whether a table of colours gives every value the grey in proportion to it, as
    some microscopes write theirs.
    """
    table = getattr(page, "colormap", None)
    if table is None:
        return False
    grey = np.arange(table.shape[1]) * (65_535 / (table.shape[1] - 1))
    return bool((np.abs(table - grey) <= grey[1]).all())  # 257 or 256 a step of 8 bits


def _alike(pages: Sequence[Array], path: Path) -> Sequence[Array]:
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
