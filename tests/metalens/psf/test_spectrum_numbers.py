"""Wavelengths that stand for a spectrum: lines, measured curves and their rules, number
by number.
"""

import math
import re

import numpy as np
import pytest

from metalens.core.errors import MaterialError, PropagationError
from metalens.psf import spectrum


def test_a_rule_has_the_whole_weight_and_a_narrow_line_201_points():
    points, share = np.linspace(0.8, 0.9, 41), np.full(41, 3.7 / 41)
    where, weight = spectrum.gauss_rule(points, share, 4)
    assert weight.sum() == pytest.approx(3.7, rel=1e-12)
    assert weight @ where**3 == pytest.approx(share @ points**3, rel=1e-12)
    assert (
        len(spectrum.spectral_weight(spectrum.Source(850.0, 3.0))[0]) == 201
    )  # 5 widths in fortieths


@pytest.mark.parametrize("more", [1.5e-6, -1.5e-6, 0.5])
def test_weights_add_up_to_one_within_a_millionth(more):
    """All light would count as so much more or less; rounding of sums of many weights
    is 1e-14.
    """
    waves = np.array([0.84, 0.86])
    assert (
        spectrum.SpectralNodes(waves, np.array([0.3, 0.7 + 0.5e-6]), 0.0).weights[1]
        > 0.7
    )
    with pytest.raises(PropagationError, match="need one of 0 or more each, sum 1"):
        spectrum.SpectralNodes(waves, np.array([0.3, 0.7 + more]), 0.0)


TAILS = [
    (800, 5e-5),
    (810, 5e-5),
    (810.25, 2e-4),
    (850, 1.0),
    (889.75, 3e-4),
    (890, 9e-5),
    (900, 9e-5),
]


def test_what_a_measured_spectrum_leaves_out_beyond_the_pillars_is_told(tmp_path):
    """Tails below a ten-thousandth of the peak: kept where the pillars are known, else
    a share of the light that no
    rule makes up for. Areas of the tails by hand, of all by trapezoids, which the rows
    bound."""
    file = tmp_path / "led.csv"
    file.write_text("\n".join(f"{nm},{value}" for nm, value in TAILS))
    whole = spectrum.read_measured_spectrum([file], within_um=(0.7, 1.0))
    nm, value = np.array(TAILS).T
    assert whole.beside == 0.0
    assert whole.wavelengths_um[[0, -1]] * 1e3 == pytest.approx(
        [800.05, 899.95], abs=0.01
    )
    area = np.trapezoid(value, nm)
    assert whole.share @ whole.wavelengths_um * 1e3 == pytest.approx(
        sum(np.diff(nm) * (value[1:] + value[:-1]) / 2 * _middles(nm, value)) / area,
        rel=1e-12,
    )
    less = spectrum.read_measured_spectrum([file], within_um=(0.8101, 0.88996))
    assert less.beside == pytest.approx(
        (10 * 5e-5 + 10 * 9e-5) / area, rel=0.05
    )  # and pieces of two slopes
    assert spectrum.spectral_nodes(
        less, path_um=0.0, tolerance=1e-3
    ).error == pytest.approx(less.beside)
    with pytest.raises(
        PropagationError,
        match=r"light from 810\.\d+ to 889\.\d+ nm, the pillars are known from 820",
    ):
        spectrum.read_measured_spectrum([file], within_um=(0.82, 0.95))


def test_points_from_the_first_to_the_last_that_pillars_are_known_for_are_kept(
    tmp_path,
):
    """Limits on rows: tails of 10 nm at 5e-5 and 9e-5 are beside, their shares to the
    last digit; the first point kept
    is that of Gauss in the first quarter of a nanometre."""
    file = tmp_path / "led.csv"
    file.write_text("\n".join(f"{nm},{value}" for nm, value in TAILS))
    nm, value = np.array(TAILS).T
    less = spectrum.read_measured_spectrum([file], within_um=(0.81, 0.89))
    assert less.beside == pytest.approx(
        (10 * 5e-5 + 10 * 9e-5) / np.trapezoid(value, nm), rel=1e-9
    )
    inside = (1 - 1 / math.sqrt(3)) / 8
    assert less.wavelengths_um[[0, -1]] * 1e3 == pytest.approx(
        [810 + inside, 890 - inside], rel=1e-12
    )
    assert less.share.sum() == pytest.approx(1, rel=1e-12)
    file.write_text(
        "\n".join(
            f"{nm},{value}"
            for nm, value in [(830, 0), *TAILS[3:5], (889.8, 0), (950, 0)]
        )
    )
    dark = spectrum.read_measured_spectrum([file], within_um=(0.7, 0.9))
    assert dark.wavelengths_um[0] > 0.83
    assert 0.88975 < dark.wavelengths_um[-1] < 0.8898  # rows of nothing are no points
    assert dark.beside == pytest.approx(
        0, abs=1e-13
    )  # one less a sum of a thousand: 1e-16 each at worst


