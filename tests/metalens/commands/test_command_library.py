"""``metalens library`` and ``metalens study``: what they write, what they refuse, and
how they end.
"""

import json

import numpy as np
import pytest

from metalens import library
from metalens.commands import library as command
from metalens.commands.library import CellFile
from metalens.core import config
from metalens.library import ProxyTolerances
from metalens.library.record import DEFAULT_CELL
from tests.command_line import call, printed

QUICK = """
[cell]
pitch_um = 0.30
height_um = 0.7
pillar = { n = 3.6, k = 0.0 }
[sweep]
samples = 120
tolerance = 1e-2
"""


@pytest.fixture
def cell(tmp_path):
    """A function that writes a config and runs the command on it."""

    def run(text, *words):
        path = tmp_path / "cell.toml"
        path.write_text(text)
        return call(f"library {path} -o {tmp_path}/library.h5", *words)

    return run


def files(folder):
    return sorted(p.name for p in folder.iterdir())


def test_library_with_proxy_and_figure(cell, tmp_path, capsys):
    assert cell(QUICK, "--json") == 0
    values = printed(capsys)
    assert values["turns"] >= 1
    assert values["max_error"] <= 1e-2
    assert values["max_phase_error_rad"] <= 1e-3  # the default phase_tolerance_rad
    assert files(tmp_path) == ["cell.toml", "library.h5", "library.png"]
    made = library.load(tmp_path / "library.h5")
    assert made.proxy is not None
    assert made.provenance.inputs.keys() == {"cell.toml"}
    assert np.isfinite(made.proxy.phase_rad(np.array([0.1, 0.2]), 0.85)).all()
    before = (tmp_path / "library.h5").read_bytes()
    assert cell(QUICK) == 2
    assert "give --force" in capsys.readouterr().err
    assert cell(QUICK, "--force") == 0
    assert (tmp_path / "library.h5").read_bytes() == before  # same input, same bytes
    shown = capsys.readouterr().out.split()  # the table of speed and error
    assert {"modal", "solves", "median", "cut"} <= set(shown)


def test_a_material_table_is_named_in_the_provenance(cell, tmp_path, capsys):
    table = tmp_path / "film.csv"
    table.write_text("wavelength_um,n,k\n0.8,3.61,0\n0.9,3.59,0\n")
    assert cell(QUICK.replace("{ n = 3.6, k = 0.0 }", f'"{table}"'), "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert library.load(tmp_path / "library.h5").provenance.inputs.keys() == {
        "cell.toml",
        "film.csv",
    }


def test_less_than_a_turn_fails_its_check(cell, tmp_path, capsys):
    assert cell(QUICK.replace("height_um = 0.7", "height_um = 0.3")) == 1
    told = capsys.readouterr().out
    assert "a lens needs 1: it was cut (above); another pitch" in told
    assert "none of the lattice's own lies below 0.236 um" in told  # 0.85 um / 3.6
    assert (tmp_path / "library.h5").exists()  # the result is there to look at


def test_a_proxy_that_misses_its_tolerances_fails_its_check(cell, tmp_path, capsys):
    assert cell(QUICK + "[proxy]\nphase_tolerance_rad = 1e-15\n") == 1
    told = capsys.readouterr().out
    # more samples, not another cell
    assert "a lens needs 1: the pillars cover 1." in told
    assert "where 1e-15 and" in told
    assert any(
        "where 1e-15 and" in note
        for note in library.load(tmp_path / "library.h5").notes
    )


SQUARES = """
[cell]
pitch_um = 0.33
height_um = 0.8
pillar = { n = 2.4 }
[cell.shape]
kind = "square"
[sweep]
wavelengths_um = [0.6]
diameters_um = [0.12, 0.2]
samples = 40
"""


def known_within(d, bars):
    """A sweep whose pillars have |t| of 0.95, a ripple of 3 mrad and these error bars."""
    t = (0.95 * np.exp(1j * (40 * d + 3e-3 * np.sin(900 * d))))[None, None, None]

    def swept(cell, settings=None, *, wavelengths_um=(0.6,), **_):
        settings = (settings or library.Sweep(wavelengths_um)).with_tolerance(cell)
        about = {"resonances": np.zeros((0, 5)), "engine": "rcwa", "solves": 13}
        one = np.array([0.6]), d, t, 0 * t, bars[None, None, None], np.abs(t) ** 2
        return library.PillarLibrary(cell, settings, ("x",), np.zeros(1), *one, **about)

    return swept


