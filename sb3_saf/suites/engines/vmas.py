"""Games of VMAS, batched in torch."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
    warnings.simplefilter("ignore")  # gym, from which VMAS imports its spaces, recommends gymnasium
    import vmas
    from vmas.simulator.environment import Environment

from sb3_saf.suites.engines.batch import Batch, BatchStep, BatchVecEnv
from sb3_saf.teams.rows import ACTION_MASK_KEY, ACTIVE_KEY, OBS_KEY, Array, TeamSpaces

_ONE_AGENT: Final = "simple"
#: Text of VMAS's warning about unknown parameters of a scenario.
_UNUSED: Final = "not used by the scenario"
#: Options of ``vmas.make_env`` on which rows depend.
_SET: Final = {"wrapper", "dict_spaces", "multidiscrete_actions", "clamp_actions", "terminated_truncated"}


def scenarios() -> list[str]:
    """Return the names of the scenarios for teams."""
    return [*vmas.scenarios, *(name for name in vmas.mpe_scenarios if name != _ONE_AGENT)]


class VmasGames(Batch):
    """
    E games of a scenario.

    VMAS has one random state for all environments; each batch sets its own one during a call.

    :param env: environment of VMAS, with ``terminated_truncated=True``
    """

    def __init__(self, env: Any) -> None:
        self._random: list[Any] = list(Environment.vmas_random_state)
        agents = [agent.name for agent in env.agents]
        self._action_spaces = [env.get_agent_action_space(agent) for agent in env.agents]
        self._width = max(sum(_flat(part).shape[1] for part in _parts(one)) for one in _observe(env))
        own = spaces.Box(-np.inf, np.inf, (self._width,), np.float32)
        action_space, self._masks = _row_actions(self._action_spaces)
        n_masked = None if self._masks is None else self._masks.shape[1]
        super().__init__(env.num_envs, agents, TeamSpaces(own, len(agents), True, n_masked), action_space, env)

    @contextlib.contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Set VMAS's random state to this batch's temporarily."""
        shared = Environment.vmas_random_state
        kept = list(shared)
        shared[:] = self._random
        try:
            yield
        finally:
            self._random = list(shared)
            shared[:] = kept

    def reset(self, seeds: Sequence[int] | None) -> dict[str, Array]:
        """Begin an episode in every game; the first seed is used for the batch (see the base class)."""
        with self._own_randomness(), _gpus_left_alone(self.env.device):
            observations = self.env.reset(seed=None if seeds is None else seeds[0] % 2**32)
        return self._rows(observations, np.ones(self.n_games, dtype=bool))

    def shorten(self) -> npt.NDArray[np.bool_]:
        """Cut the episodes that have just begun (see the base class)."""
        if self.env.max_steps is None:
            return super().shorten()
        self.env.steps[:] = th.arange(self.n_games) * self.env.max_steps // self.n_games
        return (self.env.steps > 0).numpy(force=True)

    def step(self, actions: Array) -> BatchStep:
        """Step every game (see the base class)."""
        with self._own_randomness():
            observations, rewards, terminated, limited, _ = self.env.step(self._chosen(actions))
            truncated = (limited & ~terminated).numpy(force=True)
            ended = (limited | terminated).numpy(force=True)
            rows = last = self._rows(observations, ~ended | truncated)
            if ended.all():
                rows = self._rows(self.env.reset(), ended)
            elif ended.any():
                for game in np.flatnonzero(ended).tolist():
                    self.env.reset_at(game, return_observations=False)
                rows = self._rows(_observe(self.env), np.ones_like(ended))
        return BatchStep(rows, th.stack(rewards, dim=1).numpy(force=True), ended, truncated, last)

    def _chosen(self, actions: Array) -> list[th.Tensor]:
        """Return the agents' actions, limited to their own spaces; actions that an agent lacks become its first."""
        chosen = []
        by_agent = th.from_numpy(actions).to(self.env.device).unbind(1)
        for own, space in zip(by_agent, self._action_spaces, strict=True):
            if self._masks is not None:
                own = th.where(own < space.n, own, 0)
            chosen.append(own[:, : space.shape[0]] if space.shape else own.unsqueeze(1))
        return chosen

    def _rows(self, observations: Sequence[Any], active: npt.NDArray[np.bool_]) -> dict[str, Array]:
        """Return rows (B, ...); in each game either all agents are active or none."""
        own = np.zeros((self.n_games, len(self.agents), self._width), dtype=np.float32)
        for index, one in enumerate(observations):
            parts = [_flat(part).numpy(force=True) for part in _parts(one)]
            np.concatenate(parts, axis=1, out=own[:, index, : sum(part.shape[1] for part in parts)])
        rows = {OBS_KEY: own.reshape(-1, self._width), ACTIVE_KEY: active.repeat(len(self.agents))}
        if self._masks is not None:
            rows[ACTION_MASK_KEY] = np.tile(self._masks, (self.n_games, 1))
        return rows

    def picture(self, game: int) -> npt.NDArray[np.uint8]:
        """Return VMAS's picture of a game; needs a display, or EGL (see the base class)."""
        with self._own_randomness():
            return np.asarray(self.env.render(mode="rgb_array", env_index=game), dtype=np.uint8)


