"""
Check the links of the built pages: ``python -m docs.tools.check_links build/docs/html``.

Links inside the site must lead to a file, and anchors to an element of it. Links to elsewhere are listed and not
fetched: builds may be offline, and a stranger's server must not break them.
"""

from __future__ import annotations

import argparse
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import unquote, urlsplit

#: Attributes that lead somewhere.
_LINKS: Final = {"a": "href", "img": "src", "link": "href", "script": "src"}


class Page(NamedTuple):
    """
    What a page leads to, and what can be led to.

    :param links: as written
    :param anchors: ids of its elements
    """

    links: list[str]
    anchors: set[str]


class _Reader(HTMLParser):
    """Collects links and ids."""

    def __init__(self) -> None:
        super().__init__()
        self.page = Page([], set())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """See the base class."""
        for name, value in attrs:
            if value is None:
                continue
            if name in ("id", "name"):
                self.page.anchors.add(value)
            if name == _LINKS.get(tag):
                self.page.links.append(value)


def read_page(path: Path) -> Page:
    """Links and anchors of an HTML file."""
    reader = _Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader.page


class Found(NamedTuple):
    """
    The outcome.

    :param n_pages: pages read
    :param n_internal: links that stay inside
    :param broken: "page: link", links that lead nowhere
    :param external: addresses elsewhere
    """

    n_pages: int
    n_internal: int
    broken: list[str]
    external: set[str]


def check(folder: Path) -> Found:
    """
    Follow every link of every page.

    :param folder: of the built HTML
    """
    folder = folder.resolve()
    pages = {path.resolve(): read_page(path) for path in sorted(folder.rglob("*.html"))}
    report = Found(len(pages), sum(map(len, _internal(pages).values())), [], set())
    for page in pages.values():
        report.external.update(link for link in page.links if urlsplit(link).scheme in ("http", "https"))
    for path, links in _internal(pages).items():
        report.broken.extend(f"{path.relative_to(folder)}: {link}" for link in links if not _leads(path, link, pages))
    return report


def _internal(pages: dict[Path, Page]) -> dict[Path, list[str]]:
    def stays(link: str) -> bool:
        parts = urlsplit(link)
        return not parts.scheme and not parts.netloc

    return {path: [link for link in page.links if stays(link)] for path, page in pages.items()}


def _leads(path: Path, link: str, pages: dict[Path, Page]) -> bool:
    parts = urlsplit(link)
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not parts.fragment or target not in pages:
        return target.is_file()
    return unquote(parts.fragment) in pages[target].anchors


def main() -> None:
    """Print the outcome; exit with 1 if a link is broken."""
    parser = argparse.ArgumentParser(prog="python -m docs.tools.check_links", description="Check links of built pages.")
    parser.add_argument("folder", type=Path, help="of the built HTML")
    folder: Path = parser.parse_args().folder
    if not (folder / "index.html").is_file():
        sys.exit(f"expected built pages in {folder}, got no index.html; run 'make docs'")
    report = check(folder)
    print(f"{report.n_pages} pages, {report.n_internal} links inside the site, {len(report.broken)} broken")
    print(f"{len(report.external)} addresses elsewhere (not fetched):", *sorted(report.external), sep="\n  ")
    if report.broken:
        sys.exit("\n".join(["links that lead nowhere:", *report.broken]))


if __name__ == "__main__":
    main()
