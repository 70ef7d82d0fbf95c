"""Where a camera's bits lie in its words: shifts undone, depths found, and nothing
touched that is no count.
"""

import numpy as np
import pytest

from characterize.captures.bits import right_align
from metalens.core.errors import CaptureError


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
def test_the_depth_of_a_converter_is_the_least_usual_one_that_holds_the_counts(
    most, kind, depth
):
    given = frames(most, kind)
    found, bits, note, beside = right_align(given, None, "a.tif")
    assert found is given  # nothing is copied
    assert bits == depth
    assert beside == ()
    assert (
        note == f"counts of {most.bit_length()} bits: taken as a {depth}-bit converter"
    )


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_counts_in_the_highest_bits_are_shifted_back_with_all_beside_them(bits):
    """A dark frame of small counts and averages are shifted with them, stated or not."""
    shift, most = 16 - bits, 2**bits - 5
    given = frames(most) << shift
    dark, average = (
        np.array([[5, 1, 2]], np.uint16) << shift,
        np.array([[5.25, 1.5, 2.0]]) * 2**shift,
    )
    for stated in (None, bits):
        found, told, note, beside = right_align(
            given, stated, "a.tif", beside=[dark, average]
        )
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
    """Even counts of 16 bits would be taken for 15 shifted ones; one odd count of the
    dark frame shows they are not.
    """
    even = frames(32_767) << 1
    assert right_align(even, None, "a.tif")[1] == 15
    found, bits, _, _ = right_align(
        even, None, "a.tif", beside=[np.array([[7]], np.uint16)]
    )
    assert found is even
    assert bits == 16


def test_few_or_wide_words_are_not_shifted():
    """Counts below 13 bits may be even by chance, and words of four bytes are no
    converter's.
    """
    for given, depth in (
        (frames(2000) << 1, 12),
        (frames(4095).astype(np.uint32) << 4, 16),
    ):
        found, bits, _, _ = right_align(given, None, "a.tif")
        assert found is given
        assert bits == depth


@pytest.mark.parametrize(
    "given", [frames(900.0, float) + 0.25, frames(900, np.int32, least=-3)]
)
def test_real_and_negative_counts_are_taken_as_they_are(given):
    """Dark frames were taken off or averages made: no bits can be told, 16 unless
    stated.
    """
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
    for wrong, stated in (
        (given, 10),
        (given << 2, 12),
        (given.astype(np.uint32) << 6, 12),
    ):
        with pytest.raises(CaptureError, match=f"the capture states {stated}"):
            right_align(wrong, stated, "a.tif")


def test_whole_real_numbers_are_counts_with_their_shift():
    """12-bit counts times 16 as float32: every one above 4095 was taken for saturated.
    Averages beside are divided.
    """
    given, dark = frames(4095), np.array([[5.25, 63.5]])
    for stated in (None, 12):
        found, bits, _, beside = right_align(
            (given * 16).astype(np.float32), stated, "a.tif", beside=[dark * 16]
        )
        assert found.tolist() == given.tolist()
        assert bits == 12
        assert beside[0].tolist() == dark.tolist()
    with pytest.raises(CaptureError, match=r"real numbers up to .* states 12 bits"):
        right_align(given * 16 + 0.25, 12, "a.tif")


@pytest.mark.parametrize(
    ("over", "shift"), [(4095, 1), (4096, 1), (65_535, 1), (65_535, 16)]
)
def test_shares_of_full_scale_are_the_counts_that_they_were(over, shift):
    """Rounding to a whole count is a millionth of a count there, not the well: it was a
    noise of 2300 electrons.
    """
    given, dark = frames(4095), np.array([[5, 64]], np.uint16)
    shares, dim = ((a * float(shift) / over).astype(np.float32) for a in (given, dark))
    found, bits, note, beside = right_align(shares, 12, "a.tif", beside=[dim])
    assert found.tolist() == given.tolist()
    assert np.allclose(beside[0], dark, atol=0.01)
    assert bits == 12
    assert "multiplied by" in note


