"""Stacks whose frames run along the last axis: taken so where that is known, refused
where it only reads so.
"""

import h5py
import numpy as np
import pytest
import tifffile

from characterize.captures import capture
from metalens.core.errors import CaptureError

RNG = np.random.default_rng(7)
FRAMES = RNG.integers(37, 4096, (5, 26, 19)).astype(np.uint16)  # n, y, x: no two alike
ABOUT = "pixel_um = 3.0\nwavelength_um = 0.85\n"


def stack(path, frames):
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["frames"] = frames
    else:
        tifffile.imwrite(path, frames, photometric="minisblack")


def folder(path, name, frames, stage, about=ABOUT):
    stack(path / name, frames)
    (path / "stage.csv").write_text(stage)
    (path / "capture.toml").write_text(about)
    return path


def rows(name, n):
    return "file,depth_um\n" + "".join(f"{name},{100 * k + 7}\n" for k in range(n))


@pytest.mark.parametrize("name", ["s.h5", "s.tif"])
def test_stated_axes_say_that_frames_run_along_the_last_axis(tmp_path, name):
    about = ABOUT + 'axes = "yxn"\n'
    found = capture.load(
        folder(tmp_path, name, np.moveaxis(FRAMES, 0, 2), rows(name, 5), about)
    )
    assert np.array_equal(found.frames, FRAMES)
    assert found.position_um.tolist() == [7, 107, 207, 307, 407]
    words = f"{name} taken as (y, x, n), 5 frames of 26 x 19 pixels, as stated"
    assert words in found.corrections


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("s.h5", (26, 19, 5)),
        ("s.tif", (26, 19, 5)),
        ("s.h5", (19, 19, 11)),
        ("s.tif", (19, 19, 11)),
        ("s.h5", (26, 19, 1)),
    ],
)
def test_a_lone_stack_that_reads_like_rows_is_refused_until_its_axes_are_stated(
    tmp_path, name, shape
):
    """Strips of 19 x 5 pixels; frames as many as they are high, and narrower; frames of
    one column.
    """
    lying = RNG.integers(37, 4096, shape).astype(np.uint16)
    stack(tmp_path / name, lying)
    with pytest.raises(
        CaptureError,
        match=r'reads like .* as \(y, x, n\); say which: axes = "nyx" or axes = "yxn"',
    ):
        capture.load(tmp_path / name)
    (tmp_path / "s.toml").write_text(ABOUT + 'step_um = 0.3\naxes = "yxn"\n')
    found = capture.load(tmp_path / name)
    assert np.array_equal(found.frames, np.moveaxis(lying, 2, 0))
    assert found.position_um == pytest.approx(0.3 * np.arange(shape[2]))
    if shape[2] >= 3:  # the least of a frame
        (tmp_path / "s.toml").write_text(ABOUT + 'axes = "nyx"\n')
        assert np.array_equal(capture.load(tmp_path / name).frames, lying)


@pytest.mark.parametrize(
    "shape", [(5, 26, 19), (30, 12, 12), (12, 12, 19), (9, 26, 9), (1, 26, 5)]
)
def test_stacks_of_frames_of_usual_shapes_are_taken_as_they_lie(tmp_path, shape):
    lying = RNG.integers(37, 4096, shape).astype(np.uint16)
    stack(tmp_path / "s.h5", lying)
    assert np.array_equal(capture.load(tmp_path / "s.h5").frames, lying)


def test_stated_axes_hold_for_dark_and_flat_too(tmp_path):
    dark, flat = FRAMES[:3] // 50, FRAMES[:4] // 2
    folder(
        tmp_path,
        "s.h5",
        np.moveaxis(FRAMES, 0, 2),
        rows("s.h5", 5),
        ABOUT + 'axes = "yxn"\nbits = 12\n',
    )
    stack(tmp_path / "dark.tif", np.moveaxis(dark, 0, 2))
    stack(tmp_path / "flat.h5", np.moveaxis(flat, 0, 2))
    found = capture.load(tmp_path)
    assert np.array_equal(found.frames, FRAMES)
    assert np.array_equal(found.dark, dark)
    assert np.array_equal(found.flat, flat)


@pytest.mark.parametrize(
    ("letters", "lying"), [("YXZ", (1, 2, 0)), ("TYX", (0, 1, 2)), ("ZYX", (0, 1, 2))]
)
def test_axes_that_an_array_was_written_with_are_its_axes(tmp_path, letters, lying):
    frames = FRAMES if letters == "YXZ" else np.moveaxis(FRAMES, 0, 2)
    metadata = {"axes": letters}
    tifffile.imwrite(
        tmp_path / "s.tif",
        frames.transpose(lying),
        photometric="minisblack",
        metadata=metadata,
    )
    assert np.array_equal(capture.load(tmp_path / "s.tif").frames, frames)
