"""Turn-based games as parallel games in which waiting agents have one legal action."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from numbers import Real
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import turn_based_aec_to_parallel

from sb3_saf.teams.conversion import ACTION_MASK, MASK_NAMES

#: Upper limit for seeds of OpenSpiel's generators and NumPy's older one.
_SEEDS: Final = 2**31


class TurnsInParallel(BaseParallelWrapper[Any, Any, Any]):
    """
    ParallelEnv for ``make_team_env`` around a turn-based game (PettingZoo's AEC form: Connect Four, Hanabi, ...).

    At each step one agent moves. All others have one legal action, 0, which is ignored; their mask allows nothing else,
    so that they learn nothing from it. The mask is where the game has it, in observations of the form {"observation",
    "action_mask"} or in infos; a game without masks gets them in ``infos[agent]["action_mask"]``, with all actions
    legal for the agent that moves.

    ::

        env = sb3_saf.make_team_env(lambda: sb3_saf.TurnsInParallel(hanabi_v5.env(colors=2, players=2)), n_envs=16)

    Seeds are taken modulo 2^31. After a game with a seed, those that follow draw theirs from it, so that they repeat
    also where the game itself would begin at random. Rewards come at the step at which the game gives them, also to
    agents that wait; a warning says if their sum until an agent's next turn is not what the game's ``last`` gives it
    then.

    :param env: an AECEnv whose agents act one after another, with Discrete actions
    :raises ValueError: if it is no AECEnv, or its actions are not Discrete
    """

    def __init__(self, env: AECEnv[Any, Any, Any]):
        if not isinstance(env, AECEnv):
            name = getattr(env, "__name__", type(env).__name__)
            raise ValueError(
                f"expected a PettingZoo AECEnv, whose agents take turns, got {name}; pass what the module's env() "
                "returns, for instance TurnsInParallel(connect_four_v3.env())"
            )
        super().__init__(turn_based_aec_to_parallel(env))
        self._aec = env
        self._rng: np.random.Generator | None = None
        #: By agent: rewards since its last turn began; None after the warning that ``last`` gives others.
        self._paid: Counter[Any] | None = Counter()
        self._n_actions: dict[Any, int] = {}
        for agent in env.possible_agents:
            space = env.action_space(agent)
            if not isinstance(space, spaces.Discrete):
                raise ValueError(f"taking turns needs Discrete actions, of which 0 is to wait, got {space} of {agent}")
            self._n_actions[agent] = int(space.n)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin a game (see PettingZoo)."""
        if seed is not None:
            seed %= _SEEDS
            self._rng = np.random.default_rng(seed)
        elif self._rng is not None:
            seed = int(self._rng.integers(_SEEDS))
        observations, infos = super().reset(seed, options)
        self._paid = None if self._paid is None else Counter()
        return self._with_masks(observations, infos)

    def step(self, actions: dict[Any, Any]) -> Any:
        """Play the move of the agent whose turn it is; actions of waiting agents are ignored."""
        mover = self._aec.agent_selection
        observations, rewards, terminations, truncations, infos = super().step(actions)
        self._check_paid(mover, rewards)
        if any(terminations.values()) or any(truncations.values()):
            # PettingZoo observes before the turns of agents that have ended, which are then skipped.
            observations = {**observations, **{agent: self._aec.observe(agent) for agent in self._aec.agents}}
            infos = {**infos, **{agent: self._aec.infos[agent] for agent in self._aec.agents}}
        observations, infos = self._with_masks(observations, infos)
        return observations, rewards, terminations, truncations, infos

    def _check_paid(self, mover: Any, rewards: Mapping[Any, Any]) -> None:
        """Warn once if the agent whose turn it is has been paid another sum than the game's ``last`` says."""
        if self._paid is None or not all(isinstance(reward, (Real, np.ndarray)) for reward in rewards.values()):
            return  # what is no number is refused where rows are made
        self._paid[mover] = 0
        self._paid.update(rewards)
        agent = self._aec.agent_selection
        if agent not in self._aec.agents:
            return
        owed = float(self._aec.last(observe=False)[1])
        if not np.isclose(owed, self._paid[agent], rtol=1e-4, atol=1e-6):
            warnings.warn(
                f"{agent} is paid {float(self._paid[agent])}, the sum of the game's rewards since its last turn, but "
                f"last() of the game says {owed}: let its step clear self.rewards, set them, and call "
                "self._accumulate_rewards(), as PettingZoo's games do",
                UserWarning,
                stacklevel=2,
            )
            self._paid = None

    def _with_masks(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any]
    ) -> tuple[dict[Any, Any], dict[Any, Any]]:
        """Return observations and infos with the mask of each agent; the game's own dicts are unchanged."""
        shown, told = dict(observations), {agent: dict(info) for agent, info in infos.items()}
        for agent, observation in observations.items():
            given = observation if isinstance(observation, Mapping) else {}
            key = next((name for name in MASK_NAMES if name in given), None)
            if key is not None:
                shown[agent] = {**given, key: self._mask(agent, given[key])}
            else:
                own = told.setdefault(agent, {})
                key = next((name for name in MASK_NAMES if own.get(name) is not None), ACTION_MASK)
                own[key] = self._mask(agent, own.get(key))
        return shown, told

    def _mask(self, agent: Any, mask: Any) -> npt.NDArray[Any]:
        """Return the mask (A,) of an agent; ``mask`` is the game's own, None if it has none."""
        if agent == self._aec.agent_selection:
            return np.ones(self._n_actions[agent], np.int8) if mask is None else np.asarray(mask)
        wait = np.zeros(self._n_actions[agent], np.int8 if mask is None else np.asarray(mask).dtype)
        wait[0] = 1
        return wait
