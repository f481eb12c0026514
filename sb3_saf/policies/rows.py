"""How policies read rows that carry their team's joint view. Letters: B rows, N agents, K views, A actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_saf.envs.teams import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    OBS_KEY,
    TEAM_KEY,
    TeamSpaces,
)
from sb3_saf.networks.gather import gather
from sb3_saf.networks.views import ViewEncoder
from sb3_saf.policies.parts import check_at_least_one

#: For those who pass what a PettingZoo environment gives.
_HOW_TO_STACK: Final = (
    ". Of observations by agent, as a ParallelEnv gives them, pass one agent's, model.predict(observations[{0!r}]), or "
    "stack them, model.predict(np.stack(list(observations.values()))): row i of the actions is then that of the i-th "
    "agent. sb3_saf.export_actors gives each agent an actor of its own"
)

#: How PettingZoo's environments give masks.
_CLASSIC: Final = {"observation", ACTION_MASK_KEY}


class TeamRowsPolicy(BasePolicy):
    """
    Base of everything that acts on rows of teams: it knows their parts, and encodes each distinct view once.

    Subclasses call :meth:`_read_rows_of` before they call SB3's constructor.
    """

    team_spaces: TeamSpaces
    views: ViewEncoder
    encode_once: bool
    chunk_size: int | None

    def _read_rows_of(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        encode_once: bool,
        chunk_size: int | None,
    ) -> None:
        """
        Take the spaces apart.

        :param observation_space: Dict of ``obs``, ``team``, ``agent``, and perhaps ``active``, ``action_mask``,
            ``state``
        :param action_space: one agent's action space
        :param encode_once: False encodes every row, which gives the same numbers slowly
        :param chunk_size: views encoded at once on the CPU, few enough for the cache; None for all
        :raises ValueError: if the space is not that of a team
        """
        if chunk_size is not None:
            check_at_least_one("chunk_size", chunk_size)
        self.team_spaces = TeamSpaces.from_observation_space(observation_space)
        _check_masks(self.team_spaces, action_space)
        self.chunk_size = chunk_size
        self.encode_once = encode_once
        self.views = ViewEncoder(self._encode, encode_once)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Make the encoder, for the observations of one agent."""
        return self.features_extractor_class(self.team_spaces.own, **self.features_extractor_kwargs)

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor | None = None) -> th.Tensor:
        """
        Encode own observations.

        :param obs: rows, or own observations alone
        :param features_extractor: must be the policy's own, or None
        :return: (B, d)
        """
        if features_extractor is not None and features_extractor is not self.features_extractor:
            raise ValueError("a team policy encodes with its own features_extractor; call the other extractor directly")
        own = self.views.own(self._own(obs))
        return gather(own.features, own.rows)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        Make tensors of NumPy observations.

        :param observation: rows, some of their entries, or own observations alone; a batch or a single one. Where
            there are masks, also in PettingZoo's form {"observation", "action_mask"}
        :return: dict of tensors with a batch axis, and whether the observation was a batch
        """
        entries = observation if isinstance(observation, Mapping) else {OBS_KEY: observation}
        if set(entries) == _CLASSIC and self.team_spaces.action_mask is not None:
            entries = {OBS_KEY: entries["observation"], ACTION_MASK_KEY: entries[ACTION_MASK_KEY]}
        keys = self.team_spaces.keys
        unknown = [key for key in entries if key not in keys]
        if unknown:
            hint = _HOW_TO_STACK.format(unknown[0]) if len(unknown) == len(entries) else ""
            raise ValueError(
                f"expected observations with the keys {', '.join(map(repr, keys))}, got {unknown[0]!r}{hint}"
            )
        arrays = {key: np.asarray(value) for key, value in entries.items()}
        if AGENT_KEY in arrays:
            arrays[AGENT_KEY] = self._checked_agent(arrays[AGENT_KEY])
        tensors, is_batch = super().obs_to_tensor(arrays)
        assert isinstance(tensors, dict)
        if len({len(tensor) for tensor in tensors.values()}) > 1:
            lengths = ", ".join(f"{key!r} {len(tensor)}" for key, tensor in tensors.items())
            raise ValueError(f"expected as many rows under each key of an observation, got {lengths}")
        return tensors, is_batch

    # --- reading rows -----------------------------------------------------------------------------------------------

    def _own(self, obs: PyTorchObs) -> th.Tensor:
        """(B, *shape) own observations."""
        own = obs if isinstance(obs, th.Tensor) else entry_of(obs, OBS_KEY, "the actor")
        return own.reshape(-1, *self.team_spaces.own_shape)

    def _team(self, obs: PyTorchObs) -> th.Tensor:
        """(B, N, *shape) joint observations."""
        return entry_of(obs, TEAM_KEY, "the critic").reshape(-1, *self.team_spaces.team.shape)

    def _agent(self, obs: PyTorchObs) -> th.Tensor:
        """(B,) agents' indices; buffers give them as (B, 1), some as floats."""
        return entry_of(obs, AGENT_KEY, "a critic or head that depends on the agent").reshape(-1).long()

    def _active(self, obs: PyTorchObs) -> th.Tensor | None:
        """(B, N) bool, agents of the rows' teams that take part; None if all always do."""
        if self.team_spaces.active is None:
            return None
        return entry_of(obs, ACTIVE_KEY, "the critic").reshape(-1, self.team_spaces.n_agents) != 0

    def _action_mask(self, obs: PyTorchObs, padded: bool = False) -> th.Tensor | None:
        """(B, A) bool, the rows' legal actions; None if all always are. Only rows of a padding may have none."""
        if self.team_spaces.action_mask is None:
            return None
        if isinstance(obs, th.Tensor) or ACTION_MASK_KEY not in obs:
            raise ValueError(
                f"expected {ACTION_MASK_KEY!r} beside {OBS_KEY!r}, because this policy was made for an environment "
                f"with action masks; pass {{{OBS_KEY!r}: ..., {ACTION_MASK_KEY!r}: ...}}, one mask of "
                f"{self.team_spaces.action_mask.n} zeros and ones per row"
            )
        mask = obs[ACTION_MASK_KEY].reshape(-1, *self.team_spaces.action_mask.shape) != 0
        stuck = ~mask.any(dim=1)
        if not padded and stuck.any():
            raise ValueError(
                f"expected at least one legal action in each {ACTION_MASK_KEY!r}, got none in row "
                f"{int(stuck.nonzero()[0])} of {len(mask)}"
            )
        return mask

    def _checked_agent(self, agent: np.ndarray) -> np.ndarray:
        n_agents = self.team_spaces.n_agents
        agent = agent[:, 0] if agent.ndim == 2 and agent.shape[1] == 1 else agent
        if agent.size and (agent.min() < 0 or agent.max() >= n_agents):
            raise ValueError(f"{AGENT_KEY!r} must be in 0..{n_agents - 1}, got {agent}")
        return agent

    def _encode(self, observations: th.Tensor) -> th.Tensor:
        """(K, d) features of own observations (K, *shape)."""
        return self._in_chunks(self.features_extractor, observations, self.team_spaces.own)

    def _in_chunks(
        self, module: Callable[[Any], th.Tensor], observations: th.Tensor, space: spaces.Space[Any]
    ) -> th.Tensor:
        """(K, ...) what a module makes of preprocessed observations (K, *shape)."""
        on_cpu = observations.device.type == "cpu"
        parts = th.split(observations, self.chunk_size if self.chunk_size and on_cpu else max(1, len(observations)))
        results = [module(preprocess_obs(part, space, self.normalize_images)) for part in parts]
        return results[0] if len(results) == 1 else th.cat(results)


def _check_masks(team: TeamSpaces, action_space: spaces.Space[Any]) -> None:
    mask = team.action_mask
    if mask is not None and not (isinstance(action_space, spaces.Discrete) and mask.n == action_space.n):
        raise ValueError(
            f"expected {ACTION_MASK_KEY!r} to be MultiBinary(A) where actions are Discrete(A), got {mask} for "
            f"{action_space}"
        )


def entry_of(obs: PyTorchObs, key: str, reader: str) -> th.Tensor:
    """A part of rows, or the complaint that ``reader`` cannot do without it."""
    if isinstance(obs, th.Tensor) or key not in obs:
        raise ValueError(
            f"expected the observation to have {key!r}, which {reader} reads, got "
            f"{'an array' if isinstance(obs, th.Tensor) else ', '.join(map(repr, obs))}; pass whole rows of "
            "sb3_saf.CentralizedValueWrapper"
        )
    return obs[key]


def pop_named(kwargs: dict[str, Any], names: set[str]) -> dict[str, Any]:
    """Take named entries out of ``kwargs``."""
    return {name: kwargs.pop(name) for name in list(kwargs) if name in names}
