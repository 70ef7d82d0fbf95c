"""Images of TIFF files: what is compressed with loss, claims too much or holds colours
in planes of their own.
"""

import struct

import numpy as np
import pytest

from characterize.captures import capture
from metalens.core.errors import CaptureError

image = pytest.importorskip("PIL.Image")
tifffile = pytest.importorskip("tifffile")
FRAMES = np.arange(3 * 6 * 5, dtype=np.uint16).reshape(3, 6, 5)


def written(tmp_path, frames=FRAMES, **about):
    tifffile.imwrite(
        tmp_path / "a.tif", frames, photometric="minisblack", metadata=None, **about
    )
    return tmp_path / "a.tif"


@pytest.mark.parametrize("code", [6, 7, 33003, 33005, 34712])
def test_frames_that_are_compressed_with_loss_are_refused_by_name(tmp_path, code):
    """The tag of the last frame of a plain file says another compression."""
    path = written(tmp_path)
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages[2].tags[259].overwrite(code)
    with pytest.raises(
        CaptureError, match=r"frame 2 is JPEG-compressed, its noise says nothing"
    ):
        capture.read_images(path)


@pytest.mark.parametrize(
    ("kind", "words"),
    [("f2", "float16 round counts above 2048"), ("c8", "complex64; need whole")],
)
def test_kinds_of_numbers_that_hold_no_counts_are_refused_by_name(
    tmp_path, kind, words
):
    with pytest.raises(CaptureError, match=words):
        capture.load(written(tmp_path, FRAMES.astype(kind)))


@pytest.mark.parametrize(("mark", "order"), [(b"MM", ">"), (b"II", "<")])
def test_what_imagej_lays_behind_the_head_of_one_image_is_a_stack(
    tmp_path, mark, order
):
    """Stacks above 4 GB have one head and say images=N. A file that has no room for
    them is refused.
    """
    words, (_, height, width) = (
        b"ImageJ=1.53t\nimages=3\nslices=3\nunit=um\nspacing=0.3\n\0\0",
        FRAMES.shape,
    )
    begins = 8 + 2 + 9 * 12 + 4
    # a short lies at the start of its word
    plain = (lambda v: v << 16) if order == ">" else int
    tags = (
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, plain(16)),
        (259, 3, 1, plain(1)),
    )
    tags += (
        (262, 3, 1, plain(1)),
        (270, 2, len(words), begins),
        (273, 4, 1, begins + len(words)),
    )
    tags += ((278, 4, 1, height), (279, 4, 1, 2 * height * width))
    head = mark + struct.pack(order + "HI", 42, 8) + struct.pack(order + "H", len(tags))
    head += (
        b"".join(struct.pack(order + "HHII", *tag) for tag in tags) + bytes(4) + words
    )
    path = tmp_path / "a.tif"
    path.write_bytes(head + FRAMES.astype(order + "u2").tobytes())
    found = capture.load(path)
    assert np.array_equal(found.frames, FRAMES)
    assert found.position_um == pytest.approx([0.0, 0.3, 0.6])
    assert found.frames.dtype.isnative
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CaptureError, match=r"says 3 images, .* has room for 2"):
        capture.load(path)


def test_pages_of_unlike_types_are_refused(tmp_path):
    """They were joined in the wider type: counts of 8 and 16 bits in one stack."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for frame in (FRAMES[0], FRAMES[1].astype(np.uint8)):
            file.write(frame, photometric="minisblack", metadata=None)
    with pytest.raises(
        CaptureError, match="frame 1 is uint8, frame 0 uint16; keep one type a file"
    ):
        capture.read_images(tmp_path / "a.tif")


@pytest.mark.parametrize(
    "about",
    [{"byteorder": ">"}, {"bigtiff": True}, {"compression": "zlib", "predictor": True}],
)
def test_other_ways_to_lay_counts_are_read_as_the_counts_they_are(tmp_path, about):
    found = capture.load(written(tmp_path, **about))
    assert np.array_equal(found.frames, FRAMES)
    assert found.frames.dtype.isnative


@pytest.mark.parametrize("predictor", [1, 2])
@pytest.mark.parametrize("packing", ["tiff_lzw", "packbits"])
@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_frames_that_other_programs_packed_are_read_as_the_counts_they_are(
    tmp_path, kind, packing, predictor
):
    """Written by Pillow. Values of all bytes, so that a wrong order of bytes or a
    difference left in would show.
    """
    if kind == "f4" and predictor == 2:
        pytest.skip("differences are of whole numbers")
    frames = (
        np.random.default_rng(3)
        .integers(0, 256 if kind == "u1" else 65_536, (3, 37, 53))
        .astype(kind)
    )
    pages = [image.fromarray(frame) for frame in frames]
    pages[0].save(
        tmp_path / "a.tif",
        save_all=True,
        append_images=pages[1:],
        compression=packing,
        tiffinfo={317: predictor},
    )
    found = capture.read_images(tmp_path / "a.tif")
    assert found.dtype == frames.dtype
    assert np.array_equal(found, frames)