def _gpus_left_alone(device: str | th.device) -> AbstractContextManager[None]:
    """Keep the random states of GPUs: VMAS seeds them, too, and only games on a GPU draw from them."""
    return th.random.fork_rng(range(th.cuda.device_count()) if th.device(device).type == "cpu" else ())


def _observe(env: Any) -> list[Any]:
    found = env.get_from_scenario(get_observations=True, get_rewards=False, get_infos=False, get_dones=False)
    return list(found[0])


def _parts(observation: Any) -> Iterator[th.Tensor]:
    """Yield the tensors of an agent's observation, each (E, ...)."""
    if isinstance(observation, dict):
        for part in observation.values():
            yield from _parts(part)
    else:
        yield observation


def _flat(part: th.Tensor) -> th.Tensor:
    return part.reshape(len(part), -1)


def _row_actions(own: Sequence[Any]) -> tuple[spaces.Space[Any], npt.NDArray[np.int8] | None]:
    """Return the action space of a row, and the actions of each agent (N, A), None if all agents have all."""
    if not own[0].shape:
        counts = np.array([space.n for space in own])
        masks = (np.arange(counts.max()) < counts[:, np.newaxis]).astype(np.int8)
        return spaces.Discrete(int(counts.max())), None if masks.all() else masks
    width = max(space.shape[0] for space in own)
    low, high = (np.zeros((len(own), width), dtype=np.float32) for _ in range(2))
    for index, space in enumerate(own):
        low[index, : space.shape[0]], high[index, : space.shape[0]] = space.low, space.high
    return spaces.Box(low.min(axis=0), high.max(axis=0)), None


def vec_env(
    scenario: str,
    n_envs: int,
    seed: int | None,
    *,
    state: bool = False,
    render_mode: str | None = None,
    stagger: bool = False,
    max_steps: int | None = None,
    continuous_actions: bool = True,
    device: str = "cpu",
    **params: Any,
) -> BatchVecEnv:
    """
    Make games of a scenario.

    :param state: must be False: VMAS has no state of the game
    :param render_mode: None or ``"rgb_array"``
    :param max_steps: time limit in game steps; None for none
    :param continuous_actions: whether actions are forces, or indices of directions
    :param device: torch device of the games
    :raises ValueError: for an unknown parameter, or if a state is requested
    """
    if state:
        raise ValueError(f"vmas/{scenario} tells no state of the game; leave state=True out")
    if max_steps is not None and not max_steps >= 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}; None for no limit")
    if given := sorted(params.keys() & _SET):
        raise ValueError(f"vmas/{scenario} has {', '.join(given)} as rows need it; leave it out")
    with warnings.catch_warnings(record=True) as said, _gpus_left_alone(device):
        warnings.simplefilter("always")
        env = vmas.make_env(
            scenario,
            n_envs,
            device=device,
            continuous_actions=continuous_actions,
            max_steps=max_steps,
            seed=0,
            clamp_actions=True,
            terminated_truncated=True,
            **params,
        )
    for warning in said:
        if _UNUSED in str(warning.message):
            raise ValueError(f"vmas/{scenario} cannot be made with {params}: {warning.message}")
    return BatchVecEnv(VmasGames(env), seed, render_mode, stagger)
