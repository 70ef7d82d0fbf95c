"""Before the fit: how the frames lie. Orientation, order and stage zero, judged against
the nominal lens.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from characterize.captures import (
    MIRRORED,
    TURNS,
    FrameSpectra,
    above_rim,
    normalized_cross_correlation,
    orient_frames,
    relative_orientation,
    shift_frames,
)
from characterize.inference.leastsquares import FitImages
from characterize.model import PLACE, ForwardModel, FrameSetting, parameter_vector
from metalens.core import threads
from metalens.core.arrays import Array

_EVERY = range(8)  # orientation
# likeness by which reversed frames must be better: defocus is similar on both sides
_TWIN = 0.05
# likeness within which orientations remain candidates: ten times what errors of an
# as-built lens were observed to exchange
_NEAR = 0.02
_TWINS = 5e-3  # likeness within which the simplest of reversed twins is chosen
_DISTINCT = 40.0  # chi-square between two orientations that a fit can distinguish
_SURE = 0.9  # likeness above which the nominal lens explains the frames
_ZEROS = 17  # stage zeros of a scan
# distances of a scan: steps of 25 um over two prior sigma, a tenth of a wave of defocus
# at NA 0.25
_DISTANCES = 17


@dataclass(frozen=True, eq=False, slots=True)
class FrameArrangement:
    """What the nominal lens says about the frames.

    stage_zero_um, distance_um: best of the scan; shift_px: (y, x) mean displacement of
    the light.
    likeness: mean over frames of the best normalised correlation, 0 to 1, at that stage
    zero.
    order: (n,) frame that fits the i-th stated depth best; reordered: whether it
    clearly differs from the stated one.
    order_seen: whether the nominal images differ enough with depth to tell.
    orientation: (0 to 7) turn that suits the frames beyond doubt; 0: as stated.
    equivalent: turns (1 to 7) under which the nominal images do not change: these cannot be
    distinguished from the chosen one.
    others: other arrangements of nearly equal likeness; fits choose among them.
    """

    stage_zero_um: float
    distance_um: float
    shift_px: tuple[float, float]
    likeness: float
    order: Array
    reordered: bool
    order_seen: bool
    orientation: int
    equivalent: tuple[int, ...]
    others: tuple["FrameArrangement", ...] = ()


def few_frames(setting: FrameSetting) -> Array:
    """Frames that distinguish the starts: both ends and the middle of the depths at
    each angle.

    Args:
        setting: depths, angles and window of the frames.
    """
    chosen: list[int] = []
    for angle in np.unique(setting.angle_rad, axis=0):
        index = np.flatnonzero((setting.angle_rad == angle).all(1))
        by_depth = index[np.argsort(setting.depth_um[index], kind="stable")]
        chosen += by_depth[
            np.unique(np.linspace(0, len(index) - 1, 4).round().astype(int))
        ].tolist()
    return np.unique(chosen)


def find_arrangement(
    model: ForwardModel,
    data: FitImages,
    *,
    scan_um: float,
    start: Array | None = None,
    reach_um: float = 0.0,
) -> FrameArrangement:
    """Stage zero, order and orientation of the frames, by comparison with the design.

    Every frame is correlated with every depth in all eight orientations, over a scan of
    the stage zero. Where the frames then seem out of order or different from the
    design, the lens-sensor distance is scanned too: it shifts the whole stack through
    focus, as no stage zero does. A stack shifted by a depth or two resembles one in
    another order. Of both results the simpler is returned, if it is as similar.

    Args:
        model: the forward model.
        data: frames, masks and noise that are fitted.
        scan_um: half range of the stage zero, um.
        start: (p,) parameters to start from; the nominal ones without it.
        reach_um: half range of the distance, um; 0 for no scan.
    """
    frames = _Frames.of(model, data)
    start = parameter_vector() if start is None else start.copy()
    nearest = float(model.setting.depth_um.min())
    zeros = (
        np.linspace(-min(scan_um, 0.6 * nearest), scan_um, _ZEROS)
        if scan_um > 0
        else np.zeros(1)
    )
    zeros = np.unique(np.append(zeros, start[PLACE["stage_zero_um"]]))
    plain, score = frames.scanned(start, zeros)
    arrangement = _arrange(frames, plain, score)
    doubtful = arrangement.reordered or arrangement.orientation or score < _SURE
    if reach_um > 0 and doubtful:
        distances = start[PLACE["distance_um"]] + reach_um * np.linspace(
            -1, 1, _DISTANCES
        )
        place, _ = frames.some(few_frames(model.setting)).scanned(
            start, zeros[:: _ZEROS // 4], distances
        )
        place, better = frames.scanned(place, zeros)
        refocused = _arrange(frames, place, better)
        simpler = (refocused.reordered, refocused.orientation > 0) < (
            arrangement.reordered,
            arrangement.orientation > 0,
        )
        if better >= score and (
            simpler or (better > score + _TWIN and not refocused.reordered)
        ):
            return refocused
    return arrangement


@dataclass(frozen=True, eq=False, slots=True)
class _Frames:
    """Frames to compare with the design.

    light: (n, y, x) less the plane of its rim. noise: (n,) of a frame.
    clipped: (n,) share of saturated pixels. back: (n,) order from the other end of the
    stage.
    """

    model: ForwardModel
    rough: ForwardModel
    light: Array
    noise: Array
    clipped: Array
    back: Array

    @classmethod
    def of(cls, model: ForwardModel, data: FitImages) -> "_Frames":
        light = above_rim(np.where(data.usable, data.electrons, np.nan))
        noise = np.sqrt((data.variance(data.electrons) * data.usable).sum((1, 2)))
        return cls(
            model,
            model.rough(),
            light,
            noise,
            data.saturated.mean((1, 2)),
            _reversed(model),
        )

    def some(self, index: Array) -> "_Frames":
        """Some of the frames."""
        model, rough = self.model.only(index), self.rough.only(index)
        return _Frames(
            model,
            rough,
            self.light[index],
            self.noise[index],
            self.clipped[index],
            _reversed(model),
        )

    def scanned(
        self, start: Array, zeros: Array, distances_um: Array | None = None
    ) -> tuple[Array, float]:
        """Best parameters of a scan of stage zero (and distance), and their likeness.

        The best way of all, order and orientation, counts at its own best place: images
        that twist with depth equal mirrored ones at another depth. A reversed order is
        charged ``_TWIN``.
        """
        distances = (
            start[PLACE["distance_um"], None] if distances_um is None else distances_um
        )
        places = np.repeat(start[None], len(distances) * len(zeros), 0)
        grid = np.meshgrid(distances, zeros, indexing="ij")
        places[:, PLACE["distance_um"]] = grid[0].ravel()
        places[:, PLACE["stage_zero_um"]] = grid[1].ravel()
        turned = self.spectra()
        orders = [np.arange(len(self.light)), self.back]

        def score(x: Array) -> Array:
            return _scores(turned, _expected(self.rough, x, self.clipped), orders)

        scores = np.nan_to_num(threads.run_each(score, places), nan=-math.inf)
        stated, reverse = scores.max(0)
        orientation, is_reversed = _way(stated, reverse)
        of_way = scores[:, int(is_reversed), orientation]
        best = int(np.argmax(of_way))
        return places[best], float(of_way[best]) - _TWIN * is_reversed

    def spectra(self) -> list[FrameSpectra]:
        """Of the frames in every orientation."""
        return [
            FrameSpectra.of(orient_frames(self.light, k), self.noise) for k in _EVERY
        ]


def _scores(
    turned: list[FrameSpectra], expected: Array, orders: Sequence[Array]
) -> Array:
    """(orders, orientations) mean likeness of the frames to the ``expected`` ones.

    Args:
        turned: spectra of the frames in every orientation.
    """
    goal = FrameSpectra.of(expected, np.zeros(len(expected)))
    return np.array(
        [[one.mean_correlation(goal, index) for one in turned] for index in orders]
    )


def _way(stated: Array, reverse: Array) -> tuple[int, bool]:
    """(orientation, whether the order is reversed): the simplest way that fits.

    Args:
        stated: (8,) likeness of the stated order.
        reverse: (8,) likeness of the reversed one.
    """
    orientation = _plainest_turn(stated)
    if reverse[0] <= stated[0] + _TWIN or reverse.max() < stated[orientation]:
        return orientation, False
    if reverse.max() > reverse[0] + _TWIN:
        return int(reverse.argmax()), True
    return 0, True


def _arrange(frames: _Frames, x: Array, likeness: float) -> FrameArrangement:
    """Arrangement of the frames: their order and orientation at parameters ``x``.

    Every order and orientation is compared with the nominal images. Where frames seem
    both reordered and turned, the simplest of the near-equal reversed twins is chosen.

    Args:
        likeness: mean correlation at ``x``.
    """
    light, noise = frames.light, frames.noise
    expected = _expected(frames.model, x, frames.clipped)
    order, reordered, order_seen = _order(light, expected, noise, frames.model)
    orders = [np.arange(len(light)), *([order] if reordered else [])]
    score = _scores(frames.spectra(), expected, orders)
    chosen = reordered, _plainest_turn(score[0])
    if reordered and chosen[1]:
        # a twin: images that twist with depth look mirrored when reversed
        twins = (True, 0), (False, chosen[1]), chosen
        best = max(score[int(way[0]), way[1]] for way in twins)
        chosen = next(
            way for way in twins if score[int(way[0]), way[1]] > best - _TWINS
        )
    chi2 = {k: _chi_square_of_turn(k, expected, light, noise) for k in _EVERY}

    def arranged(way: tuple[bool, int]) -> FrameArrangement:
        oriented = orient_frames(light[orders[int(way[0])]], way[1])
        noises = noise[orders[int(way[0])]].tolist()
        pairs = zip(oriented, expected, noises, strict=True)
        shifts = [normalized_cross_correlation(a, b, s)[1] for a, b, s in pairs]
        y, x_px = np.median(shifts, axis=0).tolist()
        return FrameArrangement(
            stage_zero_um=float(x[PLACE["stage_zero_um"]]),
            distance_um=float(x[PLACE["distance_um"]]),
            shift_px=(y, x_px),
            likeness=likeness,
            order=order,
            reordered=way[0],
            order_seen=order_seen,
            orientation=way[1],
            equivalent=tuple(k for k in _EVERY if k and chi2[k] < _DISTINCT),
        )

    distinct = [
        (chosen[0], k)
        for k in _EVERY
        if chi2[relative_orientation(chosen[1], k)] >= _DISTINCT
    ]
    if reordered:  # the likeliest of the other order
        other = not chosen[0]
        distinct.append((other, int(score[int(other)].argmax())))
    others = [
        arranged(way)
        for way in distinct
        if score[int(way[0]), way[1]] > score[int(chosen[0]), chosen[1]] - _NEAR
    ]
    return replace(arranged(chosen), others=tuple(others))


def _chi_square_of_turn(k: int, expected: Array, light: Array, noise: Array) -> float:
    """Chi-square between the nominal images and the same in orientation ``k``.

    At the brightness of the measured frames: how well fits can distinguish the two.
    """
    change = ((orient_frames(expected, k) - expected) ** 2).sum((1, 2))
    power = change * _brightness(light, expected, noise) ** 2
    return float((power * light[0].size / np.maximum(noise, 1e-300) ** 2).sum())


def _reversed(model: ForwardModel) -> Array:
    """(n,) frames from the other end of the stage, at each field angle."""
    order = np.arange(len(model.setting.depth_um))
    for group in model.groups:
        by_depth = group.index[
            np.argsort(model.setting.depth_um[group.index], kind="stable")
        ]
        order[by_depth] = by_depth[::-1]
    return order


def _expected(model: ForwardModel, x: Array, clipped: Array) -> Array:
    """Nominal frames without background, clipped as the measured ones.

    The same share of pixels is clipped in each.
    """
    images = model.images(_bare(x))[0]
    tops = [
        np.quantile(image, 1 - share)
        for image, share in zip(images, clipped, strict=True)
    ]
    return above_rim(np.minimum(images, np.array(tops)[:, None, None]))


def _order(
    light: Array, expected: Array, noise: Array, model: ForwardModel
) -> tuple[Array, bool, bool]:
    """Optimal assignment of frames to depths, by shape and brightness.

    The sum of squared differences over the noise is minimised (Hungarian method).

    Returns:
        ((n,) order, whether it clearly differs from the stated one, whether the nominal
        images differ enough between depths to judge).
    """
    n = len(light)
    bright = expected * _brightness(light, expected, noise)
    distances = np.full((n, n), np.inf)
    between_nominal = np.full((n, n), np.inf)
    for group in model.groups:
        for i in group.index:
            for j in group.index:
                distances[i, j] = _distance(light[j], bright[i]) / noise[j] ** 2
                between_nominal[i, j] = _distance(bright[j], bright[i]) / noise[j] ** 2
    finite = np.where(np.isfinite(distances), distances, 1e12)
    rows, columns = optimize.linear_sum_assignment(finite)
    stated = float(np.trace(distances))
    best = float(finite[rows, columns].sum())
    neighbours = np.where(np.eye(n, dtype=bool), np.inf, between_nominal).min(1)
    distinct = bool(n > 1 and np.median(neighbours) > 0.2)
    differs = bool((columns != rows).sum() >= 2 and best < 0.7 * stated and distinct)
    return columns, differs, distinct


def _brightness(light: Array, expected: Array, noise: Array) -> float:
    """Amplitude ratio of measured to expected light, by their power less the noise.

    At least 0.1 of the power counts, as the difference may be 0 or negative.
    """
    power = float((light**2).sum())
    signal = max(power - float((noise**2).sum()), 0.1 * power)
    return math.sqrt(signal / max(float((expected**2).sum()), 1e-300))


def _distance(a: Array, b: Array) -> float:
    """Squared difference of two images after the shift of highest correlation."""
    _, (dy, dx) = normalized_cross_correlation(a, b, 0.0)
    return float(((a - shift_frames(b, (int(dy), int(dx)))) ** 2).sum())


def _plainest_turn(scores: Array) -> int:
    """The simplest orientation of best likeness; 0 unless it clearly beats that.

    Within 2e-3 the first of equals is taken. Clearly: half of the missing likeness and
    0.02 better than the frames as stated.
    """
    best = int(np.flatnonzero(scores >= scores.max() - 2e-3)[0])
    halved = (1 - scores[best]) < 0.5 * (1 - scores[0])
    return best if halved and scores[best] - scores[0] > 0.02 else 0


def _bare(x: Array) -> Array:
    """Parameters without background, at unit gain: only the shape matters here."""
    out = x.copy()
    for name in ("background_e", "background_x_e", "background_y_e"):
        out[PLACE[name]] = 0.0
    return out


def rearrange_frames(values: Array, arrangement: FrameArrangement) -> Array:
    """Frames turned and put in order as the arrangement says, where it is clear.

    Args:
        values: (n, y, x) values of the frames.
    """
    out = orient_frames(values, arrangement.orientation)
    return np.asarray(out[arrangement.order] if arrangement.reordered else out)


def arrangement_text(arrangement: FrameArrangement) -> list[str]:
    """Sentences on the orientation and order of the frames, and on what of it is
    ambiguous.

    Args:
        arrangement: how the frames lie.
    """
    words = []
    turns = TURNS + MIRRORED
    if arrangement.orientation:
        words.append(
            f"frames fit the design only {turns[arrangement.orientation]}: used so"
        )
    if arrangement.reordered:
        words.append(
            f"frames fit the stated depths only in the order {arrangement.order.tolist()}: used so"
        )
    if arrangement.equivalent:
        which = ", ".join(turns[k] for k in arrangement.equivalent)
        words.append(
            f"the design looks the same {which}: the orientation of the frames cannot be seen as far as these go; "
            "gradients, coma, astigmatism, trefoil and decentre are along the camera's axes"
        )
    if not arrangement.order_seen:
        words.append(
            "images of neighbouring depths differ by less than the noise: the order of the frames cannot be seen"
        )
    return words
