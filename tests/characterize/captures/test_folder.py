"""Capture folders as other programs, disks and spreadsheets leave them: read, told, or
refused with what to do.
"""

import numpy as np
import pytest
import tifffile

from characterize.captures import capture, folder
from metalens.core.errors import CaptureError

FRAMES = np.random.default_rng(3).integers(37, 4096, (5, 26, 19)).astype(np.uint16)
TABLE = "file,depth_mm\r\na0.tif,1.5\r\na1.tif,2.5\r\na2.tif,-3.5\r\n"


def frames(path, names=("a0.tif", "a1.tif", "a2.tif")):
    for name, frame in zip(names, FRAMES, strict=False):
        tifffile.imwrite(path / name, frame, photometric="minisblack")
    return path


@pytest.mark.parametrize(
    "name", ["img_channel000_position000_time000000000_z{:03d}_a.tif", "Z{}.TIF"]
)
def test_numbered_frames_of_which_one_is_missing_are_not_placed_by_a_step(
    tmp_path, name
):
    """Files 3, 4, 7, 8 of a scan by 2 um: the third lies 8 um off the first, not 4."""
    frames(tmp_path, [name.format(k) for k in (3, 4, 7, 8)])
    assert np.array_equal(capture.load(tmp_path).frames, FRAMES[:4])
    (tmp_path / "capture.toml").write_text("step_um = 2.0\n")
    with pytest.raises(
        CaptureError,
        match=r"is 3 numbers after .*, others 1: .*list frames and depths in stage\.csv",
    ):
        capture.load(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ("z07.tif", "z09.tif", "z11.tif"),  # every other one
        ("b.tif", "d.tif", "z.tif"),
        (
            "t3_z1.tif",
            "t4_z2.tif",
            "t7_z3.tif",
        ),  # two numbers: which one counts is not known
        ("z1.tif", "z2.tif", "last9.tif"),
        ("z1.tif",),
    ],
)
def test_other_names_are_placed_by_the_step(tmp_path, names):
    frames(tmp_path, names)
    (tmp_path / "capture.toml").write_text("step_um = 2.5\n")
    assert capture.load(tmp_path).position_um.tolist() == [0.0, 2.5, 5.0][: len(names)]


def test_listed_frames_may_leave_numbers_out(tmp_path):
    frames(tmp_path, ("z1.tif", "z2.tif", "z9.tif"))
    (tmp_path / "stage.csv").write_text(
        "file,exposure_s\nz9.tif,0.1\nz2.tif,0.1\nz1.tif,0.1\n"
    )
    (tmp_path / "capture.toml").write_text("step_um = 2.5\n")
    assert capture.load(tmp_path).position_um.tolist() == [0.0, 2.5, 5.0]


def test_what_a_system_hides_is_no_frame(tmp_path):
    """A disk that a Mac wrote to has ._a0.tif beside a0.tif."""
    frames(tmp_path)
    (tmp_path / "._a0.tif").write_bytes(b"\0\5\x16\7" + bytes(90))
    (tmp_path / "._dark.npy").write_bytes(bytes(90))
    found = capture.load(tmp_path)
    assert found.names == ("a0.tif", "a1.tif", "a2.tif")
    assert len(found.corrections) == 1  # of bits


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        (".npy", r"tifffile\.imwrite"),
        (".npz", r"tifffile\.imwrite"),
        (".mat", r"in MATLAB: imwrite"),
        (".fits", "astropy"),
        (".bmp", "from ImageJ"),
        (".nxs", r"named \.h5"),
    ],
)
def test_a_kind_of_file_that_is_not_read_is_refused_with_its_cure(
    tmp_path, suffix, words
):
    (tmp_path / f"s{suffix}").write_bytes(bytes(99))
    with pytest.raises(
        CaptureError,
        match=rf"cannot read \{suffix}; need TIFF, PNG or HDF5: save it .*{words}",
    ):
        capture.load(tmp_path / f"s{suffix}")
    assert folder.conversion_hint(".xyz") == ""


@pytest.mark.parametrize(
    ("name", "right"),
    [
        ("stage.xlsx", "stage.csv"),
        ("Stage.TXT", "stage.csv"),
        ("capture.yaml", "capture.toml"),
    ],
)
def test_tables_in_a_format_that_nothing_reads_are_refused_unless_the_right_one_is_there(
    tmp_path, name, right
):
    """They were passed over: depths and pixels unknown, without a word."""
    frames(tmp_path)
    (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(CaptureError, match=f"{name}: not read, .*; save it as {right}"):
        capture.load(tmp_path)
    (tmp_path / right).write_text(TABLE if right == "stage.csv" else "pixel_um = 3.7\n")
    assert len(capture.load(tmp_path).frames) == 3


def test_names_in_capital_letters_are_the_same_names(tmp_path):
    frames(tmp_path)
    (tmp_path / "Stage.CSV").write_text(TABLE)
    (tmp_path / "CAPTURE.TOML").write_text("pixel_um = 3.7\n")
    found = capture.load(tmp_path)
    assert found.position_um.tolist() == [1500.0, 2500.0, -3500.0]
    assert found.pixel_um == 3.7


@pytest.mark.parametrize(
    "table",
    [
        TABLE.replace("file,depth_mm", "File , Depth_mm "),
        TABLE.replace("depth_mm", "depth_\u00b5m").replace(".5", "500"),
        TABLE.replace("depth_mm", "Z_\u03bcm").replace(".5", "500"),
        TABLE + ",\r\n,\r\n",
        TABLE + "\r\n\r\n",
    ],
)
def test_tables_as_spreadsheets_and_people_write_them_are_read(tmp_path, table):
    frames(tmp_path)
    (tmp_path / "stage.csv").write_text(table, encoding="utf-8-sig", newline="")
    assert capture.load(tmp_path).position_um.tolist() == [1500.0, 2500.0, -3500.0]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            TABLE.replace("1.5", "1,5"),
            r"row 2: more values than columns \(file, depth_mm\); a comma inside a number",
        ),
        (
            TABLE.replace("2.5", '"2,5"'),
            "row 3: depth_mm is '2,5', need a number with a point",
        ),
        (
            TABLE.replace("depth_mm", "depth"),
            "column 'depth' without a unit; name it depth_um",
        ),
        (TABLE.replace("depth_mm", "depth (mm)"), "did you mean 'depth_mm'"),
        (
            TABLE.replace("file,", "Depth_mm,file,").replace("a", "1,a"),
            "are not all different",
        ),
        (TABLE.replace("\r\na1", "\r\n,2\r\na1"), "row 3: no 'file'"),
        (
            TABLE.replace("a1.tif", "A1.TIFF"),
            r"row 3: frame 'A1\.TIFF' is not in .*; did you mean 'a1\.tif'",
        ),
        (
            "file,page\na0.tif,1\n",
            "row 2: page 1 \\(from 0\\) of 'a0.tif', which holds 1",
        ),
    ],
)
def test_tables_that_cannot_be_read_say_why(tmp_path, table, words):
    frames(tmp_path)
    (tmp_path / "stage.csv").write_text(table)
    with pytest.raises(CaptureError, match=words):
        capture.load(tmp_path)


@pytest.mark.parametrize("name", ["s.btf", "s.tf8"])
def test_big_tiff_files_are_read_by_their_own_suffixes(tmp_path, name):
    tifffile.imwrite(
        tmp_path / name, FRAMES, bigtiff=True, byteorder=">", photometric="minisblack"
    )
    assert np.array_equal(capture.load(tmp_path / name).frames, FRAMES)