def test_squares_that_state_no_tolerance_have_the_bars_of_their_solver(
    cell, monkeypatch, capsys
):
    """A smooth curve with bars of 0.012, wider beside one size: told, and no failure
    unless 1e-2 was asked for.
    """
    d = np.linspace(0.12, 0.2, 40)
    bars = np.where(abs(d - 0.13) < 3e-3, 0.05, 0.012)
    monkeypatch.setattr(library, "sweep", known_within(d, bars))
    assert cell(SQUARES, "--accept-partial-turn") == 0
    told = capsys.readouterr().out
    assert "3 of 40 error bars are above the tolerance 0.02 (largest 0.05)" in told
    entry_error = float(told.split("rms error of t of the meta-atoms")[1].split()[0])
    assert entry_error == pytest.approx(np.sqrt(np.mean((bars / 0.95) ** 2)), rel=0.03)
    assert "FAILED" not in told  # the ripple of 3 mrad lies within half of the bars
    assert cell(SQUARES + "tolerance = 1e-2\n", "--accept-partial-turn", "--force") == 1
    assert (
        "FAILED: 40 of 40 error bars are above the tolerance 0.01"
        in capsys.readouterr().out
    )
    asked = SQUARES + "[proxy]\nphase_tolerance_rad = 1e-3\n"
    assert cell(asked, "--accept-partial-turn", "--force") == 1
    assert "FAILED: the proxy follows the phase within" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pitch_um", "pich_um", "did you mean 'pitch_um'"),
        ("samples", "sampels", "did you mean 'samples'"),
        ("[sweep]", "[swep]", "did you mean 'sweep'"),
        ("pitch_um = 0.30", "pitch_um = 0.90", "(1, 0) propagate in the cover"),
        ("pitch_um = 0.30", "pitch_um = -1.0", "need a finite length above 0"),
        ("pitch_um = 0.30", "pitch_um = inf", "pitch_um is inf, need a finite number"),
        ("pitch_um = 0.30", "pitch_um = nan", "pitch_um is nan"),
        ("pitch_um = 0.30", 'pitch_um = "wide"', "need float"),
        ("{ n = 3.6, k = 0.0 }", '"a-Sj"', "did you mean 'a-Si'"),
        ("{ n = 3.6, k = 0.0 }", "{ n = -3.6 }", "need finite n > 0"),
        ("{ n = 3.6, k = 0.0 }", '"none.csv"', "none.csv: no such file"),
        ("tolerance = 1e-2", "wavelengths_um = [50.0]", "its source holds from"),
        ("tolerance = 1e-2", "diameters_um = [0.1, 0.3]", "pillars touch"),
        ("tolerance = 1e-2", "diameters_um = [0.1]", "need 2"),
        ("tolerance = 1e-2", "tolerance = 0.0", "need 1e-8 to 0.1"),
        ("tolerance = 1e-2", "tolerance = ", "not valid TOML"),
    ],
)
def test_bad_input_ends_with_2_and_writes_nothing(
    cell, tmp_path, capsys, old, new, words
):
    assert old in QUICK
    assert cell(QUICK.replace(old, new)) == 2
    assert words in capsys.readouterr().err
    assert files(tmp_path) == ["cell.toml"]


def test_missing_config_and_folder(tmp_path, capsys):
    assert call(f"library {tmp_path}/none.toml") == 2
    assert "none.toml: no such file" in capsys.readouterr().err
    (tmp_path / "cell.toml").write_text(QUICK)
    assert call(f"library {tmp_path}/cell.toml -o {tmp_path}/no/l.h5") == 2
    assert "does not exist" in capsys.readouterr().err


def test_the_example_is_the_default_cell(request):
    example = request.config.rootpath / "examples" / "cell.toml"
    assert config.load(example, CellFile).cell == DEFAULT_CELL
    assert (
        config.loads("", CellFile).sweep.with_tolerance(DEFAULT_CELL)
        == config.load(example, CellFile).sweep
    )
    stated = ProxyTolerances(phase_tolerance_rad=1e-3, transmission_tolerance=1e-3)
    assert config.load(example, CellFile).proxy == stated


STUDY = """
pitches_um = [0.30]
heights_um = [0.7]
wavelengths_um = [0.85]
tolerance = 2e-2
"""


def test_study(tmp_path, capsys):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    out = tmp_path / "study"
    assert call(f"study {path} -o {out} --json") == 0
    told = printed(capsys)
    assert (told["pitch_um"], told["cells"]) == (0.3, 1)  # no other material is tried
    assert files(out) == ["cell_study.json", "cell_study.png", "manifest.json"]
    assert call(f"study {path} -o {out}") == 2
    assert "give --force" in capsys.readouterr().err
    path.write_text(STUDY.replace("0.7", "0.2"))
    assert call(f"study {path} -o {out} --force") == 1
    path.write_text(STUDY.replace("pitches", "pitchs"))
    assert call(f"study {path} -o {out} --force") == 2
    assert "did you mean 'pitches_um'" in capsys.readouterr().err
    path.write_text(STUDY)
    assert call(f"study {path} -o {tmp_path}/no/study") == 2
    assert "does not exist" in capsys.readouterr().err


