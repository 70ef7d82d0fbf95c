"""Captures on disk: what is read, what is put right, what is refused and where."""

import math

import cv2
import h5py
import numpy as np
import pytest
import tifffile

from characterize.captures import capture
from metalens.core.errors import CaptureError

RNG = np.random.default_rng(1)
FRAMES = RNG.integers(0, 4096, (4, 12, 16)).astype(np.uint16)


def folder(
    path, frames=FRAMES, stage=None, about="pixel_um = 3.0\nwavelength_um = 0.85\n"
):
    for i, frame in enumerate(frames):
        tifffile.imwrite(path / f"frame_{i}.tif", frame)
    rows = [f"frame_{i}.tif,{20 + 2 * i},0.5" for i in range(len(frames))]
    (path / "stage.csv").write_text(
        stage or "file,depth_mm,angle_deg\n" + "\n".join(rows) + "\n"
    )
    (path / "capture.toml").write_text(about)
    return path


def test_folder_with_stage_and_description(tmp_path):
    found = capture.load(folder(tmp_path))
    assert np.array_equal(found.frames, FRAMES)
    assert np.allclose(found.position_um, [20e3, 22e3, 24e3, 26e3])
    assert np.allclose(found.angle_rad, [math.radians(0.5), 0])
    assert (found.pixel_um, found.wavelength_um, found.bits) == (3.0, 0.85, 12)


@pytest.mark.parametrize(
    ("about", "pitch"), [("", 3.0), ('channel = "blue"\nmosaic = "RGGB"\n', 6.0)]
)
def test_a_pixel_is_as_wide_as_the_camera_has_it_whatever_its_colour(
    tmp_path, about, pitch
):
    """3 um wide and high, each or every second of them, in a folder or a file of all
    frames.
    """
    (tmp_path / "stack.toml").write_text(f"pixel_um = 3.0\n{about}")
    tifffile.imwrite(tmp_path / "stack.tif", FRAMES, photometric="minisblack")
    (tmp_path / "folder").mkdir()
    for place in (
        folder(tmp_path / "folder", about=f"pixel_um = 3.0\n{about}"),
        tmp_path / "stack.tif",
    ):
        found = capture.load(place)
        assert found.pixel_um == pitch
        assert found.fill * found.pixel_um == 3.0
        assert found.frames.shape == (4, 12 * 3 / pitch, 16 * 3 / pitch)


def test_stage_order_is_the_order_of_the_frames(tmp_path):
    stage = "file,z_um\n" + "".join(f"frame_{i}.tif,{i}\n" for i in (2, 0, 3, 1))
    found = capture.load(folder(tmp_path, stage=stage))
    assert np.array_equal(found.frames, FRAMES[[2, 0, 3, 1]])
    assert found.position_um.tolist() == [2, 0, 3, 1]


def test_stack_png_and_hdf5_hold_the_same_frames(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES)
    cv2.imwrite(str(tmp_path / "b.png"), FRAMES[1])
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_dataset(
            "frames",
            data=FRAMES.astype(">u2"),
            chunks=(2, 12, 5),
            compression="gzip",
            shuffle=True,
        )
    assert capture.load(tmp_path / "c.h5").frames.dtype.isnative
    assert np.array_equal(capture.load(tmp_path / "a.tif").frames, FRAMES)
    assert np.array_equal(capture.load(tmp_path / "b.png").frames[0], FRAMES[1])
    assert np.array_equal(capture.load(tmp_path / "c.h5").frames, FRAMES)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_counts_shifted_into_the_high_bits_are_shifted_back(tmp_path, bits):
    counts = RNG.integers(0, 1 << bits, (3, 20, 20)).astype(np.uint16)
    counts[0, 0, 0] = (1 << bits) - 1
    tifffile.imwrite(tmp_path / "a.tif", counts << (16 - bits))
    found = capture.load(tmp_path / "a.tif")
    assert found.bits == bits
    assert np.array_equal(found.frames, counts)
    assert "shifted back" in found.corrections[0]


