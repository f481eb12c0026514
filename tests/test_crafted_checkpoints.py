"""
Checkpoints with correct checksums and wrong contents either raise our errors or train; they never crash.

``CRAFTED=1000 python -m pytest tests/test_crafted_checkpoints.py`` tries 1,000.
"""

from __future__ import annotations

import contextlib
import copy
import os
import random
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

import sb3_saf
from sb3_saf import QPLEX, CheckpointError, NonFiniteError, resumable_learn
from sb3_saf.checkpoints.data import decode, encode

ROUNDS = int(os.environ.get("CRAFTED", "18"))
N_AGENTS, N_GAMES, N_STEPS = 2, 2, 6
ROWS = N_AGENTS * N_GAMES
TASK: dict[str, Any] = {"n_agents": N_AGENTS, "grid_size": 7, "n_treasures": 3, "coordination": 1, "max_cycles": 5}
LIGHT: dict[str, Any] = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [4]}
ALGORITHMS = ("ppo", "recurrent", "qplex")

Change = Callable[[Any], Any]


def make(algorithm: str, folder: Path) -> tuple[Any, Any]:
    env = sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=0, monitor_dir=str(folder), **TASK)
    eval_env = sb3_saf.make_team_env("TeamTogether", 1, seed=9, **TASK)
    callback = sb3_saf.TeamEvalCallback(eval_env, n_eval_episodes=1, eval_freq=6, log_path=str(folder), verbose=0)
    common: dict[str, Any] = {"seed": 0, "tensorboard_log": str(folder / "tb"), "device": "cpu"}
    if algorithm == "qplex":
        kwargs: dict[str, Any] = LIGHT | {"lstm_hidden_size": 4, "sequence_length": 3, "burn_in": 1}
        model: Any = QPLEX(
            "QPLEXLstmPolicy", env, buffer_size=20, learning_starts=4, batch_size=3, train_freq=4,
            policy_kwargs=kwargs, **common,
        )  # fmt: skip
    elif algorithm == "recurrent":
        kwargs = LIGHT | {"lstm_hidden_size": 4}
        model = RecurrentPPO(
            "SAFLstmPolicy", env, n_steps=N_STEPS, batch_size=ROWS * N_STEPS, n_epochs=1, policy_kwargs=kwargs, **common
        )
    else:
        model = PPO(
            "SAFPolicy", env, n_steps=N_STEPS, batch_size=ROWS * N_STEPS, n_epochs=1, policy_kwargs=LIGHT,
            rollout_buffer_class=sb3_saf.TeamRolloutBuffer, **common,
        )  # fmt: skip
    return model, callback


def learn(algorithm: str, folder: Path, rollouts: int) -> Any:
    model, callback = make(algorithm, folder)
    try:
        steps = rollouts * ROWS * N_STEPS
        return resumable_learn(model, steps, folder / "ck", callback, every_game_steps=1, keep=1, tb_log_name="run")
    finally:
        model.env.close()


