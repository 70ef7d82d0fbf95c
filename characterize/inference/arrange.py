"""Before the fit: how the frames lie. Orientation, order and stage zero, judged against
the nominal lens.
"""

import itertools
import math
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
Way = tuple[bool, int]  # reordered, orientation
Shift = tuple[float, float]
Both = tuple[Array, Array]
"""Images as they are, and those of a camera on its side: the same where frames are square."""
# of the likeness by which reversed frames must do better: defocus looks much alike on
# both sides
_TWIN = 0.05
# of the likeness: by ten times less errors of a made lens were seen to exchange two
# orientations
_NEAR = 0.02
_TWINS = 5e-3  # of the likeness of a twin, within which the plainest is taken
_TOLD = 40.0  # chi-square between orientations from which on fits may tell them apart
_SURE = 0.9  # likeness from which on the nominal lens explains the frames
_ZEROS = 17
# of the scan: 25 um apart over two sigma of the prior, a tenth of a wave of defocus at
# NA 0.25
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
    orientation: (0 to 7) turn that suits the frames best; clearly: whether it beats the
    stated one beyond doubt.
    alike: turns (1 to 7) under which the nominal images do not change: these cannot be
    distinguished from the chosen one.
    others: the same in other ways about as much alike: as a lens is made, any may be
    the one; fits tell.
    """

    stage_zero_um: float
    distance_um: float
    shift_px: tuple[float, float]
    likeness: float
    order: Array
    reordered: bool
    order_seen: bool
    orientation: int
    clearly: bool
    alike: tuple[int, ...]
    others: tuple["FrameArrangement", ...] = ()

    @property
    def words(self) -> str:
        """The orientation in words."""
        return (TURNS + MIRRORED)[self.orientation]


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
    """Scan the stage zero over +-``scan_um`` and compare every frame with every depth,
    in all eight orientations.

    Where the frames then seem out of order or hardly alike, the lens-sensor distance is
    scanned over +-``reach_um``
    too: it shifts the whole stack through focus, as no stage zero does, and a stack
    shifted by a depth or two looks
    like one in another order. What needs less putting right and is as much alike is
    taken.

    Args:
        model: the forward model.
        data: frames, masks and noise that are fitted.
        start: (p,) where it begins.
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
    found = _laid(frames, plain, score)
    if reach_um > 0 and (found.reordered or found.clearly or score < _SURE):
        distances = start[PLACE["distance_um"]] + reach_um * np.linspace(
            -1, 1, _DISTANCES
        )
        moved, _ = frames.some(few_frames(model.setting)).scanned(
            start, zeros[:: _ZEROS // 4], distances
        )
        moved, better = frames.scanned(moved, zeros)
        other = _laid(frames, moved, better)
        simpler = (other.reordered, other.clearly) < (found.reordered, found.clearly)
        if better >= score and (
            simpler or (better > score + _TWIN and not other.reordered)
        ):
            return other
    return found


@dataclass(frozen=True, eq=False, slots=True)
class _Frames:
    """What is compared: light (n, y, x) less its rim, noise and share of clipped pixels
    (n,), frames end to end.
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
            model.quick(),
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
        """Parameters at the best stage zero (and distance) of the way that the frames
        lie; likeness there.

        Each way has its own best: images that twist with depth are mirrored ones at
        another depth.
        """
        distances = (
            start[PLACE["distance_um"], None] if distances_um is None else distances_um
        )
        places = np.repeat(start[None], len(distances) * len(zeros), 0)
        places[:, PLACE["distance_um"]], places[:, PLACE["stage_zero_um"]] = (
            part.ravel() for part in np.meshgrid(distances, zeros, indexing="ij")
        )
        turned = [
            FrameSpectra.of(orient_frames(self.light, k), self.noise) for k in _EVERY
        ]
        scores = np.nan_to_num(
            threads.run_each(lambda x: self._scores(x, turned), places), nan=-math.inf
        )
        stated, back = scores.max(0)
        orientation, back_first = _way(stated, back)
        place = int(np.argmax(scores[:, int(back_first), orientation]))
        return places[place], float(
            scores[place, int(back_first), orientation]
        ) - _TWIN * back_first

    def _scores(self, x: Array, turned: list[FrameSpectra]) -> Array:
        """(2, orientations) likeness at some parameters: of frames as stated, and end
        to end.
        """
        upright, aside = _expected(self.rough, x, self.clipped)
        first = FrameSpectra.of(upright, 0 * self.noise)
        expected = (
            first,
            first if aside is upright else FrameSpectra.of(aside, 0 * self.noise),
        )
        orders = np.arange(len(self.light)), self.back
        return np.array(
            [
                [turned[k].alike(expected[k % 2], index) for k in _EVERY]
                for index in orders
            ]
        )


def _way(stated: Array, back: Array) -> tuple[int, bool]:
    """Place of the orientation, and whether frames lie end to end, by their likeness:
    the least that explains them.
    """
    orientation, clearly = _plainest_turn(stated)
    orientation = orientation if clearly else 0
    if back[0] <= stated[0] + _TWIN or back.max() < stated[orientation]:
        return orientation, False
    return (int(back.argmax()) if back.max() > back[0] + _TWIN else 0), True


def _laid(frames: _Frames, x: Array, likeness: float) -> FrameArrangement:
    """Order and orientation of the frames, judged against the images at some
    parameters.
    """
    light, noise = frames.light, frames.noise
    expected = _expected(frames.model, x, frames.clipped)
    order, reordered, seen = _order(light, expected[0], noise, frames.model)
    orders = {False: np.arange(len(light)), **({True: order} if reordered else {})}
    alike, shifts = _ways(frames, expected, orders)
    stated = np.array([alike[False, k] for k in _EVERY])
    orientation, clearly = _plainest_turn(stated)
    if reordered and clearly:
        # a twin: images that twist with depth look mirrored when reversed
        twins = (True, 0), (False, orientation), (True, orientation)
        best = max(alike[way] for way in twins)
        way = next(way for way in twins if alike[way] > best - _TWINS)
        reordered, clearly = way[0], way[1] > 0
    chosen = reordered, orientation if clearly else 0
    apart = {k: _apart(k, expected, light, noise) for k in _EVERY}
    found = FrameArrangement(
        stage_zero_um=float(x[PLACE["stage_zero_um"]]),
        distance_um=float(x[PLACE["distance_um"]]),
        shift_px=shifts[chosen],
        likeness=likeness,
        order=order,
        reordered=reordered,
        order_seen=seen,
        orientation=chosen[1],
        clearly=clearly,
        alike=tuple(k for k in apart if k and apart[k] < _TOLD),
    )
    distinct = [
        way
        for way in alike
        if way[0] == reordered
        and apart[relative_orientation(chosen[1], way[1])] >= _TOLD
    ]
    twin = sorted(
        (way for way in alike if way[0] != reordered), key=lambda way: -alike[way]
    )[:1]
    others = [
        replace(
            found,
            reordered=way[0],
            orientation=way[1],
            clearly=way[1] > 0,
            shift_px=shifts[way],
        )
        for way in [*distinct, *twin]
        if alike[way] > alike[chosen] - _NEAR
    ]
    return replace(found, others=tuple(others))


def _ways(
    frames: _Frames, expected: Both, orders: dict[bool, Array]
) -> tuple[dict[Way, float], dict[Way, Shift]]:
    """Mean likeness and shift (y, x) of the frames, by whether they are reordered and
    by orientation.
    """
    alike, shifts = {}, {}
    for way in itertools.product(orders, _EVERY):
        index = orders[way[0]]
        found = _compare(
            orient_frames(frames.light[index], way[1]),
            expected[way[1] % 2],
            frames.noise[index],
        )
        alike[way] = float(np.mean([score for score, _ in found]))
        y, x = np.median([shift for _, shift in found], axis=0).tolist()
        shifts[way] = y, x
    return alike, shifts


def _apart(k: int, expected: Both, light: Array, noise: Array) -> float:
    """Chi-square between the nominal images, as bright as the light, and these turned
    about the chief ray.
    """
    unlike = ((orient_frames(expected[0], k) - expected[k % 2]) ** 2).sum(
        (1, 2)
    ) * _brightness(light, expected[0], noise) ** 2
    return float((unlike * light[0].size / np.maximum(noise, 1e-300) ** 2).sum())


def _reversed(model: ForwardModel) -> Array:
    """(n,) frames from the other end of the stage, at each field angle."""
    back = np.arange(len(model.setting.depth_um))
    for group in model.groups:
        by_depth = group.index[
            np.argsort(model.setting.depth_um[group.index], kind="stable")
        ]
        back[by_depth] = by_depth[::-1]
    return back


def _expected(model: ForwardModel, x: Array, clipped: Array) -> Both:
    """Nominal frames without background, clipped in as large a share of their pixels as
    the measured ones.
    """
    upright = _clipped(model, x, clipped)
    square = model.setting.rows == model.setting.columns
    return upright, upright if square else _clipped(model.exchanged(), x, clipped)


def _clipped(model: ForwardModel, x: Array, clipped: Array) -> Array:
    images = model.images(_bare(x))[0]
    tops = [
        np.quantile(image, 1 - share)
        for image, share in zip(images, clipped, strict=True)
    ]
    return above_rim(np.minimum(images, np.array(tops)[:, None, None]))


def _compare(
    light: Array, expected: Array, noise: Array
) -> list[tuple[float, tuple[float, float]]]:
    return [
        normalized_cross_correlation(a, b, float(s))
        for a, b, s in zip(light, expected, noise, strict=True)
    ]


def _order(
    light: Array, expected: Array, noise: Array, model: ForwardModel
) -> tuple[Array, bool, bool]:
    """Assignment of frames to depths by shape and brightness: (order, clearly
    different, observable at all).
    """
    n = len(light)
    bright = expected * _brightness(light, expected, noise)
    apart = np.full((n, n), np.inf)
    unlike = np.full((n, n), np.inf)
    for group in model.groups:
        for i in group.index:
            for j in group.index:
                apart[i, j] = _distance(light[j], bright[i]) / noise[j] ** 2
                unlike[i, j] = _distance(bright[j], bright[i]) / noise[j] ** 2
    finite = np.where(np.isfinite(apart), apart, 1e12)
    rows, columns = optimize.linear_sum_assignment(finite)
    stated = float(np.trace(apart))
    best = float(finite[rows, columns].sum())
    neighbours = np.where(np.eye(n, dtype=bool), np.inf, unlike).min(1)
    distinct = bool(n > 1 and np.median(neighbours) > 0.2)
    return (
        columns,
        bool((columns != rows).sum() >= 2 and best < 0.7 * stated and distinct),
        distinct,
    )


def _brightness(light: Array, expected: Array, noise: Array) -> float:
    """Of the light over that expected, by their power: the sum of frames less a plane
    may be 0, or below.
    """
    power = float((light**2).sum())
    seen = max(power - float((noise**2).sum()), 0.1 * power)
    return math.sqrt(seen / max(float((expected**2).sum()), 1e-300))


def _distance(a: Array, b: Array) -> float:
    """Squared difference of two images after the shift that makes them most alike."""
    _, (dy, dx) = normalized_cross_correlation(a, b, 0.0)
    return float(((a - shift_frames(b, (int(dy), int(dx)))) ** 2).sum())


def _plainest_turn(scores: Array) -> tuple[int, bool]:
    """Of equal likenesses the plainest turn; whether it beats the first, that of frames
    as stated, beyond doubt.
    """
    best = int(np.flatnonzero(scores >= scores.max() - 2e-3)[0])
    return best, bool(
        best != 0
        and (1 - scores[best]) < 0.5 * (1 - scores[0])
        and scores[best] - scores[0] > 0.02
    )


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
    out = (
        orient_frames(values, arrangement.orientation)
        if arrangement.clearly
        else values
    )
    return np.asarray(out[arrangement.order] if arrangement.reordered else out)


def laid_words(found: FrameArrangement) -> list[str]:
    """Sentences on the orientation and order of the frames, and on what of it is
    ambiguous.

    Args:
        found: how the frames lie.
    """
    words = []
    if found.clearly:
        words.append(f"frames fit the design only {found.words}: used so")
    if found.reordered:
        words.append(
            f"frames fit the stated depths only in the order {found.order.tolist()}: used so"
        )
    if found.alike:
        which = ", ".join((TURNS + MIRRORED)[k] for k in found.alike)
        words.append(
            f"the design looks the same {which}: the orientation of the frames cannot be seen as far as these go; "
            "gradients, coma, astigmatism, trefoil and decentre are along the camera's axes"
        )
    if not found.order_seen:
        words.append(
            "images of neighbouring depths differ by less than the noise: the order of the frames cannot be seen"
        )
    return words
