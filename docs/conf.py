"""Settings of the documentation: ``make docs`` builds it, warnings as errors."""

from __future__ import annotations

import inspect
import re
import shutil
import sys
from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # the checkout's own packages, installed or not

project = "sb3-saf"
author = "sb3-saf contributors"
copyright = f"2026, {author}"

extensions = ["docs.mathml", "myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton"]
html_math_renderer = "mathml"
# Notebooks are pages with the outputs that they are stored with; `make notebooks` runs them.
nb_execution_mode = "off"
nb_merge_streams = True
copybutton_prompt_text = ">>> |... |$ "
copybutton_prompt_is_regexp = False
exclude_patterns = ["extra", "tools"]
html_theme = "furo"
html_title = "sb3-saf"
html_static_path = ["_static"]
html_extra_path = ["extra"]
html_css_files = ["tables.css"]
html_show_sphinx = False
#: The repository's address is written once: in the README's ``pip install``.
(_address,) = re.findall(r'git\+(https://[^"\s]+)', (ROOT / "README.md").read_text(encoding="utf-8"))
html_theme_options = {"footer_icons": [{"name": "Repository", "url": _address, "html": "Repository", "class": ""}]}

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True
# What belongs to others, and to our own modules that the reference does not list, is named without a link.
nitpick_ignore_regex = [
    (r"py:.*", r"(?!sb3_saf\.[A-Z]|hecogrid_envs\.[A-Z]).*"),
]

#: Folders outside this one whose pages are copied into it, and their names here.
COPIED = {"notebooks": "tutorials", "results": "results"}
#: A line of this form is replaced by the docstring of the named class, which is Markdown.
DOCSTRING_LINE = "%docstring "


def _link_copies(app: Sphinx, docname: str, source: list[str]) -> None:
    """Links to ``results`` and ``notebooks``, which work in the repository, lead to the copies that are built."""
    source[0] = re.sub(
        r"(\]\((?:\.\./)*)\.\./(results|notebooks)/", lambda link: f"{link[1]}{COPIED[link[2]]}/", source[0]
    )


def _insert_docstrings(app: Sphinx, docname: str, source: list[str]) -> None:
    """The environments' pages are their classes' docstrings."""
    lines = source[0].splitlines()
    if any(line.startswith(DOCSTRING_LINE) for line in lines):
        source[0] = "\n".join(
            _docstring(line.removeprefix(DOCSTRING_LINE)) if line.startswith(DOCSTRING_LINE) else line for line in lines
        )


def _docstring(path: str) -> str:
    module, _, name = path.strip().rpartition(".")
    text = inspect.getdoc(getattr(import_module(module), name))
    if not text:
        raise ValueError(f"{path} has no docstring")
    return text


def _drop_markdown_docstrings(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """In the reference, the tasks' long Markdown docstrings are one line and a link to their page."""
    if what == "class" and "## Actions" in lines:
        lines[:] = [lines[0], "", "Its page is under *Games*.", ""]


def _copy_pages() -> None:
    """Copy the pages that live outside this folder into it: Sphinx reads no others."""
    docs = ROOT / "docs"
    for folder, pages in COPIED.items():
        shutil.rmtree(docs / pages, ignore_errors=True)  # pages that are gone
        shutil.copytree(ROOT / folder, docs / pages, ignore=shutil.ignore_patterns("*.py*", "__*"))
        for copied in [*(docs / pages).rglob("*.md"), *(docs / pages).rglob("*.ipynb")]:
            text = copied.read_text(encoding="utf-8").replace("../docs/", "../")
            text = text.replace("](../trained_teams/", f"]({_address}/tree/main/trained_teams/")
            # A report is reached from the page that it belongs to, not from the sidebar.
            is_report = copied.name == "report.md"
            copied.write_text("---\norphan: true\n---\n\n" + text if is_report else text, encoding="utf-8")
    shutil.copyfile(ROOT / "CHANGELOG.md", docs / "changelog.md")


def setup(app: Sphinx) -> None:
    """Copy pages and register the functions above."""
    _copy_pages()
    app.connect("source-read", _link_copies)
    app.connect("source-read", _insert_docstrings)
    app.connect("autodoc-process-docstring", _drop_markdown_docstrings)
