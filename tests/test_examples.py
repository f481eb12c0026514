"""The example programs run, on environments that are installed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import sb3_saf
from examples import curriculum
from examples.train_pettingzoo import ENVIRONMENTS, main
from sb3_saf.training.settings import Settings

NEEDS = {"multiwalker": "Box2D", "pursuit": "pettingzoo.sisl.pursuit_v5", "hanabi": "pyspiel"}


@pytest.mark.filterwarnings("ignore")  # those of other projects
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environments_of_others_train(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(NEEDS.get(name, "mpe2"), exc_type=ImportError)
    example = ENVIRONMENTS[name]
    short = {**example.params, "max_cycles": 20} if "max_cycles" in example.params else example.params
    monkeypatch.setitem(ENVIRONMENTS, name, example._replace(n_games=2, n_steps=20, params=short))
    main(["--env", name, "--game-steps", "40", "--episodes", "2"])
    printed = capsys.readouterr().out
    assert re.search(r"trained  -?\d+\.\d\d \[.*2 team episodes\)\n  random   -?\d+\.\d\d \[", printed), printed


def test_a_curriculum_trains_one_model_on_one_level_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    levels: list[int] = []
    tested: list[Any] = []
    make_env: Any = Settings.make_env
    evaluate_team = sb3_saf.evaluate_team

    def note_level(settings: Settings, seed: int, **kwargs: Any) -> Any:
        env = make_env(settings, seed, **kwargs)
        levels.append(env.unwrapped.batch.params.coordination)
        return env

    def note_model(model: Any, *args: Any, **kwargs: Any) -> Any:
        tested.append(model)
        return evaluate_team(model, *args, **kwargs)

    monkeypatch.setattr(Settings, "make_env", note_level)
    monkeypatch.setattr(sb3_saf, "evaluate_team", note_model)
    monkeypatch.setattr(curriculum, "N_EPISODES", 2)
    plan = (curriculum.Stage(1, 800), curriculum.Stage(2, 1_600), curriculum.Stage(3, 800))
    monkeypatch.setitem(curriculum.PLANS, "curriculum", plan)
    curriculum.train_and_test(curriculum.Run("TeamSupport-v0", "ippo", "curriculum", 0))
    assert levels == [3, 1, 2, 3]
    (model,) = tested
    assert model.num_timesteps == 5 * 3_200
    (steps,) = {int(state["step"]) for state in model.policy.optimizer.state.values()}
    assert steps == 4 * 2 * 4  # rollouts, minibatches, epochs: the optimiser goes on as well


def test_runs_of_the_curriculum_that_are_done_are_not_run_again(tmp_path: Path) -> None:
    output = tmp_path / "results" / "curriculum.csv"
    runs = [curriculum.Run("TeamSupport-v0", curriculum.RANDOM, "", seed) for seed in (0, 1)]
    curriculum.execute(runs[:1], output, workers=1)
    kept = output.read_text().replace("TeamSupport-v0,random,,0,", "TeamSupport-v0,random,,0,9")
    output.write_text(kept)
    curriculum.execute(runs, output, workers=1)
    assert output.read_text().startswith(kept)
    results = curriculum.read(output)
    assert list(results) == runs
    assert results[runs[0]] > 9 > results[runs[1]] > 0
    *_, row = curriculum.table(results)
    assert re.fullmatch(r"\| TeamSupport-v0 \| random \|  \| 2 \| \d+\.\d\d \[-?\d+\.\d\d, \d+\.\d\d\] \|", row), row
