"""The report page: self-contained, escaped, pictures and tables in place."""

import re

import numpy as np
import pytest

from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Markup, Section, Table


@pytest.fixture
def page(tmp_path):
    figure, axes = report.make_figure()
    axes.plot([0, 1], [0, 1])
    picture = Figure(report.figure_png(figure), "A line <b>rising</b>")
    table = Table(("name", "value"), (("t", 0.123456), ("<script>", 3)), "numbers")
    sections = [
        Section(
            "One & two",
            "First paragraph.\n\nSecond <i>paragraph</i>.",
            (picture, table),
        ),
        Section("View", items=(Markup("<svg id='view'></svg>"),)),
        Section("End"),
    ]
    keys = [
        KeyFigure("pillars", "8,721,433"),
        KeyFigure("checked", "yes", good=True),
        KeyFigure("left", "1", good=False),
    ]
    report.write_report(
        tmp_path / "report.html", "A lens", sections, lead="Lead.", key_figures=keys
    )
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def test_page_works_offline(page):
    assert not re.search(r"(?:src|href)=[\"'](?!data:|#)", page)
    assert "@import" not in page
    assert page.count("data:image/png;base64,") == 1


def test_text_is_escaped_and_markup_is_not(page):
    assert "A line &lt;b&gt;rising&lt;/b&gt;" in page
    assert "<script>" not in page
    assert "<svg id='view'></svg>" in page


def test_paragraphs_tables_keys_and_contents_are_there(page):
    assert page.count("<p>") == 3
    assert "<td>0.1235</td>" in page
    assert 'class="key good"' in page
    assert 'class="key bad"' in page
    assert 'href="#s3"' in page
    assert 'name="viewport"' in page


def test_same_drawing_gives_the_same_bytes():
    def draw():
        figure, axes = report.make_figure()
        axes.imshow(np.eye(5))
        return report.figure_png(figure)

    assert draw() == draw()


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("max_phase_error_rad", "largest phase error / rad"),
        ("chi2_per_dof", "chi² per degree of freedom"),
        ("mtf50_x_per_um", "mtf50 x / (1/µm)"),
        ("gaze_axial_deg", "gaze axial / deg"),
        ("energy_um2", "energy / µm²"),
        ("seconds", "time / s"),
        ("peak_e", "peak / electrons"),
        ("strehl", "Strehl ratio"),
        ("psf_tolerance", "PSF tolerance"),
    ],
)
def test_keys_are_said_in_plain_words_with_their_unit(key, said):
    assert report.in_words(key) == said


def test_a_picture_has_two_pixels_for_each_of_the_page(fine_pictures):
    figure, _ = report.make_figure(size=(4.0, 3.0))
    width = int.from_bytes(report.figure_png(figure)[16:20], "big")
    assert width == pytest.approx(2 * 4.0 * 110, rel=0.1)  # cut to what is drawn


def test_paper_and_dark_rooms_have_their_own_look(page):
    for media in ("print", "(prefers-color-scheme: dark)", "(max-width:40rem)"):
        assert f"@media {media}" in page
