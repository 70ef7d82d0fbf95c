"""Pages to explore artefacts: nothing is lost on the way into the page, nothing leads
out of it, a browser shows it.
"""

import base64
import json
import re
import shutil
import typing
import zlib
from importlib import resources

import numpy as np
import pytest

from metalens import lens, psf
from metalens.cell import Cell, Index
from metalens.commands import view
from metalens.core.errors import OutputError
from metalens.design import Focus, make
from metalens.proxy import Proxy
from metalens.view import ClassMapPanel, CurvePanel, Panel, TablePanel, artefacts, page
from tests.metalens.view.browser_page import BROWSER, told


def _unpacked(entry):
    kinds = {"Float32Array": "<f4", "Uint8Array": "u1", "Uint16Array": "<u2"}
    raw = zlib.decompress(base64.b64decode(entry["data"]))
    return np.frombuffer(raw, kinds[entry["type"]]).reshape(entry["shape"])


def _content(text):
    inside = re.search(
        r'<script type="application/json" id="data">(.*?)</script>', text, re.S
    )
    return json.loads(inside.group(1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A lens without symmetry and its PSFs."""
    folder = tmp_path_factory.mktemp("view")
    coefficients = np.polynomial.Chebyshev.interpolate(
        lambda d: 55 * d, 2, domain=[0.08, 0.21]
    ).coef[None]
    proxy = Proxy(
        coefficients, np.array([[0.83]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
    )
    focus = Focus(0.85, 60.0, 900.0)
    made, _ = make(
        lambda x, y: (
            1.7e-2 * x**3 + 0.4 * y[:, None] - 0.031 * (x**2 + y[:, None] ** 2)
        ),
        focus,
        aperture_um=17.0,
        cell=Cell(pitch_um=0.30, pillar=Index(3.6)),
        proxy=proxy,
    )
    lens.save(folder / "lens.h5", made)
    seen = psf.View((700.0, 900.0, 1400.0), ((0.0, 0.0), (0.07, -0.03)), 14.0, 28)
    psf.save(folder / "psf.h5", psf.from_lens(made, seen, tolerance=1e-3))
    return folder


def test_every_pillar_is_in_the_page(folder):
    design = lens.load(folder / "lens.h5")
    panel = _content(page.page_html("lens", artefacts.lens_panels(folder / "lens.h5")))[
        "panels"
    ][0]
    index = _unpacked(panel["index"])
    sizes = np.array([0.0, *panel["sizes"]])
    # sizes have six digits: half of the last one is 5e-4 nm
    assert abs(sizes[index] - 1e3 * design.diameters.diameter_um).max() < 5.1e-4
    assert panel["pitch_um"] == 0.3
    picked = tuple(np.argwhere(index > 0)[37])
    turns = design.phase_rad()[picked] / (2 * np.pi)
    assert panel["columns"]["phase / turns"][index[picked] - 1] == pytest.approx(
        turns, rel=1e-5
    )


def test_psfs_keep_their_axes(folder):
    stack = psf.load(folder / "psf.h5")
    panel = _content(page.page_html("psf", artefacts.psf_panels(folder / "psf.h5")))[
        "panels"
    ][0]
    values = _unpacked(panel["values"])
    assert values.shape == (2, 3, 28, 28)
    assert [axis["name"] for axis in panel["axes"]] == ["field angle", "depth"]
    assert panel["axes"][1]["values"] == [0.7, 0.9, 1.4]
    scaled = stack.intensity / stack.intensity.max()
    assert abs(values - scaled).max() < 1e-7  # float32
    assert panel["step_um"] == 0.5


def test_nothing_in_a_page_leads_out_of_it(folder):
    text = page.page_html(
        "a & b </script><script>alert(1)</script>",
        artefacts.psf_panels(folder / "psf.h5"),
    )
    outside = set(
        re.findall(
            r"(?:src|href)\s*=\s*[\"']?(?!data:|#)[^\s\"'>]+|@import|fetch\(|XMLHttpRequest",
            text,
        )
    )
    assert not outside
    assert _content(text)["title"] == "a & b </script><script>alert(1)</script>"
    assert "<script>alert" not in text


def test_a_page_goes_beside_a_report_of_the_same_name(folder, tmp_path):
    shutil.copy(folder / "psf.h5", tmp_path / "psf.h5")
    report = tmp_path / "psf.html"
    report.write_text(
        '<!doctype html><meta name="generator" content="metalens"><p>report</p>',
        encoding="utf-8",
    )
    options = view.Options(file=tmp_path / "psf.h5", quiet=True)
    assert view.run(options) == 0
    assert "report" in report.read_text(encoding="utf-8")
    page_text = (tmp_path / "psf_view.html").read_text(encoding="utf-8")
    assert "Point spread function" in page_text
    report.unlink()
    assert view.run(options) == 0
    with pytest.raises(
        OutputError, match=r"psf\.html exists"
    ):  # a page is not written over without a word
        view.run(options)


@pytest.mark.skipif(
    BROWSER is None, reason="no browser to show the page in: install chromium"
)
@pytest.mark.parametrize("what", ["lens", "psf", "all"])
def test_a_browser_shows_every_figure(what, folder, tmp_path):
    if what == "all":
        x = np.linspace(1, 3, 17)
        panels = [
            CurvePanel(
                "line",
                x,
                "x",
                {"y": x**2},
                "y",
                errors={"y": 0.1 * x},
                bands=[(1.5, 1.7)],
            ),
            ClassMapPanel(
                "map",
                np.array([[0, 1], [2, 1]], np.uint8),
                np.array([90.0, 130.0]),
                0.3,
                "nm",
                marks=[(0, 0, "m")],
            ),
            TablePanel("table", ("a", "b"), [(1.25, "text"), (float("nan"), "x")]),
        ]
    else:
        panels = getattr(artefacts, f"{what}_panels")(folder / f"{what}.h5")
    path = tmp_path / "page.html"
    path.write_text(page.page_html(what, panels, about={"settings": "x = 1"}))
    shown = told(path, "return document.documentElement.outerHTML")
    assert 'data-ready="true"' in shown
    assert 'class="failed"' not in shown
    assert shown.count("<section") == len(panels)
    assert shown.count("<canvas") >= sum(not isinstance(p, TablePanel) for p in panels)
    if what == "psf":  # the number under the cross is that of the file
        stack = psf.load(folder / "psf.h5").intensity
        number = float(
            re.search(r"x 0.25 µm, y 0.25 µm: ([0-9.e-]+) of", shown).group(1)
        )
        # sliders begin at the highest peak
        angle, depth, *_ = np.unravel_index(int(stack.argmax()), stack.shape)
        assert number == pytest.approx(
            float(stack[angle, depth, 14, 14] / stack.max()), rel=1e-3
        )  # four digits


def test_the_page_draws_every_kind_of_panel():
    script = resources.files("metalens") / "data" / "view" / "view.js"
    drawn = re.search(r"const DRAW = {(.*)};", script.read_text(encoding="utf-8"))[1]
    kinds = {c.__name__ for c in typing.get_args(Panel)}
    assert kinds == set(re.findall(r"(\w+Panel):", drawn))
