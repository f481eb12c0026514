"""The pages of results are what ``python -m benchmarks.paper`` makes of the raw data, and short enough to be read."""

from __future__ import annotations

from benchmarks import paper


def test_pages_of_results_equal_their_raw_data() -> None:
    pages = paper.pages()
    for page, text in pages.items():
        assert page.read_text(encoding="utf-8") == text, f"{page}: run python -m benchmarks.paper"
    assert max(text.count("\n") for text in pages.values()) <= 150
