"""The images of a TIFF file, refused where it is damaged, lossy or claims more than it
holds.
"""

import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

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


def read_tiff(path: Path, *, coloured: bool = False, mosaic: bool = False) -> Array:
    """(n, y, x) images of a file, or (n, y, x, colours).

    Args:
        path: the file.
        coloured: separate planes are the colours of an image; else they are images,
            since some writers take a stack of three or four for colours.
        mosaic: whether the layout of a raw mosaic of colours is stated.

    Raises:
        CaptureError: truncated, no TIFF file, JPEG inside, pages of different size or
            type; inverted values, colour tables (except of greys in order), a raw
            mosaic without its layout.
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
        RuntimeError,  # of a codec
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
            "for "
            f"{max((size - offset) // first.nbytes, 1)} ({size} bytes): truncated, or "
            "cut out of a stack; save it anew"
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
