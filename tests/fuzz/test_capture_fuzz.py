"""Damaged captures and process tables: TIFF, PNG, stage.csv, capture.toml and CSV are
refused by type or read whole.
"""

import math

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from characterize.captures import capture
from layout.pec import psf
from layout.process.process import ExposureSettings
from metalens.core.errors import MetalensError
from metalens.fabrication import bias

LIMITS = dict(max_examples=60)
FRAMES = (np.arange(2 * 6 * 5).reshape(2, 6, 5) * 37 % 1000).astype(np.uint16)
STAGE = "file,page,depth_mm,angle_deg,exposure_s\nf.tif,0,18.0,0.0,0.01\nf.tif,1,22.5,1.5,0.01\n"
ABOUT = 'pixel_um = 3.0\nwavelength_um = 0.85\nbits = 10\ncamera = "x"\n'
DOSE = b"radius_um,energy\n0.05,10.0\n0.1,4.0\n0.3,1.0\n1.0,0.3\n3.0,0.1\n10.0,0.01\n"
ODD = (
    "nan",
    "inf",
    "-1",
    "1e400",
    "",
    '"',
    "f.tif",
    "99999999999999999999",
    "\x00",
    "0x10",
    "1;2",
    "ä",
)


def _write(folder):
    tifffile.imwrite(folder / "f.tif", FRAMES)
    (folder / "stage.csv").write_text(STAGE, encoding="utf-8")
    (folder / "capture.toml").write_text(ABOUT, encoding="utf-8")


def _damaged(whole, data):
    """Bytes that were cut, flipped, doubled or had an odd value put in the place of a
    word.
    """
    how = data.draw(
        st.sampled_from(["cut", "flip", "insert", "twice", "value"]), label="how"
    )
    if how == "cut":
        return whole[: data.draw(st.integers(0, len(whole) - 1), label="length")]
    if how == "twice":
        return whole + whole
    at = data.draw(st.integers(0, len(whole) - 1), label="at")
    if how == "flip":
        return (
            whole[:at]
            + bytes([whole[at] ^ (1 << data.draw(st.integers(0, 7), label="bit"))])
            + whole[at + 1 :]
        )
    if how == "insert":
        return (
            whole[:at]
            + bytes([data.draw(st.integers(0, 255), label="byte")])
            + whole[at:]
        )
    return (
        whole[:at]
        + data.draw(st.sampled_from(ODD), label="odd").encode()
        + whole[at + 1 :]
    )


def _read(load):
    """(what was read, '') or (None, what the refusal said)."""
    try:
        return load(), ""
    except MetalensError as refusal:
        return None, str(refusal)


def test_the_capture_itself_is_good(tmp_path):
    _write(tmp_path)
    found = capture.load(tmp_path)
    assert np.array_equal(found.frames, FRAMES)
    assert found.position_um.tolist() == [18e3, 22.5e3]


def test_the_exposure_table_itself_is_good(tmp_path):
    """Its density falls from the first radius to the last, as the table does."""
    path = tmp_path / "dose.csv"
    path.write_bytes(DOSE)
    found = psf.point_exposure(ExposureSettings(csv=path)).density(
        np.array([0.05, 0.3, 3.0, 10.0])
    )
    assert (found > 0).all()
    assert (np.diff(found) < 0).all()


@pytest.mark.parametrize("name", ["f.tif", "stage.csv", "capture.toml"])
@settings(**LIMITS)
@given(data=st.data())
def test_damaged_captures_are_refused_by_type_or_read_whole(
    tmp_path_factory, name, data
):
    folder = tmp_path_factory.mktemp("fuzz")
    _write(folder)
    path = folder / name
    path.write_bytes(_damaged(path.read_bytes(), data))
    found, said = _read(lambda: capture.load(folder))
    if found is None:
        assert str(folder) in said
        return
    assert np.isfinite(found.frames).all()
    assert found.frames.ndim == 3
    assert len(found.frames) == len(found.position_um) == len(found.names)
    assert math.isnan(found.pixel_um) or found.pixel_um > 0


