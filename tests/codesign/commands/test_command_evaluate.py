"""``metalens evaluate optics`` from lens files to tables, numbers and pictures;
refusals leave nothing.
"""

import json
import math

import numpy as np
import pytest

from metalens import design, lens
from metalens.cell.record import Cell, Index
from metalens.design.profiles import Focus
from tests.command_line import call
from tests.proxies import proxy_of

IDEAL = proxy_of([0.0, 3 * math.pi], [1.0], (0.08, 0.32), 0.85, 1e-6)
CELL = Cell(pitch_um=0.4, pillar=Index(3.6), substrate=Index(1.45))
TOML = """[axial]
depths_mm = [1.6, 2.6]
count = 3
angles_deg = [0.0, 5.0]
binnings = [1, 2]
window_um = 60.0
[scenes]
count = 2
pixels = 24
pitch_um = 9.0
window_um = 72.0
image_tolerance = 0.3
[reader]
frames = 64
pool = 32
test = 32
pixels = 32
pitch_um = 12.0
depths_mm = [14.0, 32.0]
tolerance = 0.5
"""


def made(path, focus_um, distance_um=600.0):
    focus = Focus(0.85, distance_um, focus_um)
    lens.save(path, design.make(design.phase_of(None, focus, radius_um=60.0), focus, aperture_um=120.0, cell=CELL,
                                proxy=IDEAL)[0])  # fmt: skip


def test_lenses_to_tables_numbers_and_pictures(tmp_path, capsys):
    made(tmp_path / "a.h5", 2000.0)
    made(tmp_path / "b.h5", 20000.0)
    (tmp_path / "o.toml").write_text(TOML)
    words = f"{tmp_path}/a.h5 {tmp_path}/b.h5 --config {tmp_path}/o.toml --reader"
    assert call(f"evaluate optics {words} -o {tmp_path}/out") == 0
    shown = capsys.readouterr().out
    assert "Read by the reference reader: 64 frames of 32 pixels of 12 µm" in shown
    assert "image error" in shown
    assert (
        0
        < json.loads((tmp_path / "out" / "optics.json").read_text())["lenses"]["b"][
            "image_error"
        ]
        < 0.3
    )
    assert "95 % interval over the scenes" in shown
    values = json.loads((tmp_path / "out" / "optics.json").read_text())
    assert values["lenses"]["a"]["scene_ratios"]["gaze"] == [1.0, 1.0, 1.0]
    assert np.shape(values["lenses"]["b"]["information_per_mm2"]) == (2, 2, 3)
    energy = values["lenses"]["a"]["encircled_energy"][0]
    # b is focused far behind this range
    assert max(energy) > max(values["lenses"]["b"]["encircled_energy"][0])
    read = values["reader"]["lenses"]
    assert set(read) == {"a", "b"}
    assert all(
        0 <= one["covered"] <= 1 and one["axial_low_mm"] < one["axial_mm"]
        for one in read.values()
    )
    assert "90 % interval" in (tmp_path / "out" / "tables.txt").read_text()
    for name in ("axial.png", "scenes.png", "report.html"):
        assert (tmp_path / "out" / name).stat().st_size > 2000


def test_an_error_above_what_is_aimed_at_ends_1_and_is_told_in_both_outputs(
    tmp_path, capsys
):
    """No sum in floating point keeps 1e-17; the files are there all the same."""
    made(tmp_path / "a.h5", 20000.0)
    small = TOML.replace("[axial]", "[axial]\ntolerance = 1e-17")
    small = small.replace("count = 2", "count = 1")
    (tmp_path / "o.toml").write_text(small.replace("count = 3", "count = 1"))
    words = f"{tmp_path}/a.h5 --config {tmp_path}/o.toml -o {tmp_path}/out"
    assert call(f"evaluate optics {words}") == 1
    assert "\n  FAILED: a: the PSFs' error " in (shown := capsys.readouterr().out)
    (told,) = json.loads((tmp_path / "out" / "optics.json").read_text())["failures"]
    assert told.endswith("is above axial.tolerance = 1e-17")
    assert told in shown


def test_lenses_of_different_sensor_distances_are_refused(tmp_path, capsys):
    made(tmp_path / "a.h5", 2000.0)
    made(tmp_path / "b.h5", 2000.0, distance_um=700.0)
    (tmp_path / "o.toml").write_text(TOML)
    words = f"{tmp_path}/a.h5 {tmp_path}/b.h5 --config {tmp_path}/o.toml"
    assert call(f"evaluate optics {words} -o {tmp_path}/out") == 2
    assert "sensor distance" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_deflector_is_told_to_have_no_focus(tmp_path, capsys):
    focus, wave = Focus(0.85, 600.0, 2000.0), 2 * math.pi / 0.85
    found = design.make(
        lambda x, y: 0.11 * wave * x + 0 * y[:, None],
        focus,
        aperture_um=60.0,
        cell=CELL,
        proxy=IDEAL,
    )
    lens.save(tmp_path / "prism.h5", found[0])
    few = TOML.replace("count = 3", "count = 1").replace("angles_deg = [0.0, 5.0]", "")
    (tmp_path / "o.toml").write_text(few)
    words = f"{tmp_path}/prism.h5 --config {tmp_path}/o.toml --scenes 1"
    call(f"evaluate optics {words} -o {tmp_path}/out")
    shown = capsys.readouterr()
    assert "prism brings no light together in one bright spot" in shown.out + shown.err


def test_light_that_the_library_of_the_lens_does_not_hold_is_refused_by_name(
    tmp_path, capsys
):
    made(tmp_path / "a.h5", 2000.0)
    (tmp_path / "o.toml").write_text(
        TOML.replace("frames = 64", "frames = 64\nfwhm_nm = 30.0")
    )
    words = f"{tmp_path}/a.h5 --config {tmp_path}/o.toml --reader -o {tmp_path}/out"
    assert call(f"evaluate optics {words}") == 2
    assert (
        "the pillars are known at 850 nm alone, and 1 of it lies beyond: sweep a library over it"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "bad",
    [
        "[scenes]\ncount = 0\n",
        "[axial]\ndepths_mm = [26.0, 16.0]\n",
        "[reader]\nframes = 5\n",
    ],
)
def test_bad_settings_are_refused(tmp_path, capsys, bad):
    made(tmp_path / "a.h5", 2000.0)
    (tmp_path / "o.toml").write_text(bad)
    words = f"{tmp_path}/a.h5 --config {tmp_path}/o.toml -o {tmp_path}/out"
    assert call(f"evaluate optics {words}") == 2
    assert "need" in capsys.readouterr().err
