"""Numbers of the paper's tables from typed stacks and images: what belongs to which
depth, angle and scene.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.evaluate import optics as evaluate
from codesign.evaluate.optics import MeasurementSettings, ResolvedSettings, SceneEnergy
from metalens.lens import reach

RNG = np.random.default_rng(5)
LENS = SimpleNamespace()
PASSED = 0.39  # light through it at normal incidence, um²


def passed_um2(lens, angle_rad, depths_um):
    return PASSED * math.cos(angle_rad[0]) * np.array(depths_um) / 1600


def test_the_span_angle_is_that_of_the_changes():
    """|a|², |b|², |a - b|² of vectors of unlike length and any direction, one beyond a right angle."""
    a, b = RNG.normal(size=(2, 3, 7)) * np.array([2.3, 0.6])[:, None, None]
    b[1] -= 2.0 * a[1]
    sums = [torch.from_numpy((part**2).sum(1)) for part in (a, b, a - b)]
    want = [
        math.acos(x @ y / np.linalg.norm(x) / np.linalg.norm(y))
        for x, y in zip(a, b, strict=True)
    ]
    found = SceneEnergy(
        *sums, light=1.0, image_error=0.0, maps=torch.zeros(1)
    ).angle_rad
    assert found.numpy() == pytest.approx(want, rel=1e-9)
    assert max(want) > math.pi / 2


def test_changes_of_scenes_are_in_the_mean_light_of_their_anchor(monkeypatch):
    """Two scenes of unlike brightness; the first one's maps are anchor, change with
    gaze, gaze against slip.
    """
    images = {
        k: torch.from_numpy(RNG.uniform(0.5, 3.0, (2, 4, 5)))
        for k in ("anchor", "gaze", "slip")
    }
    views = SimpleNamespace(**{k: SimpleNamespace(frames=k) for k in images})
    monkeypatch.setattr(evaluate.scene, "image", lambda frames, optics: images[frames])
    found = evaluate.energies_of(object(), views, light=0.83, image_error=0.07)
    scaled = {
        k: [one.numpy()[n] / images["anchor"].numpy()[n].mean() for n in (0, 1)]
        for k, one in images.items()
    }
    for n in (0, 1):
        anchor, gaze, slip = (scaled[k][n] for k in ("anchor", "gaze", "slip"))
        assert float(found.gaze[n]) == pytest.approx(
            ((gaze - anchor) ** 2).sum(), rel=1e-12
        )
        assert float(found.slip[n]) == pytest.approx(
            ((slip - anchor) ** 2).sum(), rel=1e-12
        )
        assert float(found.separability[n]) == pytest.approx(
            ((gaze - slip) ** 2).sum(), rel=1e-12
        )
    anchor, gaze, slip = (scaled[k][0] for k in ("anchor", "gaze", "slip"))
    assert found.maps.numpy() == pytest.approx(
        np.stack([anchor, (gaze - anchor) ** 2, (gaze - slip) ** 2]), rel=1e-12
    )
    assert (found.light, found.image_error) == (0.83, 0.07)


def rendered(depth_mm, coverage):
    frames = SimpleNamespace(
        depth_um=1e3 * torch.tensor(depth_mm), coverage=torch.tensor(coverage)
    )
    return SimpleNamespace(frames=frames)


def test_depths_of_scenes_are_of_what_is_seen_in_any_view():
    views = [
        rendered([3.0, 17.5, 21.0], [0.0, 0.3, 1.0]),
        rendered([19.0, 64.0, 90.0], [1.0, 0.01, 0.0]),
    ]
    assert evaluate.depths_of(views) == pytest.approx((17.5e3, 64e3))
    assert evaluate.depths_of([rendered([2.0, 3.0], [1.0, 1.0])]) == (
        5e3,
        6e3,
    )  # no lens sees nearer


def filled(**changes):
    given = dict(
        depths_mm=(1.6, 2.6),
        count=3,
        angles_deg=(0.0, 40.0),
        binnings=(1, 3),
        normalisation="sum",
    )
    given |= dict(
        pixel_um=2.5,
        window_um=12.0,
        sample_um=0.75,
        radius_um=2.0,
        step_um=70.0,
        tolerance=0.02,
    )
    return ResolvedSettings(**(given | changes))


def test_axial_numbers_are_of_each_depth_and_the_next_at_every_angle(monkeypatch):
    """A point of light that a circle holds whole: encircled is the light of the stack
    over that through the lens from
    its angle and depth; the two depths of a difference are ``step_um`` apart, whatever
    their order in the stack."""
    asked, wanted = [], []

    def from_lens(lens, view, *, tolerance):
        wanted.append((view, tolerance))
        depths = np.array(view.depths_um)
        light = np.zeros((2, len(depths), 16, 16))
        light[:, np.arange(len(depths)), 4, 11] = 1.0
        energy = np.stack([depths * 1e-5, depths * 1.5e-5])
        return SimpleNamespace(
            intensity=light * depths[:, None, None], energy_um2=energy, error=0.013
        )

    def information(near, far, **about):
        asked.append((near, far, about))
        return torch.full(near.shape[:2], float(len(asked)))

    monkeypatch.setattr(evaluate, "from_lens", from_lens)
    monkeypatch.setattr(evaluate, "passed_um2", passed_um2)
    monkeypatch.setattr(evaluate, "axial_information", information)
    found = evaluate.measure_axial_information(LENS, filled())
    view, tolerance = wanted[0]
    assert sorted(view.depths_um) == pytest.approx([1600, 1670, 2100, 2170, 2600, 2670])
    assert (view.window_um, view.samples, tolerance) == (12.0, 16, 0.02)
    assert np.array(view.angles_rad) == pytest.approx(
        np.array([[0.0, 0.0], [math.radians(40), 0.0]])
    )
    for n, pixel in enumerate((2.5, 7.5)):
        near, far, about = asked[n]
        assert near.sum((-1, -2)).numpy() == pytest.approx(
            np.array([[1600, 2100, 2600]] * 2)
        )
        assert far.sum((-1, -2)).numpy() == pytest.approx(
            np.array([[1670, 2170, 2670]] * 2)
        )
        assert about == dict(
            step_um=70.0, sample_um=0.75, pixel_um=pixel, normalisation="sum"
        )
    assert found.information.shape == (2, 2, 3)
    assert found.information[:, 1].unique().tolist() == [2.0]
    depths = np.array([1600, 2100, 2600])
    share = np.full((2, 3), 1e-5 * 1600 / PASSED) * [
        [1],
        [1.5 / math.cos(math.radians(40))],
    ]
    assert (share < 1).all()
    assert found.encircled.numpy() == pytest.approx(
        share * depths, rel=1e-6
    )  # the PSFs here are of that sum
    assert found.psf_error == 0.013
    line = np.zeros((3, 16))
    line[:, 11] = depths
    assert found.slices.numpy() == pytest.approx(line)


def test_no_lens_gives_more_light_than_goes_through_it(monkeypatch):
    light = np.ones((1, 2, 16, 16)) / 256
    stack = SimpleNamespace(
        intensity=light, energy_um2=np.full((1, 2), 3 * PASSED), error=0.0
    )
    monkeypatch.setattr(evaluate, "from_lens", lambda *given, **more: stack)
    monkeypatch.setattr(evaluate, "passed_um2", passed_um2)
    monkeypatch.setattr(
        evaluate,
        "axial_information",
        lambda near, far, **about: torch.zeros(near.shape[:2]),
    )
    found = evaluate.measure_axial_information(
        LENS, filled(count=1, angles_deg=(0.0,), depths_mm=(1.6, 1.6), radius_um=40.0)
    )
    assert float(found.encircled) == pytest.approx(1.0, rel=1e-6)


def test_what_a_setting_leaves_out_is_that_of_the_lens():
    """Window, disc and pixel in wavelength / NA, here of 0.85 um and 1.7 mm over 240
    um: 6.02 um.
    """
    lens = reach.ApertureSummary(240.0, 0.85, 1700.0, 9000.0)
    made = MeasurementSettings(count=4, binnings=(2, 5)).about(lens)
    airy = 0.85 * 1700 / 240
    assert made.pixel_um == pytest.approx(0.88 * airy, rel=0.01)  # to two digits
    assert made.radius_um == pytest.approx(5.3 * airy, rel=0.02)
    fine = min(0.86 * 0.85 / 4 * math.hypot(240, 1700) / 240, 2 * made.pixel_um / 4)
    assert made.sample_um == pytest.approx(fine, rel=0.02)
    near, far = (1 / (1 / 9000 + sign * 3.5 * 0.85 / 240**2) for sign in (1, -1))
    assert made.depths_mm == pytest.approx((near * 1e-3, far * 1e-3), rel=0.02)
    blur = 240 * 1700 * 3.5 * 0.85 / 240**2
    assert made.window_um == pytest.approx(max(56.4 * airy, 8 * blur), rel=0.02)
    assert made.window_um / made.sample_um == pytest.approx(
        round(made.window_um / made.sample_um)
    )
    assert made.step_um == pytest.approx(
        min(0.23 * 0.85 * (near / 240) ** 2, near / 50), rel=0.03
    )
    own = MeasurementSettings(
        depths_mm=(3.0, 4.5),
        pixel_um=7.0,
        sample_um=0.9,
        window_um=31.0,
        radius_um=11.0,
    ).about(lens)
    assert (own.depths_mm, own.pixel_um, own.sample_um, own.radius_um) == (
        (3.0, 4.5),
        7.0,
        0.9,
        11.0,
    )
    assert own.window_um == pytest.approx(34 * 0.9)  # whole samples


def test_kernels_of_one_psf_a_depth_are_centred_and_know_what_the_window_loses(
    monkeypatch,
):
    """Pixels of 4.1 um in five samples each, 25 of them over a window of 100 um; steps
    of 0.5 mm at 21 mm in 1/z.
    """
    seen = []

    def from_lens(lens, view, *, tolerance):
        seen.append((view, tolerance))
        light = np.zeros((1, len(view.depths_um), view.samples, view.samples))
        middle = view.samples // 2
        light[..., middle - 1 : middle + 1, middle - 1 : middle + 1] = 0.7
        energy = (
            passed_um2(lens, (0.0, 0.0), view.depths_um)
            * np.linspace(0.9, 0.6, len(view.depths_um))
        )[None]
        return SimpleNamespace(intensity=light, energy_um2=energy)

    monkeypatch.setattr(evaluate, "from_lens", from_lens)
    monkeypatch.setattr(evaluate, "passed_um2", passed_um2)
    made, light = evaluate.lens_basis(
        LENS, [rendered([18.0, 41.0], [1.0, 1.0])], pitch_um=4.1, window_um=100.0
    )
    view, _ = seen[0]
    count = math.ceil((1 / 18e3 - 1 / 41e3) / (500 / 21e3**2)) + 1
    assert view.depths_um == pytest.approx(1 / np.linspace(1 / 18e3, 1 / 41e3, count))
    assert (view.window_um, view.samples) == (pytest.approx(26 * 4.1), 26 * 5)
    assert light == pytest.approx(0.6, rel=1e-9)
    kernel = torch.as_tensor(made.kernels)
    assert kernel.shape[-2:] == (27, 27)
    middle = kernel.abs().flatten(-2).argmax(-1)
    assert set(middle.flatten().tolist()) == {13 * 27 + 13}
