"""Event files: checksums by known answers, and every record read back by an independent
reader of the format.
"""

import struct

import pytest

from codesign.train.journal import EVENTS, Journal, crc32c


def test_castagnoli_checksum_of_the_known_vectors():
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA  # RFC 3720, B.4


def _records(content):
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        for data, mark in (
            (content[:8], content[8:12]),
            (content[12 : 12 + length], content[12 + length : 16 + length]),
        ):
            crc = crc32c(data)
            assert (
                struct.unpack("<I", mark)[0]
                == ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
            )
        yield content[12 : 12 + length]
        content = content[16 + length :]


def _varint(data, at):
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _fields(data):
    at, found = 0, []
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = _varint(data, at)
        elif kind == 1:
            value, at = struct.unpack("<d", data[at : at + 8])[0], at + 8
        elif kind == 5:
            value, at = struct.unpack("<f", data[at : at + 4])[0], at + 4
        else:
            size, at = _varint(data, at)
            value, at = data[at : at + size], at + size
        found.append((key >> 3, value))
    return found


def test_events_read_back_as_they_were_written(tmp_path):
    from metalens.ground import report

    figure, _ = report.canvas(size=(2.0, 1.0))
    png = report.png(figure)
    Journal(tmp_path).scalars(300, {"loss": 0.5, "pitch": 9.25})
    Journal(tmp_path).picture(301, "psf", png)
    version, scalars, picture = (
        _fields(r) for r in _records((tmp_path / EVENTS).read_bytes())
    )
    assert dict(version)[3] == b"brain.Event:2"
    assert dict(scalars)[2] == 300
    values = [dict(_fields(v)) for _, v in _fields(dict(scalars)[5])]
    assert values == [{1: b"loss", 2: 0.5}, {1: b"pitch", 2: 9.25}]
    assert dict(picture)[2] == 301
    image = dict(_fields(dict(_fields(dict(_fields(dict(picture)[5]))[1]))[4]))
    assert image[4] == png
    assert struct.unpack(">II", png[16:24]) == (image[2], image[1])


def test_tensorboard_itself_reads_them(tmp_path):
    loader = pytest.importorskip(
        "tensorboard.backend.event_processing.event_file_loader"
    )
    Journal(tmp_path).scalars(7, {"loss": 0.25})
    events = list(loader.EventFileLoader(str(tmp_path / EVENTS)).Load())
    assert events[-1].step == 7
