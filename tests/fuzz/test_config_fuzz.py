"""Damaged settings: TOML of every command and CSV tables, with flipped bytes or odd
values, are refused by type.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterize.bench.bench import HiddenLens
from characterize.commands.fit import MetrologySettings
from characterize.pupil.model import PupilSpec
from codesign.train import run as runs
from layout.process import process as processes
from metalens import materials
from metalens.commands.chain import ChainFiles
from metalens.commands.design import DesignSettings
from metalens.commands.library import CellFile
from metalens.commands.psf import PsfSettings
from metalens.core import config
from metalens.core.errors import MetalensError

TEXTS = {
    "cell": ("[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n[sweep]\nwavelengths_um = [0.85]\nsamples = 200\n", CellFile),
    "design": ('profile = "cubic"\naperture_mm = 0.5\n[limits]\nmin_gap_nm = 70\n[cubic]\nstrength_rad = 5\n',
        DesignSettings),
    "psf": ("depths_mm = [16.0, 26.0, 0.5]\nangles_deg = [0.0, 10.0]\ntolerance = 1e-4\n", PsfSettings),
    "process": ('name = "x"\n[rules]\ngrid_nm = 1\n[bias]\ntable_nm = [[80, -6.0], [120, 1.0]]\n', processes.Process),
    "truth": ('depths_um = [18000.0, 22000.0]\npeak_e = 8000.0\n[[parameter]]\nname = "bias_nm"\nvalue = 3.0\n', HiddenLens),
    "metrology": ('scan_um = 150.0\n[[known]]\nname = "height_nm"\nvalue = -3.0\nsigma = 3.0\n', MetrologySettings),
    "pupil": ("numerical_aperture = 0.5\nwavelength_um = 0.6\npixel_um = 0.1\nstep_um = 0.5\n", PupilSpec),
    "chain": ('cell = "c.toml"\ndesign = "d.toml"\nprocess = "p.toml"\n', ChainFiles),
    "run": ('preset = "smoke"\n[inner]\nsteps = 3\n[run]\npitch_um = 18.0\n', None),
}  # fmt: skip
LIMITS = dict(max_examples=40)


def _load(kind, path):
    record = TEXTS[kind][1]
    if kind == "run":
        return runs.load_run_settings(path)
    return (
        processes.load_process(path) if kind == "process" else config.load(path, record)
    )


@pytest.mark.parametrize("kind", sorted(TEXTS))
def test_the_texts_themselves_are_good(tmp_path, kind):
    (tmp_path / "c.toml").write_text(TEXTS[kind][0], encoding="utf-8")
    assert _load(kind, tmp_path / "c.toml") is not None


@pytest.mark.parametrize("kind", sorted(TEXTS))
@settings(**LIMITS)
@given(data=st.data())
def test_damaged_settings_are_refused_by_type(tmp_path_factory, kind, data):
    whole = bytearray(TEXTS[kind][0].encode())
    how = data.draw(st.sampled_from(["cut", "flip", "byte", "twice"]), label="how")
    if how == "cut":
        whole = whole[: data.draw(st.integers(0, len(whole)), label="length")]
    elif how == "flip":
        at = data.draw(st.integers(0, len(whole) - 1), label="at")
        whole[at] ^= 1 << data.draw(st.integers(0, 7), label="bit")
    elif how == "byte":
        whole.insert(
            data.draw(st.integers(0, len(whole)), label="at"),
            data.draw(st.integers(0, 255), label="byte"),
        )
    else:
        whole = whole + whole
    path = tmp_path_factory.mktemp("fuzz") / "c.toml"
    path.write_bytes(bytes(whole))
    try:
        _load(kind, path)
    except MetalensError as refusal:
        said = str(refusal)
    else:
        said = "accepted"
    assert said


@settings(**LIMITS)
@given(data=st.data())
def test_damaged_material_tables_are_refused_by_type(tmp_path_factory, data):
    whole = bytearray(
        b"wavelength_um,n,k\n0.80,3.70,0.010\n0.85,3.60,0.005\n0.90,3.55,0.002\n"
    )
    at = data.draw(st.integers(0, len(whole) - 1), label="at")
    whole[at] = data.draw(st.integers(0, 255), label="byte")
    whole = whole[: data.draw(st.integers(0, len(whole)), label="length")]
    path = tmp_path_factory.mktemp("fuzz") / "m.csv"
    path.write_bytes(bytes(whole))
    try:
        n = materials.index(str(path), 0.85)
    except MetalensError:
        return
    assert n.real > 0
    assert n.imag >= 0
