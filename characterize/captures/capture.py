"""Bench captures as they lie on disk: frames, stage positions, dark and flat, with
their bit depth.
"""

import logging
import math
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from characterize.captures import folder, png, stage
from characterize.captures.bits import right_align
from characterize.captures.colour import ColourChannels
from characterize.captures.tiff import ImageFile, read_tiff
from metalens.core import reading, store, transaction
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, MetalensError
from metalens.core.notebook import RecordView, own_axes

TIFF = (".tif", ".tiff", ".tf8", ".btf")
PNG = (".png",)
HDF5 = (".h5", ".hdf5")
LOSSY = (".jpg", ".jpeg", ".jp2", ".webp")
_PLAIN = ColourChannels()


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Capture(RecordView):
    """Frames of a bench run in right-aligned counts, with their stage, camera and
    description.

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

    def plot(self, ax: Any = None, *, frame: int = 0) -> Any:
        """Draw one frame in counts; returns the axes.

        Args:
            ax: matplotlib axes; those of a new figure where none are given.
            frame: its number.
        """
        axes = own_axes(ax)
        axes.imshow(self.frames[frame], cmap="gray")
        axes.set(title=self.names[frame], xlabel="x / pixel", ylabel="y / pixel")
        return axes

    def to_xarray(self) -> Any:
        """xarray.Dataset of the counts over (frame, y, x), with the stage of every
        frame.
        """
        import xarray

        stage = {
            "position_um": self.position_um,
            "angle_x_rad": self.angle_rad[:, 0],
            "angle_y_rad": self.angle_rad[:, 1],
            "exposure_s": self.exposure_s,
        }
        return xarray.Dataset(
            {"frames": (("frame", "y", "x"), self.frames)},
            {name: (("frame",), values) for name, values in stage.items()},
            {"pixel_um": self.pixel_um, "bits": self.bits},
        )

    def __post_init__(self) -> None:
        n = len(self.frames)
        shape = self.frames.shape[1:]
        if self.frames.ndim != 3 or n == 0 or min(shape) < 3:
            raise CaptureError(
                f"frames of shape {self.frames.shape}: need (n, y, x) with at least "
                "one frame of 3 x 3"
            )
        for name, expected_shape in (
            ("position_um", (n,)),
            ("angle_rad", (n, 2)),
            ("exposure_s", (n,)),
        ):
            if getattr(self, name).shape != expected_shape:
                raise CaptureError(
                    f"{name} has shape {getattr(self, name).shape}, need "
                    f"{expected_shape} for {n} frames"
                )
        for name in ("dark", "flat"):
            image = getattr(self, name)
            if image is not None and image.shape[1:] != shape:
                raise CaptureError(
                    f"{name} frames are {image.shape[1:]}, the frames {shape}; crop "
                    "them equally"
                )

    @property
    def full_scale(self) -> int:
        """Largest count of the converter."""
        return int((1 << self.bits) - 1)


def load(path: str | Path) -> Capture:
    """Read a capture: a TIFF, PNG or HDF5 file, or a folder of them.

    A folder holds frames: those of ``stage.csv`` or ``stage.json``, else every image
    that is not dark or flat, by name (frame_2 before frame_10). It may hold
    ``dark.tif``, ``flat.tif`` and ``capture.toml`` or ``capture.json`` (pixel_um,
    step_um, wavelength_um, bits, and others; ``voxel_um`` as z, y, x). A single file
    has the same entries in ``NAME.toml`` or ``NAME.json``, else in its ImageJ or OME
    tags.

    Args:
        path: the file or folder.

    Raises:
        CaptureError: no such path, lossy or truncated images, frames of different size,
            non-finite values, stage rows that do not match the frames; file, row and
            frame are named.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(
            f"{path}: no such file or folder; need a capture (TIFF, PNG, HDF5 or a "
            "folder of them)"
        )
    logging.getLogger("tifffile").setLevel(
        logging.CRITICAL
    )  # what it makes of a damaged file is said in one error
    try:
        return _load(path)
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
    return check_images(_PLAIN.pick(read_all(path).images, path), path)


def check_images(images: Array, path: Path) -> Array:
    """Images as they are.

    Args:
        images: (n, y, x), or with colours last.
        path: the file.

    Raises:
        CaptureError: empty, of numbers that hold no counts, of half precision, or
            non-finite.
    """
    if images.size == 0:
        raise CaptureError(f"{path}: images of shape {images.shape} are empty")
    kind = images.dtype.kind
    if kind not in "uif" or images.dtype.itemsize > 8:
        raise CaptureError(
            f"{path}: values of type {images.dtype}; need whole or real numbers"
        )
    if kind == "f" and images.dtype.itemsize < 4:
        raise CaptureError(
            f"{path}: values of type {images.dtype} round counts above 2048; save "
            "whole numbers"
        )
    if not (finite := np.isfinite(images)).all():
        frame, row, column = (int(i) for i in np.argwhere(~finite)[0][:3])
        raise CaptureError(
            f"{path}: {images[frame, row, column]} in frame {frame}, row {row}, column "
            f"{column}"
        )
    return images


