"""The pages of results are what ``python -m benchmarks.paper`` makes of the raw data, and short enough to be read."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import paper, peers, suite_results
from sb3_saf.experiments.tables import CURVES, RUNS, marl_eval


def test_pages_of_results_equal_their_raw_data() -> None:
    pages = paper.pages()
    for page, text in pages.items():
        assert page.read_text(encoding="utf-8") == text, f"{page}: run python -m benchmarks.paper"
    assert pages[paper.PAGES[0]].count("\n") <= 150
    grid = json.loads((paper.RAW / "marl_eval.json").read_text(encoding="utf-8"))
    assert grid == marl_eval(paper.grid(), "hecogrid")
    runs = [sorted(of_method) for of_task in grid["hecogrid"].values() for of_method in of_task.values()]
    assert runs == [[f"seed_{seed}" for seed in range(5)]] * 24 * 4


def test_tables_of_predictions_can_be_read() -> None:
    for folder in (paper.RAW, suite_results.RAW):
        assert list(pd.read_csv(folder / "predictions.csv")) == ["block", "question", "prediction", "measured"]


def test_curves_are_the_evaluations_of_their_runs() -> None:
    """Not the episodes of training: a run has 20, and its best policy is that of one of them."""
    for path in paper.RAW.glob(f"*/{RUNS}"):
        runs, curves = pd.read_csv(path).query("game_steps > 0"), pd.read_csv(path.parent / CURVES)
        steps = curves.groupby(["method", "task", "level", "seed"])["game_steps"].agg(list)
        for run in runs.itertuples():
            evaluations = steps[run.method, run.task, run.train_level, run.seed]
            assert len(evaluations) == 20 and run.best_game_steps in evaluations, f"{path}: {run.cell}"


def test_cells_trained_again_replace_the_older_ones(tmp_path: Path) -> None:
    for factor, folder in ((1, "older"), (2, "newer")):
        (tmp_path / folder / "parts").mkdir(parents=True)
        for file, column in ((RUNS, "return_mean"), (CURVES, "score")):
            frame = pd.read_csv(paper.RAW / "parts" / file)
            frame[column] *= factor
            rows = frame if factor == 1 else frame[frame["method"] == "saf-no-ks"]
            rows.to_csv(tmp_path / folder / "parts" / file, index=False)
        paper.add("parts", tmp_path / folder / "parts", raw=tmp_path / "raw")
    for file, column in ((RUNS, "return_mean"), (CURVES, "score")):
        before, after = (pd.read_csv(folder / "parts" / file) for folder in (paper.RAW, tmp_path / "raw"))
        twice = (after.groupby("method")[column].sum() / before.groupby("method")[column].sum()).round(3)
        assert len(after) == len(before) and dict(twice[twice != 1]) == {"saf-no-ks": 2}
    part = tmp_path / "part" / "ood-ablation"
    part.mkdir(parents=True)
    for file, level in ((RUNS, "train_level"), (CURVES, "level")):
        frame = pd.read_csv(paper.RAW / "ood-ablation" / file)
        frame[frame[level] == "c2-h1"].to_csv(part / file, index=False)
    shutil.copytree(paper.RAW / "ood-ablation", tmp_path / "raw" / "ood-ablation")
    paper.add("ood-ablation", part, raw=tmp_path / "raw")  # tests at the same levels of teams trained at others stay
    assert len(pd.read_csv(tmp_path / "raw" / "ood-ablation" / RUNS)) == len(
        pd.read_csv(paper.RAW / "ood-ablation" / RUNS)
    )


def test_trainings_of_others_stand_beside_those_of_similar_length() -> None:
    task = suite_results.Task("jaxmarl/MPE_simple_spread_v3", 1_000_000)
    lengths = (400_000, 500_000, 2_000_000, 2_100_000)
    rows = [{"task": task.game, "program": "P", "game_steps": steps, "return": -1.0} for steps in lengths]
    notes = [note for _, note, _ in suite_results.beside(task, pd.DataFrame(rows)) if note.startswith("P")]
    assert [note.split()[2] for note in notes] == ["500,000", "2,000,000"]


def test_whole_trainings_are_read_where_they_were_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(words: list[str]) -> None:
        published = suite_results.RAW / "lbf-Foraging-15x15-4p-3f-v3"
        shutil.copytree(published, Path(words[words.index("-f") + 1], words[1]))

    monkeypatch.setattr(suite_results, "experiments", train)
    peers.print_trainings(dict.fromkeys((peer.kind for peer in peers.RATED), None), {})
    assert capsys.readouterr().out.count("| MAPPO | 5,000,000 | 0.51 | 4683 |") == len(peers.RATED)