def test_pillars_of_one_wavelength_take_all_that_is_lit(tmp_path):
    file = tmp_path / "led.csv"
    file.write_text("\n".join(f"{nm},{value}" for nm, value in TAILS))
    found = spectrum.read_measured_spectrum([file], within_um=(0.85, 0.85))
    assert found.wavelengths_um[[0, -1]] * 1e3 == pytest.approx(
        [810.1, 889.9], abs=0.13
    )  # from 1e-4 of the peak on
    nm, value = np.array(TAILS).T
    rest = 10 * 5e-5 + 10 * 9e-5
    assert found.beside == pytest.approx(rest / np.trapezoid(value, nm), rel=0.03)


def _middles(nm, value):
    """Centroids of trapezoids."""
    a, b = value[:-1], value[1:]
    return nm[:-1] + np.diff(nm) * (a + 2 * b) / (3 * (a + b))


def test_lines_narrower_than_the_step_between_points_are_seen(tmp_path):
    """A laser of 0.2 nm beside a diode: shares are those of the areas 0.1 * 40 and 10."""
    laser, led = tmp_path / "laser.csv", tmp_path / "flat.csv"
    laser.write_text("840,1\n849.9,1\n850.0,41\n850.1,1\n850.2,1\n850.3,1\n850.4,1\n")
    led.write_text("840.1 1\n850.1 1\n")
    found = spectrum.read_measured_spectrum([laser, led], within_um=(0.8, 0.9))
    line = found.share[np.abs(found.wavelengths_um * 1e3 - 850.0) < 0.1].sum()
    assert line == pytest.approx((4.0 + 0.2) / (4.0 + 10.0), rel=1e-9)
    alone = tmp_path / "alone.csv"
    alone.write_text("849.93,0\n849.95,1\n849.97,0\n")
    assert spectrum.read_measured_spectrum(
        [alone], within_um=(0.8, 0.9)
    ).wavelengths_um.mean() == pytest.approx(0.84995, rel=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "nm;power\n840,5;0,3\n850,5;1,0\n860;0,2\n",
        "840,5\t0,3\n850,5\t1,0\n860\t0,2\n",
        "840,5 0,3 0,01\n850,5 1,0 0,01\n860,0 0,2 0,01\n",
        "840.5, 0.3, 0.01\r\n850.5, 1.0, 0.01\r\n860, 0.2, 7\r\n",
        "\ufeff860,0.2\n850.5,1\n840.5,0.3\n",
        "840.5 0.3\n850.5 1\n860 0.2",
    ],
)
def test_a_decimal_comma_is_told_from_one_that_parts_columns(tmp_path, text):
    file = tmp_path / "led.csv"
    file.write_bytes(text.encode())
    assert spectrum._curve(file).tolist() == [[840.5, 0.3], [850.5, 1.0], [860.0, 0.2]]


def test_wavelengths_are_as_few_as_tell_every_path_of_two_lines():
    """Lines of 0.3 at 0.84 um and 0.7 at 0.86 um: their mean alone errs most over the
    longest of 65 paths that it is
    asked for, two tell all."""
    lines, share, reach = np.array([0.84, 0.86]), np.array([0.3, 0.7]), 7.0
    mean = float(lines @ share)
    p = reach * np.arange(65) / 64
    miss = max(
        abs(np.exp(2j * np.pi * a / mean) - share @ np.exp(2j * np.pi * a / lines))
        for a in p
    )
    assert miss > 0.05
    source = spectrum.MeasuredSpectrum(lines, share)
    one = spectrum.spectral_nodes(source, path_um=reach, tolerance=1.001 * miss)
    assert one.wavelengths_um == pytest.approx([mean])
    assert one.error == pytest.approx(miss, rel=1e-9)
    two = spectrum.spectral_nodes(source, path_um=reach, tolerance=0.999 * miss)
    assert np.sort(two.wavelengths_um) == pytest.approx(lines, rel=1e-12)
    assert two.weights.sum() == pytest.approx(1, rel=1e-12)
    assert two.error < 1e-9


