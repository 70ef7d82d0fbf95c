"""What an imager says of its own error, cause by cause, from PSFs that are typed in."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.field import Grid, engine, left_out, patches, plan
from metalens.field.forming import Imager
from metalens.field.plan import Plan
from metalens.field.points import Window
from metalens.ground.errors import SceneError
from metalens.lens import Layers, Stop
from metalens.psf import Nodes

RNG = np.random.default_rng(31)
Y, X = (
    torch.tensor([-300.0, 40.0, 260.0]).double(),
    torch.tensor([-500.0, -90.0, 420.0, 700.0]).double(),
)
WAVES = Nodes(np.array([0.82, 0.88]), np.array([0.25, 0.75]), 0.004)
PLAN = Plan(
    Y, X, torch.tensor([3e3, 4e3, 9e3]).double(), WAVES, Window(7, 2.0), folds=False
)
OPTICS = SimpleNamespace(distance_um=900.0, layers=Layers())


def psf_of(scale, shape=()):
    light = torch.from_numpy(RNG.uniform(0.2, 1.0, (*shape, 7, 7)))
    return scale * light / light.sum((-1, -2), keepdim=True)


def test_the_error_of_an_image_adds_its_causes_and_not_the_light_outside():
    made = Imager(
        None,
        None,
        None,
        None,
        [],
        [],
        {"kernels": 0.03, "nodes": 0.04, "spectrum": 0.12, "outside": 0.5},
    )
    assert made.error == pytest.approx(0.13, rel=1e-12)


def test_illumination_falls_with_the_fourth_power_of_the_cosine_of_its_own_place():
    light = (
        psf_of(1.0, (3, 4, 3))
        * torch.from_numpy(RNG.uniform(0.5, 2.0, (3, 4, 3)))[..., None, None]
    )
    unit, energy = engine.normalised(light, OPTICS, PLAN)
    for i, y in enumerate(Y.tolist()):
        for j, x in enumerate(X.tolist()):
            cosine = 900 / math.hypot(x, y, 900)
            for k in range(3):
                total = float(light[i, j, k].sum())
                assert float(energy[i, j, k]) == pytest.approx(
                    total * cosine**4, rel=1e-12
                )
                assert unit[i, j, k].numpy() == pytest.approx(
                    light[i, j, k].numpy() / total, rel=1e-12
                )


@pytest.mark.parametrize(
    ("tolerance", "coverage", "rank", "few"),
    [(0.05, 0.2, 3, 2), (0.2, 0.05, 2, 2), (0.011, 0.4, 4, 1), (2.0, 3.0, 1, 1)],
)
def test_of_a_patch_the_first_kernels_are_kept_that_either_tolerance_needs(
    tolerance, coverage, rank, few
):
    """Without any, 1 is missing, then 0.3, 0.08, 0.02, 0.01; what is left holds the
    light that all of them did.
    """
    missing = torch.tensor([1.0, 0.3, 0.08, 0.02, 0.01]).double()
    mix, weights = (
        torch.from_numpy(RNG.uniform(0.5, 1.5, shape)) for shape in ((4, 5), (6, 3, 4))
    )
    share = torch.from_numpy(RNG.uniform(0.7, 1.3, 6)) * float(
        (weights @ mix.sum(1)).mean()
    )
    whole = patches.Patch(
        (2, 4),
        (1, 4),
        share,
        weights,
        torch.ones(6, 3),
        mix,
        torch.arange(5),
        missing,
        4,
    )
    kept = whole.trimmed(tolerance, coverage)
    assert (kept.mix.shape, kept.coverage) == ((rank, 5), few)
    assert torch.equal(kept.mix, mix[:rank])
    light = kept.weights @ kept.mix.sum(1)
    first = weights[..., :rank] @ mix[:rank].sum(1)
    told = first > share[:, None] / 2
    want = torch.where(told, share[:, None].expand(6, 3), first)
    assert light.numpy() == pytest.approx(want.numpy(), rel=1e-12)


def test_the_width_of_light_is_its_root_mean_square_distance_from_its_middle():
    light = (
        psf_of(3.0, (2, 2)) * torch.tensor([[1.0, 0.4], [2.5, 0.7]])[..., None, None]
    )
    light[0, 1] = 0.0
    light[0, 1, 2, 5] = 1.0  # a point is as wide as half a sample
    want = []
    for psf in light.reshape(-1, 7, 7).numpy():
        y, x = np.mgrid[:7, :7]
        cy, cx = (psf * y).sum() / psf.sum(), (psf * x).sum() / psf.sum()
        want.append(
            math.sqrt(
                max((psf * ((y - cy) ** 2 + (x - cx) ** 2)).sum() / psf.sum(), 0.25)
            )
        )
    assert left_out.width(light) == pytest.approx(np.mean(want), rel=1e-9)


def test_the_transform_is_judged_by_rays_seen_from_a_width_aside(monkeypatch):
    """By 0.6 and 0.8 of the width along x and y, at the first wavelength; root of the
    mean square over all PSFs, each
    by its light."""
    plain, other, asked = psf_of(1.0, (2, 3)), psf_of(1.0, (2, 3)), []
    light = torch.tensor([[0.8, 0.75, 0.7], [0.1, 0.04, 0.02]])[..., None, None]

    def psfs(optics, at, *, depths_um, wavelength_um, window, shift_um):
        asked.append((at, depths_um, wavelength_um, shift_um))
        return light * plain if shift_um == (0.0, 0.0) else light * other

    monkeypatch.setattr(left_out, "psfs", psfs)
    at, depths = torch.zeros(2, 2), torch.ones(3)
    found = left_out.neglected(
        left_out.Judged(OPTICS, WAVES, PLAN.window, (at, depths))
    )
    wide = left_out.width(plain) * 2.0
    assert [wave for _, _, wave, _ in asked] == [0.82, 0.82]
    assert asked[1][3] == pytest.approx((0.6 * wide, 0.8 * wide))
    errors = [
        float(plan.relative(o, p))
        for o, p in zip(other.flatten(0, 1), plain.flatten(0, 1), strict=True)
    ]
    level = (light / light[0]).flatten().numpy()  # of the brighter place
    assert found == pytest.approx(math.sqrt(np.mean((errors * level) ** 2)), rel=1e-6)


@pytest.mark.parametrize(
    "slopes", [False, True]
)  # with derivatives one point after the other
def test_a_spectrum_is_the_sum_of_its_wavelengths_by_weight_at_every_point(
    monkeypatch, slopes
):
    def psfs(optics, at, *, depths_um, wavelength_um, window, finest_um):
        assert finest_um == 0.82
        return (at.sum() + 10 * wavelength_um) * torch.ones(1, len(depths_um), 7, 7)

    monkeypatch.setattr(plan, "psfs", psfs)
    at = torch.tensor([[1.0, 2.0], [5.0, -3.0], [0.5, 0.25]], requires_grad=slopes)
    found = plan.spectral(OPTICS, at, torch.ones(2), WAVES, PLAN.window)
    middle = 10 * (0.25 * 0.82 + 0.75 * 0.88)
    assert found.shape == (3, 2, 7, 7)
    assert found.requires_grad is slopes
    assert found[:, 1, 4, 2].detach().numpy() == pytest.approx(
        [3 + middle, 2 + middle, 0.75 + middle], rel=1e-6
    )


def test_pixels_that_no_node_holds_judge_what_is_used(monkeypatch):
    """Places of the pixels between the outermost nodes, depths at 13 and 58 % of the
    range of 1/z; PSFs count by their
    light, and that by itself; light through the lens that the true PSFs lose is
    outside; the transform is judged at
    five of the places, by PSFs that are computed once, pillars taken together at two;
    half of what lies beyond a window
    is edge."""
    seen, asked, plain = {}, [], torch.zeros(5, 2, 7, 7)
    true, used = psf_of(1.0, (16, 2)), psf_of(1.0, (16, 2))
    passed, through = (
        torch.from_numpy(RNG.uniform(*ends, (16, 2)))
        for ends in ((0.1, 0.9), (0.9, 0.97))
    )
    told = torch.from_numpy(RNG.uniform(0.1, 0.9, (16, 2)))

    def spectral(optics, at, depths, waves, window):
        seen.update(at=at, depths=depths)
        return true * passed[..., None, None]

    def psfs_used(made, pixels, depths):
        seen.update(pixels=pixels)
        return used.float()

    def lights_used(made, pixels, depths):
        return told.float()

    def neglected(judged):
        seen.update(few=judged.at, plain=judged.shown)
        return 0.017

    monkeypatch.setattr(engine, "spectral", spectral)
    monkeypatch.setattr(engine, "psfs_used", psfs_used)
    monkeypatch.setattr(engine, "lights_used", lights_used)

    def unpolarised(judged):
        assert judged.shown is plain
        seen.update(turned=judged.at)
        return 0.0031

    monkeypatch.setattr(engine.left_out, "neglected", neglected)
    monkeypatch.setattr(engine.left_out, "unpolarised", unpolarised)
    monkeypatch.setattr(
        engine.left_out,
        "folded",
        lambda judged: 0.0047 * len(judged.at[0]) * (judged.shown is plain),
    )
    monkeypatch.setattr(
        engine.left_out.Judged, "lit", lambda judged: asked.append(judged) or plain
    )

    def missing(optics, wave, window, at):
        seen.update(wave=wave, every=at)
        return 0.0023

    monkeypatch.setattr(engine.left_out, "missing", missing)
    monkeypatch.setattr(
        engine,
        "sampling",
        lambda optics, window, wave: SimpleNamespace(beyond=0.05 * wave),
    )
    monkeypatch.setattr(
        engine,
        "through",
        lambda optics, at, *, depths_um, wavelength_um, window: through,
    )
    monkeypatch.setattr(engine, "_dimmer", lambda made: 1.3)
    grid = Grid((31, 44), 2.0, (3e3, 9e3), window=7)
    parts = engine._held_out(OPTICS, SimpleNamespace(plan=PLAN, grid=grid))
    rows, columns = grid.frame
    pixels = seen["pixels"].numpy()
    assert pixels.shape == (16, 2)
    assert pixels[:, 0].max() < rows
    assert rows <= pixels[:, 1].max() < columns  # rows and columns are not exchanged
    y = -300 + 560 * pixels[:, 0] / (rows - 1)
    x = -500 + 1200 * pixels[:, 1] / (columns - 1)
    assert seen["at"].numpy() == pytest.approx(np.stack([x, y], 1))
    assert seen["depths"].tolist() == pytest.approx(
        [1 / (1 / 3e3 + s * (1 / 9e3 - 1 / 3e3)) for s in (0.13, 0.58)]
    )
    cosine4 = torch.from_numpy(1 / (1 + (x**2 + y**2) / OPTICS.distance_um**2) ** 2)[
        :, None
    ]
    want, got = (
        part * light[..., None, None]
        for part, light in ((true, passed * cosine4), (used, told))
    )
    shown = [
        [(patches.texture_view(part[:, z]) ** 2).sum() for z in (0, 1)]
        for part in (got - want, want)
    ]
    assert parts["nodes"] == pytest.approx(
        1.3 * math.sqrt(max(shown[0]) / max(shown[1])), rel=1e-5
    )
    assert parts["outside"] == pytest.approx(
        1 - float(passed.sum() / through.sum()), rel=1e-9
    )
    share = 1.3 * float(passed[:5].max() / passed.norm() * math.sqrt(32))
    assert parts["spectrum"] == 0.004
    assert parts["transform"] == pytest.approx(0.017 * share, rel=1e-9)
    assert parts["polarisation"] == pytest.approx(0.0031 * share, rel=1e-9)
    assert parts["folded"] == pytest.approx(5 * 0.0047 * share, rel=1e-9)
    assert parts["pillars"] == pytest.approx(1.3 * 0.0023)
    assert seen["wave"] == 0.82
    assert seen["every"][0].numpy() == pytest.approx(seen["at"].numpy()[:2])
    assert seen["every"][1] is seen["depths"]
    assert seen["plain"] is plain
    assert len(asked) == 1
    assert (asked[0].waves, asked[0].window) == (WAVES, PLAN.window)
    for name in ("turned", "few"):
        assert seen[name][0].numpy() == pytest.approx(seen["at"].numpy()[:5])
    assert parts["edge"] == pytest.approx(0.05 * 0.82 / 2)
    few, depths = seen["few"]
    assert few.numpy() == pytest.approx(seen["at"].numpy()[:5])
    assert depths is seen["depths"]


def test_kernels_are_thinned_to_what_a_texture_shows_and_the_error_is_that_of_the_texture(
    monkeypatch,
):
    """Trimmed at 8, 6 and 4.5 times their share the texture is off by 1.3, 0.98 and
    0.96 of it: the last is taken.
    """
    share = 0.02 * 0.6
    off = {8.0: 1.3, 6.0: 0.98, 4.5: 0.96}
    image = torch.from_numpy(RNG.uniform(0.5, 1.5, (1, 9, 8)))
    grid = Grid((9, 8), 2.0, (3e3, 9e3), window=3)
    whole = Imager(grid, PLAN, torch.zeros(1), None, [], [], {"kernels": 0.005})
    asked = []

    def trimmed(optics, tolerance):
        asked.append(tolerance / share)
        return Imager(grid, PLAN, None, None, [], [], {"looser": tolerance / share})

    def blurred(frames, optics):
        looser = optics.parts.get("looser")
        return image if looser is None else image * (1 + share * off[round(looser, 6)])

    monkeypatch.setattr(engine, "trimmed", trimmed)
    monkeypatch.setattr(engine, "blurred", blurred)
    found = engine.thinned(whole, tolerance=0.02)
    assert asked == pytest.approx(
        [8.0, 6.0, 4.5, 4.5]
    )  # 0.98 of the share is above 0.97 of it
    assert found.parts["kernels"] == pytest.approx(
        math.hypot(0.96 * share, 0.005), rel=1e-6
    )


def test_eighths_of_a_round_field_give_all_of_it(monkeypatch):
    """PSFs that know their place alone, of a lens that is the same to all sides:
    mirrored in x, y and the diagonal.
    """
    ring = torch.tensor([-6.0, -2.5, 0.0, 2.5, 6.0]).double()
    grid = torch.arange(-3, 4).double()

    def psf(x, y):
        away = torch.hypot(grid[:, None] - 0.3 * y, grid - 0.3 * x)
        return torch.exp(-away) * (1 + 0.02 * (x * grid + y * grid[:, None]))

    def spectral(optics, at, depths, waves, window):
        assert len(at) == 6
        return torch.stack([torch.stack([psf(x, y)]) for x, y in at])

    monkeypatch.setattr(engine, "spectral", spectral)
    made = Plan(ring, ring, torch.ones(1).double(), WAVES, Window(7, 1.0), folds=True)
    out = engine._folded(OPTICS, made, "cpu")
    for i, y in enumerate(ring):
        for j, x in enumerate(ring):
            assert out[i, j, 0].numpy() == pytest.approx(psf(x, y).numpy(), rel=1e-9), (
                i,
                j,
            )


def test_only_places_that_no_node_holds_judge_an_interpolation():
    """Between 0, 1, 2 and 12 lies 7 alone: half-way between neighbours is a node
    itself.
    """
    base, change = psf_of(1.0, (1,)), psf_of(1.0, (1,)) - psf_of(1.0, (1,))

    def at(places):
        return torch.stack(
            [2.0 * (base + 1e-5 * float(i) ** 4 * change) for i in places]
        )

    known = plan._Known(at)
    nodes = [0.0, 1.0, 2.0, 12.0]
    cubic = (
        np.linalg.solve(np.vander(nodes, 4), np.array(nodes) ** 4)
        @ np.vander([7.0], 4)[0]
    )
    got = base + 1e-5 * cubic * change
    want = plan.relative(got, base + 1e-5 * 7.0**4 * change)
    assert known.error([0, 1, 2, 12]) == pytest.approx(float(want[0]), rel=1e-9)
    assert sorted(known.kept) == [0, 1, 2, 7, 12]


def test_one_draw_stands_for_all_points_and_the_whole_spectrum(monkeypatch):
    """12 points: 12 times the product with the light of that point."""
    from metalens.field import slopes

    light = psf_of(1.0, (1, 3))
    asked = {}

    def psfs(optics, at, *, depths_um, wavelength_um, window, finest_um):
        asked.update(at=at, wave=wavelength_um, finest=finest_um)
        return light

    monkeypatch.setattr(slopes, "psfs", psfs)
    gradient = torch.from_numpy(RNG.normal(size=(3, 4, 3, 7, 7)))
    waves = Nodes(np.array([0.82, 0.88]), np.array([0.3, 0.7]), 0.0)
    made = Plan(Y, X, PLAN.depths_um, waves, PLAN.window, folds=False)
    found = slopes.term(OPTICS, made, gradient, 6, 1)
    assert float(found) == pytest.approx(
        12 * float((gradient[1, 2] * light[0]).sum()), rel=1e-9
    )
    assert asked["at"].tolist() == [[420.0, 40.0]]
    assert (asked["wave"], asked["finest"]) == (0.88, 0.82)


def test_a_near_sheet_hides_what_it_covers_of_a_far_one():
    """Light 0.2 through coverage 0.3 before light 0.5 through 0.8, of which 0.7 is
    free; in the sheets' own sum 1.1.
    """
    from metalens.field.forming import _over

    light, cover = (
        torch.tensor([[[[0.2]], [[0.5]]]]).double(),
        torch.tensor([[[[0.3]], [[0.8]]]]).double(),
    )
    seen = (0.2 + 0.5 * 0.7 / 0.8) / (0.3 + 0.7) * 1.1
    assert float(_over(light, cover)) == pytest.approx(seen, rel=1e-6)
    alone = torch.tensor([[[[0.0]], [[0.8]]]]).double()
    assert float(
        _over(light * torch.tensor([0.0, 1.0])[None, :, None, None], alone)
    ) == pytest.approx(0.5, rel=1e-6)
    whole = torch.tensor([[[[1.0]], [[0.4]]]]).double()
    assert float(_over(light, whole)) == pytest.approx(
        0.2 * 1.4, rel=1e-6
    )  # nothing of the far one


def test_of_places_and_depths_the_worst_shadow_of_a_stop_counts(monkeypatch):
    """In air: N = R² cos³ / (λ L), 1/L = 1/s + 1/(z - s) along the ray, and R b cos /
    (λ d) zones of a blur b, over
    held^¼ of windows that hold a share of the light, by the light of the place; the
    sensor lies as far as 240 um of
    air."""
    layers = Layers(stop=Stop(31.0, 70.0), behind=(Film(Index(1.5), 90.0),))
    optics = SimpleNamespace(distance_um=270.0, layers=layers)
    places = torch.tensor([[20.0, -31.0], [60.0, 95.0], [-3.0, 8.0]]).double()
    depths = torch.tensor([400.0, 2100.0]).double()
    told, light, held = (
        {},
        torch.rand(3, 2, 5, 5),
        np.array([[0.9, 0.7], [0.2, 0.6], [0.8, 0.5]]),
    )
    lit = np.array([[0.9, 1.0], [0.7, 0.4], [1.0, 0.8]])
    for blurs in (
        np.array([[2.0, 1.0], [5.0, 0.3], [9.0, 2.5]]),
        np.array([[2.0, 1.0], [5.0, 0.3], [2.0, 17.0]]),
    ):
        monkeypatch.setattr(engine, "blur_um", lambda *given, blurs=blurs: blurs)
        for (x, y), row, parts, level in zip(
            places.tolist(), blurs, held, lit, strict=True
        ):
            cosine = 240 / math.hypot(x, y, 240)
            for z, blur, part, bright in zip(
                (400.0, 2100.0), row, parts, level, strict=True
            ):
                number = 31.0**2 * cosine**3 / (0.8 * 70 * (z - 70) / z)
                told[x, z] = (
                    bright
                    * (0.005 + 0.055 * 31.0 * blur / 240 * cosine / 0.8 / part**0.25)
                    / number
                )
        got = engine._ripples(
            optics,
            0.8,
            (places, depths),
            (light, *map(torch.from_numpy, (held, lit))),
            1.3,
        )
        assert got == pytest.approx(max(told.values()), rel=1e-9)
        assert max(told, key=told.get) == (
            (-3.0, 400.0) if blurs[2, 0] == 9.0 else (-3.0, 2100.0)
        )


def test_the_texture_that_kernels_are_judged_by_fills_all_depths_with_two_sheets():
    """Each sheet over a range of 1/z of its own, together 0.2 to 0.95 of it; light of
    mean 1 and contrast 0.3.
    """
    frames = engine.trial(Grid((57, 44), 2.0, (3e3, 9e3), window=7))
    cover, depth = frames.coverage[0], frames.depth_um[0]
    assert cover.sum(0).numpy() == pytest.approx(np.ones(cover.shape[1:]), abs=1e-6)
    assert 0.2 < float(cover[0].mean()) < 0.8
    share = (1 / depth.double() - 1 / 3e3) / (1 / 9e3 - 1 / 3e3)
    ends = [(float(one.min()), float(one.max())) for one in share]
    assert ends[0] == pytest.approx((0.0, 0.4), abs=1e-5)
    assert ends[1] == pytest.approx((0.25, 0.95), abs=1e-5)
    light = (frames.radiance[0] / cover)[
        cover > 1e-5
    ]  # of both sheets, but where one is all there is
    assert float(light.mean()) == pytest.approx(1.0, abs=0.02)
    assert float(light.std()) == pytest.approx(
        0.3, abs=0.02
    )  # less what is cut off at 0


def test_an_image_in_the_shadow_counts_errors_over_its_own_light():
    """Light falls by a factor of 20 over a frame whose margin lies in the light: even
    light of PSFs of one sample.
    """
    grid = Grid((1, 3), 2.0, (3e3, 9e3), margin=3, window=3)
    point = torch.zeros(3, 3)
    point[1, 1] = 1.0
    nodes = [torch.linspace(-half, half, 2).double() for half in grid.half_um]
    about = Plan(
        *nodes, torch.tensor([4e3]).double(), WAVES, Window(3, 2.0), folds=False
    )
    stack = point.expand(2, 2, 1, 3, 3)
    energy = torch.tensor([20.0, 1.0]).expand(2, 2)[..., None]
    lit = np.linspace(20.0, 1.0, 9)
    for light in (energy, energy.flip(1)):
        made = Imager(grid, about, stack, light, [], [], {})
        want = math.sqrt(np.mean(lit**2) / np.mean(lit[3:6] ** 2))
        assert engine._dimmer(made) == pytest.approx(want, rel=1e-6)
    peak = torch.tensor([[1.0, 1.0], [1.0, 1.0]])[..., None]
    assert engine._dimmer(Imager(grid, about, stack, peak, [], [], {})) == 1.0


@pytest.mark.parametrize(
    ("counts", "whole"), [([6, 6, 6], False), ([6, 6, 6, 7], True), ([12], True)]
)
def test_products_of_all_nodes_are_taken_at_once_where_those_of_the_patches_are_more(
    counts, whole
):
    """12 nodes of two depths: 576 products, or 144 of every patch of 6 nodes; both ways
    they are the same sums.
    """
    seen = torch.from_numpy(RNG.uniform(-1, 1, (3, 4, 2, 5)))
    known = patches.Products(seen, counts)
    assert (known.whole is not None) is whole
    flat, nodes = seen.reshape(24, 5).numpy(), np.array([2, 3, 8, 9, 20, 21])
    want = np.einsum("if,jf->ij", flat[nodes], flat[nodes]).reshape(3, 2, 3, 2)
    assert known.of(torch.from_numpy(nodes)).numpy() == pytest.approx(
        want, rel=1e-12, abs=1e-14
    )


def test_four_nodes_interpolate_cubics_at_places_of_any_shape():
    """Positions in two axes: the weights come last, and what they add up is a cubic's
    value.
    """
    place = torch.from_numpy(RNG.uniform(0, 6, (3, 5)))
    first, weights = patches.lagrange(place, 7)
    assert weights.shape == (3, 5, 4)
    nodes = torch.arange(7, dtype=torch.float64)

    def cubic(x):
        return 0.3 * x**3 - 1.7 * x**2 + 0.9 * x + 2.1

    found = (weights * cubic(nodes)[first[..., None] + torch.arange(4)]).sum(-1)
    assert found.numpy() == pytest.approx(cubic(place).numpy(), rel=1e-9)


def test_an_image_is_planned_to_its_own_light_where_nodes_allow_it(monkeypatch):
    """3 times dimmer: a third of the tolerance; where that is refused the tolerance
    itself, whose refusals are told.
    """
    asked, least = [], 0.0

    def planned(*given, tolerance, folds):
        asked.append(tolerance)
        if tolerance < least:
            raise SceneError(f"above {tolerance:.2g}")
        return given, folds

    monkeypatch.setattr(engine, "planned", planned)
    assert engine._planned((1, 2), 0.06, 3.0, folds=True) == (
        ((1, 2), True),
        pytest.approx(0.02),
    )
    least = 0.03
    assert engine._planned((1, 2), 0.06, 3.0, folds=False) == (((1, 2), False), 0.06)
    least = 0.1
    with pytest.raises(SceneError, match=r"above 0\.06"):
        engine._planned((1,), 0.06, 3.0, folds=True)
    assert asked == pytest.approx([0.02, 0.02, 0.06, 0.02, 0.06])
    engine._planned((1,), 0.2, 1.0, folds=True)
    engine._planned((1,), 1.5, 8.0, folds=True)  # refused by its own number
    assert asked[5:] == [0.2, 1.5]


@pytest.mark.parametrize("floor", [0.4, 0.04, 0.0])
def test_how_deep_an_image_lies_in_the_shadow_is_told_by_six_points_an_axis(
    monkeypatch, floor
):
    """From rim to rim, at the middle of 1/z: cubics through them hold light that is (x
    / half)² and a floor. Of an
    image that is 2.0, 6.7 and 13 times dimmer than its frame, the last counts as one of
    8 times."""
    grid, seen = Grid((1, 3), 2.0, (3e3, 9e3), margin=3, window=3), []

    def node_psfs(optics, made):
        seen.append(made)
        point = torch.zeros(3, 3)
        point[1, 1] = 1.0
        light = ((made.x_um - 210.0) / 8) ** 2 + floor + 0 * made.y_um[:, None]
        return point.expand(6, 6, 1, 3, 3), light.float()[..., None]

    monkeypatch.setattr(engine, "node_psfs", node_psfs)
    optics = SimpleNamespace(layers=Layers(stop=Stop(30.0, 100.0, (0.0, 0.0))))
    found = engine._shaded(optics, grid, 0.85, (210.0, -90.0))
    (made,) = seen
    assert made.x_um.tolist() == pytest.approx(
        [210 + 8 * s for s in (-1, -0.6, -0.2, 0.2, 0.6, 1)]
    )
    assert made.y_um.tolist() == pytest.approx(
        [-90 + 6 * s for s in (-1, -0.6, -0.2, 0.2, 0.6, 1)]
    )
    assert made.depths_um.tolist() == pytest.approx([4.5e3])
    assert made.waves.wavelengths_um.tolist() == [0.85]
    lit = np.linspace(-1, 1, 9) ** 2 + floor
    assert found == pytest.approx(
        min(math.sqrt(np.mean(lit**2) / np.mean(lit[3:6] ** 2)), 8.0), rel=1e-5
    )
    assert (
        engine._shaded(SimpleNamespace(layers=Layers()), grid, 0.85, (210.0, -90.0))
        == 1.0
    )


def test_tolerances_of_kernels_go_down_to_the_dimmest_image_in_steps_of_two_at_most():
    """An image that is eight times dimmer than its frame asks for an eighth: no more
    than twice as fine is taken.
    """
    steps = np.array(engine.LOOSER)
    assert (steps[1:] < steps[:-1]).all()
    assert (steps[:-1] / steps[1:]).max() < 2.1
    assert steps[-1] <= 1 / engine.DEEPEST < steps[-2]
    assert steps[0] == 8.0  # of the worst PSF of a patch, when all others do better


@pytest.mark.parametrize(
    ("samples", "nodes", "finer", "count"),
    [(7, 80, 4, 7), (201, 80, 2, 127), (61, 180, 5, 49)],
)
def test_pillars_taken_together_are_judged_by_every_pillar_on_finer_points(
    monkeypatch, samples, nodes, finer, count
):
    """Points half of Nyquist's step apart, half of that where no more than 256 are, of
    the middle of wide windows; each
    sample the mean over two squares, a triangle; PSFs of sum 1 by the light of those
    that are used."""
    asked, every, got = (
        [],
        torch.from_numpy(
            RNG.uniform(0.1, 1, (2, 3, (count + 1) * finer, (count + 1) * finer))
        ),
        [],
    )

    def of_pillars(optics, wave, wavelength_um, at, sampled):
        asked.append((at[0].tolist(), at[1].tolist(), sampled))
        return every[len(asked) - 1]

    def psfs(optics, at, *, depths_um, wavelength_um, window):
        got.append(
            torch.from_numpy(RNG.uniform(0.1, 1, (1, 3, samples, samples)))
            * (0.3 if got else 0.8)
        )
        return got[-1]

    monkeypatch.setattr(left_out, "_of_pillars", of_pillars)
    monkeypatch.setattr(left_out, "psfs", psfs)
    monkeypatch.setattr(
        left_out, "sampling", lambda *_: SimpleNamespace(nodes=nodes, step=0.005)
    )
    optics = SimpleNamespace(
        wave=SimpleNamespace(pitch_um=0.4, answer=len)
    )  # whose pillars are asked by _of_pillars
    places, depths = (
        torch.tensor([[20.0, -31.0], [3.0, 8.0]]),
        torch.tensor([4e2, 9e2, 21e2]),
    )
    found = left_out.missing(optics, 0.85, Window(samples, 2.0), (places, depths))
    assert asked == [
        (place, depths.tolist(), (2.0, count + 1, finer)) for place in places.tolist()
    ]
    points = (np.arange((count + 1) * finer) + 0.5) / finer - (count + 1) / 2
    share = torch.from_numpy(
        np.maximum(
            1 - np.abs(points - (np.arange(count) - (count - 1) / 2)[:, None]), 0
        )
    )
    edge = (samples - count) // 2
    errors, light = torch.empty(2, 3), torch.empty(2, 3)
    for n, k in np.ndindex(2, 3):
        want = share @ every[n, k] @ share.T
        one = got[n][0, k, edge : edge + count, edge : edge + count]
        errors[n, k] = float(plan.relative(one / one.sum(), want / want.sum()))
        light[n, k] = one.sum()
    level = light / light.amax(0)
    assert found == pytest.approx(
        float(torch.sqrt((errors * level).square().mean())), rel=1e-5
    )
    assert (
        left_out.missing(
            SimpleNamespace(wave=object()), 0.85, Window(samples, 2.0), (places, depths)
        )
        == 0.0
    )
