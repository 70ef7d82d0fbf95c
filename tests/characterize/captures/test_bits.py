"""Where a camera's bits lie in its words: shifts undone, depths found, and nothing touched that is no count."""

import numpy as np
import pytest

from characterize.captures.bits import right_align
from metalens.ground.errors import CaptureError


def frames(most, kind=np.uint16, least=0):
    """Two frames of counts whose largest is given, all bits below it in use."""
    return np.array([[[least, most, 1], [3, most // 2, most - 1]]] * 2, kind)


@pytest.mark.parametrize(
    ("most", "kind", "depth"),
    [
        (300, np.uint16, 10),
        (1023, np.uint16, 10),
        (1024, np.uint16, 12),
        (4096, np.uint16, 14),
        (16384, np.uint16, 16),
        (200, np.uint16, 8),
        (37, np.uint8, 8),
        (200, np.uint8, 8),
        (70_000, np.uint32, 16),
    ],
)
def test_the_depth_of_a_converter_is_the_least_usual_one_that_holds_the_counts(most, kind, depth):
    given = frames(most, kind)
    found, bits, note, beside = right_align(given, None, "a.tif")
    assert found is given  # nothing is copied
    assert bits == depth
    assert beside == ()
    assert note == f"counts of {most.bit_length()} bits: taken as a {depth}-bit converter"


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_counts_in_the_highest_bits_are_shifted_back_with_all_beside_them(bits):
    """A dark frame of small counts and averages are shifted with them, stated or not."""
    shift, most = 16 - bits, 2**bits - 5
    given = frames(most) << shift
    dark, average = np.array([[5, 1, 2]], np.uint16) << shift, np.array([[5.25, 1.5, 2.0]]) * 2**shift
    for stated in (None, bits):
        found, told, note, beside = right_align(given, stated, "a.tif", beside=[dark, average])
        assert found.tolist() == frames(most).tolist()
        assert told == bits
        assert "shifted back" in note
        assert beside[0].tolist() == [[5, 1, 2]]
        assert beside[0].dtype == np.uint16
        assert beside[1] == pytest.approx(np.array([[5.25, 1.5, 2.0]]))


def test_even_counts_are_shifted_back_by_no_more_than_was_stated():
    even = frames(4095) & 0xFFE
    assert right_align(even << 4, 12, "a.tif")[0].tolist() == even.tolist()


def test_frames_that_hide_a_shift_are_told_by_the_dark_frame_beside_them():
    """Even counts of 16 bits would be taken for 15 shifted ones; one odd count of the dark frame shows they are not."""
    even = frames(32_767) << 1
    assert right_align(even, None, "a.tif")[1] == 15
    found, bits, _, _ = right_align(even, None, "a.tif", beside=[np.array([[7]], np.uint16)])
    assert found is even
    assert bits == 16


def test_few_or_wide_words_are_not_shifted():
    """Counts below 13 bits may be even by chance, and words of four bytes are no converter's."""
    for given, depth in ((frames(2000) << 1, 12), (frames(4095).astype(np.uint32) << 4, 16)):
        found, bits, _, _ = right_align(given, None, "a.tif")
        assert found is given
        assert bits == depth


@pytest.mark.parametrize("given", [frames(900.0, float), frames(900, np.int32, least=-3)])
def test_real_and_negative_counts_are_taken_as_they_are(given):
    """Dark frames were taken off or averages made: no bits can be told, 16 unless stated."""
    dark = np.array([[16, 32]], np.uint16)
    for stated, told in ((None, 16), (12, 12)):
        found, bits, note, beside = right_align(given, stated, "a.tif", beside=[dark])
        assert found is given
        assert bits == told
        assert note == "counts are real numbers: taken as they are"
        assert beside[0] is dark
    assert right_align(given, None, "a.tif")[1] == 16


def test_stated_bits_hold_the_counts_at_one_end_or_the_other():
    given = frames(4095)
    found, bits, note, _ = right_align(given, 12, "a.tif")
    assert found is given
    assert (bits, note) == (12, "12 bits as stated")
    assert right_align(0 * given, 12, "a.tif")[0].max() == 0
    for wrong, stated in ((given, 10), (given << 2, 12), (given.astype(np.uint32) << 6, 12)):
        with pytest.raises(CaptureError, match=f"the capture states {stated}"):
            right_align(wrong, stated, "a.tif")
