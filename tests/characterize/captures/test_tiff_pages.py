"""Images of TIFF files: what is compressed with loss, claims too much or holds colours in planes of their own."""

import importlib.util

import numpy as np
import pytest

from characterize.captures import capture, tiff_pages
from characterize.captures.colour import Colours
from metalens.ground.errors import CaptureError

tifffile = pytest.importorskip("tifffile")
FRAMES = np.arange(3 * 6 * 5, dtype=np.uint16).reshape(3, 6, 5)


def written(tmp_path, frames=FRAMES, **about):
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="minisblack", metadata=None, **about)
    return tmp_path / "a.tif"


def test_plain_frames_are_read_as_they_are(tmp_path):
    assert np.array_equal(tiff_pages.read(written(tmp_path)), FRAMES)


def test_frames_are_named_by_their_files_and_those_of_a_stack_by_their_places_too(tmp_path):
    stack = written(tmp_path)
    tifffile.imwrite(tmp_path / "b.tif", FRAMES[1], photometric="minisblack", metadata=None)
    names, frames, _ = capture._all_frames([stack, tmp_path / "b.tif"], tmp_path, Colours(), None)
    assert names == ("a.tif[0]", "a.tif[1]", "a.tif[2]", "b.tif")
    assert np.array_equal(frames, np.stack([*FRAMES, FRAMES[1]]))


@pytest.mark.parametrize(
    ("code", "words"),
    [
        *((code, "JPEG-compressed, its noise says nothing") for code in (6, 7, 33003, 33005, 34712)),
        (5, r"compressed \(LZW\)"),
        (32773, r"compressed \(PackBits\)"),
        (34925, r"compressed \(LZMA\)"),
        (50000, r"compressed \(Zstandard\)"),
    ],
)
def test_frames_that_are_compressed_with_loss_or_by_a_stranger_are_refused_by_name(tmp_path, code, words):
    """The tag of the last frame of a plain file says another compression."""
    if "JPEG" not in words and importlib.util.find_spec("imagecodecs"):
        pytest.skip("read by its package")
    path = written(tmp_path)
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages[2].tags[259].overwrite(code)
    with pytest.raises(CaptureError, match=f"frame 2 is {words}"):
        tiff_pages.read(path)


def test_frames_together_may_claim_no_more_than_is_held(tmp_path, monkeypatch):
    monkeypatch.setattr(tiff_pages, "_MOST_BYTES", FRAMES.nbytes)
    assert len(tiff_pages.read(written(tmp_path))) == 3
    monkeypatch.setattr(tiff_pages, "_MOST_BYTES", FRAMES.nbytes - 1)
    with pytest.raises(CaptureError, match=r"frame 2 claims \(6, 5\) values"):
        tiff_pages.read(written(tmp_path))


def test_planes_are_images_or_the_colours_of_one(tmp_path):
    path = written(tmp_path, FRAMES[None], planarconfig="separate")
    assert np.array_equal(tiff_pages.read(path), FRAMES)
    assert np.array_equal(tiff_pages.read(path, coloured=True), np.moveaxis(FRAMES, 0, -1)[None])
    assert np.array_equal(tiff_pages.read(written(tmp_path), coloured=True), FRAMES)


@pytest.mark.parametrize(
    ("kind", "words"), [("f2", "float16 round counts above 2048"), ("c8", "complex64; need whole")]
)
def test_kinds_of_numbers_that_hold_no_counts_are_refused_by_name(tmp_path, kind, words):
    with pytest.raises(CaptureError, match=words):
        capture.load(written(tmp_path, FRAMES.astype(kind)))