def test_parts_of_a_window_miss_what_their_own_paths_miss():
    """Of two lines the mean alone; the error of parts of 7 and 2.1875 um is the root of
    their mean square by light.
    """
    lines, share = np.array([0.84, 0.86]), np.array([0.3, 0.7])
    mean = float(lines @ share)
    p = 7.0 * np.arange(129) / 128
    off = np.abs(
        np.exp(2j * np.pi * p / mean) - np.exp(2j * np.pi * p[:, None] / lines) @ share
    )
    spans, light = np.array([7.0, p[40]]), np.array([0.2, 0.8])
    want = np.array([off.max(), off[:41].max()])
    assert want[1] < 0.5 * want[0]
    source = spectrum.MeasuredSpectrum(lines, share, 0.003)
    one = spectrum.SpectralNodes(np.array([mean]), np.ones(1), 0.0, source)
    assert spectrum.quadrature_error(one, spans) == pytest.approx(
        want + 0.003, rel=1e-9
    )
    whole = math.sqrt(light @ (want + 0.003) ** 2)
    assert spectrum.spectral_nodes(
        source, path_um=spans, tolerance=1.001 * whole, light=light
    ).error == pytest.approx(whole)
    assert (
        len(
            spectrum.spectral_nodes(
                source, path_um=spans, tolerance=0.999 * whole, light=light
            ).weights
        )
        == 2
    )
    assert spectrum.quadrature_error(
        spectrum.SpectralNodes(lines, share, 0.04), spans
    ).tolist() == [0.04, 0.04]


def test_a_line_has_half_its_light_half_a_width_away():
    """Behind thick silicon every photon counts, so light of equal power counts by its
    wavelength.
    """
    um, share = spectrum.spectral_weight(spectrum.Source(850.0, 30.0, silicon_um=1e6))
    level = np.interp([0.850, 0.835, 0.865, 0.880], um, share)
    assert level[1:] / level[0] == pytest.approx(
        np.array([835, 865, 880]) / 850 * [0.5, 0.5, 1 / 16], rel=1e-9
    )
    assert (um[0], um[-1]) == pytest.approx((0.775, 0.925), rel=1e-12)
    assert share.sum() == pytest.approx(1, rel=1e-12)


def test_gauss_rule_is_exact_for_polynomials_under_the_weight():
    """Eigenvalues and first components are rounded to eps times the matrix and its
    size, and a moment of order n moves
    by n times that: of a span of the line, to the power n."""
    um, share = spectrum.spectral_weight(spectrum.Source(850.0, 30.0))
    assert share.sum() == pytest.approx(1)
    reach = np.abs(um - 0.85).max()
    for count in (1, 2, 5):
        x, w = spectrum.gauss_rule(um, share, count)
        for power in range(2 * count):
            budget = (
                1e-14 * count * max(power, 1) * max(1.0, 0.85 / reach) * reach**power
            )
            found, want = (
                (v * (t - 0.85) ** power).sum() for t, v in ((x, w), (um, share))
            )
            assert found == pytest.approx(want, rel=0, abs=budget)
        assert (w > 0).all()


def test_diode_line_has_its_peak_and_width():
    um, share = spectrum.spectral_weight(
        spectrum.Source(850.0, 30.0, silicon_um=1e6)
    )  # thick silicon: flat response times λ
    line = share / um
    half = um[line >= line.max() / 2]
    assert (half[0] + half[-1]) / 2 == pytest.approx(0.85, abs=3e-4)
    assert half[-1] - half[0] == pytest.approx(0.03, abs=6e-4)
    thin = spectrum.spectral_weight(spectrum.Source(850.0, 30.0))[1]
    assert (thin * um).sum() < (
        share * um
    ).sum()  # thin silicon sees less of the red side


