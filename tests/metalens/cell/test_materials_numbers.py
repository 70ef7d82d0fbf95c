"""Pages, tables, blends and fused silica at the ends of their ranges, with their
slopes, by hand.
"""

import cmath
import math

import numpy as np
import pytest

from metalens import materials
from metalens.cell import materials as rooms
from metalens.cell.record import Blend, Index
from metalens.core.errors import MaterialError


def test_fused_silica_is_malitsons_from_0_21_to_3_71_um():
    """n² = 1 + Σ B λ² / (λ² - c²) of the paper, term by term; refused just beyond."""
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    for wavelength in (0.21, 0.3, 0.8, 1.9, 3.71):
        square = 1 + sum(b * wavelength**2 / (wavelength**2 - c**2) for b, c in terms)
        assert materials.index("SiO2", wavelength) == pytest.approx(
            math.sqrt(square), rel=1e-13
        )
    for wavelength in (0.2099, 3.7101):
        with pytest.raises(
            MaterialError, match=r"SiO2 at .* holds from 0\.21 to 3\.71 um"
        ):
            materials.index("SiO2", wavelength)
    assert materials.index("air", 1e-9) == materials.index("air", 1e9) == 1
    assert materials.index_dispersion("air", 0.5) == 0


@pytest.mark.parametrize("wavelength", [0.25, 0.7, 2.9])
def test_the_dispersion_of_fused_silica_is_its_difference(wavelength):
    step = 1e-4 * wavelength
    ends = [materials.index("SiO2", wavelength + s * step).real for s in (-2, -1, 1, 2)]
    want = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
    assert materials.index_dispersion("SiO2", wavelength) == pytest.approx(
        want, rel=1e-8
    )  # step⁴, and ε / step


def table():
    rows = np.array([[0.4, 0.5, 0.8], [2.0, 1.7, 1.1], [0.3, 0.02, 0.05]])
    return rooms.Material("mine", "here", (0.4, 0.8), rows)


@pytest.mark.parametrize(
    ("wavelength", "n", "rate"),
    [
        (0.4, 2.0 + 0.3j, -3 - 2.8j),
        (0.47, 1.79 + 0.104j, -3 - 2.8j),
        (0.5, 1.7 + 0.02j, -2 + 0.1j),
        (0.62, 1.46 + 0.032j, -2 + 0.1j),
        (0.8, 1.1 + 0.05j, -2 + 0.1j),
    ],
)
def test_a_table_is_straight_between_its_rows_and_holds_at_both_ends(
    wavelength, n, rate
):
    assert materials.index(table(), wavelength) == pytest.approx(n, rel=1e-12)
    assert materials.index_dispersion(table(), wavelength) == pytest.approx(
        rate, rel=1e-10
    )


def page(tmp_path, n_range, k_rows):
    lines = "".join(f"        {w} {k}\n" for w, k in k_rows)
    file = tmp_path / "page.yml"
    file.write_text(
        f"DATA:\n  - type: formula 5\n    wavelength_range: {n_range}\n    coefficients: 1.5 0.01 -2\n"
        f"  - type: tabulated k\n    data: |\n{lines}"
    )
    return str(file)


@pytest.mark.parametrize(
    ("n_range", "k_rows", "want"),
    [
        ("0.3 2.0", [(0.5, 0.1), (0.9, 0.2)], (0.5, 0.9)),
        ("0.6 0.7", [(0.5, 0.1), (0.9, 0.2)], (0.6, 0.7)),
        ("0.6 2.0", [(0.5, 0.1), (0.9, 0.2)], (0.6, 0.9)),
        ("0.3 0.7", [(0.5, 0.1), (0.9, 0.2)], (0.5, 0.7)),
    ],
)
def test_a_page_holds_where_both_of_its_parts_do(tmp_path, n_range, k_rows, want):
    found = page(tmp_path, n_range, k_rows)
    assert materials.find_material(found).range_um == want
    middle = sum(want) / 2
    k = 0.1 + (middle - 0.5) / 0.4 * 0.1
    assert materials.index(found, middle) == pytest.approx(
        1.5 + 0.01 / middle**2 + 1j * k, rel=1e-12
    )
    assert materials.index_dispersion(found, middle) == pytest.approx(
        -0.02 / middle**3 + 0.25j, rel=1e-9
    )


