"""The documentation pages: their code runs, their links resolve, the names in them exist."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import hecogrid_envs
import sb3_saf
from docs.tools.figures import FIGURES, FOLDER
from sb3_saf.registration import DECLARATIONS
from tests.test_first_pages import PAGES as FIRST_PAGES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=NAMES)
#: Those whose commands tests/test_first_pages.py does not run.
OTHER_PAGES = pytest.mark.parametrize("page", [ROOT / name for name in NAMES if name not in FIRST_PAGES])

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]\n]*\]\(([^)\s]+)\)")


def blocks(page: Path, language: str) -> list[str]:
    return [code for found, code in FENCE.findall(page.read_text(encoding="utf-8")) if found == language]


def text_of(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def heading_anchors(page: Path) -> set[str]:
    """Return the anchors that Markdown hosts create for headings."""
    titles = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@EVERY_PAGE
def test_python_compiles(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, str(page), "exec")


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "pycon")], ids=lambda page: page.stem)
def test_sessions_print_what_the_page_says(page: Path) -> None:
    session = "\n".join(blocks(page, "pycon"))
    test = doctest.DocTestParser().get_doctest(session, {}, page.name, str(page), 0)
    said: list[str] = []
    outcome = doctest.DocTestRunner(verbose=False).run(test, out=said.append)
    assert outcome.attempted > 0
    assert outcome.failed == 0, "".join(said)


OWN_ENVIRONMENT = "docs/reference/own_environment.md"
#: Pages whose Python blocks are run, in order.
RUN = (
    *("README.md", OWN_ENVIRONMENT, "docs/resume.md", "docs/qplex.md", "docs/zoo.md"),
    *("docs/outreach/pettingzoo.md", "docs/outreach/stable_baselines3.md"),
)
#: Replacements that make them fast: few games, steps and episodes.
SMALL = {
    r"n_envs=\d+": "n_envs=2",
    r"\b\d+_000\b": "400",
    r"(?<=[(=])(16|32|200)\b|(?<=, )64(?=\))": "2",
    '"small"': '"smoke"',
}


@pytest.mark.parametrize("page", RUN)
def test_code_of_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names: dict[str, Any] = {"own_observation": np.ones(2)}  # which the README does not make
    exec(blocks(ROOT / OWN_ENVIRONMENT, "python")[0], names)  # a whole environment
    code = "\n".join(blocks(ROOT / page, "python"))
    for number, small in SMALL.items():
        code = re.sub(number, small, code)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, page, "exec"), names)


@pytest.mark.parametrize("page", FIRST_PAGES)
def test_no_block_of_the_first_pages_is_left_out(page: str) -> None:
    """Blocks of other languages, or indented, would be run by neither this file nor tests/test_first_pages.py."""
    languages = re.findall(r"```(\w+)", (ROOT / page).read_text(encoding="utf-8"))
    assert set(languages) <= {"sh", "python", "pycon"}
    assert len(languages) == sum(len(blocks(ROOT / page, language)) for language in set(languages))
    assert "python" not in languages or page in RUN


@EVERY_PAGE
def test_links_inside_the_repository_resolve(page: Path) -> None:
    for link in LINK.findall(text_of(page)):
        if re.match(r"https?:|mailto:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if target.is_relative_to(ROOT / "docs" / "results"):  # copies that the documentation's build makes
            target = ROOT / target.relative_to(ROOT / "docs")
        assert target.exists(), f"{link}: no such file"
        if anchor:
            assert anchor in heading_anchors(target), f"{link}: no such heading"


@EVERY_PAGE
def test_names_of_ours_exist(page: Path) -> None:
    """``sb3_saf.X`` and ``hecogrid_envs.X.Y`` anywhere on the page, imports in code included."""
    text = page.read_text(encoding="utf-8")
    for name in set(re.findall(r"(?<![\w/])(?:sb3_saf|hecogrid_envs)(?:\.[A-Za-z_]\w*)+", text)):
        assert exists(name), f"{name} does not exist"
    for code in blocks(page, "python"):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and node.module in ("sb3_saf", "hecogrid_envs"):
                assert all(exists(f"{node.module}.{alias.name}") for alias in node.names)


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    owner, *path = name.split(".")
    found: object = importlib.import_module(owner)
    for part in path:
        owner = f"{owner}.{part}"
        if not hasattr(found, part) and not _is_module(owner):
            return False
        found = getattr(found, part) if hasattr(found, part) else importlib.import_module(owner)
    return True


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


@OTHER_PAGES
def test_commands_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for module in re.findall(r"python -m ((?:sb3_saf|hecogrid_envs|docs|benchmarks|tests|examples)[\w.]*)", text):
        assert find_spec(module.rstrip(".")) is not None, f"python -m {module}"
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE)) <= targets


@OTHER_PAGES
def test_printed_commands_are_understood(page: Path) -> None:
    """The options of each command exist, and take the values on the page."""
    text = re.sub(r"\\\n", " ", page.read_text(encoding="utf-8"))
    for program, words in re.findall(r"python -m sb3_saf\.(train|enjoy|plot|replay) +(\w[^`#|\n]*|-[^`#|\n]*)", text):
        parser = importlib.import_module(f"sb3_saf.training.{program}").make_parser()
        parser.parse_args(shlex.split(words))


def test_every_public_name_is_in_the_reference() -> None:
    for package in (sb3_saf, hecogrid_envs):
        reference = (ROOT / "docs" / "api" / f"{package.__name__}.md").read_text(encoding="utf-8")
        missing = [n for n in package.__all__ if not re.search(rf"\b{package.__name__}\.{n}\b", reference)]
        assert missing == []


def test_the_table_of_policies_is_the_registration() -> None:
    """Each algorithm's row names exactly the policies that it knows."""
    lines = (ROOT / "docs" / "reference" / "can_i_use.md").read_text(encoding="utf-8").splitlines()
    policies: dict[Any, set[str]] = {}
    for declaration in DECLARATIONS:
        for algorithm, classes in declaration.policies.items():
            policies.setdefault(algorithm, set()).update(policy.__name__ for policy in classes)
    for algorithm, names in policies.items():
        (row,) = [line for line in lines if re.match(rf"\| `\w+\.{algorithm.__name__}`", line)]
        assert set(re.findall(r"`(\w+Policy)`", row)) == names


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_what_their_command_draws(name: str) -> None:
    with Image.open(FOLDER / name) as picture:
        np.testing.assert_array_equal(np.asarray(picture), FIGURES[name]())


def test_parameter_table_is_the_programs() -> None:
    from sb3_saf.parameters import parameter_table

    page = (ROOT / "docs" / "algorithms" / "index.md").read_text(encoding="utf-8")
    for row in parameter_table():
        paper = "" if row.paper is None else f"{row.paper:,}"
        assert re.search(rf"^\| {row.name} \| {row.counted:,} \| ?{paper} ?\|", page, re.MULTILINE), row.name


def test_citation_is_of_this_version() -> None:
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    setup = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert f"version = {citation['version']}\n" in setup
    assert f"license = {citation['license']}\n" in setup
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith(f"{citation['license']} License")
    assert [paper["doi"] for paper in citation["references"]] == ["10.48550/arXiv.2210.03022"]
