"""Reproduction check: run a finished cell again and compare."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

from sb3_saf.experiments.cell import Job, run_job, versions
from sb3_saf.experiments.files import differences, read_json
from sb3_saf.experiments.grid import Cell
from sb3_saf.experiments.results import Results
from sb3_saf.export.weights import read_weights


class Check(NamedTuple):
    """Results equal bit for bit and different in a second run, and differing versions."""

    equal: list[str]
    different: list[str]
    software: str


def check_cell(folder: Path, device: str = "auto") -> Check:
    """
    Train and test a cell again in a temporary folder, and compare with its results.

    :param folder: folder of a finished cell, ``RESULTS/cells/TASK-LEVEL/METHOD/seed-N``
    :param device: as in SB3
    :raises ValueError: if there is no finished cell, or its settings have changed since
    """
    described = read_json(folder / "cell.json")
    if described is None or len(folder.resolve().parents) < 4:
        raise ValueError(f"{folder} is no finished cell; expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N")
    cell, results = Cell.from_dict(described), Results(folder.resolve().parents[3])
    config, status = results.config(), results.status(cell)
    if config is None or status is None:
        problems = "; ".join(results.damaged.values()) or f"{results.folder} has no settings.json"
        raise ValueError(f"{folder} is no finished cell: {problems}")
    results.agree(config, [cell])
    with tempfile.TemporaryDirectory() as name:
        Job(cell, config, device, int(status.get("threads", 1))).write(Path(name))
        run_job(Path(name))
        return _compare(cell, results, Path(name, "result"))


def _compare(cell: Cell, results: Results, fresh: Path) -> Check:
    folder = results.cell_folder(cell)
    found: dict[str, str] = {}
    for level in cell.tests:
        before = results.test(cell, level)
        after = read_json(fresh / "tests" / f"{level.slug}.json")
        returns = [None if test is None else test["returns"] for test in (before, after)]
        same = returns[0] == returns[1]
        found[f"returns at {level}"] = "" if same else f"{_mean(before)} before, {_mean(after)} now"
    if cell.is_trained:
        same = _curve(folder / "curve.csv") == _curve(fresh / "curve.csv")
        found["learning curve"] = "" if same else "differs"
        found["weights"] = _difference_of_weights(folder / "model.zip", fresh / "model.zip")
    then, now = results.versions(cell), versions(None)
    same_names = {name: value for name, value in then.items() if name in now and name != "host"}
    return Check(
        [name for name, difference in found.items() if not difference],
        [f"{name}: {difference}" for name, difference in found.items() if difference],
        differences(same_names, {name: now[name] for name in same_names}, most=10),
    )


def _mean(test: dict[str, object] | None) -> str:
    return "missing" if test is None else f"mean {test['return_mean']}"


def _curve(path: Path) -> list[list[str]]:
    """Return the lines of a learning curve without the processor time."""
    lines = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    return [[value for index, value in enumerate(line) if index != 1] for line in lines]


def _difference_of_weights(before: Path, after: Path) -> str:
    if not before.exists():
        return "the model is missing"
    ours, theirs = read_weights(before), read_weights(after)
    if list(ours) != list(theirs):
        return "other names"
    largest = max(float((ours[name].double() - theirs[name].double()).abs().max()) for name in ours)
    return f"differ by up to {largest:.3g}" if largest > 0 else ""
