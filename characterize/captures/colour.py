"""Frames that a camera wrote in colour: one channel of them, where the bench says which."""

from pathlib import Path

from metalens.ground.arrays import Array
from metalens.ground.errors import CaptureError

CHANNELS = ("red", "green", "blue")


def pick(images: Array, channel: object, path: Path, *, grey: bool = True) -> Array:
    """One channel of (n, y, x, red green blue [alpha]); grey images as they are.

    Args:
        grey: False where a channel can only be that of colour images.

    Raises:
        CaptureError: colour without a channel, or an unknown one; a channel of grey images where they cannot be.
    """
    if channel is not None and channel not in CHANNELS:
        raise CaptureError(f"{path}: channel = {channel!r} in the capture's description; need one of {CHANNELS}")
    if images.ndim == 3 and channel is not None and not grey:
        raise CaptureError(
            f"{path}: grey images, the capture's description says channel = {channel!r}; leave it out for a sensor "
            "without colours, and save a raw Bayer mosaic as the pixels of the lit colour alone, with their pitch"
        )
    if images.ndim == 3:
        return images
    if images.ndim != 4 or images.shape[-1] not in (3, 4):
        raise CaptureError(
            f"{path}: images of shape {images.shape}; need grey frames (n, y, x), or colour (n, y, x, 3)"
        )
    if channel is None:
        raise CaptureError(
            f"{path}: colour images of shape {images.shape[1:]}; grey frames straight from the sensor are best, else "
            'say which of them is lit: channel = "green" (or "red", "blue") in capture.toml'
        )
    return images[..., CHANNELS.index(str(channel))]


def notes(channel: object) -> list[str]:
    """What to say of frames that were a channel."""
    if channel is None:
        return []
    return [f"channel {channel} used: where colours were interpolated, neighbouring pixels share their noise"]
