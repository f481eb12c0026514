"""Published teams: what is written, loaded and checked, and those of the repository."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_saf import ExportError, evaluate_team, load_team, load_weights, save_weights
from sb3_saf.experiments import cli, tables
from sb3_saf.experiments.definitions import EXPERIMENTS, RunConfig, Selection
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import run
from sb3_saf.suites.registry import suites
from sb3_saf.teams.files import read_json, write_json
from sb3_saf.training import folders as trained_teams
from sb3_saf.training.commands import CommandError
from sb3_saf.training.enjoy import enjoy
from sb3_saf.training.folders import (
    FINISHED,
    TEAMS,
    TEST_GAMES,
    WEIGHTS,
    Run,
    check_team,
    find_team,
    finish_run,
    missing_package,
    team_names,
)
from sb3_saf.training.replay import write_page
from tests.experiments_jobs import InlineEngine, read_table

#: Two large updates, and teams after them: seeds play differently.
OVERRIDES = {"game_steps": 80, "learning_rate": 0.01}
SMOKE = RunConfig("smoke", OVERRIDES, episodes=TEST_GAMES + 8, eval_freq=80, eval_episodes=2)
METHODS = ("saf", "ippo", "saf-gru", "qplex")
LEVEL = "TeamSupport-c2-h2"
NAMES = sorted(f"{LEVEL}/{method}" for method in METHODS)
#: All teams of the repository may take no more.
MEGABYTES = 20
ALL_EQUAL = "; 100% of the games are equal"
ROOT = TEAMS.parent


@pytest.fixture(scope="module")
def experiments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of experiments with all methods, of ``ippo`` two seeds, read-only."""
    folder = tmp_path_factory.mktemp("experiments")
    for seeds, methods in (((0,), METHODS), ((1,), ("ippo",))):
        run(EXPERIMENTS["joint"], Selection(seeds, methods, (), ("2",)), SMOKE, Results(folder), InlineEngine())
    return folder


@pytest.fixture(scope="module")
def published(experiments: Path) -> Path:
    """Return the teams of the experiments, read-only; another experiment has no finished cell."""
    shutil.copytree(experiments / "joint" / "selections", experiments / "heterogeneity" / "selections")
    assert cli.main(["publish", str(experiments), str(experiments / "teams")]) == 0
    return experiments / "teams"


@pytest.fixture
def teams(published: Path, tmp_path: Path) -> Path:
    """Return a copy of the teams to damage."""
    return shutil.copytree(published, tmp_path / "teams")


def change(teams: Path, edit: Callable[[dict[str, Any]], object], name: str = f"{LEVEL}/ippo") -> None:
    """Change the settings of a team."""
    content = read_json(teams / name / "run.json")
    edit(content["settings"])
    write_json(teams / name / "run.json", content)
    finish_run(teams / name)


def change_returns(teams: Path, edit: Callable[[list[float]], list[float]]) -> None:
    """Change the returns in the row of a team."""
    path = teams / LEVEL / "ippo" / "run.json"
    content = read_json(path)
    returns = edit([float(text) for text in content["row"]["returns"].split()])
    write_json(path, {**content, "row": {**content["row"], "returns": " ".join(map(repr, returns))}})
    finish_run(path.parent)


@pytest.mark.parametrize("method", METHODS)
def test_a_team_plays_its_games_again(published: Path, method: str) -> None:
    model = load_team(LEVEL, method, published)
    env = model.get_env()
    assert env is not None
    assert len(evaluate_team(model, env, 3).returns) == 3
    assert getattr(model, "exploration_rate", 0.0) == 0.0  # its actions are those that it has learned
    env.close()
    assert f"{TEST_GAMES} games" in check_team(f"{LEVEL}/{method}", published, batches=1)


def test_games_of_a_team_are_those_of_neither_training_nor_evaluation(published: Path) -> None:
    model = load_team(LEVEL, "ippo", published)
    games, run = model.get_env(), find_team(f"{LEVEL}/ippo", published)
    assert games is not None
    shown: Any = games.reset()
    for evaluation in (False, True):
        other: Any = run.settings.make_env(run.seed, evaluation=evaluation).reset()
        assert not np.array_equal(shown["obs"], other["obs"])