@pytest.mark.parametrize(
    ("peak_nm", "fwhm_nm"), [(633.4, 0.1), (940.0, 1e-3), (850.3, 2.3)]
)
def test_a_narrow_line_keeps_its_peak_and_width(peak_nm, fwhm_nm):
    """Cut at 2.5 FWHM a Gaussian loses 4e-9; silicon, below 2 % a nm, moves the mean by
    that times its variance.
    """
    um, share = spectrum.spectral_weight(spectrum.Source(peak_nm, fwhm_nm))
    mean = (um * share).sum() * 1e3
    sigma = fwhm_nm / math.sqrt(8 * math.log(2))
    assert mean == pytest.approx(peak_nm, abs=0.02 * sigma**2 + 1e-9)
    assert math.sqrt(((um * 1e3 - mean) ** 2 * share).sum()) == pytest.approx(
        sigma, rel=2e-4
    )


@pytest.mark.parametrize("fwhm_nm", [1e-300, 9.9e-4])
def test_a_line_narrower_than_any_lens_resolves_is_refused(fwhm_nm):
    with pytest.raises(PropagationError, match=rf"fwhm_nm={fwhm_nm}.* one wavelength"):
        spectrum.Source(850.0, fwhm_nm)


def test_the_narrowest_line_is_one_wavelength_to_a_lens_of_a_millimetre():
    """Of 1 mm of path the contrast is 1 - (pi path width / wavelength²)² / (4 ln 2) = 1
    - 6.8e-6.
    """
    found = spectrum.spectral_nodes(
        spectrum.Source(850.0, 1e-3), path_um=1e3, tolerance=1e-5
    )
    assert found.wavelengths_um == pytest.approx([0.85], abs=1e-8)
    turn = math.pi * 1e3 * 1e-6 / 0.85**2
    assert found.error == pytest.approx(turn**2 / (4 * math.log(2)), rel=0.02)


@pytest.mark.parametrize(
    ("fwhm_nm", "word"),
    [(250.0, "fwhm_nm = 250 reaches to 225 nm"), (1e9, "wavelength")],
)
def test_a_line_beyond_the_data_of_silicon_is_refused(fwhm_nm, word):
    with pytest.raises(MaterialError, match=word):
        spectrum.spectral_weight(spectrum.Source(850.0, fwhm_nm))


def test_as_many_wavelengths_as_the_tolerance_needs():
    source = spectrum.Source(850.0, 30.0)
    few, more = (
        spectrum.spectral_nodes(source, path_um=10.0, tolerance=t) for t in (1e-2, 1e-5)
    )
    assert len(few.weights) < len(more.weights)
    um, share = spectrum.spectral_weight(source)
    for found, tolerance in ((few, 1e-2), (more, 1e-5)):
        for path in (0.0, 3.3, 10.0):
            want = np.exp(2j * np.pi * path / um) @ share
            assert (
                abs(
                    np.exp(2j * np.pi * path / found.wavelengths_um) @ found.weights
                    - want
                )
                <= tolerance
            )
    with pytest.raises(PropagationError, match="wavelengths needed"):
        spectrum.spectral_nodes(source, path_um=3000.0, tolerance=1e-6)


def test_sixty_four_wavelengths_are_the_most():
    """As many lines as that are told exactly, by themselves; one more is refused."""
    share = np.random.default_rng(4).uniform(0.5, 2, 65)
    lines = np.linspace(0.8, 0.9, 64)
    found = spectrum.spectral_nodes(
        spectrum.MeasuredSpectrum(lines, share[:64] / share[:64].sum()),
        path_um=3000.0,
        tolerance=1e-7,
    )
    assert np.sort(found.wavelengths_um) == pytest.approx(lines, rel=1e-9)
    more = spectrum.MeasuredSpectrum(np.linspace(0.8, 0.9, 65), share / share.sum())
    with pytest.raises(PropagationError, match="more than 64 wavelengths"):
        spectrum.spectral_nodes(more, path_um=3000.0, tolerance=1e-7)


def test_a_bad_row_is_told_by_its_line(tmp_path):
    file = tmp_path / "led.csv"
    file.write_text("# nm, value\n840,1\n850,2\n860 nm?,3\n")
    with pytest.raises(PropagationError, match="line 4 is '860 nm"):
        spectrum.read_measured_spectrum([file], within_um=(0.8, 0.9))


