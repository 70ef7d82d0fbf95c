"""Lattices of an assembly that are never all in memory: written, read by sums, and told
apart where they differ.
"""

import numpy as np
import pytest

import layout
from layout.formats import compare, gdsii_write, oasis_write
from layout.formats.library import (
    QUARTERS,
    CellReference,
    MaskCell,
    MaskLibrary,
    PillarSites,
)
from layout.mask.plan import PillarArray
from tests.referees.mask_places import places

# of unequal length; the second class has no cell and does not occur
NAMES = ("THIN", "", "WIDER_ONE", "MIDST")


def assembly(block, turn=5):
    cells = {
        name: MaskCell(name, {(1, 0): [np.array([[0, 0], [90 + n, 0], [0, 80]])]})
        for n, name in enumerate(NAMES)
        if name
    }
    sites = PillarSites(
        PillarArray.of("OWN", block, pitch=410, x0=-7001, y0=9003), NAMES
    )
    lenses = CellReference(
        "LENS", 500, -300, QUARTERS[turn], 3, 2, (20_000, 0), (0, 30_000)
    )
    cells["LENS"] = MaskCell("LENS", pillars=sites)
    cells["TOP"] = MaskCell("TOP", references=(lenses,))
    return MaskLibrary("LIB", cells)


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (gdsii_write.write_gdsii, layout.read_gdsii),
        (oasis_write.write_oasis, layout.read_oasis),
    ],
    ids=["gds", "oas"],
)
@pytest.mark.parametrize("keep", [None, 5])
def test_every_site_is_written_and_a_moved_or_missing_one_is_seen(
    tmp_path, write, read, keep
):
    block = np.random.default_rng(4).choice([0, 1, 3, 4], (37, 300)).astype(np.uint8)
    made = assembly(block)
    write(made, tmp_path / "m")
    content = read(tmp_path / "m", keep=keep)
    assert compare.mask_differences(made, content) == []
    if keep is None:
        row, column = np.nonzero(block == 3)
        x, y = places(content, "LENS")["WIDER_ONE"]
        wanted = {
            (-7001 + 410 * c, 9003 - 410 * r)
            for r, c in zip(row.tolist(), column.tolist(), strict=True)
        }
        assert set(zip(x.tolist(), y.tolist(), strict=True)) == wanted
    swapped, lost = block.copy(), block.copy()
    swapped[5, 7:9] = block[5, 9], 4 - block[5, 9] // 2
    lost[np.unravel_index(np.flatnonzero(block == 3)[-1], block.shape)] = 0
    for other in (swapped, lost, np.roll(block, 1, axis=1)):
        assert not np.array_equal(other, block)
        found = compare.mask_differences(assembly(other), content)
        assert any(text.startswith("cell LENS: ") for text in found), found
    assert compare.mask_differences(assembly(block, turn=4), content)