def test_the_best_seed_of_each_method_is_published_with_its_row(experiments: Path, published: Path) -> None:
    assert team_names(published) == NAMES
    rows = read_table(experiments / "joint" / "runs.csv")
    for name in NAMES:
        row = find_team(name, published).description["row"]
        mine = [one for one in rows if one["method"] == row["method"]]
        assert len(mine) == (2 if name.endswith("/ippo") else 1)
        (best,) = (one for one in mine if one["cell"] == row["cell"])
        assert row["return_mean"] == float(best["return_mean"]) == max(float(one["return_mean"]) for one in mine)
        assert np.mean([float(text) for text in row["returns"].split()]) == row["return_mean"]


def test_a_team_stays_until_the_next_one_can_be_made(
    experiments: Path, teams: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise ValueError("its suite is not installed")

    monkeypatch.setattr(tables, "make_policy", fail)
    with pytest.raises(ValueError, match="its suite is not installed"):
        tables.publish(experiments, teams)
    assert len(team_names(teams)) == len(METHODS)
    assert check_team(NAMES[0], teams, batches=1)


def test_a_damaged_cell_is_not_passed_over(experiments: Path, published: Path, tmp_path: Path) -> None:
    curve = experiments / "cells" / find_team(NAMES[0], published).description["row"]["cell"] / "curve.csv"
    content = curve.read_bytes()
    try:
        curve.write_bytes(content + b"\n")
        with pytest.raises(ValueError, match=r"curve.csv has changed .* the same run command writes it anew"):
            tables.publish(experiments, tmp_path)
        assert not list(tmp_path.iterdir())
        assert tables.publish(experiments, tmp_path, only=NAMES[1]) == [NAMES[1]]
    finally:
        curve.write_bytes(content)


def test_published_files_name_no_computer_and_are_small(published: Path) -> None:
    for name in NAMES:
        assert {path.name for path in (published / name).iterdir()} == {
            *("run.json", "finished.json", "replay.html", WEIGHTS)
        }
        assert not {"host", "system"} & read_json(published / name / "run.json")["versions"].keys()
        assert (published / name / "replay.html").stat().st_size <= 300_000


def test_enjoy_and_replay_play_a_team(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_teams, "TEAMS", published)
    assert len(enjoy(["--team", f"{LEVEL}/saf-gru", "--no-render", "--episodes", "2"]).returns) == 2
    assert len(enjoy(["--team", f"{LEVEL}/saf", "--no-render", "--env-kwargs", "n_agents:5"]).returns) == 32
    refused = {
        "leave --env out": ["--env", "KeyForTreasure-v0"],
        "leave --algo out": ["--algo", "mappo"],
        "expected games like those on which": ["--env-kwargs", "view_size:5"],
    }
    for words, given in refused.items():
        with pytest.raises(CommandError, match=words):
            enjoy(["--team", f"{LEVEL}/saf", "--no-render", *given])
    models = [str(published / LEVEL / "saf"), str(published / LEVEL / "saf-gru" / WEIGHTS)]
    with pytest.raises(CommandError, match="expected games like those on which"):
        write_page(["--model", models[0], "--env-kwargs", "n_agents:5"])
    page = tmp_path / "page.html"
    assert write_page(["--model", *models, "-o", str(page)]).is_file()
    of_other_games = shutil.copytree(published, tmp_path / "teams") / LEVEL / "saf"
    change(tmp_path / "teams", lambda saved: saved["env_kwargs"].update(coordination=1), f"{LEVEL}/saf")
    both = ["--model", models[0], str(of_other_games), "-o", str(page)]
    with pytest.raises(CommandError, match="play one game, but coordination was 2, now 1; choose models of one"):
        write_page(both)
    assert write_page([*both, "--env-kwargs", "coordination:2"]).is_file()
    change(tmp_path / "teams", lambda saved: saved.update(frame_stack=2), f"{LEVEL}/saf")
    with pytest.raises(
        CommandError, match=r"frame_stack was None, now 2; choose models of one task with equal wrappers"
    ):
        write_page([*both, "--env-kwargs", "coordination:2"])


def test_a_page_runs_no_code_of_a_team(teams: Path, tmp_path: Path) -> None:
    team = teams / LEVEL / "saf"
    change(teams, lambda saved: saved.update(env_wrapper="os.system"), f"{LEVEL}/saf")
    with pytest.raises(CommandError, match="names could run code"):
        write_page(["--model", str(team), "-o", str(tmp_path / "page.html")])
    change(teams, lambda saved: saved.update(env_wrapper=None), f"{LEVEL}/saf")
    change(teams, lambda saved: saved["hyperparams"].update(env_wrapper="os.system"), f"{LEVEL}/saf")
    with pytest.raises(CommandError, match="expected env_wrapper beside the saved hyperparams"):
        write_page(["--model", str(team), "-o", str(tmp_path / "page.html")])
    (team / "run.json").write_text((team / "run.json").read_text() + " ")
    with pytest.raises(CommandError, match="has changed since the run was finished"):
        write_page(["--model", str(team), "-o", str(tmp_path / "page.html")])


def test_the_command_checks_all_teams(teams: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["teams", str(teams)]) == 0
    assert capsys.readouterr().out.count(ALL_EQUAL) == len(METHODS)
    path = teams / LEVEL / "saf" / WEIGHTS
    content = bytearray(path.read_bytes())
    content[-7] ^= 1
    path.write_bytes(content)
    description = teams / LEVEL / "ippo" / "run.json"
    description.write_text(description.read_text() + " ")
    assert cli.main(["teams", str(teams)]) == 1
    printed = capsys.readouterr()
    assert printed.out.count(ALL_EQUAL) == len(METHODS) - 2
    assert printed.err.count("has changed since the run was finished; restore the team from the repository") == 2


def test_a_team_of_a_suite_that_is_not_installed_is_no_failure(teams: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"{LEVEL}/ippo"
    assert missing_package(name, teams) is None
    change(teams, lambda saved: saved.update(env="smax/3m"), name)
    problem = missing_package(name, teams)
    if problem is None:
        pytest.skip("SMAX is installed")
    assert cli.main(["teams", str(teams)]) == 0
    printed = capsys.readouterr()
    assert f"{name}: not played, {problem}" in printed.out and printed.out.count(ALL_EQUAL) == len(METHODS) - 1


def test_exchanged_weights_are_found_by_their_games(teams: Path, experiments: Path) -> None:
    """The other seed's, with new digests: only the games tell."""
    row = read_json(teams / LEVEL / "ippo" / "run.json")["row"]
    other = experiments / "cells" / LEVEL.replace("/", "-") / "ippo" / f"seed-{1 - row['seed']}" / "best_model.zip"
    model = load_team(LEVEL, "ippo", teams)
    load_weights(model, other)
    save_weights(model, teams / LEVEL / "ippo" / WEIGHTS)
    finish_run(teams / LEVEL / "ippo")
    with pytest.raises(ValueError, match="of the games are equal, expected 90%"):
        check_team(f"{LEVEL}/ippo", teams)


@pytest.mark.parametrize(
    ("n_changed", "shift", "message"),
    [(3, 0.5, ""), (TEST_GAMES, 1e-4, "0% of the games are equal, expected 90%")],
)
def test_few_games_may_differ(teams: Path, n_changed: int, shift: float, message: str) -> None:
    """As on another kind of processor."""
    change_returns(teams, lambda returns: [*(value + shift for value in returns[:n_changed]), *returns[n_changed:]])
    if message:
        with pytest.raises(ValueError, match=message):
            check_team(f"{LEVEL}/ippo", teams, batches=1)
    else:
        assert "91% of the games are equal" in check_team(f"{LEVEL}/ippo", teams, batches=1)


def test_games_of_other_packages_may_differ_by_chance(teams: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_teams, "EQUAL_GAMES", 0.0)
    change_returns(teams, lambda returns: [value + (1 if index % 2 else -1) for index, value in enumerate(returns)])
    assert "0% of the games are equal" in check_team(f"{LEVEL}/ippo", teams)
    change_returns(teams, lambda returns: [value + (4 if index % 2 else 6) for index, value in enumerate(returns)])
    with pytest.raises(ValueError, match="expected no difference but by chance, got -5 to -5"):
        check_team(f"{LEVEL}/ippo", teams)


@pytest.mark.parametrize(
    ("env", "method", "message"),
    [
        (LEVEL, "ipo", f"unknown team '{LEVEL}/ipo' \\(did you mean '{LEVEL}/ippo'"),
        ("TeamSupport-c2", "ippo", f"did you mean '{LEVEL}/ippo'"),
        ("../teams/" + LEVEL, "ippo", "unknown team"),
    ],
)
def test_an_unknown_team_names_the_nearest(published: Path, env: str, method: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_team(env, method, published)


@pytest.mark.parametrize(("file", "words"), [(WEIGHTS, "is missing"), (FINISHED, "cannot be read")])
def test_a_team_that_lacks_a_file_is_no_unknown_one(teams: Path, file: str, words: str) -> None:
    (teams / LEVEL / "ippo" / file).unlink()
    assert team_names(teams) == NAMES
    with pytest.raises(ExportError, match=f"{file} {words}.*; restore the team from the repository"):
        load_team(LEVEL, "ippo", teams)


def test_a_folder_without_teams_says_where_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="got none; name the folder trained_teams of the repository"):
        load_team(LEVEL, "saf", tmp_path)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda saved: saved["hyperparams"]["policy_kwargs"].update(net_arch=[8]),
            "has a tensor that the network does not have",
        ),
        (lambda saved: saved["hyperparams"].update(novelty=1), "unknown setting of PPO 'novelty'"),
        (lambda saved: saved.update(algo="ippo-2"), "unknown algorithm 'ippo-2' \\(did you mean 'ippo'"),
    ],
)
def test_a_team_of_another_version_says_which(
    teams: Path, edit: Callable[[dict[str, Any]], object], message: str
) -> None:
    change(teams, edit)
    with pytest.raises(ExportError, match=f"{message}.* was trained with sb3-saf 0.* at commit .*; this is sb3-saf 0"):
        load_team(LEVEL, "ippo", teams)


