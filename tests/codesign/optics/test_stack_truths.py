"""Settings of the trained optics and what follows from them, by the formulas of their
docstrings.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.optics import families, lens_errors
from codesign.optics import stack as optics
from codesign.optics.lens_errors import LensError
from codesign.optics.stack import OpticsConfig, PixelPsfStack
from metalens.design import profiles
from metalens.image import coordinates

OWN = OpticsConfig(
    aperture_mm=0.7, sensor_distance_mm=1.6, wavelength_nm=790.0, focus_mm=17.0, depths_mm=(11.0, 47.0), depth_count=7,
    sample_um=7.0, window_samples=21, fwhm_nm=24.0, filter_nm=10.0, polynomials=0,
)  # fmt: skip


def test_a_filter_before_a_line_passes_its_share():
    """Two Gaussians about one wavelength: w / sqrt(w² + s²) of the light, 10 of 26;
    without a filter all.
    """
    assert OWN.passed == pytest.approx(10 / 26)
    assert OpticsConfig().passed == 1.0


def test_depths_are_even_in_their_inverse():
    want = [1e3 / (1 / 11 + n / 6 * (1 / 47 - 1 / 11)) for n in range(7)]
    assert OWN.depths_um.tolist() == pytest.approx(want)


def test_samples_of_the_intensity_show_its_finest_detail():
    """wavelength / (4 NA) apart or less, NA the sine of the rim: 0.926 um here, so 7.6
    of them in 7 um, odd: 9.
    """
    sine = 350 / math.hypot(350, 1600)
    assert 0.79 / (4 * sine) == pytest.approx(0.924, abs=2e-3)
    need = math.ceil(7.0 / (0.79 / (4 * sine)))
    assert OWN.fine == need + 1 - need % 2 == 9


def test_the_pupil_has_the_nodes_that_the_window_asks_for():
    """A twentieth more than the period of the nodes' spacing in sines, an even number;
    64 at least.
    """
    pupil = OWN.pupil
    assert (pupil.radius_um, pupil.sensor_distance_um, pupil.wavelength_um) == (
        350.0,
        1600.0,
        pytest.approx(0.79),
    )
    width = 21 * 7.0 * 1.05
    assert pupil.period_um >= width * (1 - 1e-9)
    assert pupil.period_um < width * (1 + 3 / pupil.nodes)
    assert pupil.nodes % 2 == 0
    assert OpticsConfig(window_samples=3).pupil.nodes == 64


def test_start_and_focus_carry_lengths_in_micrometres():
    made = OpticsConfig(
        aperture_mm=0.7,
        foci_mm=(15.0, 22.5),
        focus_mm=17.0,
        sensor_distance_mm=1.6,
        wavelength_nm=790,
    )
    assert made.start.radius_um == pytest.approx(350.0)
    assert made.start.foci_um == pytest.approx((15e3, 22.5e3))
    for focus in (made.focus, made.start.focus):
        assert (focus.wavelength_um, focus.sensor_distance_um) == pytest.approx(
            (0.79, 1600.0)
        )
        assert focus.source_distance_um == pytest.approx(17000.0)


def test_kernels_are_of_psfs_of_sum_one():
    light = torch.rand(3, 5, 5, dtype=torch.float64) + 0.1
    light = light * torch.tensor([0.3, 1.0, 2.7])[:, None, None]
    made = PixelPsfStack(
        light, torch.tensor([1e4, 2e4, 3e4], dtype=torch.float64)
    ).basis(1e-9)
    back = torch.einsum(
        "dr,ryx->dyx",
        torch.as_tensor(made.weights)[0, 0].double(),
        torch.as_tensor(made.kernels).double(),
    )
    want = light / light.sum((1, 2), keepdim=True)
    assert back.numpy() == pytest.approx(want.numpy(), abs=1e-6)


def test_light_of_the_stack_is_that_of_the_pupil_by_plain_sums():
    """Rayleigh's quadratic lens seen at two depths: |Σ light of the nodes exp(i f x)|²
    over whole samples, by sums over
    all frequencies that a sample's grid can show; the share of the light of the
    aperture."""
    made = optics.lens_psf_stack(OWN, torch.zeros(0)).intensity.double().numpy()
    want = summed(OWN, 0.0)
    scale = want.sum() / made[4].sum()
    assert made[4] == pytest.approx(want / scale, abs=2e-3 * made[4].max())
    assert scale == pytest.approx(1.0, rel=1e-3)


def summed(settings, phase_rad):
    """(window, window) light of the fifth depth behind the nodes' phase, as a share."""
    carriers, _ = optics._carriers(settings)
    pupil, light = settings.pupil, carriers[4].numpy() * np.exp(1j * phase_rad)
    nodes = light.shape[0]
    edge = pupil.period_um / 14.0
    most = math.floor(edge + 0.5)
    auto = (
        np.fft.fft2(np.abs(np.fft.fft2(light, s=(3 * nodes, 3 * nodes))) ** 2)
        / (3 * nodes) ** 2
    )
    harmonic = np.arange(-most, most + 1)
    sinc = np.sinc(harmonic / pupil.period_um * 7.0) * np.clip(
        edge - np.abs(harmonic) + 0.5, 0, 1
    )
    place = (np.arange(21) - 10) * 7.0
    wave = np.exp(2j * np.pi * np.outer(place, harmonic) / pupil.period_um) * sinc
    kept = auto[np.ix_(harmonic, harmonic)]
    given = (
        np.pi * (350.0 / 1600 / (2 * pupil.edge / nodes)) ** 2
    )  # nodes of the aperture, as its area
    given *= 1 - 2 * math.sqrt(2) * 147.0 / (
        3 * 2 * math.pi / 0.79 * pupil.edge * pupil.period_um**2
    )
    return (wave @ kept @ wave.T).real * (7.0 / pupil.period_um) ** 2 / given


