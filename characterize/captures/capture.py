"""Bench captures as they lie on disk: frames, stage positions, dark and flat, with
their bit depth found out.
"""

import dataclasses
import logging
import math
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from characterize.captures import axes, folder, png, stage, tiff_pages, tiff_tags
from characterize.captures.bits import right_align
from characterize.captures.colour import ColourChannels
from metalens.core import reading, store, transaction
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, MetalensError

TIFF = (".tif", ".tiff", ".tf8", ".btf")
PNG = (".png",)
HDF5 = (".h5", ".hdf5")
LOSSY = (".jpg", ".jpeg", ".jp2", ".webp")
_PLAIN = ColourChannels()
Stack = tuple[Array, str]


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """Frames of a bench run in counts, right-aligned, and all that was written down
    with them.

    frames: (n, y, x) counts, +x right, +y down.
    position_um: (n,) of the stage as read (the depth of the source on a lens bench);
    nan where unknown.
    angle_rad: (n, 2) field angle of the source towards (+x, +y).
    exposure_s: (n,) nan where unknown.
    names: of every frame, for messages.
    bits: of the converter; the largest count is 2**bits - 1.
    pixel_um, wavelength_um: nan where unknown; the first is the pitch of the frames.
    fill: width of a pixel over that pitch: a half where frames are one colour of a
    mosaic.
    dark, flat: (k, y, x) counts, or None.
    about: further entries of the capture's description (numbers and words).
    corrections: what was changed on the way in, in words.
    """

    frames: Array
    position_um: Array
    angle_rad: Array
    exposure_s: Array
    names: tuple[str, ...]
    bits: int
    pixel_um: float = math.nan
    wavelength_um: float = math.nan
    dark: Array | None = None
    flat: Array | None = None
    about: dict[str, Any] = field(default_factory=dict)
    corrections: tuple[str, ...] = ()
    fill: float = 1.0

    def __post_init__(self) -> None:
        n, shape = len(self.frames), self.frames.shape[1:]
        if self.frames.ndim != 3 or n == 0 or min(shape) < 3:
            raise CaptureError(
                f"frames of shape {self.frames.shape}: need (n, y, x) with at least one frame of 3 x 3"
            )
        for name, wanted in (
            ("position_um", (n,)),
            ("angle_rad", (n, 2)),
            ("exposure_s", (n,)),
        ):
            if getattr(self, name).shape != wanted:
                raise CaptureError(
                    f"{name} has shape {getattr(self, name).shape}, need {wanted} for {n} frames"
                )
        for name in ("dark", "flat"):
            image = getattr(self, name)
            if image is not None and image.shape[1:] != shape:
                raise CaptureError(
                    f"{name} frames are {image.shape[1:]}, the frames {shape}; crop them alike"
                )

    @property
    def full_scale(self) -> int:
        """Largest count of the converter."""
        return int((1 << self.bits) - 1)


