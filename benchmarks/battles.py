"""
Ask why a team wins or loses battles of SMAX: ``python -m benchmarks.battles RUN``.

Plays a trained team many times from the same starts, counts who can shoot when the first unit is hit, and lets a
planner act in the team's place before the first hit, after it, or always. The planner draws joint actions of the team,
plays each to the end in copies of the battle with other random streams and the team's most likely actions, and takes
the best.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import jax
import jaxmarl
import numpy as np
import numpy.typing as npt

from sb3_saf.experiments.results import BEST_MODEL
from sb3_saf.suites.engines.jaxmarl import SCENARIOS, JaxPrograms, rules_of
from sb3_saf.teams.rows import Array
from sb3_saf.training.enjoy import make_policy
from sb3_saf.training.folders import WEIGHTS, Run

_NAME: Final = "HeuristicEnemySMAX"
#: What the planner may do: moments at which it acts, by whether any unit has been hit.
PLANNED: Final = {"never": (), "before the first hit": (False,), "after it": (True,), "always": (False, True)}


class Position(NamedTuple):
    """
    E battles at one moment.

    :param buffers: the games, see ``Packing``
    :param rows: (E, N, ...) observations and masks
    """

    buffers: list[Any]
    rows: dict[str, Any]


class Battles:
    """
    Battles of a trained team.

    :param folder: its run, of ``sb3_saf.train``, or a folder of ``trained_teams``
    """

    def __init__(self, folder: Path, seed: int) -> None:
        run = Run(folder)
        weights = next(path for name in (BEST_MODEL, WEIGHTS) if (path := folder / name).exists())
        self._policy = make_policy(run.settings, weights)
        env = jaxmarl.make(_NAME, scenario=SCENARIOS[run.settings.environment.task])
        self._programs = JaxPrograms(env, rules_of(_NAME))
        self._random = np.random.default_rng(seed)

    def begin(self, n: int) -> Position:
        """Return n new battles."""
        return Position(*self._programs.begin(self._keys(n)))

    def act(self, position: Position, deterministic: bool) -> Array:
        """Return the team's actions, (E, N)."""
        rows = {key: np.asarray(one).reshape(-1, *one.shape[2:]) for key, one in position.rows.items()}
        actions, _ = self._policy.predict(rows, deterministic=deterministic)
        return actions.reshape(-1, len(self._programs.agents))

    def copies(self, position: Position, n: int) -> Position:
        """Return n copies of every battle, each with a random stream of its own."""
        buffers, rows = jax.tree.map(lambda one: np.repeat(np.asarray(one), n, axis=0), tuple(position))
        games = self._programs.packing.unpack(buffers)
        return Position(jax.vmap(self._programs.packing.pack)(games._replace(key=self._keys(len(games.key)))), rows)

    def is_hit(self, position: Position) -> npt.NDArray[np.bool_]:
        """Return where any unit has lost health, (E,)."""
        battle = self._battle(position)
        return (battle.unit_health < self._programs.env.unit_type_health[battle.unit_types]).any(axis=1)

    def in_reach(self, position: Position) -> npt.NDArray[np.int64]:
        """Return how many units of the team, and of the enemy, have an opponent in reach of their weapons, (E, 2)."""
        battle, n = self._battle(position), len(self._programs.agents)
        distances = np.linalg.norm(battle.unit_positions[:, :, None] - battle.unit_positions[:, None], axis=3)
        reach = np.asarray(self._programs.env.unit_type_attack_ranges)[battle.unit_types]
        shots = (distances < reach[:, :, None]) & battle.unit_alive[:, :, None] & battle.unit_alive[:, None]
        return np.stack([shots[:, :n, n:].any(axis=2).sum(axis=1), shots[:, n:, :n].any(axis=2).sum(axis=1)], axis=1)

    def plan(self, position: Position, n_candidates: int, n_futures: int) -> Array:
        """Return the best of n candidates, the most likely actions and drawn ones, (E, N)."""
        drawn = [self.act(position, deterministic=index == 0) for index in range(n_candidates)]
        candidates = np.stack(drawn, axis=1)
        first = np.repeat(candidates.reshape(-1, candidates.shape[2]), n_futures, axis=0)
        won = self.play(self.copies(position, n_candidates * n_futures), first=first)
        chances = won.reshape(len(candidates), n_candidates, n_futures).mean(axis=2)
        return candidates[np.arange(len(candidates)), chances.argmax(axis=1)]

    def play(
        self,
        position: Position,
        deterministic: bool = True,
        first: Array | None = None,
        planned: tuple[bool, ...] = (),
        planner: tuple[int, int] = (12, 8),
        watch: Callable[[Position, npt.NDArray[np.bool_]], None] = lambda position, is_over: None,
    ) -> npt.NDArray[np.bool_]:
        """
        Play battles to the end.

        :param first: (E, N) first actions in the place of the team's
        :param planned: whether a unit has been hit when the planner acts, see ``PLANNED``
        :param planner: candidates and futures of each
        :param watch: called after each step with the position, and (E,) which battles are over, then new ones follow
        :return: (E,) won
        """
        n = len(position.buffers[0])
        is_over, won = np.zeros(n, bool), np.zeros(n, bool)
        while not is_over.all():
            actions = self.act(position, deterministic) if first is None else first
            first = None
            if planned:
                moment = np.isin(self.is_hit(position), planned) & ~is_over
                actions = np.where(moment[:, None], self.plan(position, *planner), actions)
            buffers, rows, _, results = self._programs.step(position.buffers, actions.astype(np.int32), np.float32(0))
            position = Position(buffers, rows)
            ended, _, victory = (np.asarray(results)[:, actions.shape[1] :] != 0).T
            won |= victory & ~is_over
            is_over |= ended
            watch(position, is_over)
        return won

    def first_contact(self, starts: Position) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float64]]:
        """Return which battles are won, (E,), and ``in_reach`` after the first hit of each, (E, 2)."""
        counts = np.full((len(starts.buffers[0]), 2), np.nan)

        def watch(position: Position, is_over: npt.NDArray[np.bool_]) -> None:
            new = self.is_hit(position) & np.isnan(counts[:, 0]) & ~is_over
            counts[new] = self.in_reach(position)[new]

        return self.play(starts, deterministic=False, watch=watch), counts

    def _battle(self, position: Position) -> Any:
        return self._programs.packing.unpack([np.asarray(one) for one in position.buffers]).state.state

    def _keys(self, n: int) -> npt.NDArray[np.uint32]:
        return self._random.integers(0, 2**32, (n, 2), dtype=np.uint32)


def main() -> None:
    """Print shares of battles won."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.battles", description=__doc__.split("\n\n")[1])
    parser.add_argument("run", type=Path, help="folder of a run on smax/...")
    parser.add_argument("-n", type=int, default=128, help="starts")
    parser.add_argument("--repeats", type=int, default=16, help="battles from each start")
    options = parser.parse_args()
    battles = Battles(options.run, seed=0)
    starts = battles.begin(options.n)
    for deterministic, name in ((False, "drawn"), (True, "most likely")):
        won = battles.play(battles.copies(starts, options.repeats), deterministic)
        chances, share = won.reshape(options.n, -1).mean(axis=1), won.mean()
        by_chance = share * (1 - share) / options.repeats
        print(f"{name} actions: {share:.1%} won; variance over starts {chances.var():.4f}, by chance {by_chance:.4f}")
    won, counts = battles.first_contact(starts)
    own, enemy = np.nanmean(counts, axis=0)
    print(f"{won.mean():.1%} won; at the first hit {own:.1f} units and {enemy:.1f} enemies have an opponent in reach")
    for name, planned in PLANNED.items():
        print(f"planner {name}: {battles.play(starts, planned=planned).mean():.1%} won")


if __name__ == "__main__":
    main()