@pytest.mark.parametrize("stated", [True, False])
def test_dark_and_flat_are_shifted_back_with_the_frames(tmp_path, stated):
    """12-bit counts in the high bits: those of the dark (37 to 44) take 10 bits with
    their shift, and fit into 12.
    """
    dark = RNG.integers(37, 45, (3, 12, 16)).astype(np.uint16)
    flat = RNG.integers(1500, 2600, (2, 12, 16)).astype(np.uint16)
    about = "pixel_um = 3.0\nwavelength_um = 0.85\n" + "bits = 12\n" * stated
    folder(tmp_path, frames=FRAMES << 4, about=about)
    tifffile.imwrite(tmp_path / "dark.tif", dark << 4, photometric="minisblack")
    tifffile.imwrite(tmp_path / "flat.tif", flat << 4, photometric="minisblack")
    found = capture.load(tmp_path)
    assert found.bits == 12
    for name, counts in (("frames", FRAMES), ("dark", dark), ("flat", flat)):
        assert np.array_equal(getattr(found, name), counts), name
    average = (dark << 4).mean(0).astype(np.float32)
    tifffile.imwrite(tmp_path / "dark.tif", average)
    assert capture.load(tmp_path).dark[0] == pytest.approx(average / 16)


def test_wrong_bit_shift_is_refused(tmp_path):
    with pytest.raises(
        CaptureError,
        match="counts use 12 bits above the lowest 0, the capture states 10",
    ):
        capture.load(folder(tmp_path, about="bits = 10\n"))


def test_truncated_tiff_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES)
    data = (tmp_path / "a.tif").read_bytes()
    for keep in (len(data) // 2, 100, 4):
        (tmp_path / "a.tif").write_bytes(data[:keep])
        with pytest.raises(CaptureError, match="truncated"):
            capture.load(tmp_path / "a.tif")


def test_jpeg_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), (FRAMES[0] // 16).astype(np.uint8))
    with pytest.raises(CaptureError, match="lossy"):
        capture.load(tmp_path / "a.jpg")


def test_nan_is_refused_with_its_place(tmp_path):
    frames = FRAMES.astype(np.float32)
    frames[2, 3, 5] = np.nan
    tifffile.imwrite(tmp_path / "a.tif", frames)
    with pytest.raises(CaptureError, match="frame 2, row 3, column 5"):
        capture.load(tmp_path / "a.tif")


def test_missing_frame_is_refused_with_its_row(tmp_path):
    folder(tmp_path)
    (tmp_path / "frame_2.tif").unlink()
    with pytest.raises(CaptureError, match="row 4: frame 'frame_2"):
        capture.load(tmp_path)


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        ("file,depht_um\nframe_0.tif,1\n", "did you mean 'depth_um'"),
        ("file,depth_um\nframe_0.tif,one\n", "row 2: depth_um is 'one'"),
        ("file,depth_um\nframe_0.tif,nan\n", "row 2: depth_um is nan"),
        ("depth_um\n1\n", "no 'file'"),
        ("file,depth_um\n", "no rows"),
    ],
)
def test_stage_errors_name_the_row(tmp_path, stage, words):
    with pytest.raises(CaptureError, match=words):
        capture.load(folder(tmp_path, stage=stage))