@pytest.mark.skipif(suites()["smax"].problem() is None, reason="jaxmarl is installed")
def test_a_suite_that_is_not_installed_says_how_to_install_it(teams: Path) -> None:
    change(teams, lambda saved: saved.update(env="smax/2s3z"))
    with pytest.raises(ValueError, match="needs jaxmarl, which is not installed: pip install 'sb3-saf\\[jaxmarl\\]'"):
        load_team(LEVEL, "ippo", teams)


@pytest.mark.parametrize(
    "settings", [{"env": "os:system"}, {"env": "mpe2.simple_spread_v3"}, {"env_wrapper": "os.system"}]
)
def test_files_that_name_code_are_refused(teams: Path, settings: dict[str, str]) -> None:
    change(teams, lambda saved: saved.update(settings))
    with pytest.raises(ExportError, match="must be a team on the games of a suite"):
        load_team(LEVEL, "ippo", teams)


def test_callbacks_of_training_are_not_made_by_loading(teams: Path) -> None:
    change(teams, lambda saved: saved.update(callback="no_such_module.Callback"))
    assert load_team(LEVEL, "ippo", teams).get_env() is not None


# --- those of the repository ------------------------------------------------------------------------------------------

OWN = team_names() if TEAMS.is_dir() else []


def test_the_teams_of_the_repository_are_whole_and_small() -> None:
    for name in OWN:
        run = Run(TEAMS / name)
        assert run.damage(WEIGHTS) is None
        row = run.description["row"]
        assert np.mean([float(text) for text in row["returns"].split()]) == row["return_mean"]
    files = [path for path in TEAMS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MEGABYTES * 10**6
    assert {path.parent for path in files} == {TEAMS / name for name in OWN}


@pytest.mark.parametrize("name", OWN[::4])
def test_a_sample_of_the_repositorys_teams_has_the_returns_of_its_rows(name: str) -> None:
    if problem := missing_package(name):
        pytest.skip(problem)
    assert "mean team return of 32 games" in check_team(name, batches=1)


@pytest.mark.parametrize("name", OWN)
def test_rows_are_those_of_the_results(name: str) -> None:
    row = Run(TEAMS / name).description["row"]
    tables = [*(ROOT / "results").glob("*/*/runs.csv"), *(ROOT / "docs" / "data").glob("memory_*.csv")]
    rows = [one for path in tables for one in csv.DictReader(path.read_text(encoding="utf-8").splitlines())]
    keys = ("method", "seed", "commit")
    same = [one for one in rows if [one.get(key) for key in keys] == [str(row[key]) for key in keys]]
    assert any(float(one["return_mean"]) == pytest.approx(row["return_mean"], abs=1e-4) for one in same)
