"""Where the stage stood, in every unit that a file may carry."""

import json
import math

import numpy as np
import pytest

from characterize.captures import stage
from metalens.core.errors import CaptureError


@pytest.mark.parametrize(
    ("column", "scale"),
    [
        ("depth_um", 1.0),
        ("z_nm", 1e-3),
        ("position_mm", 1e3),
        ("depth_mm", 1e3),
        ("position_nm", 1e-3),
        ("z_cm", 1e4),
        ("depth_m", 1e6),
    ],
)
def test_positions_and_angles_carry_their_unit(tmp_path, column, scale):
    (tmp_path / "stage.csv").write_text(
        f"file,page,{column},angle_deg,angle_y_rad,exposure_s\na.tif,3,2.5,4,0.02,0.1\nb.tif,0,-7,-1.5,0.3,0.25\n"
    )
    rows = stage.read_stage(tmp_path)
    assert rows.files == ("a.tif", "b.tif")
    assert rows.page == (3, 0)
    assert rows.position_um == pytest.approx(np.array([2.5, -7.0]) * scale, rel=1e-12)
    want = np.array([[math.radians(4), 0.02], [math.radians(-1.5), 0.3]])
    assert rows.angle_rad == pytest.approx(want, rel=1e-12)
    assert rows.exposure_s.tolist() == [0.1, 0.25]


def test_what_is_not_listed_is_unknown_and_along_the_axis(tmp_path):
    (tmp_path / "stage.json").write_text(
        json.dumps([{"file": "a.png", "angle_rad": 0.1, "angle_y_deg": 2}])
    )
    rows = stage.read_stage(tmp_path)
    assert np.isnan(rows.position_um).all()
    assert np.isnan(rows.exposure_s).all()
    assert rows.page == (None,)
    assert rows.angle_rad == pytest.approx(np.array([[0.1, math.radians(2)]]))


def test_other_names_and_units_of_a_description_are_taken(tmp_path):
    (tmp_path / "capture.toml").write_text(
        "pixel_size_nm = 65\nz_step_um = -0.2\nemission_nm = 520\n"
    )
    found = stage.read_about(tmp_path)
    assert found == pytest.approx(
        {"pixel_um": 0.065, "step_um": -0.2, "wavelength_um": 0.52}
    )
    (tmp_path / "capture.toml").write_text(
        "voxel_um = [0.3, 0.11, 0.12]\nstep_um = 0.4\n"
    )
    assert stage.read_about(tmp_path) == {"step_um": 0.4, "pixel_um": 0.12}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            "file,depth_um,depth_mm\na.tif,730,0.9\n",
            "depth_um and depth_mm say the same",
        ),
        (
            "file,angle_deg,angle_rad\na.tif,7,0.3\n",
            "angle_deg and angle_rad say the same",
        ),
        (
            "file,angle_y_deg,angle_y_rad\na.tif,7,0.3\n",
            "angle_y_deg and angle_y_rad say the same",
        ),
        ("file;depth_mm\na.tif;0,73\n", "parted by ';'; save it with commas"),
        ("file\tdepth_mm\na.tif\t0.73\n", "save it with commas"),
        ("file,page\na.tif,1\na.tif,2.5\n", "row 3: page is 2.5, need a whole number"),
    ],
)
def test_tables_that_could_be_read_in_two_ways_are_refused(tmp_path, table, words):
    (tmp_path / "stage.csv").write_text(table)
    with pytest.raises(CaptureError, match=words):
        stage.read_stage(tmp_path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("gain_e = 0", "gain_e = 0, need a number above 0"),
        ("gain_e = -2.3", "gain_e = -2.3, need a number above 0"),
        ('gain_e = "high"', "gain_e = 'high', need a number"),
        ("gain_e = true", "gain_e = True, need a number"),
        ("read_noise_e = -1.5", "read_noise_e = -1.5, need a number from 0 on"),
        ("offset = nan", "offset = nan, need a number"),
        ("bits = 11.5", "bits = 11.5, need a number above 0, whole"),
        ("bits = 33", "bits = 33, need a number above 0, whole, at most 32"),
        ("step_um = 0", "step_um = 0, need a number"),
        ("glass_um = -5.0", "glass_um = -5.0, need a number from 0 on"),
        ("glass_tilt_y_deg = 97.0", "glass_tilt_y_deg = 97.0, need a number between"),
        ("wavelength_sigma_nm = -0.1", "need a number from 0 on"),
        ("gain = 2.1", "unknown entry 'gain'; did you mean 'gain_e'"),
        ("pixels_um = 2.1", "unknown entry 'pixels_um'; did you mean 'pixel_um'"),
    ],
)
def test_what_no_camera_has_is_refused_and_misspelt_names_are_told(
    tmp_path, line, words
):
    (tmp_path / "capture.toml").write_text(line + "\n")
    with pytest.raises(CaptureError, match="capture.toml: .*" + words):
        stage.read_about(tmp_path)


@pytest.mark.parametrize("time", ["0", "-0.02"])
def test_an_exposure_of_no_length_is_refused_by_its_row(tmp_path, time):
    (tmp_path / "stage.csv").write_text(
        f"file,depth_um,exposure_s\na.tif,2.5,0.1\nb.tif,3.5,{time}\n"
    )
    with pytest.raises(
        CaptureError, match=r"stage\.csv, row 3: exposure_s is -?0.*above 0"
    ):
        stage.read_stage(tmp_path)
