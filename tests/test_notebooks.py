"""The notebook files, and the program that runs them; ``make notebooks`` runs them."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode

from notebooks.execute import PARAMETERS, QUICK, NotebookError, code_cells, execute, source_files, tidied
from tests.test_docs import LINK

FILES = source_files()
EVERY_NOTEBOOK = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
#: Size limit in bytes. Larger notebooks are slow on GitHub.
LARGEST = 1_500_000


def read(path: Path) -> NotebookNode:
    return nbformat.read(path, as_version=4)


def written_by(cell: NotebookNode) -> str:
    """Return all text output of a cell."""
    texts = [output.get("text", "") for output in cell.outputs]
    return "".join([*texts, *(output.get("data", {}).get("text/plain", "") for output in cell.outputs)])


def test_there_are_five_and_the_readme_and_quick_numbers_know_them() -> None:
    names = [path.name for path in FILES]
    assert [name[0] for name in names] == list("12345")
    assert list(QUICK) == names
    readme = (FILES[0].parent / "README.md").read_text(encoding="utf-8")
    assert [link for link in LINK.findall(readme) if link.endswith(".ipynb")] == names


@EVERY_NOTEBOOK
def test_was_run_from_top_to_bottom_and_has_pictures(path: Path) -> None:
    cells = code_cells(read(path))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    assert {output.output_type for output in outputs} <= {"stream", "display_data", "execute_result"}
    assert all(output.get("name") != "stderr" for output in outputs)


@EVERY_NOTEBOOK
def test_leaves_nothing_of_the_machine_that_ran_it(path: Path) -> None:
    notebook = read(path)
    assert path.stat().st_size < LARGEST
    text = "\n".join(cell.source + written_by(cell) for cell in code_cells(notebook))
    assert re.findall(r"/(?:home|root|tmp|work|opt|Users)/\S*", text) == []
    assert re.findall(r"\b(?:TODO|FIXME|XXX)\b|Warning\b|Traceback", text) == []
    assert tidied(read(path)) == notebook


@EVERY_NOTEBOOK
def test_quick_numbers_replace_ones_that_are_there(path: Path) -> None:
    (cell,) = [cell for cell in code_cells(read(path)) if PARAMETERS in cell.metadata.get("tags", [])]
    lines = [node for node in ast.parse(cell.source).body if isinstance(node, ast.Assign)]
    there = {ast.unparse(node.targets[0]): type(ast.literal_eval(node.value)) for node in lines}
    assert {name: type(value) for name, value in QUICK[path.name].items()}.items() <= there.items()


@EVERY_NOTEBOOK
def test_links_lead_somewhere(path: Path) -> None:
    texts = [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]
    for link in (link for text in texts for link in LINK.findall(text)):
        assert re.match("https?:", link) or (path.parent / link).is_file(), link


def save(path: Path, *cells: str) -> Path:
    """Write a notebook whose first cell has the parameters."""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in cells])
    notebook.cells[0].metadata["tags"] = [PARAMETERS]
    nbformat.write(notebook, path)
    return path


def test_warnings_are_errors(tmp_path: Path) -> None:
    with pytest.raises(NotebookError, match="UserWarning: old"):
        execute(save(tmp_path / "a.ipynb", "n = 3", "import warnings\nwarnings.warn('old', stacklevel=1)"), {})


def test_commands_say_python_also_where_no_environment_is_active(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.defpath)
    says = "from sb3_saf.training.folders import python_command\nprint(python_command('sb3_saf.train'))"
    notebook = execute(save(tmp_path / "a.ipynb", "n = 3", says), {})
    assert written_by(code_cells(notebook)[1]).strip() == "python -m sb3_saf.train"