def read_all(path: Path, colours: ColourChannels = _PLAIN) -> ImageFile:
    """Images of one file as they lie there, (n, y, x) or (n, y, x, red green blue
    [alpha]), with what its tags state.

    Args:
        path: the file.
        colours: illuminated channel, and layout of a mosaic.

    Raises:
        CaptureError: unknown, lossy or truncated.
    """
    suffix = path.suffix.lower()
    if suffix in LOSSY:
        raise CaptureError(
            f"{path}: {suffix} is lossy and gamma-coded, its noise says nothing; save "
            "TIFF, PNG or HDF5"
        )
    if suffix in TIFF:
        return read_tiff(
            path, coloured=colours.channel is not None, mosaic=bool(colours.mosaic)
        )
    if suffix in PNG:
        images = png.read_png(path)
    elif suffix in HDF5:
        images = _read_hdf5(path)
    else:
        kind = suffix or "a file without suffix"
        raise CaptureError(
            f"{path}: cannot read {kind}; need TIFF, PNG or "
            f"HDF5{folder.conversion_hint(suffix)}"
        )
    return ImageFile(images[None] if images.ndim == 2 else images)


def _load(path: Path) -> Capture:
    """Capture of a folder with its tables, or of one file with the TOML of its name.

    The tags of a TIFF file count where it holds all frames and nothing else is stated.
    """
    description, rows, files = stage.read_sidecar(path), None, [path]
    companions: dict[str, Path] = {}
    notes: list[str] = []
    if path.is_dir():
        transaction.check_manifest(path)
        description = stage.read_about(path)
        rows = stage.read_stage(path)
        files = folder.list_images(path, TIFF + PNG + HDF5 + LOSSY)
        companions = {
            file.stem.lower(): file
            for file in files
            if file.stem.lower() in ("dark", "flat")
        }
        files = [file for file in files if file not in companions.values()]
        if rows:
            notes += stage.unlisted_images_text(files, rows)
        notes += stage.unread_keys_text(description)
        notes += folder.unread_images_text(path, companions)
    colours = ColourChannels.of(description, str(path))
    order = description.pop("axes", None)
    tags = ImageFile(np.empty(0))

    def read_frames(file: Path, *, is_frame: bool = True) -> Array:
        """(n, y, x) frames of one file in one colour."""
        nonlocal tags
        content = read_all(file, colours)
        tags = content if is_frame else tags
        images = _frames_first(content, file, order, notes)
        picked = colours.pick(images, file, allow_grey=not is_frame)
        return check_images(picked, file)

    if rows:
        frames = _listed_frames(files, path, rows, read_frames)
    else:
        names, frames = _all_frames(files, path, read_frames)
        rows = stage.StageRows.unknown(names)
    stacks = [read_frames(file, is_frame=False) for file in companions.values()]
    frames, bits, note, aligned = right_align(
        frames, description.pop("bits", None), str(path), companions=stacks
    )
    dark_and_flat = dict(zip(companions, aligned, strict=True))
    if len(files) > 1:
        tags = ImageFile(frames)
    position = rows.position_um
    if "step_um" in description and not np.isfinite(position).any():
        folder.check_steps(files if not rows.source else (), path)
        position = np.arange(len(frames)) * float(description["step_um"])
    elif not rows.source and len(tags.position_um) == len(frames):
        position = tags.position_um
    return Capture(
        frames,
        position,
        rows.angle_rad,
        rows.exposure_s,
        rows.files,
        bits,
        pixel_um=description.pop("pixel_um", tags.pixel_um) * colours.pitch,
        wavelength_um=description.pop("wavelength_um", math.nan),
        dark=dark_and_flat.get("dark"),
        flat=dark_and_flat.get("flat"),
        about=description,
        corrections=(note, *tags.notes, *colours.notes(), *notes),
        fill=1 / colours.pitch,
    )