@pytest.mark.parametrize(
    ("aperture_mm", "distance_mm", "samples", "sample_um", "within"),
    [
        (0.3, 2.2, 33, 3.0, 1e-3),
        (0.5, 4.0, 31, 3.3, 1e-3),
        (0.5, 4.0, 15, 6.0, 1e-3),
        (0.3, 2.2, 21, 9.0, 2e-3),
    ],
)
def test_a_window_holds_what_a_round_aperture_sends_to_its_samples(
    aperture_mm, distance_mm, samples, sample_um, within
):
    """(2 / π) (acos ρ - ρ √(1 - ρ²)), ρ = λ f / 2 NA, times the samples' sinc, over
    frequencies to 1 / (2 samples).

    0.95 to 0.99 of the light. Nodes across the rim counted by their squares it is 1e-2
    too bright; with the last
    harmonic whole, or left out, 1e-2 off where samples are coarse. The first samples
    are so fine that nodes have
    fewer harmonics than they show.
    """
    settings = OpticsConfig(
        aperture_mm=aperture_mm, sensor_distance_mm=distance_mm, focus_mm=20.0, depths_mm=(20.0, 40.0), depth_count=2,
        sample_um=sample_um, window_samples=samples, polynomials=0,
    )  # fmt: skip
    light = float(
        optics.lens_psf_stack(settings, torch.zeros(0)).intensity[0].double().sum()
    )
    node, weight = np.polynomial.legendre.leggauss(200)
    f, weight = (node + 1) / (4 * sample_um), weight / (4 * sample_um)
    place = (np.arange(samples) - (samples - 1) / 2) * sample_um
    row = (
        2
        * np.cos(2 * np.pi * np.outer(place, f)).sum(0)
        * np.sinc(f * sample_um)
        * sample_um
        * weight
    )
    sine = aperture_mm / 2 / math.hypot(aperture_mm / 2, distance_mm)
    rho = np.clip(0.85 * np.hypot(f[:, None], f) / (2 * sine), 0, 1)
    want = float(row @ (2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))) @ row)
    assert light / want == pytest.approx(1, abs=within)


BENT = replace(OWN, polynomials=4, zones=2)
RAD = torch.tensor([0.7, -0.4, 0.5, 1.1], dtype=torch.float64)
WRONG = LensError(
    {"tilt_waves": 0.2, "astigmatism_waves": -0.13, "bias_nm": 4.0, "gradient_nm": 9.0},
    0.7,
)


