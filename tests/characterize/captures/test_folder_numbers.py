"""Names in a folder: numbers counted within words, steps between them, and how many
names are said.
"""

import pytest

from characterize.captures import folder
from metalens.core.errors import CaptureError


def made(path, *names):
    for name in names:
        (path / name).write_bytes(b"")
    return [path / name for name in names]


def test_numbers_are_counted_wherever_they_stand_and_words_go_by_their_letters(
    tmp_path,
):
    """Numbers stand before words, small and capital letters alike: 2 before 10, z2_t10
    before z10_t2.
    """
    names = (
        "10.tif",
        "2.TIF",
        "a_9.tif",
        "A_10.tif",
        "a_10_3.tif",
        "b.tif",
        "z2_t10.tif",
        "z10_t2.tif",
    )
    made(tmp_path, *reversed(names), ".hidden.tif", "c.tiff", "d.txt")
    assert [path.name for path in folder.list_images(tmp_path, {".tif"})] == [
        "2.TIF", "10.tif", "a_9.tif", "A_10.tif", "a_10_3.tif", "b.tif", "z2_t10.tif", "z10_t2.tif",
    ]  # fmt: skip
    assert folder._parts("Ab07c") == [("ab", -1), ("", 7), ("c", -1)]


@pytest.mark.parametrize(("count", "said"), [(1, 1), (5, 5), (6, 5)])
def test_five_files_that_are_not_read_are_named_and_all_are_counted(
    tmp_path, count, said
):
    names = [f"f{k}.npy" for k in range(count)]
    made(tmp_path, *names, ".g.npy", "a.tif")
    (words,) = folder.unread_images_text(tmp_path, ())
    assert (
        words
        == f"{count} files left out, of kinds that are not read: {', '.join(names[:said])}"
    )
    assert folder.unread_images_text(tmp_path, ("dark",)) == (words,)


def test_dark_frames_of_another_kind_are_refused_unless_there_are_others(tmp_path):
    made(tmp_path, "Dark.bmp")
    assert folder.unread_images_text(tmp_path, ("dark",)) == (
        "1 files left out, of kinds that are not read: Dark.bmp",
    )
    for beside in ((), ("flat",)):
        with pytest.raises(CaptureError, match=r"Dark\.bmp: cannot read \.bmp"):
            folder.unread_images_text(tmp_path, beside)


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        (
            ("t3_z5.tif", "t3_z7.tif", "t3_z9.tif", "t3_z13.tif", "t3_z15.tif"),
            (13, 9, 4, 2),
        ),
        (
            ("t3_z5.tif", "t3_z12.tif", "t3_z13.tif", "t3_z14.tif"),
            (12, 5, 7, 1),
        ),  # the first step is the wide one
        (("t3_z5.tif", "t3_z7.tif", "t3_z9.tif"), None),
        (("t3_z5.tif", "t4_z7.tif", "t5_z11.tif"), None),  # two numbers count
        (("t3_z5.tif", "t4_z7.tif", "t4_z13.tif"), None),
        (("t3_z5.tif", "u3_z7.tif", "t3_z11.tif"), None),  # other words
        (("t3_z5.tif", "t3_z5.tiff"), None),  # none counts
    ],
)
def test_the_widest_step_of_the_one_number_that_counts_is_told(tmp_path, names, gap):
    files = [tmp_path / name for name in names]
    if gap is None:
        folder.check_steps(files, tmp_path)
        return
    after, before, step, others = gap
    words = rf"t3_z{after}\.tif is {step} numbers after t3_z{before}\.tif, others {others}: is"
    with pytest.raises(CaptureError, match=words):
        folder.check_steps(files, tmp_path)


def test_the_likest_name_is_offered_as_it_is_spelt():
    there = ("Frame_01.tif", "frame_02.tif", "dark.tif")
    assert (
        folder.similar_name_hint("frame_1.TIF", there)
        == "; did you mean 'Frame_01.tif'?"
    )
    assert (
        folder.similar_name_hint("frame_02.tiff", there)
        == "; did you mean 'frame_02.tif'?"
    )
    assert folder.similar_name_hint("quite another", there) == ""
    assert folder.similar_name_hint("frame_1.tif", ()) == ""


def test_a_table_is_found_by_its_first_right_kind(tmp_path):
    made(tmp_path, "stage.json", "Stage.CSV", "capture.yml")
    assert folder.find_table(tmp_path, "stage").name == "Stage.CSV"
    (tmp_path / "Stage.CSV").unlink()
    assert folder.find_table(tmp_path, "stage").name == "stage.json"
    with pytest.raises(
        CaptureError, match=r"capture\.yml: not read, .*; save it as capture\.toml"
    ):
        folder.find_table(tmp_path, "capture")
    (tmp_path / "capture.yml").unlink()
    assert folder.find_table(tmp_path, "capture") is None