def _frames_first(
    content: ImageFile, path: Path, order: str | None, notes: list[str]
) -> Array:
    """Images as (n, y, x), of colour images with these behind; appends to ``notes``
    where they lay otherwise.

    Args:
        content: the file's images.
        path: the file.
        order: of the axes as the description states it, "nyx" or "yxn"; None where it
            says nothing: that of the file.

    Raises:
        CaptureError: another order; or nothing is stated, and the last axis is the
            shortest, as of stacks whose frames run along it.
    """
    if order not in (None, "nyx", "yxn"):
        raise CaptureError(
            f'{path}: axes = {order!r}; need "nyx" (frames along the first axis of a '
            'stack) or "yxn" (along its last)'
        )
    stack, order = content.images, order or content.order
    if stack.ndim < 3 or len(stack) == 1 or order == "nyx":
        return stack
    first, second, last = stack.shape[:3]
    if order == "yxn":
        notes.append(
            f"{reading.to_valid_utf8(path.name)} taken as (y, x, n), {last} frames of "
            f"{first} x {second} pixels, as stated"
        )
        return np.ascontiguousarray(np.moveaxis(stack, 2, 0))
    if last < min(first, second):
        raise CaptureError(
            f"{path}: a stack of shape {stack.shape[:3]} is {first} frames of "
            f"{second} x {last} pixels as (n, y, x), but reads like {last} frames of "
            f'{first} x {second} as (y, x, n); say which: axes = "nyx" or axes = "yxn" '
            "in capture.toml (of a single file, in the TOML of its name beside it)"
        )
    return stack


def _all_frames(
    files: Sequence[Path], folder_path: Path, read: Callable[[Path], Array]
) -> tuple[tuple[str, ...], Array]:
    """Names and (n, y, x) frames of all image files, in order."""
    if not files:
        raise CaptureError(
            f"{folder_path}: no frames; need TIFF, PNG or HDF5 images in it"
        )
    stacks = [read(file) for file in files]
    names = [
        f"{file.name}[{i}]" if len(images) > 1 else file.name
        for file, images in zip(files, stacks, strict=True)
        for i in range(len(images))
    ]
    return tuple(map(reading.to_valid_utf8, names)), _join(stacks, files)


def _listed_frames(
    files: Sequence[Path],
    folder_path: Path,
    rows: stage.StageRows,
    read: Callable[[Path], Array],
) -> Array:
    """(n, y, x) frames in the order of the stage file.

    Without a page column, rows of one file take its pages one after the other.

    Args:
        files: image files of the folder.
        folder_path: folder of the capture.
        rows: rows of the stage file.
        read: gives the (n, y, x) frames of a file.
    """
    files_by_name = {stage.normalize_spelling(file.name): file for file in files}
    stacks: dict[str, Array] = {}
    images = []
    row_count = Counter(rows.files)
    pages_taken = Counter[str]()
    for row, (name, stated) in enumerate(zip(rows.files, rows.page, strict=True), 2):
        path = files_by_name.get(stage.normalize_spelling(name), folder_path / name)
        if not path.is_file():
            raise CaptureError(
                f"{rows.source}, row {row}: frame {name!r} is not in {folder_path}"
                f"{folder.similar_name_hint(name, files_by_name)}"
            )
        if name not in stacks:
            stacks[name] = read(path)
        stack = stacks[name]
        page = min(pages_taken[name], len(stack) - 1) if stated is None else stated
        pages_taken[name] += 1
        if stated is None and len(stack) not in (1, row_count[name]):
            raise CaptureError(
                f"{rows.source}, row {row}: {name!r} holds {len(stack)} pages and "
                f"stands in {row_count[name]} rows; say "
                "with a column page (from 0) which one each row means, or, if its "
                f"{stack.shape} are not (n, y, x) but "
                '(y, x, n), axes = "yxn" in capture.toml'
            )
        if not 0 <= page < len(stack):
            raise CaptureError(
                f"{rows.source}, row {row}: page {page} (from 0) of {name!r}, which "
                f"holds {len(stack)}"
            )
        images.append(stack[page][None])
    return _join(images, [folder_path / name for name in rows.files])


def _join(stacks: Sequence[Array], files: Sequence[Path]) -> Array:
    """Stacks as one (n, y, x) array; refuses frames of different size or type."""
    for stack, path in zip(stacks, files, strict=True):
        if stack.shape[1:] != stacks[0].shape[1:] or stack.dtype != stacks[0].dtype:
            raise CaptureError(
                f"{path}: frame of {stack.shape[1:]} {stack.dtype}, others "
                f"{stacks[0].shape[1:]} {stacks[0].dtype}"
            )
    return np.concatenate(stacks)


def _read_hdf5(path: Path) -> Array:
    """Data set ``frames`` of an HDF5 file; refuses a damaged file."""
    if not path.is_file():  # a pipe would be waited for
        raise CaptureError(f"{path}: {reading.missing_reason(path)}")
    try:
        with h5py.File(path, "r") as file:
            frames = file.get("frames")
            if not isinstance(frames, h5py.Dataset):
                raise CaptureError(
                    f"{path}: 'frames' is no data set (n, y, x) of this file, which has "
                    f"{', '.join(sorted(file)) or 'nothing'}"
                )
            store.check_claim(path, frames, "frames")
            native = frames.dtype.newbyteorder("=")
            return np.asarray(frames[...]).astype(native, copy=False)
    except MetalensError:
        raise
    except store.DAMAGE as error:
        raise CaptureError(
            f"{path}: truncated or not an HDF5 file ({error})"
        ) from error
