"""Snapshots of games: derived values equal those of the game, and impossible states are refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hecogrid_envs import GameBatch, HECOGridParams
from hecogrid_envs.constants import Rules
from sb3_saf import game_seeds

N_GAMES = 4
#: Crowded, so that several agents share a cell.
LEVEL: dict[str, Any] = {
    "n_agents": 6,
    "grid_size": 9,
    "n_treasures": 12,
    "coordination": 2,
    "heterogeneity": 3,
    "max_cycles": 25,
    "observation": "tiles",
}


def played(task: str = "TeamTogether", rules: Rules = "paper", n_steps: int = 60) -> GameBatch:
    batch = GameBatch(task, HECOGridParams(**LEVEL, rules=rules), N_GAMES)
    batch.reset(seeds=game_seeds(0, N_GAMES))
    actions = np.random.default_rng(0).choice(7, size=(n_steps, N_GAMES, 6), p=[0.1, 0.1, 0.4, 0.2, 0.2, 0, 0])
    for step in actions:
        batch.advance(step)
    return batch


@pytest.mark.parametrize("rules", ["paper", "released"])
@pytest.mark.parametrize("task", ["TeamTogether", "TeamSupport", "KeyForTreasure"])
def test_games_of_a_snapshot_are_those_that_were_played(task: str, rules: Rules) -> None:
    batch = played(task, rules)
    fresh = GameBatch(task, batch.params, N_GAMES)
    fresh.restore(batch.snapshot())
    rng = np.random.default_rng(1)
    for _ in range(40):
        actions = rng.integers(7, size=(N_GAMES, 6))
        for one, other in zip(batch.advance(actions), fresh.advance(actions), strict=True):
            np.testing.assert_array_equal(one, other)


def _set(name: str, value: Any) -> Callable[[dict[str, Any]], object]:
    def change(snapshot: dict[str, Any]) -> None:
        snapshot[name].reshape(-1)[0] = value

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (_set("x", 0), "agent 0 .*wall"),
        (_set("terrain", 0), "outer ring"),
        (_set("has_key", 2), "`has_key`"),
        (_set("colour", 200), "`colour` .*got 200"),
        (_set("order", 77), "`order` is not a permutation"),
        (lambda snapshot: snapshot.pop("rng"), "`rng`"),
        (lambda snapshot: snapshot.update(x=snapshot["x"][:, :5]), r"`x` as int32 \(4, 6\)"),
        (lambda snapshot: snapshot.update(x=snapshot["x"].astype(float)), "`x` .*got float64"),
    ],
)
def test_what_kernels_cannot_index_is_refused_and_changes_nothing(change: Callable[..., object], named: str) -> None:
    batch = played(n_steps=5)
    before, snapshot = batch.snapshot(), batch.snapshot()
    change(snapshot)
    with pytest.raises(ValueError, match=named):
        batch.restore(snapshot)
    np.testing.assert_equal(batch.snapshot(), before)
