"""What a browser draws, pixel by pixel, against the same picture made with numpy from
the data.
"""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from metalens.view import (
    ClassMapPanel,
    CurvePanel,
    ImagePanel,
    PointPanel,
    SliderAxis,
    TablePanel,
    page,
)
from tests.metalens.view.browser_page import BROWSER, printed, told

pytestmark = pytest.mark.skipif(
    BROWSER is None, reason="no browser to draw the page in: install chromium"
)
# cividis (Nuñez, Anderton, Renslow 2018) at nine even steps, as drawn
CIVIDIS = np.array(
    [[0, 34, 78], [18, 53, 112], [59, 73, 108], [87, 93, 109], [112, 113, 115], [138, 134, 120], [165, 156, 116],
     [195, 179, 105], [255, 234, 70]], float)  # fmt: skip


def _colour(share):
    at = np.clip(share, 0, 1) * 8
    return np.stack([np.interp(at, np.arange(9), CIVIDIS[:, k]) for k in range(3)], -1)


def _told(folder, panels, script, *, width=1440):
    (folder / "page.html").write_text(page.page_html("page", panels))
    return told(folder / "page.html", script, width=width)


def _canvas(folder, panels, which, **more):
    url = _told(
        folder,
        panels,
        f"return document.querySelectorAll('{which}')[0].toDataURL();",
        **more,
    )
    picture = Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert(
        "RGB"
    )
    return np.asarray(picture, float)


def test_an_image_has_the_colours_of_its_values(tmp_path):
    values = np.random.default_rng(5).uniform(0, 3, (2, 7, 11))
    values[0] *= 0.4  # the first one is shown on its own scale
    drawn = _canvas(
        tmp_path,
        [ImagePanel("psf", values, [SliderAxis("depth", [1.0, 2.0], "mm")], 0.5)],
        "canvas.image",
    )
    wanted = _colour(values[0] / values[0].max())
    away = np.ones((7, 11), bool)
    away[3, :] = away[:, 5] = away[4, :] = away[:, 6] = (
        False  # the cross and its blurred edge
    )
    # 256 colours: half a step of the table is at most 8 * 60 / 512 levels, and half of
    # one for rounding
    assert np.abs(drawn - wanted)[away].max() <= 1.5


def _everything():
    x = np.linspace(1, 3, 17)
    long = "a word-of-great-length_" * 9
    return [
        ImagePanel(
            "image",
            np.random.default_rng(4).uniform(0, 1, (3, 40, 40)),
            [SliderAxis("depth", [1, 2, 3])],
            0.3,
            optics=True,
        ),
        CurvePanel(
            "line", x, "x", {"y": 0.99999 + 1e-7 * x}, "y", errors={"y": 1e-8 * x}
        ),
        TablePanel(
            "table",
            ("name", "value", "from", "to"),
            [(long, 1.2345e-11, -3.25, 4.5), ("b", 2.0, 1.0, 3.0)],
        ),
    ]


def test_no_page_is_wider_than_the_screen(tmp_path):
    for width in (1440, 640):
        script = """const charts = Array.from(document.querySelectorAll(".uplot"));
        const over = charts.map((u) => u.clientWidth - u.parentElement.clientWidth);
        return [document.documentElement.scrollWidth, innerWidth, ...over];"""
        whole, screen, *over = map(
            int, _told(tmp_path, _everything(), script, width=width).split(",")
        )
        assert whole <= screen
        assert max(over) <= 0


def test_ticks_tell_neighbours_apart(tmp_path):
    splits = "[[0.9999985, 0.999999, 0.9999995, 1], [0, 0.25, 0.5], [-40, 0, 40], [0, 2e-9, 4e-9]]"
    script = f"return JSON.stringify({splits}.map((s) => ticks(null, s)));"
    wanted = '[["0.9999985","0.999999","0.9999995","1"],["0","0.25","0.5"],["-40","0","40"],["0","2e-9","4e-9"]]'
    assert _told(tmp_path, _everything(), script) == wanted


@pytest.mark.parametrize("gap", [np.nan, np.inf])
def test_a_curve_with_gaps_is_drawn_but_for_these(tmp_path, gap):
    """Of 100 pieces the first is left out with its end, and two beside a value in the
    middle: 3 % of the columns.
    """
    x = np.linspace(0.0, 1.0, 101)
    values = np.where((np.arange(101) == 0) | (np.arange(101) == 50), gap, 2.0 + x)
    wide = []
    for y in (2.0 + x, values):
        drawn = _canvas(
            tmp_path, [CurvePanel("line", x, "x", {"y": y}, "y")], ".uplot canvas"
        )
        # columns with colour: axes and grid are grey
        wide.append(int((np.ptp(drawn, axis=-1) > 40).any(0).sum()))
        (tmp_path / "page.html").unlink()
    assert wide[0] > 0.8 * drawn.shape[1]
    # ends of lines: 2 px of 1000 each
    assert 1 - wide[1] / wide[0] == pytest.approx(0.03, abs=0.005)


