"""What a command will need is checked before its work begins."""

import numpy as np
import pytest

from characterize.captures import capture as captures
from layout.gdsii import read as gdsii_read
from metalens.cell.record import Cell, Index
from metalens.cli import BAD_INPUT, main
from metalens.commands import design
from metalens.pillars.proxy import Proxy


@pytest.fixture
def untouched(monkeypatch):
    """The work of the commands, which must not begin."""

    def begin(*_, **__):
        pytest.fail("the work began")

    monkeypatch.setattr(captures, "load", begin)
    monkeypatch.setattr(gdsii_read, "read", begin)
    monkeypatch.setattr(design, "_phase", begin)


def test_outputs_that_cannot_be_written_are_refused_before_inputs_are_read(tmp_path, untouched, capsys):
    (tmp_path / "mask.gds").write_bytes(b"\0\6\0\2\0\7")
    (tmp_path / "taken").write_text("mine")
    for words in (
        ["measure", str(tmp_path), "-o", str(tmp_path / "no" / "out")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "no" / "out.lyrdb")],
        ["measure", str(tmp_path), "-o", str(tmp_path / "taken")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "taken"), "--force"],
    ):
        assert main(words) == BAD_INPUT
        told = capsys.readouterr().err
        assert "does not exist" in told or "taken" in told
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_wavelength_outside_the_library_is_refused_before_the_search(tmp_path, untouched, monkeypatch, capsys):
    proxy = Proxy(np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.84, 0.86), 0.0, 0.0)
    monkeypatch.setattr(design, "_pillars", lambda *_: (Cell(0.3, pillar=Index(3.6)), proxy, {}))
    (tmp_path / "d.toml").write_text('profile = "fisher"\nwavelength_nm = 940.0\naperture_mm = 0.05\n')
    assert main(["design", str(tmp_path / "d.toml"), "-o", str(tmp_path / "l.h5")]) == BAD_INPUT
    assert "um, but the proxy holds from 0.84 to 0.86 um" in capsys.readouterr().err