@settings(**LIMITS)
@given(data=st.data())
def test_damaged_png_frames_are_refused_by_type_or_read_whole(tmp_path_factory, data):
    import cv2

    folder = tmp_path_factory.mktemp("fuzz")
    cv2.imwrite(str(folder / "f.png"), FRAMES[0])
    path = folder / "f.png"
    path.write_bytes(_damaged(path.read_bytes(), data))
    found, said = _read(lambda: capture.load(path))
    if found is None:
        assert str(path) in said
        return
    assert found.frames.ndim == 3


@pytest.mark.parametrize("first", [0, 1])
def test_a_tiff_whose_list_of_frames_is_a_ring_is_refused(tmp_path, first):
    """The last of three frames names an earlier one as the next."""
    path = tmp_path / "f.tif"
    tifffile.imwrite(
        path,
        np.concatenate([FRAMES, FRAMES[:1] + 7]),
        photometric="minisblack",
        metadata=None,
    )
    with tifffile.TiffFile(path) as file:
        places = [(page.offset, len(page.tags)) for page in file.pages]
    assert len(places) == len(capture.load(path).frames) == 3
    (last, tags), whole = places[-1], bytearray(path.read_bytes())
    after = last + 2 + 12 * tags
    whole[after : after + 4] = places[first][0].to_bytes(4, "little")
    path.write_bytes(whole)
    found, said = _read(lambda: capture.load(path))
    assert found is None
    assert f"{path}: damaged: frame 3 is an earlier one" in said


@pytest.mark.parametrize("claim", [0xFF000000, 10_000])
def test_a_png_block_longer_than_its_file_is_refused_before_room_is_made(
    tmp_path, monkeypatch, claim
):
    """The library takes the memory that the length claims, 4.3 GB here."""
    import cv2

    path = tmp_path / "f.png"
    cv2.imwrite(str(path), FRAMES[0])
    whole = path.read_bytes()
    assert len(capture.load(path).frames) == 1
    at = whole.index(b"IDAT") - 4
    path.write_bytes(whole[:at] + claim.to_bytes(4, "big") + whole[at + 4 :])
    monkeypatch.setattr(cv2, "imread", None)
    found, said = _read(lambda: capture.load(path))
    assert found is None
    assert f"{path}: truncated or not a PNG file (a block ends at byte" in said


def test_a_png_of_two_heads_is_refused(tmp_path):
    """The size is judged by the first, pictures may be formed by the last."""
    import cv2

    path = tmp_path / "f.png"
    cv2.imwrite(str(path), FRAMES[0])
    whole = path.read_bytes()
    path.write_bytes(whole[:33] + whole[8:])
    found, said = _read(lambda: capture.load(path))
    assert found is None
    assert "a second head" in said


@settings(**LIMITS)
@given(data=st.data())
def test_damaged_bias_tables_are_refused_by_type_or_hold_numbers(
    tmp_path_factory, data
):
    path = tmp_path_factory.mktemp("fuzz") / "bias.csv"
    path.write_bytes(_damaged(b"drawn_nm,bias_nm\n80,-6.0\n120,1.0\n200,2.5\n", data))
    found, said = _read(lambda: bias.Bias(table_nm=bias.read_csv(path)))
    if found is None:
        assert said
        return
    assert np.isfinite(found.at(np.array([50.0, 100.0, 300.0]))).all()


@settings(**LIMITS)
@given(data=st.data())
def test_damaged_exposure_tables_are_refused_by_type_or_fitted(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fuzz") / "dose.csv"
    path.write_bytes(_damaged(DOSE, data))
    found, said = _read(lambda: psf.point_exposure(ExposureSettings(csv=path)))
    if found is None:
        assert said
        return
    assert np.isfinite(found.density(np.array([0.05, 0.5, 20.0]))).all()
