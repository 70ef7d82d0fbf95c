"""The dose table: columns of numbers as pattern preparation reads them, and what it
leaves out.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.files import CellContent, MaskContent, doses
from layout.process.process import Exposure, Layers, Process
from metalens.ground.errors import MaskFileError

PROCESS = Process(layers=Layers(aperture=(22, 1)), exposure=Exposure(base_uC_cm2=270.0))
TABLE = """layer,datatype,relative_dose,dose_uC_cm2,step,name
1,0,1.234568,333.333,pillars,thin
2,7,0.040000,10.800,pillars,
22,0,1.500000,405.000,aperture,opening
22,1,2.000000,540.000,aperture,
"""


def test_the_table_has_six_decimals_of_doses_rising_by_layer(tmp_path):
    """1.2345679 x 270 is 333.333; a layer is of the aperture by its number, whatever
    its datatype.
    """
    made = {(22, 1): 2.0, (1, 0): 1.2345679, (22, 0): 1.5, (2, 7): 0.04}
    plan = SimpleNamespace(doses=made, layer_names={(1, 0): "thin", (22, 0): "opening"})
    doses.write(plan, PROCESS, tmp_path / "doses.csv")
    assert (tmp_path / "doses.csv").read_text() == TABLE
    assert doses.read(tmp_path / "doses.csv") == {
        (1, 0): 1.234568,
        (2, 7): 0.04,
        (22, 0): 1.5,
        (22, 1): 2.0,
    }
    assert doses.HEAD[:3] == ("layer", "datatype", "relative_dose")


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("1,0,1.5\n1,0,1.6\n", "line 3: layer .* twice"),
        ("1,0,1.5\n1,1,0\n", "line 3: .* no dose above 0"),
        ("1,0,-1.5\n", "line 2: "),
        ("1,0,1e6\n", "line 2: "),
        ("1,0,nan\n", "line 2: "),
        (
            "1,0,1.5\n1,1,1.5\n1,x,1.6\n",
            "line 4: need columns layer, datatype, relative_dose of numbers",
        ),
    ],
)
def test_a_line_that_is_no_dose_is_refused_by_number(tmp_path, lines, words):
    (tmp_path / "d.csv").write_text("layer,datatype,relative_dose\n" + lines)
    with pytest.raises(MaskFileError, match=words):
        doses.read(tmp_path / "d.csv")


def test_doses_just_within_the_limits_are_read(tmp_path):
    (tmp_path / "d.csv").write_text(
        "layer,datatype,relative_dose\n0,3,999999\n5,0,1e-9\n"
    )
    assert doses.read(tmp_path / "d.csv") == {(0, 3): 999999.0, (5, 0): 1e-9}


def test_layers_without_a_dose_are_those_that_are_exposed_and_not_in_the_table():
    shape = np.array([[0, 0], [5, 0], [0, 7]])
    cells = {
        "A": CellContent("A", {(1, 0): [shape], (7, 0): [shape], (40, 2): [shape]}),
        "B": CellContent(
            "B", {(10, 0): [shape], (9, 9): [shape]}, {(3, 1): [(0, 0, 4)]}
        ),
    }
    content = MaskContent("GDSII", 1.0, cells)
    assert doses.missing(content, {(1, 0): 1.0, (50, 0): 1.0}, Process()) == (
        (3, 1),
        (9, 9),
        (40, 2),
    )
    assert (
        doses.missing(
            content, dict.fromkeys([(1, 0), (3, 1), (9, 9), (40, 2)], 1.0), Process()
        )
        == ()
    )
