"""What a page can show: images with sliders, curves, maps of classes, points to pick,
numbers. Data, no drawing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from metalens.core.arrays import Array


@dataclass(frozen=True, slots=True)
class SliderAxis:
    """A slider: its name, its values, and their unit.

    blink: steps through its values by itself, on one scale. first: place of the value
    that is shown at first.
    """

    name: str
    values: Sequence[float | str]
    unit: str = ""
    blink: bool = False
    first: int = 0


def at_brightest(axes: Sequence[SliderAxis], values: Array) -> list[SliderAxis]:
    """The sliders ``axes`` of images, set to the one with the highest peak.

    Args:
        axes: sliders, one for each leading axis.
        values: (*axes, y, x) images.
    """
    places = np.unravel_index(int(values.argmax()), values.shape)
    return [
        replace(axis, first=int(place))
        for axis, place in zip(axes, places, strict=False)
    ]


@dataclass(frozen=True, eq=False, slots=True)
class ImagePanel:
    """A stack of images, one slider an axis before (y, x).

    values: (*axes, y, x) real; shown in single precision.
    step_um: spacing of the samples; centre at (n-1)/2. across: its unit, where it is no
    length.
    from_least: whether colours begin at the least value in place of zero (depths).
    unit: of the values. signed: zero has a colour of its own (residuals). optics: MTF
    and encircled energy are shown.
    """

    title: str
    values: Array
    axes: Sequence[SliderAxis]
    step_um: float
    unit: str = ""
    caption: str = ""
    signed: bool = False
    optics: bool = False
    across: str = "µm"
    from_least: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class CurvePanel:
    """Curves over one axis, one slider for each further one.

    x: (n,). lines: {name: (*axes, n)}; errors: {name of a line: (*axes, n)}, drawn as a
    band of ± that much.
    bands: (start, stop) stretches of x that are left out.
    """

    title: str
    x: Array
    x_name: str
    lines: Mapping[str, Array]
    y_name: str
    axes: Sequence[SliderAxis] = ()
    errors: Mapping[str, Array] = field(default_factory=dict)
    bands: Sequence[tuple[float, float]] = ()
    caption: str = ""
    scale: Literal["linear", "log"] = "linear"


@dataclass(frozen=True, eq=False, slots=True)
class ClassMapPanel:
    """A map of classes on a lattice, every site present: averaged where many share a
    pixel of the screen.

    index: (y, x) class of each site, 0 where there is nothing. sizes: (classes,) value
    of each, from 1.
    columns: further values of each class, shown where the pointer is (dose, datatype).
    marks: (x_um, y_um, text) places with something to say (broken rules).
    """

    title: str
    index: Array
    sizes: Array
    pitch_um: float
    unit: str
    caption: str = ""
    columns: Mapping[str, Sequence[Any] | Array] = field(default_factory=dict)
    marks: Sequence[tuple[float, float, str]] = ()


@dataclass(frozen=True, eq=False, slots=True)
class TablePanel:
    """A table; numbers are shown to four digits."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class OutlinePanel:
    """Copies of one polygon, nothing left out.

    layer: name of the layer it is drawn on. corners: (n, 2), places: (m, 2) int32, both
    in the drawing's unit.
    notes: shown where the pointer is (cell, size, dose).
    """

    layer: str
    corners: Array
    places: Array
    notes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class DrawingPanel:
    """Polygons on layers that can be turned on and off; far away the covered part of a
    pixel is shown.

    unit_um: of corners and places. marks: (x_um, y_um, text) places with something to
    say (broken rules).
    """

    title: str
    outlines: Sequence[OutlinePanel]
    unit_um: float
    caption: str = ""
    marks: Sequence[tuple[float, float, str]] = ()


@dataclass(frozen=True, eq=False, slots=True)
class PointPanel:
    """Points that can be picked, by a click or with the arrow keys; what is known of
    the picked one is shown.

    x, y: (n,) finite. groups: (n,) name of each, which gives its colour. front: places
    of the points that a stepped
    line joins, by rising x (a Pareto set). notes: (n,) further values of each point by
    name.
    """

    title: str
    x: Sequence[float]
    y: Sequence[float]
    x_name: str
    y_name: str
    groups: Sequence[str]
    front: Sequence[int] = ()
    front_name: str = "Pareto set"
    notes: Sequence[Mapping[str, Any]] = ()
    caption: str = ""


Panel = ImagePanel | CurvePanel | ClassMapPanel | DrawingPanel | TablePanel | PointPanel


def classes_of(values: Array, *, most: int = 65535) -> tuple[Array, Array]:
    """(index, sizes) of a map of few distinct positive values; 0 stays 0.

    Where there are more than ``most`` distinct values they are put into ``most`` equal
    steps (a diameter map in
    float64 has as many as it has sites; 65535 steps over 200 nm are 3 pm).
    """
    kinds = np.unique(values[values > 0])
    if len(kinds) <= most:
        index = np.where(values > 0, np.searchsorted(kinds, values) + 1, 0)
    else:
        low, high = float(kinds[0]), float(kinds[-1])
        step = (high - low) / (most - 1)
        index = np.where(
            values > 0, np.rint((values - low) / step).astype(np.int64) + 1, 0
        )
        kinds = low + step * np.arange(most)
    return index.astype(np.uint8 if len(kinds) < 256 else np.uint16), kinds
