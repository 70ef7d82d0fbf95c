"""What ``metalens design`` says of unlike neighbours: rough or solved, and refused
where no rows are solved.
"""

from types import SimpleNamespace

import pytest

from metalens.commands import design_words as words
from metalens.design import Conversion, Quality, Unlike
from metalens.ground.errors import ConfigError
from metalens.lens import Layers

QUALITY = Quality(
    pillars=900,
    numerical_aperture=0.6,
    efficiency=0.9,
    transmission=0.95,
    strehl=0.97,
    field_of_view_rad=0.1,
    max_phase_error_rad=0.3,
)


def test_a_solved_share_is_stated_with_its_error_and_a_rough_one_as_a_bound():
    solved, rough = Unlike(0.8, 0.05, (3, 5, 6)), Unlike(0.7, 0.3)
    told = words.text("head", Layers(), QUALITY, None, solved)
    assert "unlike neighbours 0.720 +- 0.045" in told
    assert "rows of 3, 5, 6" in told
    assert "as much as 60.0%" in words.text(
        "head", Layers(), QUALITY, None, rough
    )  # 1 - (0.7 - 0.3)
    assert "as much as 0.4%" in words.text(
        "head", Layers(), QUALITY, None, Unlike(1.004, 0.004)
    )  # a gain there
    assert words.values(QUALITY, None, solved)["neighbours"] == {
        "share": 0.8,
        "error": 0.05,
        "pillars": (3, 5, 6),
    }
    assert "neighbours" not in words.values(QUALITY, None)


@pytest.mark.parametrize(
    ("quality", "conversion", "why"),
    [
        (QUALITY, SimpleNamespace(spec=Conversion), "pillars that are turned"),
        (
            Quality(900, 0.6, 0.9, 0.95, 0.97, 0.1, 0.3, focuses=False),
            None,
            "a phase without a focus",
        ),
    ],
)
def test_where_no_rows_are_solved_the_option_is_refused_and_nothing_is_said(
    quality, conversion, why
):
    assert words.neighbours(None, quality, conversion, 10.0, solve=False) == (
        None,
        None,
    )
    with pytest.raises(ConfigError, match=f"own_cell: {why}"):
        words.neighbours(None, quality, conversion, 10.0, solve=True)
