"""
Run the notebooks from top to bottom, each in its own kernel: ``python -m notebooks.execute``.

By default with small numbers, as a test (``make notebooks``, part of CI), without writing anything. ``--full`` uses the
notebooks' own numbers, ``--save`` stores the outputs in the files. An exception or anything written to stderr, such as
a warning, is an error.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode

import hecogrid_envs

FOLDER: Final = Path(__file__).resolve().parent
#: Tag of the parameters cell, as in papermill.
PARAMETERS: Final = "parameters"
#: Small numbers for CI, which replace those in the parameters cell.
QUICK: Final[dict[str, dict[str, object]]] = {
    "1_worlds.ipynb": {"n_games": 8},
    "2_train_and_compare.ipynb": {"game_steps": 800, "seeds": [0, 1], "n_games": 8},
    "3_look_inside.ipynb": {"game_steps": 800, "n_games": 4},
    "4_results_to_figures.ipynb": {"size": "smoke", "game_steps": 80, "seeds": [0], "levels": "2", "episodes": 8},
    "5_your_own_environment.ipynb": {"game_steps": 800, "n_games": 8},
}
#: Seconds for one cell.
TIMEOUT: Final = 3600


class NotebookError(Exception):
    """An error in a notebook."""


def source_files() -> list[Path]:
    """All notebooks, in reading order."""
    return sorted(FOLDER.glob("*.ipynb"))


def execute(path: Path, parameters: Mapping[str, object]) -> NotebookNode:
    """
    Run a notebook in a clean kernel and an empty folder.

    :param path: of the notebook
    :param parameters: replaces numbers of its parameters cell
    :return: the notebook with its outputs
    :raises NotebookError: for an exception, or for anything on stderr
    """
    notebook = with_parameters(nbformat.read(path, as_version=4), parameters)
    # As in an active environment: commands say "python", not where it is.
    paths = os.pathsep.join((os.path.dirname(sys.executable), os.environ["PATH"]))
    with tempfile.TemporaryDirectory(prefix="notebook") as folder:
        client = NotebookClient(
            notebook,
            timeout=TIMEOUT,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],  # do not warn that its sockets are not encrypted
            resources={"metadata": {"path": folder}},
        )
        try:
            client.execute(env={**os.environ, "PATH": paths})
        except CellExecutionError as error:
            raise NotebookError(f"{path.name}: {error}") from None
    for cell in code_cells(notebook):
        written = "".join(complaints(cell))
        if written:
            raise NotebookError(f"{path.name}: this cell wrote to stderr\n\n{cell.source}\n\n{written}")
    return notebook


def with_parameters(notebook: NotebookNode, parameters: Mapping[str, object]) -> NotebookNode:
    """
    Insert a cell with other numbers after the parameters cell.

    :raises NotebookError: if there is no parameters cell
    """
    if not parameters:
        return notebook
    places = [index for index, cell in enumerate(notebook.cells) if PARAMETERS in cell.metadata.get("tags", [])]
    if len(places) != 1:
        raise NotebookError(f"expected one cell with the tag {PARAMETERS!r}, got {len(places)}")
    code = "\n".join(f"{name} = {value!r}" for name, value in parameters.items())
    notebook.cells.insert(places[0] + 1, nbformat.v4.new_code_cell(code))
    return notebook


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    """Return the code cells."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def complaints(cell: NotebookNode) -> Iterator[str]:
    """Yield what a cell wrote to stderr."""
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stderr":
            yield output.text


def tidied(notebook: NotebookNode) -> NotebookNode:
    """Return the notebook without machine-dependent parts and without a second image format."""
    notebook.metadata = nbformat.from_dict(
        {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python", "pygments_lexer": "ipython3"},
        }
    )
    for index, cell in enumerate(notebook.cells):
        cell.id = f"cell-{index}"
        tags = cell.metadata.get("tags")
        cell.metadata = nbformat.from_dict({"tags": tags} if tags else {})
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                output.data.pop("image/jpeg", None)
            if "metadata" in output:
                output.metadata = nbformat.from_dict({})
    return notebook


def run(path: Path, full: bool, save: bool) -> str:
    """
    Run one notebook.

    :return: a message about the result
    :raises NotebookError: if it fails
    """
    began = time.perf_counter()
    notebook = execute(path, {} if full else QUICK[path.name])
    if save:
        nbformat.write(tidied(notebook), path)
    return f"{path.name}: {time.perf_counter() - began:.0f} s"


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run notebooks and print how long each took.

    :return: 1 if one failed
    """
    parser = argparse.ArgumentParser(prog="python -m notebooks.execute", description="Run the notebooks.")
    parser.add_argument("names", nargs="*", help="beginnings of file names, such as 2; default: all")
    parser.add_argument("--full", action="store_true", help="with the notebooks' own numbers: minutes each")
    parser.add_argument("--save", action="store_true", help="write what came out into the files")
    parser.add_argument("--jobs", type=int, default=1, help="notebooks at the same time")
    options = parser.parse_args(arguments)
    if options.save and not options.full:
        parser.error("--save keeps pictures for readers, which need --full")
    names = tuple(options.names) or ("",)
    paths = [path for path in source_files() if path.name.startswith(names)]
    if not paths:
        parser.error(f"no notebook begins with {' or '.join(names)}")

    hecogrid_envs.GameBatch("TeamSupport", hecogrid_envs.HECOGridParams())  # on a new machine, prints that it compiles

    def tried(path: Path) -> str | NotebookError:
        try:
            return run(path, options.full, options.save)
        except NotebookError as error:
            return error

    failed = False
    with ThreadPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(tried, reversed(paths)):  # the longest ones are at the end
            failed |= isinstance(outcome, NotebookError)
            print(outcome, file=sys.stderr if isinstance(outcome, NotebookError) else sys.stdout, flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
