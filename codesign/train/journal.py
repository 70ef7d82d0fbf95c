"""TensorBoard event files of a run, written without TensorBoard: scalars and pictures
(PSFs, frames, masks).

A file is a list of records (length, its checksum, content, its checksum; masked
CRC-32C) whose contents are ``Event``
messages in protocol-buffer encoding. ``tensorboard --logdir RUN_DIR`` shows them.
"""

import functools
import struct
import time
from collections.abc import Mapping
from pathlib import Path

EVENTS = "events.out.tfevents.0.codesign"


class Journal:
    """Appends to the event file of a folder; a resumed run goes on in the same file."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / EVENTS
        if not self.path.exists():
            self._append(_bytes(3, b"brain.Event:2"))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers of a step, by name."""
        parts = [
            _bytes(1, _bytes(1, name.encode()) + _key(2, 5) + struct.pack("<f", v))
            for name, v in values.items()
        ]
        self._append(_key(2, 0) + _varint(step) + _bytes(5, b"".join(parts)))

    def picture(self, step: int, name: str, png: bytes) -> None:
        """A PNG picture of a step."""
        width, height = struct.unpack(
            ">II", png[16:24]
        )  # of the header chunk that every PNG begins with
        size = (
            _key(1, 0)
            + _varint(height)
            + _key(2, 0)
            + _varint(width)
            + _key(3, 0)
            + _varint(4)
        )
        value = _bytes(1, name.encode()) + _bytes(4, size + _bytes(4, png))
        self._append(_key(2, 0) + _varint(step) + _bytes(5, _bytes(1, value)))

    def _append(self, event: bytes) -> None:
        content = _key(1, 1) + struct.pack("<d", time.time()) + event
        length = struct.pack("<Q", len(content))
        with open(self.path, "ab") as file:
            file.write(length + _checksum(length) + content + _checksum(content))


def _checksum(content: bytes) -> bytes:
    crc = crc32c(content)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def crc32c(content: bytes) -> int:
    """CRC-32 by Castagnoli's polynomial."""
    crc = 0xFFFFFFFF
    table = _crc_table()
    for byte in content:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


@functools.cache
def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


def _key(number: int, kind: int) -> bytes:
    return _varint(number << 3 | kind)


def _bytes(number: int, content: bytes) -> bytes:
    return _key(number, 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