def test_colour_and_foreign_files_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(CaptureError, match="grey"):
        capture.load(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("no image")
    with pytest.raises(CaptureError, match="need TIFF, PNG or HDF5"):
        capture.load(tmp_path / "a.txt")
    with pytest.raises(CaptureError, match="no such file"):
        capture.load(tmp_path / "b.tif")


@pytest.mark.parametrize("suffix", ["tif", "png"])
@pytest.mark.parametrize(("channel", "place"), [("red", 0), ("green", 1), ("blue", 2)])
def test_one_channel_of_colour_frames_is_taken_where_it_is_named(
    tmp_path, suffix, channel, place
):
    colours = np.random.default_rng(7).integers(0, 900, (2, 9, 14, 3)).astype(
        np.uint16
    ) * np.array([1, 2, 4], np.uint16)
    for i, image in enumerate(colours):
        path = tmp_path / f"frame_{i}.{suffix}"
        if suffix == "png":
            cv2.imwrite(str(path), image[..., ::-1])
        else:
            tifffile.imwrite(path, image, photometric="rgb")
    (tmp_path / "capture.toml").write_text(f'bits = 12\nchannel = "{channel}"\n')
    found = capture.load(tmp_path)
    assert np.array_equal(found.frames, colours[..., place])
    assert any(f"channel {channel}" in words for words in found.corrections)
    (tmp_path / "capture.toml").write_text('channel = "infrared"\n')
    with pytest.raises(CaptureError, match="channel = 'infrared'"):
        capture.load(tmp_path)
    (tmp_path / "capture.toml").write_text("bits = 12\n")
    with pytest.raises(CaptureError, match='channel = "green"'):
        capture.load(tmp_path)


def test_a_channel_of_grey_frames_is_refused(tmp_path):
    """It changed nothing, and the corrections said that it had been used."""
    folder(tmp_path, about='channel = "green"\n')
    with pytest.raises(
        CaptureError, match=r"grey images.*channel = 'green'; leave it out"
    ):
        capture.load(tmp_path)


@pytest.mark.parametrize("name", ["dark_3.tif", "Flats.tif", "dark-01.tif"])
def test_dark_and_flat_files_that_would_not_be_used_are_refused(tmp_path, name):
    tifffile.imwrite(folder(tmp_path) / name, FRAMES[1])
    with pytest.raises(
        CaptureError, match=f"'{name}' is not named there.*one stack (dark|flat).tif"
    ):
        capture.load(tmp_path)


def test_images_that_the_stage_file_does_not_name_are_told(tmp_path):
    tifffile.imwrite(folder(tmp_path) / "darker try.tif", FRAMES[1])
    found = capture.load(tmp_path)
    assert len(found.frames) == len(FRAMES)
    assert any("left out: darker try.tif" in words for words in found.corrections)


def test_compressed_frames_of_another_program_are_read(tmp_path):
    """OpenCV writes LZW unless told otherwise."""
    cv2.imwrite(str(tmp_path / "a.tif"), FRAMES[0], [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    assert np.array_equal(capture.load(tmp_path / "a.tif").frames, FRAMES[:1])


@pytest.mark.parametrize(
    "words",
    [
        '{"voxel_um": [0.3, 0.13, 0.13], "emission_nm": 520}',
        '{"z_step_nm": 300, "pixel_nm": 130, "wavelength_um": 0.52}',
    ],
)
def test_sizes_beside_a_file_or_in_a_folder_of_numbered_frames(tmp_path, words):
    """Numbers count: z10 comes after z9; NAME.json beside a stack and capture.json in a
    folder say the same.
    """
    frames = np.random.default_rng(0).integers(0, 250, (12, 9, 11), dtype=np.uint8)
    folder = tmp_path / "planes"
    folder.mkdir()
    for i, frame in enumerate(frames):
        tifffile.imwrite(folder / f"z{i}.tif", frame, photometric="minisblack")
    tifffile.imwrite(tmp_path / "stack.tif", frames, photometric="minisblack")
    (folder / "capture.json").write_text(words)
    (tmp_path / "stack.json").write_text(words)
    for shots in (capture.load(folder), capture.load(tmp_path / "stack.tif")):
        assert np.array_equal(shots.frames, frames)
        assert np.allclose(shots.position_um, np.arange(12) * 0.3)
        assert (round(shots.pixel_um, 9), round(shots.wavelength_um, 9)) == (0.13, 0.52)


def test_several_channels_are_refused(tmp_path):
    frames = np.zeros((4, 2, 9, 11), np.uint16)
    tifffile.imwrite(
        tmp_path / "c.tif",
        frames,
        imagej=True,
        metadata={"axes": "ZCYX", "channels": 2},
    )
    with pytest.raises(CaptureError, match="2 channels"):
        capture.load(tmp_path / "c.tif")


def test_a_stack_without_a_column_of_pages_has_a_row_for_each_page(tmp_path):
    """Rows of one file are its pages in turn, beside a single image; a stack of other
    length is not guessed at.
    """
    folder(
        tmp_path,
        stage="file,depth_um\n" + "s.tif,7\nframe_1.tif,8\ns.tif,9\ns.tif,11\n",
    )
    tifffile.imwrite(tmp_path / "s.tif", FRAMES[[2, 0, 3]], photometric="minisblack")
    found = capture.load(tmp_path)
    assert np.array_equal(found.frames, FRAMES[[2, 1, 0, 3]])
    assert found.position_um.tolist() == [7, 8, 9, 11]
    (tmp_path / "stage.csv").write_text("file,depth_um\ns.tif,7\ns.tif,9\n")
    with pytest.raises(
        CaptureError,
        match=r"row 2: 's.tif' holds 3 pages and stands in 2 rows.*column page",
    ):
        capture.load(tmp_path)
    (tmp_path / "stage.csv").write_text("file,page,depth_um\ns.tif,2,7\ns.tif,0,9\n")
    assert np.array_equal(capture.load(tmp_path).frames, FRAMES[[3, 2]])
