"""Before the fit: how the frames lie. Orientation, order and stage zero, judged against the nominal lens."""

from dataclasses import dataclass

import numpy as np
from scipy import fft, optimize

from characterize.forward import ForwardModel
from characterize.parameters import PLACE, vector
from metalens.store import Array

TURNS = ("as they are", "turned by 90°", "turned by 180°", "turned by 270°")
MIRRORED = tuple("mirrored, then " + words for words in TURNS)


@dataclass(frozen=True, eq=False, slots=True)
class Arrangement:
    """What the nominal lens says about the frames.

    stage_zero_um: best of the scan; shift_px: (y, x) mean displacement of the light.
    likeness: mean over frames of the best normalised correlation, 0 to 1, at that stage zero.
    order: (n,) frame that fits the i-th stated depth best; reordered: whether it clearly differs from the stated one.
    order_seen: whether the nominal images differ enough with depth to tell.
    orientation: (0 to 7) turn that suits the frames best; clearly: whether it beats the stated one beyond doubt.
    """

    stage_zero_um: float
    shift_px: tuple[float, float]
    likeness: float
    order: Array
    reordered: bool
    order_seen: bool
    orientation: int
    clearly: bool

    @property
    def words(self) -> str:
        """The orientation in words."""
        return (TURNS + MIRRORED)[self.orientation]


def turn(frames: Array, orientation: int) -> Array:
    """(n, y, x) frames mirrored left-right for 4 to 7, then turned by 90° (orientation mod 4) times."""
    turned = frames[..., ::-1] if orientation >= 4 else frames
    return np.rot90(turned, orientation % 4, axes=(-2, -1))


def arrange(
    model: ForwardModel, frames: Array, usable: Array, *, scan_um: float, start: Array | None = None
) -> Arrangement:
    """Scan the stage zero over +-``scan_um`` and compare every frame with every depth, in all eight orientations."""
    light = _prepare(np.where(usable, frames, np.nan))
    start = vector() if start is None else start.copy()
    nearest = float(model.setting.depth_um.min())
    zeros = np.linspace(-min(scan_um, 0.6 * nearest), scan_um, 17) if scan_um > 0 else np.zeros(1)
    zeros = np.unique(np.append(zeros, start[PLACE["stage_zero_um"]]))
    scores = []
    for zero in zeros:
        start[PLACE["stage_zero_um"]] = zero
        expected = _prepare(model.images(_bare(start))[0])
        scores.append(np.mean([_likeness(a, b)[0] for a, b in zip(light, expected, strict=True)]))
    best = int(np.argmax(scores))
    start[PLACE["stage_zero_um"]] = zeros[best]
    expected = _prepare(model.images(_bare(start))[0])
    found = [_likeness(a, b) for a, b in zip(light, expected, strict=True)]
    order, reordered, seen = _order(light, expected, model)
    orientation, clearly = _orientation(light, expected)
    shift = np.median([s for _, s in found], axis=0)
    return Arrangement(
        float(zeros[best]),
        (float(shift[0]), float(shift[1])),
        float(scores[best]),
        order,
        reordered,
        seen,
        orientation,
        clearly,
    )


def _order(light: Array, expected: Array, model: ForwardModel) -> tuple[Array, bool, bool]:
    """Assignment of frames to depths of one angle each; (order, clearly different, observable at all)."""
    n = len(light)
    table = np.full((n, n), -1.0)
    alike = np.full((n, n), -1.0)
    for group in model.groups:
        for i in group.index:
            for j in group.index:
                table[i, j] = _likeness(light[j], expected[i])[0]
                alike[i, j] = _likeness(expected[j], expected[i])[0]
    rows, columns = optimize.linear_sum_assignment(-table)
    gain = table[rows, columns].sum() - np.trace(table)
    others = alike - 2 * np.eye(n)
    distinct = bool(n > 1 and np.median(others.max(1)) < 0.997)
    moved = int((columns != rows).sum())
    return columns, bool(moved >= 2 and gain > 0.01 * moved and distinct), distinct


def _orientation(light: Array, expected: Array) -> tuple[int, bool]:
    scores = []
    square = light.shape[1] == light.shape[2]
    for orientation in range(8):
        if orientation % 2 and not square:
            scores.append(-1.0)
            continue
        turned = turn(light, orientation)
        scores.append(float(np.mean([_likeness(a, b)[0] for a, b in zip(turned, expected, strict=True)])))
    best = int(np.argmax(scores))
    return best, best != 0 and (1 - scores[best]) < 0.5 * (1 - scores[0]) and scores[best] - scores[0] > 0.02


def _bare(x: Array) -> Array:
    """Parameters without background, at unit gain: only the shape matters here."""
    out = x.copy()
    for name in ("background_e", "background_x_e", "background_y_e"):
        out[PLACE[name]] = 0.0
    return out


def _prepare(frames: Array) -> Array:
    """Frames less a plane through their rim, holes filled by the frame's median."""
    out = np.empty(frames.shape)
    ny, nx = frames.shape[1:]
    y, x = np.mgrid[-1 : 1 : ny * 1j, -1 : 1 : nx * 1j]
    rim = np.ones((ny, nx), bool)
    rim[2:-2, 2:-2] = False
    for i, frame in enumerate(frames):
        filled = np.where(np.isfinite(frame), frame, np.nanmedian(frame))
        design = np.stack([np.ones(rim.sum()), x[rim], y[rim]], 1)
        plane = np.linalg.lstsq(design, filled[rim], rcond=None)[0]
        out[i] = filled - (plane[0] + plane[1] * x + plane[2] * y)
    return out


def _likeness(a: Array, b: Array) -> tuple[float, tuple[float, float]]:
    """Largest normalised cross-correlation over all shifts, and the shift (y, x) of a against b in pixels."""
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    if norm == 0:
        return 0.0, (0.0, 0.0)
    shape = [2 * s for s in a.shape]
    cross = fft.irfft2(fft.rfft2(a, shape) * np.conj(fft.rfft2(b, shape)), shape)
    row, column = np.unravel_index(int(cross.argmax()), cross.shape)
    shift = [int(i) - s if i >= s // 2 else int(i) for i, s in ((row, shape[0]), (column, shape[1]))]
    return float(cross.max()) / norm, (float(shift[0]), float(shift[1]))


def rearranged(values: Array, arrangement: Arrangement) -> Array:
    """Frames turned and put in order as the arrangement says, where it is clear."""
    out = turn(values, arrangement.orientation) if arrangement.clearly else values
    return np.asarray(out[arrangement.order] if arrangement.reordered else out)