def test_shares_of_which_no_counts_can_be_made_are_refused_where_counts_matter():
    shares = np.sqrt(frames(4095) / 4095.0)
    for told in ({"bits": 12}, {"bits": None, "beside": [shares]}):
        with pytest.raises(
            CaptureError, match="multiply frames, dark and flat by the full scale"
        ):
            right_align(shares, where="a.tif", **told)
    assert (
        right_align(shares, None, "a.tif")[0] is shares
    )  # a bead stack: nothing is said of its counts


@pytest.mark.parametrize(
    ("most", "off", "whole"),
    [
        (900, 0.008, True),
        (900, 0.012, False),
        (65_535, 0.0, True),
        (65_536, 0.0, False),
    ],
)
def test_real_numbers_are_counts_where_they_are_whole_to_a_hundredth_and_fit_a_word(
    most, off, whole
):
    """float32 keeps a share of 65535 to 0.004; the next number would be 0 in a word of
    16 bits.
    """
    given = np.array([[[3.0, 17.0 - off, most + 0.0]]])
    found, _, note, _ = right_align(given, None, "a.tif")
    assert ("real numbers" in note) is not whole
    assert found.tolist() == (np.rint(given) if whole else given).tolist()


def test_counts_beside_shares_of_full_scale_are_left_and_shares_are_multiplied():
    shares, dark = frames(4095) / 4095.0, np.array([[5.0, 64.0]])
    beside = right_align(
        shares, 12, "a.tif", beside=[dark, dark / 4095.0, np.array([[0.25, 1.0]])]
    )[3]
    assert beside[0].tolist() == dark.tolist()
    assert beside[1] == pytest.approx(dark)
    assert beside[2] == pytest.approx(np.array([[0.25, 1.0]]) * 4095)


def stretched(count, bits, how):
    if how == "scaled":
        return np.rint(count * (65_535 / ((1 << bits) - 1))).astype(np.uint16)
    text = np.char.mod(
        "%s", [[f"{c:0{bits}b}" * 3 for c in row] for row in count]
    )  # digits again until there are 16
    return np.array([[int(word[:16], 2) for word in row] for row in text], np.uint16)


@pytest.mark.parametrize("how", ["scaled", "repeated"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_counts_that_were_stretched_over_16_bits_are_taken_back(bits, how):
    """With a dim dark frame and an average of it; stated or not. One other level
    between them is no stretch.
    """
    rng = np.random.default_rng(bits)
    given, dark = rng.integers(0, 1 << bits, (31, 37)), rng.integers(3, 9, (31, 37))
    words, dim = (stretched(a, bits, how) for a in (given, dark))
    for stated in (None, bits):
        found, depth, note, beside = right_align(
            words, stated, "a.tif", beside=[dim, dim.mean(0)]
        )
        assert (found.tolist(), depth) == (given.tolist(), bits)
        assert note == f"{bits}-bit counts were stretched over 16 bits: taken back"
        assert beside[0].tolist() == dark.tolist()
        assert beside[1] == pytest.approx(
            dark.mean(0), abs=0.6 / 2 ** (16 - bits)
        )  # each word rounded, by half at most
    other = words.copy()
    other[3, 5] += 1
    assert right_align(other, None, "a.tif")[1] == 16


def test_few_levels_are_no_stretch():
    """31 of 16 bits that lie as those of 14 do, by chance once in 4**31: too few to
    tell.
    """
    words = stretched(np.arange(5000, 5031)[None], 14, "repeated")
    assert right_align(words, None, "a.tif")[0] is words
    more = stretched(np.arange(5000, 5032)[None], 14, "repeated")
    assert right_align(more, None, "a.tif")[1] == 14


def test_unsigned_words_that_were_saved_as_signed_are_refused():
    """Counts of 40000 lie at -25536, or all are moved by 32768; what a dark frame was
    taken off is small below 0.
    """
    given = frames(40_000)
    moved = (given.astype(np.int32) - 32_768).astype(np.int16)
    for words in (given.view(np.int16), moved):
        with pytest.raises(
            CaptureError, match=r"signed counts down to -.*save them as unsigned"
        ):
            right_align(words, None, "a.tif")
    with pytest.raises(CaptureError, match="save them as unsigned"):
        right_align(frames(900), None, "a.tif", beside=[moved])
    assert right_align(frames(900, np.int16, least=-37), None, "a.tif")[2].startswith(
        "counts are real numbers"
    )