def test_parts_that_share_no_wavelength_are_refused(tmp_path):
    with pytest.raises(
        MaterialError,
        match=r"n holds from 0\.3 to 0\.5 um, and k at no wavelength of these",
    ):
        materials.find_material(page(tmp_path, "0.3 0.5", [(0.5, 0.1), (0.9, 0.2)]))


def bruggeman(a, b, share):
    """Root with n, k >= 0 of share (b - e)/(b + 2e) + (1 - share)(a - e)/(a + 2e) = 0,
    by the quadratic of numpy.
    """
    f = 1 - share
    roots = np.roots([-2.0, (2 * f - share) * a + (2 * share - f) * b, a * b])
    return next(n for n in map(cmath.sqrt, roots) if n.real > 0 and n.imag >= -1e-12)


BLENDS = [
    Blend("Au", "SiO2", 0.65),
    Blend("a-Si", "air", 0.8),
    Blend("ITO", "a-Si", 0.35),
    Blend("Ge", "a-Si", 0.1, n_offset=0.03, k_offset=-0.02),
]


@pytest.mark.parametrize("blend", BLENDS)
def test_blends_of_absorbing_materials_are_bruggemans(blend):
    """And their slopes are differences, of tables that are straight about 0.7 um for
    1e-5.
    """
    a, b = (materials.index(name, 0.7) ** 2 for name in (blend.base, blend.other))
    want = bruggeman(a, b, blend.share) + complex(blend.n_offset, blend.k_offset)
    assert materials.index(blend, 0.7) == pytest.approx(want, rel=1e-12)
    ends = [materials.index(blend, 0.7 + s * 1e-5) for s in (-1, 1)]
    assert materials.index_dispersion(blend, 0.7) == pytest.approx(
        (ends[1] - ends[0]) / 2e-5, rel=1e-5
    )


def test_offsets_alone_leave_the_slope_and_may_not_turn_loss_to_gain():
    shifted = Blend("a-Si", n_offset=-0.2, k_offset=0.01)
    assert materials.index(shifted, 0.7) == pytest.approx(
        materials.index("a-Si", 0.7) - 0.2 + 0.01j, rel=1e-12
    )
    assert materials.index_dispersion(shifted, 0.7) == materials.index_dispersion(
        "a-Si", 0.7
    )
    with pytest.raises(MaterialError, match=r"n \+ ik = .*need n > 0 and k >= 0"):
        materials.index(Blend("SiO2", k_offset=-1e-6), 0.7)
    with pytest.raises(MaterialError, match="blend of SiO2"):
        materials.index(Blend("SiO2", n_offset=-1.46), 0.7)
    assert materials.index(Blend("SiO2", n_offset=-1.44), 0.7).real > 0


def test_kin_that_hold_at_their_very_ends_are_named():
    low, high = materials.find_material("Ge-infrared").range_um
    assert materials.find_material("Ge").range_um[1] < high
    for wavelength in (high,):
        with pytest.raises(
            MaterialError, match=r"another material \('Ge-infrared' holds there\)"
        ):
            materials.index("Ge", wavelength)
    with pytest.raises(MaterialError, match="another material, or plain"):
        materials.index("Ge", high * (1 + 1e-9))
    assert low < high


def test_plain_numbers_have_no_slope_and_absorb_as_they_say():
    assert materials.index(Index(1.7, 0.03), 123.0) == 1.7 + 0.03j
    assert materials.index_dispersion(Index(1.7, 0.03), 123.0) == 0


@pytest.mark.parametrize("metal", ["Au", "Ag", "Al"])
def test_blends_with_metals_go_from_one_to_the_other_and_absorb(metal):
    """Both of Bruggeman's roots solve his equation; the one that absorbs at every share
    leads from metal to glass.
    """
    b, shares = materials.index("SiO2", 0.85) ** 2, np.linspace(0.0, 1.0, 81)
    a = materials.index(metal, 0.85) ** 2
    e = np.array(
        [
            materials.index(Blend(metal, "SiO2", share), 0.85) ** 2
            for share in shares.tolist()
        ]
    )
    left = (1 - shares) * (a - e) / (a + 2 * e) + shares * (b - e) / (b + 2 * e)
    assert np.abs(left).max() < 1e-12
    assert e.imag.min() > -1e-12
    assert [e[0], e[-1]] == pytest.approx([a, b], rel=1e-12)
    assert np.abs(np.diff(e)).max() < 0.1 * abs(
        a - b
    )  # a wrong root jumps by most of it
