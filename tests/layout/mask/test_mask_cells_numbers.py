"""Classes of drawn pillars, block by block, pillar by pillar in plain numpy."""

import numpy as np
import pytest

from layout.mask import cells
from layout.process import isolation, process
from metalens.core.errors import LensError, ProcessError
from metalens.lens import DiameterMap

PLAIN = "[rules]\ngrid_nm = 1\ndiameter_step_nm = 4\n"
ALONE = PLAIN + "[bias]\nisolated_nm = 9.0\nrange_um = 0.9\n"
RNG = np.random.default_rng(3)


def rules(tmp_path, text):
    (tmp_path / "p.toml").write_text(text)
    return process.load(tmp_path / "p.toml")


def lens(sizes_nm, pitch_um=0.4):
    return DiameterMap(np.asarray(sizes_nm, float) * 1e-3, pitch_um)


@pytest.mark.parametrize("sites", [1 << 20, 6])
def test_classes_are_the_drawn_sizes_thinnest_first(tmp_path, monkeypatch, sites):
    monkeypatch.setattr(cells, "_BLOCK_SITES", sites)
    sizes = [
        [0, 101.5, 240.0],
        [198.2, 0, 101.9],
        [100.4, 240.9, 197.9],
        [0, 0, 102.2],
        [237.9, 300, 0],
    ]
    found = cells.quantise_diameters(lens(sizes), rules(tmp_path, PLAIN))
    assert found.diameters_nm.tolist() == [100, 104, 196, 200, 236, 240, 300]
    drawn = np.rint(np.asarray(sizes) / 4) * 4
    classes = np.searchsorted(found.diameters_nm, drawn) + 1
    assert np.array_equal(found.classes, np.where(drawn > 0, classes, 0))
    assert found.counts.tolist() == [
        int((drawn == d).sum()) for d in found.diameters_nm
    ]
    assert found.rounding_nm == 2.0
    assert found.classes.dtype == np.uint8


def test_more_than_255_classes_take_two_bytes(tmp_path):
    text = PLAIN.replace("= 4", "= 1")
    for count, kind in ((255, np.uint8), (256, np.uint16)):
        found = cells.quantise_diameters(
            lens([np.arange(100, 100 + count)], 0.5), rules(tmp_path, text)
        )
        assert (len(found.diameters_nm), found.classes.dtype) == (count, kind)
        assert found.classes[0].tolist() == list(range(1, count + 1))


@pytest.mark.parametrize("sites", [1 << 20, 30])
def test_pillars_that_lack_neighbours_are_drawn_for_what_they_lack(
    tmp_path, monkeypatch, sites
):
    """Isolation of the whole map at once, and the size that is drawn for each pillar by
    itself.
    """
    monkeypatch.setattr(cells, "_BLOCK_SITES", sites)
    made = rules(tmp_path, ALONE)
    sizes = np.where(
        RNG.uniform(size=(31, 9)) < 0.4, RNG.uniform(120, 260, (31, 9)), 0.0
    )
    design = lens(sizes)
    found = cells.quantise_diameters(design, made)
    alone = isolation.isolation_map(sizes > 0, design.steps_um, 0.9, centred=False)
    want = np.zeros(sizes.shape)
    for at in zip(*np.nonzero(sizes), strict=True):
        want[at] = made.written_diameter_nm(sizes[at][None], alone[at][None])[0]
    drawn = np.concatenate([[0], found.diameters_nm])[found.classes]
    assert (
        np.abs(drawn - want)[sizes > 0].max() <= 2.0 + 1 / 16
    )  # half a step, and the table of those with neighbours
    assert (np.abs(drawn - want) <= 2.0)[alone > 0].all()
    assert np.abs(want - sizes)[sizes > 0].max() > 4.5
    assert not drawn[sizes == 0].any()


@pytest.mark.parametrize("sites", [1 << 20, 6])
def test_what_cannot_be_drawn_is_named_in_its_row_of_the_map(
    tmp_path, monkeypatch, sites
):
    monkeypatch.setattr(cells, "_BLOCK_SITES", sites)
    made = rules(tmp_path, PLAIN)
    sizes = np.full((7, 3), 200.0)
    sizes[5, 2] = 399.0
    with pytest.raises(
        ProcessError,
        match=r"row 5, column 2 is 0\.4 um, need less than the pitch of 0\.4 um",
    ):
        cells.quantise_diameters(lens(sizes), made)
    sizes[5, 2] = 397.0
    assert cells.quantise_diameters(lens(sizes), made).diameters_nm.tolist() == [
        200,
        396,
    ]
    sizes[4, 1] = 1.9
    with pytest.raises(
        ProcessError,
        match=r"row 4, column 1, 0\.0019 um wide, would be drawn with diameter 0",
    ):
        cells.quantise_diameters(lens(sizes), made)


def test_a_map_that_is_emptied_is_refused(tmp_path):
    made = lens(np.full((2, 2), 200.0))
    made.diameter_um[:] = 0
    with pytest.raises(LensError, match="holds no pillar"):
        cells.quantise_diameters(made, rules(tmp_path, PLAIN))
