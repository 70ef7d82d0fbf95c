"""Before the fit: how the frames lie. Orientation and stage zero, judged against the
nominal lens.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from characterize.captures import (
    MIRRORED,
    TURNS,
    FrameSpectra,
    above_rim,
    best_shift,
    orient_frames,
    relative_orientation,
    shift_frames,
)
from characterize.inference.leastsquares import FitImages
from characterize.model import PLACE, ForwardModel, FrameSetting
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.core.errors import FitRefused
from metalens.fabrication import wavelength_scale

_ORIENTATIONS = range(len(TURNS + MIRRORED))
_ASIDE_UM = 50.0  # largest offset of a window
# correlation by which a lens at another distance must be better
_CLEARER = 0.05
# correlation within which orientations cannot be distinguished: ten times what errors of
# an as-built lens were observed to exchange
_NEAR = 0.02
_DISTINCT = 40.0  # chi-square between two orientations that a fit can distinguish
_SURE = 0.9  # correlation above which the nominal lens explains the frames
_RESEMBLES = 0.45  # below which the frames show no image of it
# places of a scan of stage zeros or distances: for distances steps of 25 um over two
# prior sigma, a tenth of a wave of defocus at NA 0.25
_SCAN_PLACES = 17


@dataclass(frozen=True, eq=False, slots=True)
class FrameArrangement:
    """What the nominal lens says about the frames.

    stage_zero_um, distance_um: best of the scan; middle_um: (x, y) of the
    window's middle from the chief ray, by the light in the frames.
    correlation: highest normalised correlation, mean over frames, 0 to 1, at that
    stage zero.
    order: (n,) frame that fits the i-th stated depth best, where it clearly differs
    from the stated one.
    order_is_observable: whether the nominal images differ enough with depth to tell.
    orientation: (0 to 7) turn that suits the frames beyond doubt; 0: as stated.
    equivalent: turns (1 to 7) that cannot be distinguished from the chosen one: under
    them the nominal images do not change, or are nearly as similar to the frames.
    """

    stage_zero_um: float
    distance_um: float
    middle_um: tuple[float, float]
    correlation: float
    order: Array | None
    order_is_observable: bool
    orientation: int
    equivalent: tuple[int, ...]


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
    start: Array,
    *,
    scan_um: float,
    reach_um: float,
) -> FrameArrangement:
    """Stage zero and orientation of the frames, by comparison with the design.

    Every frame is correlated with its depth in all eight orientations, over a scan of
    the stage zero. Where the frames then seem turned, out of order or different from
    the design, the lens-sensor distance is scanned too: it shifts the whole stack
    through focus, as no stage zero does. A stack shifted by a depth or two resembles
    one in another order. Of both results the simpler is returned, if it is as similar.

    Args:
        model: the forward model.
        data: frames, masks and noise that are fitted.
        start: all parameters about which is searched.
        scan_um: half range of the stage zero, um.
        reach_um: half range of the distance, um; 0 for no scan.

    Raises:
        FitRefused: frames of another lens, or in another order than stated.
    """
    frames = _Frames.of(model, data)
    nearest = float(model.setting.depth_um.min())
    zeros = np.linspace(-min(scan_um, 0.6 * nearest), scan_um, _SCAN_PLACES)
    zeros = np.unique(np.append(zeros, start[PLACE["stage_zero_um"]]))
    stated_um = start[PLACE["distance_um"], None]
    best = _arrange(frames, *frames.scanned(start, zeros, stated_um))
    if reach_um > 0 and (any(_is_unusual(best)) or best.correlation < _SURE):
        distances = stated_um + reach_um * np.linspace(-1, 1, _SCAN_PLACES)
        few = frames.some(few_frames(model.setting))
        place, _ = few.scanned(start, zeros[:: _SCAN_PLACES // 4], distances)
        place, correlation = frames.scanned(
            place, zeros, place[PLACE["distance_um"], None]
        )
        moved = _arrange(frames, place, correlation)
        gain = correlation - best.correlation
        clearer = gain > _CLEARER and moved.order is None
        if gain >= 0 and (_is_unusual(moved) < _is_unusual(best) or clearer):
            best = moved
    if best.order is not None:
        raise FitRefused(
            "fit refused: frames fit the stated depths only in the order "
            f"{best.order.tolist()}: correct the depths in stage.csv"
        )
    if best.correlation < _RESEMBLES:
        raise FitRefused(
            "fit refused: the frames look like no image of this lens (best correlation "
            f"{best.correlation:.2f}); they are of another lens than this "
            f"{model.lens.profile} one, far from the stated depths, or dark"
        )
    return best


def _is_unusual(arrangement: FrameArrangement) -> tuple[bool, bool]:
    """Whether frames are out of order, and whether they are turned."""
    return arrangement.order is not None, arrangement.orientation > 0


@dataclass(frozen=True, eq=False, slots=True)
class _Frames:
    """Frames to compare with the design.

    light: (n, y, x) less the plane of its rim. noise: (n,) of a frame.
    clipped: (n,) share of saturated pixels.
    """

    model: ForwardModel
    light: Array
    noise: Array
    clipped: Array

    @classmethod
    def of(cls, model: ForwardModel, data: FitImages) -> "_Frames":
        light = above_rim(np.where(data.usable, data.electrons, np.nan))
        noise = np.sqrt((data.variance(data.electrons) * data.usable).sum((1, 2)))
        return cls(model, light, noise, data.saturated.mean((1, 2)))

    def some(self, index: Array) -> "_Frames":
        """Some of the frames."""
        parts = (self.light[index], self.noise[index], self.clipped[index])
        return _Frames(self.model.only(index), *parts)

    def scanned(
        self, start: Array, zeros: Array, distances: Array
    ) -> tuple[Array, float]:
        """Best parameters of a scan of stage zero and distance, and their correlation.

        The orientation counts that is best at its own best place: images that twist
        with depth equal mirrored ones at another depth.
        """
        places = np.repeat(start[None], len(distances) * len(zeros), 0)
        grid = np.meshgrid(distances, zeros, indexing="ij")
        places[:, PLACE["distance_um"]] = grid[0].ravel()
        places[:, PLACE["stage_zero_um"]] = grid[1].ravel()
        turned = self.spectra()

        def score(x: Array) -> Array:
            return _scores(turned, _expected(self.model, x, self.clipped))

        scores = np.nan_to_num(threads.run_each(score, places), nan=-math.inf)
        of_turn = scores[:, _plainest_turn(scores.max(0))]
        best = int(np.argmax(of_turn))
        return places[best], float(of_turn[best])

    def spectra(self) -> list[FrameSpectra]:
        """Of the frames in every orientation."""
        return [
            FrameSpectra.of(orient_frames(self.light, k), self.noise)
            for k in _ORIENTATIONS
        ]


def _scores(turned: list[FrameSpectra], expected: Array) -> Array:
    """(orientations,) mean correlation of the frames to the ``expected`` ones.

    Args:
        turned: spectra of the frames in every orientation.
    """
    goal = FrameSpectra.of(expected, np.zeros(len(expected)))
    return np.array([one.mean_correlation(goal) for one in turned])


def _arrange(frames: _Frames, x: Array, correlation: float) -> FrameArrangement:
    """Arrangement of the frames: their order and orientation at parameters ``x``.

    Images that twist with depth look mirrored when reversed: frames that seem both are
    out of order.

    Args:
        correlation: mean correlation at ``x``.
    """
    light, noise = frames.light, frames.noise
    expected = _expected(frames.model, x, frames.clipped)
    order, order_is_observable = _order(light, expected, noise, frames.model)
    score = _scores(frames.spectra(), expected)
    chosen = _plainest_turn(score)
    if order is not None and chosen:
        sorted_frames = FrameSpectra.of(light[order], noise[order])
        if _scores([sorted_frames], expected)[0] < score[chosen] - 5e-3:
            order = None
    near = {
        relative_orientation(chosen, k)
        for k in _ORIENTATIONS
        if score[k] > score[chosen] - _NEAR
    }
    symmetric = {
        k
        for k in _ORIENTATIONS
        if _chi_square_of_turn(k, expected, light, noise) < _DISTINCT
    }
    pairs = zip(orient_frames(light, chosen), expected, strict=True)
    shifts = [best_shift(a, b) for a, b in pairs]
    most = _ASIDE_UM * wavelength_scale(frames.model.lens.wavelength_um)
    y_um, x_um = -np.median(shifts, axis=0) * frames.model.setting.pixel_um
    return FrameArrangement(
        stage_zero_um=float(x[PLACE["stage_zero_um"]]),
        distance_um=float(x[PLACE["distance_um"]]),
        middle_um=(
            float(np.clip(x_um, -most, most)),
            float(np.clip(y_um, -most, most)),
        ),
        correlation=correlation,
        order=order,
        order_is_observable=order_is_observable,
        orientation=chosen,
        equivalent=tuple(sorted((near | symmetric) - {0})),
    )


def _chi_square_of_turn(k: int, expected: Array, light: Array, noise: Array) -> float:
    """Chi-square between the nominal images and the same in orientation ``k``.

    At the brightness of the measured frames: how well fits can distinguish the two.
    """
    change = ((orient_frames(expected, k) - expected) ** 2).sum((1, 2))
    power = change * _brightness(light, expected, noise) ** 2
    return float((power * light[0].size / np.maximum(noise, 1e-300) ** 2).sum())


def _expected(model: ForwardModel, x: Array, clipped: Array) -> Array:
    """Nominal frames above their rim, clipped as the measured ones.

    The same share of pixels is clipped in each.
    """
    images = model.images(x)[0]
    tops = [
        np.quantile(image, 1 - share)
        for image, share in zip(images, clipped, strict=True)
    ]
    return above_rim(np.minimum(images, np.array(tops)[:, None, None]))


def _order(
    light: Array, expected: Array, noise: Array, model: ForwardModel
) -> tuple[Array | None, bool]:
    """Optimal assignment of frames to depths, by shape and brightness.

    The sum of squared differences over the noise is minimised (Hungarian method).

    Returns:
        ((n,) order where it clearly differs from the stated one, whether the nominal
        images differ enough between depths to judge).
    """
    n = len(light)
    bright = expected * _brightness(light, expected, noise)
    distances, between_nominal = np.full((2, n, n), np.inf)
    for group in model.groups:
        for i in group.index:
            for j in group.index:
                distances[i, j] = _distance(light[j], bright[i]) / noise[j] ** 2
                between_nominal[i, j] = _distance(bright[j], bright[i]) / noise[j] ** 2
    finite = np.where(np.isfinite(distances), distances, 1e12)
    rows, columns = optimize.linear_sum_assignment(finite)
    stated, best = float(np.trace(distances)), float(finite[rows, columns].sum())
    neighbours = np.where(np.eye(n, dtype=bool), np.inf, between_nominal).min(1)
    distinct = bool(n > 1 and np.median(neighbours) > 0.2)
    differs = (columns != rows).sum() >= 2 and best < 0.7 * stated and distinct
    return columns if differs else None, distinct


def _brightness(light: Array, expected: Array, noise: Array) -> float:
    """Amplitude ratio of measured to expected light, by their power less the noise.

    At least 0.1 of the power counts, as the difference may be 0 or negative.
    """
    power = float((light**2).sum())
    signal = max(power - float((noise**2).sum()), 0.1 * power)
    return math.sqrt(signal / max(float((expected**2).sum()), 1e-300))


def _distance(a: Array, b: Array) -> float:
    """Squared difference of two images after the shift of highest correlation."""
    return float(((a - shift_frames(b, best_shift(a, b))) ** 2).sum())


def _plainest_turn(scores: Array) -> int:
    """The simplest orientation of highest correlation; 0 unless it clearly beats that.

    Within 2e-3 the first of equals is taken. Clearly: half of the missing
    correlation and 0.02 better than the frames as stated.
    """
    best = int(np.flatnonzero(scores >= scores.max() - 2e-3)[0])
    halved = (1 - scores[best]) < 0.5 * (1 - scores[0])
    return best if halved and scores[best] - scores[0] > 0.02 else 0


def arrangement_text(arrangement: FrameArrangement) -> list[str]:
    """Sentences on the orientation of the frames, and on what of it is ambiguous.

    Args:
        arrangement: how the frames lie.
    """
    words = []
    turns = TURNS + MIRRORED
    if arrangement.orientation:
        words.append(
            f"frames fit the design only {turns[arrangement.orientation]}: used so"
        )
    if arrangement.equivalent:
        which = ", ".join(turns[k] for k in arrangement.equivalent)
        words.append(
            f"the design looks the same {which}: the orientation of the frames cannot be seen as far as these go; "
            "gradients, coma, astigmatism, trefoil and decentre are along the camera's axes"
        )
    if not arrangement.order_is_observable:
        words.append(
            "images of neighbouring depths differ by less than the noise: the order of the frames cannot be seen"
        )
    return words