def load(path: str | Path) -> Capture:
    """Read a capture: a TIFF, PNG or HDF5 file, or a folder of them.

    A folder holds frames (named in ``stage.csv`` or ``stage.json``, else every image
    that is not dark or flat, in
    the order of their names, numbers counted), and may hold ``dark.tif``, ``flat.tif``
    and ``capture.toml`` or
    ``capture.json`` (pixel_um, step_um, wavelength_um, bits, and what else is known;
    ``voxel_um`` as z, y, x). A single
    file takes the same from ``NAME.toml`` or ``NAME.json`` beside it, else from its
    ImageJ or OME tags.

    Args:
        path: the file or folder.

    Raises:
        CaptureError: nothing there, lossy or truncated images, frames of different
            size, non-finite values,
            stage rows that do not match the frames; file, row and frame are named.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(
            f"{path}: no such file or folder; need a capture (TIFF, PNG, HDF5 or a folder of them)"
        )
    logging.getLogger("tifffile").setLevel(
        logging.CRITICAL
    )  # what it makes of a damaged file is said in one error
    try:
        return _load_folder(path) if path.is_dir() else _load_file(path)
    except MetalensError:
        raise
    except (
        *store.DAMAGE,
        IndexError,
        ArithmeticError,
        RecursionError,
        struct.error,
    ) as error:
        raise CaptureError(
            f"{path}: damaged, or entries of the wrong kind ({error})"
        ) from None


def read_images(path: Path) -> Array:
    """(n, y, x) grey images of one file, in its own number type.

    Args:
        path: the file.

    Raises:
        CaptureError: unknown, lossy, truncated or non-finite; colour.
    """
    return check_images(_PLAIN.pick(read_all(path), path), path)


def _stack(
    path: Path, colours: ColourChannels, order: str | None, *, count: int | None = None
) -> Stack:
    """Frames of one file and what to say of their axes."""
    images = read_all(path, colours)
    if order is None and path.suffix.lower() in TIFF:
        order = tiff_pages.page_order(path)
    images, note = axes.frames_first(images, path, order, count=count)
    return check_images(colours.pick(images, path, grey=False), path), note


def _beside(path: Path, colours: ColourChannels, size: tuple[int, ...]) -> Stack:
    """Dark or flat of frames of a size, and what to say of its axes."""
    images, note = axes.as_large(
        read_all(path, colours), path, size, pitch=colours.pitch
    )
    return check_images(colours.pick(images, path, grey=True), path), note


def check_images(images: Array, path: Path) -> Array:
    """Images as they are.

    Args:
        images: (n, y, x), or with colours last.
        path: the file.

    Raises:
        CaptureError: empty, of numbers that hold no counts, or non-finite.
    """
    if images.size == 0:
        raise CaptureError(f"{path}: images of shape {images.shape} are empty")
    _check_values(images, path)
    return images


def read_all(path: Path, colours: ColourChannels = _PLAIN) -> Array:
    """(n, y, x) or (n, y, x, red green blue [alpha]): the images of one file as they
    lie there.

    Args:
        path: the file.
        colours: which channel is lit, and how a mosaic lies.

    Raises:
        CaptureError: unknown, lossy or truncated.
    """
    suffix = path.suffix.lower()
    if suffix in LOSSY:
        raise CaptureError(
            f"{path}: {suffix} is lossy and gamma-coded, its noise says nothing; save TIFF, PNG or HDF5"
        )
    read_tiff = partial(
        tiff_pages.read_tiff,
        coloured=colours.channel is not None,
        mosaic=bool(colours.mosaic),
    )
    readers: dict[tuple[str, ...], Callable[[Path], Array]] = {
        TIFF: read_tiff,
        PNG: png.read_png,
        HDF5: _read_hdf5,
    }
    reader = next(
        (read for suffixes, read in readers.items() if suffix in suffixes), None
    )
    if reader is None:
        kind = suffix or "a file without suffix"
        raise CaptureError(
            f"{path}: cannot read {kind}; need TIFF, PNG or HDF5{folder.conversion_hint(suffix)}"
        )
    images = reader(path)
    return images[None] if images.ndim == 2 else images


def _load_file(path: Path) -> Capture:
    about = stage.read_beside(path)
    colours = ColourChannels.of(about, str(path))
    images, said = _stack(path, colours, axes.stated_axes(about, str(path)))
    tags = (
        tiff_tags.read_tags(path)
        if path.suffix.lower() in TIFF
        else tiff_tags.TiffTags()
    )
    images, bits, note, _ = right_align(images, about.pop("bits", None), str(path))
    n = len(images)
    step = about.get("step_um", math.nan)
    position = np.arange(n) * step if math.isfinite(step) else tags.position_um
    notes = [note, *([said] if said else []), *tags.notes, *colours.notes()]
    return Capture(
        images,
        position if len(position) == n else np.full(n, np.nan),
        np.zeros((n, 2)),
        np.full(n, np.nan),
        tuple(f"{reading.to_valid_utf8(path.name)}[{i}]" for i in range(n)),
        bits,
        pixel_um=about.pop("pixel_um", tags.pixel_um) * colours.pitch,
        wavelength_um=about.pop("wavelength_um", math.nan),
        about=about,
        corrections=tuple(notes),
        fill=1 / colours.pitch,
    )


def _load_folder(at: Path) -> Capture:
    transaction.check_manifest(at)
    about = stage.read_about(at)
    rows = stage.read_stage(at)
    files = folder.list_images(at, TIFF + PNG + HDF5 + LOSSY)
    special = {p.stem.lower(): p for p in files if p.stem.lower() in ("dark", "flat")}
    files = [p for p in files if p not in special.values()]
    colours = ColourChannels.of(about, str(at))
    order = axes.stated_axes(about, str(at))
    said = [
        *(stage.left_out(files, rows) if rows else ()),
        *stage.unread_keys_text(about),
        *folder.unread_images_text(at, special),
    ]
    if rows is None:
        names, frames, notes = _all_frames(files, at, colours, order)
        rows = stage.StageRows.unknown(names)
    else:
        frames, notes = _listed_frames(
            {stage.normalize_spelling(p.name): p for p in files},
            at,
            rows,
            colours,
            order,
        )
    beside = {
        name: _beside(p, colours, frames.shape[1:]) for name, p in special.items()
    }
    stacks = {name: images for name, (images, _) in beside.items()}
    said += [
        words for words in (*notes, *(words for _, words in beside.values())) if words
    ]
    bits = about.pop("bits", None)
    frames, depth, note, aligned = right_align(
        frames, bits, str(at), beside=tuple(stacks.values())
    )
    extra = dict(zip(stacks, aligned, strict=True))
    if "step_um" in about and not np.isfinite(rows.position_um).any():
        folder.check_steps(files if not rows.source else (), at)
        rows = dataclasses.replace(
            rows, position_um=np.arange(len(frames)) * float(about["step_um"])
        )
    return Capture(
        frames,
        rows.position_um,
        rows.angle_rad,
        rows.exposure_s,
        rows.files,
        depth,
        pixel_um=about.pop("pixel_um", math.nan) * colours.pitch,
        wavelength_um=about.pop("wavelength_um", math.nan),
        dark=extra.get("dark"),
        flat=extra.get("flat"),
        about=about,
        corrections=(note, *colours.notes(), *said),
        fill=1 / colours.pitch,
    )


def _all_frames(
    files: Sequence[Path], at: Path, colours: ColourChannels, order: str | None
) -> tuple[tuple[str, ...], Array, list[str]]:
    """Names, frames, and what to say of their axes."""
    if not files:
        raise CaptureError(f"{at}: no frames; need TIFF, PNG or HDF5 images in it")
    names: list[str] = []
    stacks, notes = [], []
    for path in files:
        images, note = _stack(path, colours, order)
        notes.append(note)
        names += (
            [f"{path.name}[{i}]" for i in range(len(images))]
            if len(images) > 1
            else [path.name]
        )
        stacks.append(images)
    return tuple(map(reading.to_valid_utf8, names)), _join(stacks, files), notes


def _listed_frames(
    there: Mapping[str, Path],
    at: Path,
    rows: stage.StageRows,
    colours: ColourChannels,
    order: str | None,
) -> tuple[Array, list[str]]:
    """The frames that the stage file names, in its order; without a column of pages,
    those of a stack in turn.

    With them what to say of their axes.
    """
    stacks: dict[str, Stack] = {}
    images = []
    rows_of, met = Counter(rows.files), Counter[str]()
    for row, (name, stated) in enumerate(zip(rows.files, rows.page, strict=True), 2):
        path = there.get(stage.normalize_spelling(name), at / name)
        if not path.is_file():
            raise CaptureError(
                f"{rows.source}, row {row}: frame {name!r} is not in {at}{folder.similar_name_hint(name, there)}"
            )
        if name not in stacks:
            count = rows_of[name] if stated is None else None
            stacks[name] = _stack(path, colours, order, count=count)
        stack = stacks[name][0]
        page = min(met[name], len(stack) - 1) if stated is None else stated
        met[name] += 1
        if stated is None and len(stack) not in (1, rows_of[name]):
            raise CaptureError(
                f"{rows.source}, row {row}: {name!r} holds {len(stack)} pages and stands in {rows_of[name]} rows; say "
                f"with a column page (from 0) which one each row means, or, if its {stack.shape} are not (n, y, x) but "
                '(y, x, n), axes = "yxn" in capture.toml'
            )
        if not 0 <= page < len(stack):
            raise CaptureError(
                f"{rows.source}, row {row}: page {page} (from 0) of {name!r}, which holds {len(stack)}"
            )
        images.append(stack[page][None])
    return _join(images, [at / name for name in rows.files]), [
        note for _, note in stacks.values()
    ]


def _join(stacks: Sequence[Array], files: Sequence[Path]) -> Array:
    for stack, path in zip(stacks, files, strict=True):
        if stack.shape[1:] != stacks[0].shape[1:] or stack.dtype != stacks[0].dtype:
            raise CaptureError(
                f"{path}: frame of {stack.shape[1:]} {stack.dtype}, others {stacks[0].shape[1:]} {stacks[0].dtype}"
            )
    return np.concatenate(stacks)


def _read_hdf5(path: Path) -> Array:
    try:
        if not path.is_file():  # a pipe would be waited for
            raise CaptureError(f"{path}: {reading.missing_reason(path)}")
        with h5py.File(path, "r") as file:
            return _frames_of(path, file)
    except MetalensError:
        raise
    except store.DAMAGE as error:
        raise CaptureError(
            f"{path}: truncated or not an HDF5 file ({error})"
        ) from error


def _frames_of(path: Path, file: h5py.File) -> Array:
    """The data set ``frames``."""
    if "frames" not in file:
        raise CaptureError(
            f"{path}: no data set 'frames' (n, y, x); found {', '.join(sorted(file)) or 'nothing'}"
        )
    if not isinstance(file.get("frames", getlink=True), h5py.HardLink):
        raise CaptureError(f"{path}: 'frames' is a link; need the data set itself")
    frames = file["frames"]
    if not isinstance(frames, h5py.Dataset):
        raise CaptureError(f"{path}: 'frames' is a group, need a data set (n, y, x)")
    store.check_claim(path, frames, "frames")
    return np.asarray(frames[...]).astype(frames.dtype.newbyteorder("="), copy=False)


def _check_values(images: Array, path: Path) -> None:
    if images.dtype.kind not in "uif" or images.dtype.itemsize > 8:
        raise CaptureError(
            f"{path}: values of type {images.dtype}; need whole or real numbers"
        )
    if images.dtype.kind == "f" and images.dtype.itemsize < 4:
        raise CaptureError(
            f"{path}: values of type {images.dtype} round counts above 2048; save whole numbers"
        )
    if images.dtype.kind == "f" and not np.isfinite(images).all():
        frame, row, column = (int(i) for i in np.argwhere(~np.isfinite(images))[0])
        raise CaptureError(
            f"{path}: {images[frame, row, column]} in frame {frame}, row {row}, column {column}"
        )