ANY_CELL = """
pitches_um = [0.62]
heights_um = [0.9]
wavelengths_um = [1.55]
min_diameter_um = 0.3
min_gap_um = 0.24
tolerance = 1e-1
[cell]
pitch_um = 1.0
pillar = "Si-infrared"
substrate = "sapphire"
"""


def test_study_of_any_cell_within_a_process(tmp_path, capsys):
    path = tmp_path / "study.toml"
    process = tmp_path / "process.toml"
    out = tmp_path / "study"
    path.write_text(ANY_CELL)
    process.write_text(
        "[rules]\nminimum_feature_nm = 310\nminimum_gap_nm = 240\ndiameter_step_nm = 10\n"
    )
    # a stretch this short
    assert call(f"study {path} --process {process} -o {out} --json") == 1
    found = json.loads((out / "cell_study.json").read_text())
    assert found["study"]["min_diameter_um"] >= 0.31
    # 0.24 between drawn polygons, whose flats lie inside the circle
    assert 0.23 <= found["study"]["min_gap_um"] < 0.24
    verdict = found["verdicts"][0]
    assert verdict["pitch_um"] == 0.62
    # sin = 1.55/0.62 - 1.7462
    assert verdict["max_angle_deg"] == pytest.approx(48.9, abs=0.4)
    capsys.readouterr()
    path.write_text(ANY_CELL.replace("[cell]", 'pillar = "Si"\n[cell]'))
    assert call(f"study {path} -o {out} --force") == 2
    assert "give pillar inside cell" in capsys.readouterr().err


def test_pillars_that_are_hardly_known_make_no_library_and_no_lens_whatever_is_asked(
    cell, tmp_path, monkeypatch, capsys
):
    """Bars of 0.2 of |t|: no curve, tolerance or coverage that is accepted makes them
    good.
    """
    d = np.linspace(0.12, 0.2, 40)
    few = np.where(np.arange(40) < 21, 0.09, 0.12)
    loose = "[proxy]\nphase_tolerance_rad = 0.5\ntransmission_tolerance = 0.5\n"
    told = []
    for bars in (0.19 + 0 * d, few):
        monkeypatch.setattr(library, "sweep", known_within(d, bars))
        assert cell(SQUARES + loose, "--accept-partial-turn", "--force") == 1
        told.append(capsys.readouterr().out)
    assert "error bars of 100% of the entries are above 0.1" in told[0]
    assert (
        "FAILED: the pillars' own error bars are 0.2 of |t| (root mean square)"
        in told[0]
    )
    assert "of the entries are above 0.1" not in told[1]  # 48 % of them
    many = known_within(d, np.where(np.arange(40) < 19, 0.09, 0.12))(DEFAULT_CELL)
    failures = command._failures(many, None, "", stated=False)
    assert (
        "error bars of 52% of the entries are above 0.1, whatever is asked for"
        in failures
    )
    assert "FAILED: the pillars' own error bars are 0.11 of |t|" in told[1]
    config = 'library = "library.h5"\naperture_mm = 0.006\nsensor_distance_mm = 0.2\nsource_distance_mm = inf\n'
    (tmp_path / "design.toml").write_text(
        config + "[limits]\nmin_diameter_nm = 80\nmin_gap_nm = 80\n"
    )
    words = f"design {tmp_path}/design.toml -o {tmp_path}/lens.h5 --accept-partial-turn"
    assert call(f"{words} --skip-focus-check") == 1
    assert (
        "FAILED: the pillars' own error bars are 0.11 of |t|" in capsys.readouterr().out
    )
    monkeypatch.setattr(library, "sweep", known_within(d, 0.05 + 0 * d))
    assert cell(SQUARES + loose, "--accept-partial-turn", "--force") == 0
    assert call(f"{words} --skip-focus-check --force") == 0
    assert "FAILED" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("turned", "told"), [("", True), ("angle_rad = 0.7853981633974483\n", False)]
)
def test_light_that_a_shape_without_a_mirror_along_x_or_y_sends_elsewhere_is_told(
    cell, monkeypatch, capsys, turned, told
):
    """|t| of 0.95 and no reflection leave 1 - 0.95² for the other polarisation."""
    hook = (
        "[[-0.5, -0.5], [0.5, -0.5], [0.5, 0.0], [0.0, 0.0], [0.0, 0.5], [-0.5, 0.5]]"
    )
    shape = f'kind = "polygon"\ncorners = {hook}\n{turned}'
    d = np.linspace(0.12, 0.2, 40)
    monkeypatch.setattr(library, "sweep", known_within(d, 0.01 + 0 * d))
    assert (
        cell(SQUARES.replace('kind = "square"\n', shape), "--accept-partial-turn") == 0
    )
    assert (
        "up to 10% of it leaves along y, or is absorbed" in capsys.readouterr().out
    ) is told
