"""Curriculum: train on the games of several stages, one stage after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, product
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_saf.teams.checks import check_count
from sb3_saf.teams.rows import ACTIVE_KEY, STAGGERED, TERMINAL_OBSERVATION, TRUNCATED
from sb3_saf.teams.vec_env import TeamVecEnvWrapper


class Stage(NamedTuple):
    """
    One stage of a curriculum.

    :param game_steps: length of the stage in game steps summed over all parallel games
    :param params: parameters of the game that differ from those of the final stage, such as ``{"coordination": 1}``
    """

    game_steps: int
    params: Mapping[str, Any]


class Curriculum(TeamVecEnvWrapper):
    """
    Vector environment that plays the games of several stages in turn; the last stage has no end.

    At the end of a stage, running episodes are truncated as by a time limit, with ``TimeLimit.truncated`` and
    ``terminal_observation`` in their infos; a rollout may therefore span two stages. Evaluations do not count these
    episodes (``"staggered"`` in their infos). Attributes, methods and seeds are those of the games of the present
    stage. Every step counts, also of games for evaluation; :meth:`seed`, which a new model calls, begins anew.

    :param stages: vector environments with equal spaces and rows; closed with this one
    :param game_steps: of every stage but the last, in game steps summed over all parallel games
    :raises ValueError: if the stages do not fit together
    """

    def __init__(self, stages: Sequence[VecEnv], game_steps: Sequence[int]) -> None:
        if len(stages) != len(game_steps) + 1:
            raise ValueError(
                f"expected the game steps of every stage but the last, {len(stages) - 1} numbers, got {len(game_steps)}"
            )
        super().__init__(stages[0])
        self.stages = tuple(stages)
        #: Game steps at which each stage but the last ends.
        self.ends = tuple(accumulate(check_count("game_steps", steps) for steps in game_steps))
        self.stage = 0
        self.game_steps = 0
        for (number, stage), name in product(enumerate(stages), ("num_envs", "observation_space", "action_space")):
            own, first = getattr(stage, name), getattr(stages[0], name)
            if own != first:
                raise ValueError(
                    f"the games of all stages of a curriculum need the same {name}: stage 0 has {first}, stage "
                    f"{number} {own}; let stages differ in what the policy does not depend on, such as coordination"
                )

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Set the seeds of the games of all stages, and begin with the first one; each stage has different seeds, the
        first one those of ``seed``.

        :return: (B,) the seed of each row's game in the first stage
        """
        self.game_steps = 0
        self._enter(0)
        seeds = [seed] * len(self.stages)
        for number in range(1, len(seeds)):  # stages differ, so that they do not repeat each other's levels
            if seed is not None:
                seeds[number] = int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0])
        chosen = [stage.seed(own) for stage, own in zip(self.stages, seeds, strict=True)]
        return chosen[0]

    def step_wait(self) -> VecEnvStepReturn:
        """Play one game step; if the stage ends with it, begin the next one."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self.game_steps += self.n_games
        if self._present_stage() == self.stage:
            return obs, rewards, dones, infos
        shown, playing = [], obs.get(ACTIVE_KEY) if isinstance(obs, dict) else None
        for row, (done, info) in enumerate(zip(dones, infos, strict=True)):
            if not done:  # a running episode is truncated
                last = (
                    {key: part[row].copy() for key, part in obs.items()} if isinstance(obs, dict) else obs[row].copy()
                )
                # Whoever waited, and is back, has an observation.
                goes_on = info.get(ACTIVE_KEY, True) if playing is None else playing[row]
                is_cut = info.get(TRUNCATED, bool(goes_on))
                # An agent that its own time limit stopped in this step has a last observation.
                info = {TERMINAL_OBSERVATION: last, **info, TRUNCATED: is_cut, STAGGERED: True}
            shown.append(info)
        self._enter(self._present_stage())
        return self.venv.reset(), rewards, np.ones_like(dones), shown

    def _present_stage(self) -> int:
        return int(np.searchsorted(self.ends, self.game_steps, side="right"))

    def _enter(self, stage: int) -> None:
        self.stage = stage
        self.venv = self.stages[stage]

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the position in the curriculum, without the state of the games."""
        return {"game_steps": self.game_steps}

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`."""
        self.game_steps = state["game_steps"]
        self._enter(self._present_stage())

    def close(self) -> None:
        """Close the games of all stages."""
        for stage in self.stages:
            stage.close()