def test_colours_are_told_at_both_ends_and_the_window_in_um(tmp_path):
    values = np.random.default_rng(9).uniform(0, 3.25, (7, 11))
    values[2, 3] = 3.25
    panel = ImagePanel("psf", values, [], 0.5, unit="electrons")
    words = _told(tmp_path, [panel], "return document.querySelector('.bar').innerText;")
    assert words.split() == ["0", "3.25", "electrons;", "5.5", "×", "3.5", "µm"]


def _points():
    return PointPanel(
        "Networks", [4.0, 1.0, 9.0, 6.5], [0.5, 0.9, 0.2, 0.8], "cost", "error", ["a", "b", "a", "b"], [1, 0, 2],
        notes=[{"width": 0.4}, {"width": 0.1}, {"width": 0.9}, {"width": 0.65}],
    )  # fmt: skip


def test_arrow_keys_step_through_points_by_rising_x(tmp_path):
    script = """const box = document.querySelector(".pick"), said = [document.querySelector(".readout").textContent];
for (const key of ["ArrowLeft", "ArrowLeft", "ArrowLeft", "ArrowLeft", "ArrowRight"]) {
  box.dispatchEvent(new KeyboardEvent("keydown", { key })); said.push(document.querySelector(".readout").textContent);
}
return said.map((words) => words.match(/cost ([0-9.]+)/)[1] + (words.includes("Pareto set") ? "*" : "")).join(" ");"""
    # it opens at the dearest of the front, and stops at the cheapest; 6.5 is not of the
    # front
    assert _told(tmp_path, [_points()], script) == "9* 6.5 4* 1* 1* 4*"


def test_a_click_picks_the_nearest_point_and_tells_what_is_known_of_it(tmp_path):
    # the plot spans the values and 6 % of them on either side, so a point lies at a
    # known share of its edges
    script = """const over = document.querySelector(".u-over"), r = over.getBoundingClientRect(), said = [];
for (const [x, y] of [[4, 0.5], [6.5, 0.8], [1, 0.9]]) {
  const across = ((x - 1) / 8 + 0.06) / 1.12, up = ((y - 0.2) / 0.7 + 0.06) / 1.12;
  const clientX = r.left + across * r.width + 5, clientY = r.bottom - up * r.height - 5;
  over.dispatchEvent(new MouseEvent("click", { clientX, clientY }));
  said.push(document.querySelector(".readout").textContent);
}
return said.join("|");"""
    assert _told(tmp_path, [_points()], script) == (
        "a (in the Pareto set): cost 4, error 0.5, width 0.4|b: cost 6.5, error 0.8, width 0.65|"
        "b (in the Pareto set): cost 1, error 0.9, width 0.1"
    )


def test_points_have_their_table(tmp_path):
    script = """const box = document.querySelector("details"); box.open = true; box.dispatchEvent(new Event("toggle"));
const words = (row) => [...row.children].map((cell) => cell.textContent).join(",");
return [...box.querySelectorAll("tbody tr")].map(words).join("|");"""
    assert (
        _told(tmp_path, [_points()], script)
        == "b,1,0.9,yes,0.1|a,4,0.5,yes,0.4|b,6.5,0.8,,0.65|a,9,0.2,yes,0.9"
    )


def test_a_map_reaches_the_paper(tmp_path):
    index = np.where(np.hypot(*(np.mgrid[:300, :300] - 150)) < 140, 1, 0).astype(
        np.uint8
    )
    panels = [ClassMapPanel("mask", index, np.array([120.0]), 0.3, "nm")]
    (tmp_path / "page.html").write_text(page.page_html("page", panels))
    printed(tmp_path / "page.html", tmp_path / "page.pdf")
    sheets = (tmp_path / "page.pdf").read_bytes()
    wide = [
        int(size) for size in re.findall(rb"/Subtype /Image\s+/Width (\d+)", sheets)
    ]
    # 180 mm of paper at 96 px an inch: what is drawn for it is a picture as wide,
    # beside its bar of colours at most
    assert max(wide, default=0) > 600
