"""Frames that a camera wrote in colour: one channel of them, where the bench says
which.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

CHANNELS = ("red", "green", "blue")


def red_first(image: Array) -> Array:
    """(y, x, red green blue [alpha]) of an image as OpenCV has it, blue first; grey (y,
    x) as it is.
    """
    return image[..., [2, 1, 0, 3][: image.shape[-1]]] if image.ndim == 3 else image


@dataclass(frozen=True, slots=True)
class ColourChannels:
    """Illuminated colour channel of the frames, and the layout of a raw Bayer mosaic.

    channel: one of ``CHANNELS``, or None. mosaic: letters of the 2 x 2 pixels that
    repeat, row by row from the first
    pixel of a frame (RGGB, BGGR, GRBG, GBRG); empty where every pixel holds all colours
    or none.
    """

    channel: str | None = None
    mosaic: str = ""

    @classmethod
    def of(cls, about: dict[str, Any], where: str) -> "ColourChannels":
        """Channel and mosaic of a capture's description, removed from it.

        Args:
            about: entries of the description.
            where: file or folder, for messages.

        Raises:
            CaptureError: an unknown channel or mosaic, a mosaic without a channel.
        """
        channel = about.pop("channel", None)
        mosaic = about.pop("mosaic", "")
        if channel is not None and channel not in CHANNELS:
            raise CaptureError(
                f"{where}: channel = {channel!r} in the capture's description; need "
                f"one of {CHANNELS}"
            )
        letters = str(mosaic).upper()
        if mosaic and (len(letters) != 4 or sorted(letters) != ["B", "G", "G", "R"]):
            raise CaptureError(
                f'{where}: mosaic = {mosaic!r}; need the 2 x 2 pixels row by row, as "RGGB"'
            )
        if mosaic and channel is None:
            raise CaptureError(
                f'{where}: a mosaic without the colour that is lit; say channel = "green" (red, blue) too'
            )
        return cls(channel, letters)

    @property
    def pitch(self) -> int:
        """Distance of the channel's pixels, in pixels of the sensor."""
        return 2 if self.mosaic else 1

    def pick(self, images: Array, path: Path, *, allow_grey: bool = True) -> Array:
        """One channel of (n, y, x, red green blue [alpha]) or of a raw mosaic (n, y,
        x); grey images as they are.

        Of two green pixels that of the upper row is used.

        Args:
            images: of one file.
            path: the file.
            allow_grey: whether grey images stand for the stated channel, as of a dark
                frame.

        Raises:
            CaptureError: colour without a channel, or where a mosaic was stated; a
                channel of grey images that are not allowed.
        """
        if images.ndim == 3 and self.mosaic:
            row, column = divmod(self.mosaic.index(str(self.channel)[0].upper()), 2)
            return images[:, row::2, column::2]
        if images.ndim == 3 and (allow_grey or self.channel is None):
            return images
        if images.ndim == 3:
            raise CaptureError(
                f"{path}: grey images, the capture's description says channel = "
                f"{self.channel!r}; leave it out for a sensor without colours, and of "
                'a raw Bayer mosaic say how its pixels lie: mosaic = "RGGB"'
            )
        if images.ndim != 4 or images.shape[-1] not in (3, 4):
            raise CaptureError(
                f"{path}: images of shape {images.shape}; need grey frames (n, y, x), "
                "or colour (n, y, x, 3)"
            )
        if self.mosaic:
            raise CaptureError(
                f"{path}: colour images of shape {images.shape[1:]}, the capture's "
                f"description says mosaic = {self.mosaic!r}: their colours were put "
                "together already; leave mosaic out, or save raw frames"
            )
        if self.channel is None:
            raise CaptureError(
                f"{path}: colour images of shape {images.shape[1:]}; grey frames "
                "straight from the sensor are best, else say which of them is lit: "
                'channel = "green" (or "red", "blue") in capture.toml'
            )
        return images[..., CHANNELS.index(self.channel)]

    def notes(self) -> list[str]:
        """Notes on the use of one colour channel; empty for grey frames."""
        if self.mosaic:
            return [
                f"channel {self.channel} used: one pixel in four of a mosaic "
                f"{self.mosaic}, at twice the pitch"
            ]
        if self.channel is None:
            return []
        return [
            f"channel {self.channel} used: where colours were interpolated, "
            "neighbouring pixels share their noise"
        ]