def by_hand(x, y, *, wrong=False):
    """Phase on top of the hyperbolic one at places over the radius: terms made
    orthonormal on the pupil's nodes.
    """
    nodes = [c.numpy() / 350 for c in coordinates(BENT.pupil)]
    inside = np.hypot(*nodes) <= 1
    raw = np.stack(families.phase_terms(*map(torch.from_numpy, nodes), 4, "free"))[
        :, inside
    ].T
    mix = np.linalg.inv(np.linalg.qr(raw)[1]) * math.sqrt(len(raw))
    assert (raw @ mix).T @ (raw @ mix) / len(raw) == pytest.approx(np.eye(4), abs=1e-9)
    total = np.tensordot(
        mix @ RAD.numpy(),
        np.stack(families.phase_terms(*map(torch.from_numpy, (x, y)), 4, "free")),
        1,
    )
    ring = np.ceil(2 * (x**2 + y**2)).clip(1, 2)
    total += (2 * ring - 1) * np.arctan2(y, x)  # a double helix of two rings
    if wrong:
        total += 2 * np.pi * (0.2 * (x**2 + y**2) * x - 0.13 * (x**2 - y**2))
        total += lens_errors.wave_front_rad(
            WRONG.state(), *map(torch.from_numpy, (x, y)), BENT.phase_rates
        ).numpy()
    return total


def test_the_phase_at_pillars_is_that_of_the_polynomials_over_the_radius():
    """Places of their own along x and y: rows and columns are not alike."""
    x, y = np.array([-0.8, 0.35, 0.1, 0.62]), np.array([0.55, -0.2, 0.05])
    across, down = np.meshgrid(x, y)
    places = torch.from_numpy(350 * across), torch.from_numpy(350 * down)
    assert optics.phase_at(BENT, RAD, *places).numpy() == pytest.approx(
        by_hand(across, down), rel=1e-9
    )
    made = optics.phase_at(BENT, RAD, *places, error=WRONG).numpy()
    assert made == pytest.approx(by_hand(across, down, wrong=True), rel=1e-9)
    whole = optics.phase_of(BENT, RAD.numpy())(350 * x, 350 * y)
    assert whole - profiles.hyperbolic_phase(
        350 * x, 350 * y[:, None], BENT.focus
    ) == pytest.approx(by_hand(across, down), rel=1e-9)
    plain = replace(BENT, polynomials=0, zones=0)
    assert not optics.phase_at(plain, RAD[:0], *places).any()
    assert optics.phase_of(plain, np.zeros(0))(350 * x, 350 * y) == pytest.approx(
        profiles.hyperbolic_phase(350 * x, 350 * y[:, None], BENT.focus)
    )


def test_a_lens_made_wrong_has_the_light_of_its_bent_phase_and_the_haze_of_its_pillars():
    x, y = (
        c.numpy().astype(float) / 350
        for c in torch.broadcast_tensors(*coordinates(BENT.pupil))
    )
    phase = np.where(np.hypot(x, y) <= 1, by_hand(x, y, wrong=True), 0.0)
    kept = math.exp(-lens_errors.variance_rad2(WRONG.state(), BENT.phase_rates))
    assert kept < 0.99
    want = kept * summed(BENT, phase) + (1 - kept) * 49 / (math.pi * 350**2)
    made = optics.lens_psf_stack(BENT, RAD, error=WRONG).intensity[4].double().numpy()
    assert made == pytest.approx(want, abs=2e-3 * want.max())
    right = optics.lens_psf_stack(BENT, RAD).intensity[4].double().numpy()
    assert np.abs(right - made).max() > 0.05 * want.max()


def test_polynomials_of_light_from_the_side_lie_where_its_rays_leave_the_lens():
    slanted = replace(BENT, angle_deg=9.0, zones=0)
    seen = optics._seen(slanted)
    lit = seen.weight.numpy() > 0
    got = optics.added_phase(slanted, RAD).numpy()
    x, y = (c.double().numpy() / 350 for c in (seen.x_um, seen.y_um))
    ring = np.ceil(2 * (x**2 + y**2)).clip(1, 2)
    want = by_hand(x, y) - (2 * ring - 1) * np.arctan2(y, x)
    assert got[lit] == pytest.approx(want[lit], rel=1e-6, abs=1e-6)
    assert 0.5 < lit.mean() < 0.9