def test_thin_silicon_sees_what_its_absorption_leaves():
    """17 um of silicon at 800 and 900 nm, half-width either side of the peak: 850 and
    306 per cm (Green 2008).
    """
    um, share = spectrum.spectral_weight(spectrum.Source(850.0, 100.0, silicon_um=17.0))
    blue, red = (float(np.interp(w, um, share)) for w in (0.8, 0.9))
    seen = [w * (1 - np.exp(-a * 17e-4)) for w, a in ((0.8, 850.0), (0.9, 306.0))]
    assert blue / red == pytest.approx(
        seen[0] / seen[1], rel=0.04
    )  # tables of silicon differ by 3 %
    middle = float(np.interp(0.85, um, share)) / (0.85 * (1 - np.exp(-535.0 * 17e-4)))
    assert blue / seen[0] / middle == pytest.approx(
        0.5, rel=0.04
    )  # full width at half maximum


def test_error_of_the_nodes_is_the_worst_over_the_paths():
    source = spectrum.Source(850.0, 42.0)
    um, share = spectrum.spectral_weight(source)
    found = spectrum.spectral_nodes(source, path_um=17.0, tolerance=3e-3)
    paths = np.linspace(0, 17.0, 400)[:, None]
    worst = np.abs(
        np.exp(2j * np.pi * paths / found.wavelengths_um) @ found.weights
        - np.exp(2j * np.pi * paths / um) @ share
    )
    assert found.error == pytest.approx(
        worst.max(), rel=0.02
    )  # the largest is at the longest path, or near
    fewer = spectrum.gauss_rule(um, share, len(found.weights) - 1)
    missed = (
        np.exp(2j * np.pi * paths / fewer[0]) @ fewer[1]
        - np.exp(2j * np.pi * paths / um) @ share
    )
    assert np.abs(missed).max() > 3e-3  # no wavelength more than needed


def test_a_spectrum_that_ends_where_the_pillars_are_known_is_kept_whole():
    """To a picometre, which files in nm round to; a point beyond that holds no light is
    left out.
    """
    nm = np.array([799.9994, 830.0, 870.0, 900.0007, 905.0])
    value = np.array([0.4, 1.0, 0.7, 0.2, 0.0])
    assert spectrum._kept(nm, value, (0.8, 0.9)) == (0, 4)
    assert spectrum._kept(nm[:4], value[:4], (0.8, 0.9)) == (0, 4)
    with pytest.raises(
        PropagationError, match=r"the pillars are known from 800 to 899\.9"
    ):
        spectrum._kept(nm, value, (0.8, 0.8999))


def test_a_diode_beyond_the_library_is_refused_with_its_share_and_what_serves():
    """Beyond 840 and 858 nm lie the tails of a Gaussian of 30 nm; silicon's response
    moves its mean by σ² s'/s, 0.7 nm
    of the photons per watt here, which changes the sum of both tails by less than 0.02.
    8 nm on the near side are 2.5
    widths of 3.2 nm. What is advised is done and not refused, however many wavelengths
    stand for it."""
    source, within = spectrum.Source(850.0, 30.0), (0.84, 0.858)
    rule = spectrum.spectral_nodes(source, path_um=60.0, tolerance=1e-3)
    with pytest.raises(PropagationError) as told:
        spectrum.nodes_inside_library(rule, source, within)
    share = float(re.search(r"and (0\.\d+) of it lies beyond", str(told.value))[1])
    sigma = 30.0 / math.sqrt(8 * math.log(2))
    assert share == pytest.approx(
        1 - (math.erf(10 / sigma / 2**0.5) + math.erf(8 / sigma / 2**0.5)) / 2, abs=0.02
    )
    assert "known from 840 to 858 nm" in str(told.value)
    assert "narrow it to a width of 3.2 nm, or sweep a library over it" in str(
        told.value
    )
    assert "([sweep] wavelengths_um = [0.775, 0.85, 0.925])" in str(told.value)
    for light, known in (
        (spectrum.Source(850.0, 3.2), within),
        (source, (0.775, 0.925)),
    ):
        for count in (2, 7, 64):
            made = spectrum.SpectralNodes(
                *spectrum.gauss_rule(*spectrum.spectrum_points(light), count), 0.0
            )
            assert spectrum.nodes_inside_library(made, light, known) is made


def test_pillars_of_one_wavelength_are_known_for_no_line_of_any_width():
    source = spectrum.Source(850.0, 12.0)
    rule = spectrum.spectral_nodes(source, path_um=60.0, tolerance=1e-2)
    with pytest.raises(
        PropagationError,
        match=r"at 850 nm alone, and 1 of it lies beyond: sweep a library over it",
    ):
        spectrum.nodes_inside_library(rule, source, (0.85, 0.85))
