"""Own tables of n and k as they are written down, and what is refused with its line."""

import numpy as np
import pytest

from metalens.cell import tables
from metalens.core.errors import MaterialError

WANT = np.array([[0.8, 0.9, 1.1], [3.5, 3.3, 3.2], [0.1, 0.0, 0.02]])


@pytest.mark.parametrize(
    "text",
    [
        "wavelength_um,n,k\n0.8,3.5,0.1\n0.9,3.3,0\n1.1,3.2,0.02\n",
        "Wavelength (nm);n;k\n800;3,5;0,1\n900;3,3;0\n1100;3,2;0,02\n",
        "k\tWavelength [nm]\tn\n0.1\t800\t3.5\n0\t900\t3.3\n0.02\t1100\t3.2\n",
        "n,k,wl\n3.2,0.02,1.1\n\n3.3,0,0.9\n3.5,0.1,0.8\n",  # falling
        "wl,n\n0.8,3.5\n0.9,3.3\n1.1,3.2\nwl, k\n0.8,0.1\n0.9,0\n1.1,0.02\n",
    ],
    ids=[
        "um",
        "nm and decimal commas",
        "tabs in another order",
        "falling",
        "k below n",
    ],
)
def test_a_table_is_read_however_it_is_written(text):
    found, said = tables.parse_table(f"# grown at\n{text}# 300 C\n", "a.csv")
    assert found == pytest.approx(WANT, rel=1e-12)
    assert said == "grown at 300 C"


def test_a_table_without_k_is_transparent():
    assert tables.parse_table("wl,n\n0.8,3.5\n0.9,3.3\n", "a")[0].tolist() == [
        [0.8, 0.9],
        [3.5, 3.3],
        [0, 0],
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("# nothing\n\n", "a: empty"),
        ("# b\nwl,m\n0.8,3\n", "a, line 2: columns wl, m"),
        ("\nwl,n\n0.8,3.5\n\n0.9,3.3,0\n", "a, line 5: 3 fields, the header has 2"),
        ("m,n\n0.8,3\n0.9,3\n", "a, line 1: columns m, n"),
        ("wl,n;m\n0.8,3\n0.9,3\n", "a, line 1: columns wl, n;m"),
        ("wl,n\n0.8,x\n0.9,3\n", "a, line 2: '0.8,x' is not numbers"),
        ("wl,n\n0.8,3\n0,3\n", "a, line 3: '0,3'; need finite"),
        ("wl,n\n0.8,3\n0.9,0\n", "a, line 3: '0.9,0'; need finite"),
        ("wl,n,k\n0.8,3,0\n0.9,3,-0.1\n", "a, line 3: '0.9,3,-0.1'; need finite"),
        ("wl,n\n0.8,3\n", "a: 1 rows"),
        ("wl,n\n0.8,3\n0.9,3\n0.9,3.1\n", "a, line 4: wavelength 0.9 um follows 0.9"),
        ("wl,n\n0.9,3\n0.8,3\n0.8,3.1\n", "a, line 4: wavelength 0.8 um follows 0.8"),
        ("wl,n\n0.9,3\n0.8,3\n0.95,3.1\n", "a, line 3: wavelength 0.8 um follows 0.9"),
        ("wl,n\n0.7,3\n0.9,3\n0.8,3.1\n", "a, line 4: wavelength 0.8 um follows 0.9"),
        (
            "wl,n\n0.8,3\n0.9,3\nwl,k\n0.8,0\n0.91,0\n",
            "a, line 4: n and k stand at different wavelengths",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_its_line(text, said):
    with pytest.raises(MaterialError) as caught:
        tables.parse_table(text, "a")
    assert said in str(caught.value)
