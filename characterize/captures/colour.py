"""Frames that a camera wrote in colour: one channel of them, where the bench says which."""

from pathlib import Path

from metalens.ground.arrays import Array
from metalens.ground.errors import CaptureError

CHANNELS = ("red", "green", "blue")


def pick(images: Array, channel: object, path: Path) -> Array:
    """One channel of (n, y, x, red green blue [alpha]); grey frames as they are.

    Raises:
        CaptureError: colour without a channel, or an unknown one.
    """
    if channel is not None and channel not in CHANNELS:
        raise CaptureError(f"{path}: channel = {channel!r} in the capture's description; need one of {CHANNELS}")
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
