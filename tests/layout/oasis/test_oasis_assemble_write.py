"""The end of an OASIS file by its standard (SEMI P39): tables of names where the file
says, each with all its names.
"""

import struct
import zlib

import numpy as np
import pytest

from layout.files import Assembly, CellContent
from layout.mask import Lattice, MaskPlan
from layout.mask.plan import pillar_classes
from layout.oasis import assemble, write

CELLNAME, LAYERNAME, END = 4, 11, 2  # with a number; of shapes
BAR = np.array([[0, 0], [300, 0], [300, 200], [0, 200]])
TITLES = {(1, 0): "pillar", (7, 2): "fields"}


def number(data, at):
    """(value, behind it) of an unsigned integer: seven bits a byte, the least first."""
    value = shift = 0
    while True:
        byte, at = data[at], at + 1
        value, shift = value | (byte & 127) << shift, shift + 7
        if byte < 128:
            return value, at


def names(data, at, record, numbers):
    """The names of a table's records, and how many numbers follow each."""
    found = []
    while data[at] == record:
        length, at = number(data, at + 1)
        found.append(data[at : at + length].decode())
        at += length
        for _ in range(numbers):
            _, at = number(data, at)
    return found


def assembled(layers, path):
    cells = {
        name: CellContent(name, {(1, 0): [BAR]}) for name in ("ONE", "LONGER", "TOP")
    }
    assemble.write(Assembly("TOP", cells, {}, layer_names=layers), path)
    return ["ONE", "LONGER", "TOP"]


def planned(layers, path):
    classes = pillar_classes(
        np.array([120, 200]),
        layer=(1, 0),
        grid=1,
        unit_nm=1.0,
        vertices=8,
        shape="round",
    )
    lattice = Lattice.of(
        "LENS", np.array([[1, 2, 2], [0, 1, 2]], np.uint8), pitch=400, x0=0, y0=0
    )
    plan = MaskPlan(
        "TOP", tuple(classes), (lattice,), (), layer_names=layers, doses={(1, 0): 1.0}
    )
    write.write(plan, path)
    return [*(made.name for made in classes), "LENS", "TOP"]


@pytest.mark.parametrize("layers", [TITLES, {}], ids=["layers", "none"])
@pytest.mark.parametrize("made", [assembled, planned])
def test_tables_stand_where_the_end_of_the_file_says(tmp_path, made, layers):
    """END: strict tables of cells, text strings, property names, property strings,
    layers and extensions; a CRC-32.
    """
    cells = made(layers, tmp_path / "a.oas")
    data = (tmp_path / "a.oas").read_bytes()
    assert data[-256] == END
    at, said = len(data) - 255, []
    for _ in range(6):
        strict, at = number(data, at)
        offset, at = number(data, at)
        assert strict == 1
        said.append(offset)
    assert sorted(names(data, said[0], CELLNAME, 1)) == sorted(cells)
    assert (said[1], said[2], said[3], said[5]) == (0, 0, 0, 0)
    if layers:
        at, found = said[4], []
        while data[at] == LAYERNAME:
            length, at = number(data, at + 1)
            name, at = data[at : at + length].decode(), at + length
            kinds = []
            for _ in range(2):  # intervals of layers and of datatypes: 3, these alone
                assert number(data, at)[0] == 3
                value, at = number(data, at + 1)
                kinds.append(value)
            found.append((tuple(kinds), name))
        assert dict(found) == TITLES
    else:
        assert said[4] == 0
    assert data[-5] == 1
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])