@pytest.fixture(scope="module")
def trees(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return a checkpoint of each algorithm, as data."""
    found = {}
    for algorithm in ALGORITHMS:
        folder = tmp_path_factory.mktemp(algorithm)
        learn(algorithm, folder, 3)
        (path,) = (folder / "ck").glob("*.ckpt")
        found[algorithm] = path.read_bytes()
        found[f"{algorithm} monitor"] = (folder / "monitor.csv").read_bytes()
    return found


def resume_from(algorithm: str, tree: Any, monitor: bytes, folder: Path) -> None:
    """Resume from a tree, in a folder of a run with a monitor.csv."""
    (folder / "ck").mkdir(parents=True)
    (folder / "ck" / "checkpoint-000000000036.ckpt").write_bytes(encode(tree, "1.0"))
    (folder / "monitor.csv").write_bytes(monitor)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        learn(algorithm, folder, 5)


# --- crafted checkpoints that failed in the past ----------------------------------------------------------------------


def _games(tree: Any) -> Any:
    return tree["environment"][-1]["state"]["games"]


def _fill(array: Any, value: Any) -> None:
    array[...] = value


def _first_statistics(tree: Any) -> Any:
    return tree["model"]["optimizer"]["state"][0]


HARMFUL: dict[str, tuple[str, Change]] = {
    "statistics of another shape": ("ppo", lambda tree: _first_statistics(tree).update(exp_avg=th.zeros(3))),
    "statistics that are missing": ("ppo", lambda tree: _first_statistics(tree).pop("exp_avg_sq")),
    "a path among the counters": (
        "ppo",
        lambda tree: tree["callbacks"][0]["counters"].update(log_path="/tmp/elsewhere"),
    ),
    "a file cut in a line": ("ppo", lambda tree: tree["environment"][1]["state"].update(file_size=50)),
    "an entry that is missing": ("ppo", lambda tree: tree["model"].pop("last")),
    "a folder of logs elsewhere": ("ppo", lambda tree: tree["logger"].update(tensorboard="..")),
    "a generator's position": ("ppo", lambda tree: tree["generators"]["numpy"]["state"].update(pos=10**6)),
    "another run's evaluations": (
        "ppo",
        lambda tree: tree["callbacks"][0]["counters"]["evaluations_results"].append([1.0, 2.0]),
    ),
    "last observations of other games": ("ppo", lambda tree: tree["model"]["last"]["_last_obs"].pop("team")),
    "tile codes beyond the table": ("ppo", lambda tree: _fill(tree["model"]["last"]["_last_obs"]["agent"], 99)),
    "memories of others": ("recurrent", lambda tree: tree["model"]["lstm"][0].pop()),
    "actions that no agent has": ("qplex", lambda tree: _fill(tree["model"]["replay"]["slots"]["actions"], 99)),
    "observations put aside": ("qplex", lambda tree: _fill(tree["model"]["replay"]["slots"]["aside_index"], 9_999)),
    "a slot beyond the buffer": ("qplex", lambda tree: tree["model"]["replay"].update(pos=10**6)),
}


@pytest.mark.parametrize("name", HARMFUL)
def test_harmful_checkpoints_are_refused_before_anything_is_touched(
    name: str, trees: dict[str, bytes], tmp_path: Path
) -> None:
    algorithm, change = HARMFUL[name]
    tree = decode(trees[algorithm])
    change(tree)
    with pytest.raises(CheckpointError):
        resume_from(algorithm, tree, trees[f"{algorithm} monitor"], tmp_path)
    assert (tmp_path / "monitor.csv").read_bytes() == trees[f"{algorithm} monitor"]
    assert {path.name for path in tmp_path.iterdir()} == {"ck", "monitor.csv"}


# --- random ones ------------------------------------------------------------------------------------------------------


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every entry of every dict and list of a tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(entries):
        yield tree, key
        yield from places(value)


EXTREMES = (
    0,
    1,
    -1,
    2**31,
    -(2**31),
    2**63 - 1,
    10**30,
    float("nan"),
    float("inf"),
    -1e300,
    True,
    None,
    "",
    "..",
    "/x",
)


def mutate_array(array: Any, rng: random.Random) -> Any:
    """Change values, shape or dtype; sometimes remove or add one value, or exchange two."""
    array = np.array(array)
    how = rng.randrange(7)
    if how == 0:
        return array.reshape(-1)[: rng.randrange(array.size + 1)].copy()
    if how == 1:
        return array.astype(rng.choice([np.int8, np.float64, np.uint64, np.int32, np.bool_]))
    if how == 2:
        return np.concatenate([array.reshape(-1)] * 3)
    if how > 4 and array.size and array.dtype.kind in "iuf":
        one, other = (rng.randrange(array.size) for _ in range(2))
        values = array.reshape(-1)
        values[[one, other]] = values[[other, one]] if how == 5 else values[[one, other]] + rng.choice([-1, 1])
        return array
    if array.dtype.kind == "f":
        extreme = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1.0])
    else:
        extreme = rng.choice([0, 1]) if array.dtype.kind == "b" else rng.choice([np.iinfo(array.dtype).max, 0, 7, 3])
    if array.size and how == 3:
        array.reshape(-1)[rng.randrange(array.size)] = extreme
    else:
        array[...] = extreme
    return array


def mutate(tree: Any, rng: random.Random) -> None:
    """Change one entry; its depth is drawn first, so arrays of games and leaves of small dicts are equally likely."""
    found = list(places(tree))
    owner, key = rng.choice(found)
    value = owner[key]
    if rng.random() < 0.15:
        del owner[key]
    elif isinstance(value, th.Tensor):
        changed = th.from_numpy(mutate_array(value.numpy(), rng))
        owner[key] = changed
    elif isinstance(value, np.ndarray) and rng.random() < 0.9:
        owner[key] = mutate_array(value, rng)
    elif rng.random() < 0.2:
        other, name = rng.choice(found)
        owner[key] = copy.deepcopy(other[name])
    else:
        owner[key] = rng.choice(EXTREMES)


@pytest.mark.parametrize("number", range(ROUNDS))
def test_crafted_checkpoints_end_in_our_errors_or_train(number: int, trees: dict[str, bytes], tmp_path: Path) -> None:
    rng = random.Random(number)
    algorithm = ALGORITHMS[number % len(ALGORITHMS)]
    tree = decode(trees[algorithm])
    for _ in range(rng.choice([1, 1, 1, 3])):
        mutate(tree, rng)
    (tmp_path / "run").mkdir()
    with contextlib.suppress(CheckpointError, NonFiniteError):
        resume_from(algorithm, tree, trees[f"{algorithm} monitor"], tmp_path / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
