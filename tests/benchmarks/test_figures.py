"""Every figure of the pages' tables and sentences comes from a file of
benchmarks/results.
"""

import pytest

from benchmarks import figures


def test_tables_of_the_pages_are_what_the_result_files_say():
    for page, table in figures.tables().items():
        assert table in page.read_text(encoding="utf-8"), (
            f"{page.name}: run python -m benchmarks.figures"
        )


@pytest.mark.parametrize("sentence", figures.SENTENCES)
def test_a_sentence_of_the_limits_says_what_the_result_files_say(sentence):
    assert figures.filled(sentence) in figures.LIMITS.read_text(encoding="utf-8")
