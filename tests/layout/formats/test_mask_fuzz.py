"""Broken mask files: a typed error that names the byte, or a clean read; never a crash,
a hang, or another error.
"""

import signal

import numpy as np
import pytest

import layout
from layout.formats import gdsii_read, oasis_read
from metalens.core.errors import MaskFileError
from tests.referees.mask_places import places

LIMIT = 200_000  # placements: a mutated array count must not fill the memory
READ = {"gds": gdsii_read.read_gdsii, "oas": oasis_read.read_oasis}
PARSE = {"gds": gdsii_read.parse_gdsii, "oas": oasis_read.parse_oasis}
FORMS = [("gds", {}), ("oas", {})]


@pytest.fixture
def masks(make_plan, tmp_path):
    """The bytes of small masks in all forms, compressed and not."""
    classes = np.random.default_rng(3).integers(0, 5, (6, 7)).astype(np.uint8)
    made = []
    for n, (suffix, options) in enumerate(FORMS):
        for kind, sites in enumerate((classes, np.ones((40, 40), np.uint8))):
            path = tmp_path / f"{n}{kind}.{suffix}"
            plan = make_plan(sites, kinds=4)
            (layout.write_gdsii if suffix == "gds" else layout.write_oasis)(
                plan, path, **options
            )
            made.append((suffix, path.read_bytes()))
    return made


def mutated(data, rng):
    """Some bytes changed, removed, doubled or moved."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at, kind = int(rng.integers(len(out))), rng.integers(5)
        if kind == 0:
            out[at] = int(rng.integers(256))
        elif kind == 1:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del out[at : at + int(rng.integers(1, 9))]
        elif kind == 3:
            out[at:at] = out[at : at + int(rng.integers(1, 9))]
        else:
            out[at : at + 1] = bytes(
                rng.choice([0, 127, 128, 255], int(rng.integers(1, 12))).astype(
                    np.uint8
                )
            )
        if not out:
            break
    return bytes(out)


def fuzz(masks, count, seed):
    rng, refused = np.random.default_rng(seed), 0

    def too_long(*_):
        raise TimeoutError("a reader hangs")

    before = signal.signal(signal.SIGALRM, too_long)
    try:
        for n in range(count):
            suffix, data = masks[n % len(masks)]
            broken = np.frombuffer(mutated(data, rng), np.uint8)
            signal.alarm(20)
            try:
                content = PARSE[suffix](broken, limit=LIMIT)
                for top in content.tops[:3]:
                    places(content, top)
            except MaskFileError as error:
                refused += "byte" in str(error) or "cell" in str(error)
            finally:
                signal.alarm(0)
    finally:
        signal.signal(signal.SIGALRM, before)
    return refused


def test_three_thousand_mutations_neither_crash_nor_hang(masks):
    assert fuzz(masks, 3000, 0) > 1500


@pytest.mark.slow
def test_a_hundred_thousand_mutations_neither_crash_nor_hang(masks):
    assert fuzz(masks, 100_000, 1) > 50_000


def test_random_bytes_are_refused(tmp_path):
    rng = np.random.default_rng(5)
    for n in range(200):
        data = rng.integers(0, 256, rng.integers(1, 400)).astype(np.uint8).tobytes()
        for suffix in READ:
            path = tmp_path / f"r.{suffix}"
            path.write_bytes(
                (
                    b"%SEMI-OASIS\r\n\x01\x031.0\x00\xe8\x07\x01"
                    if n % 2 and suffix == "oas"
                    else b""
                )
                + data
            )
            with pytest.raises(MaskFileError, match="byte"):
                READ[suffix](path)


def test_a_block_that_claims_more_than_is_unpacked_is_refused(tmp_path):
    from layout.formats import oasis_records as oasis

    sizes = oasis.unsigned_integer(2**45) + oasis.unsigned_integer(3)
    block = bytes([oasis.OasisRecord.CBLOCK, 0]) + sizes + b"abc"
    (tmp_path / "z.oas").write_bytes(
        oasis.start_record(1.0) + block + oasis.end_record((0,) * 6, 0)
    )
    with pytest.raises(MaskFileError, match="compressed block of 35,184,372,088,832"):
        layout.read_oasis(tmp_path / "z.oas")
