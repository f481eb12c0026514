"""Reading of rows of teams. Letters: B rows, N agents, K unique own observations, A actions, d features."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_saf.buffers.rollout import TeamMinibatch
from sb3_saf.networks.encoders import encoded
from sb3_saf.networks.row_encoder import EncodedRows, EncodedTeams, RowEncoder
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.conversion import CLASSIC, Given, RowForm, check_form_of_state, given_by_game, pixels_to_codes
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    ALL_KEYS,
    EPISODE_START_KEY,
    OBS_KEY,
    STATE_KEY,
    TEAM_KEY,
    TeamSpaces,
    TerminalRow,
    check_masks,
)

Observation = np.ndarray | Mapping[str, Any]
ChunkSize: TypeAlias = int | Literal["auto"] | None
_CHUNK_OF_CONVOLUTIONS: Final = 512


class TeamRowsPolicy(BasePolicy):
    """
    Base of all policies on rows of teams: reads their entries and encodes them.

    Subclasses call :meth:`_read_rows_of` before they call SB3's constructor.
    """

    team_spaces: TeamSpaces
    row_encoder: RowEncoder
    encode_once: bool | None
    chunk_size: ChunkSize

    def _read_rows_of(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        encode_once: bool | None,
        chunk_size: ChunkSize,
    ) -> None:
        """Read the spaces; arguments and errors as in :class:`~sb3_saf.policies.base.TeamPolicy`."""
        if chunk_size is not None and chunk_size != "auto":
            check_count("chunk_size", chunk_size)
        self.team_spaces = TeamSpaces.from_observation_space(observation_space)
        check_masks(self.team_spaces.action_mask, action_space)
        self.chunk_size = chunk_size
        self.encode_once = encode_once
        whole_numbers = np.issubdtype(self.team_spaces.team.dtype, np.integer)
        self.row_encoder = RowEncoder(self._encode, whole_numbers if encode_once is None else encode_once)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """
        Make the encoder for one agent's observations.

        :raises ValueError: if its class does not support their space
        """
        own, kind = self.team_spaces.own, self.features_extractor_class
        try:
            if hasattr(own, "atlas") and issubclass(kind, FlattenExtractor):
                raise RuntimeError("it would read tile codes as magnitudes")
            return kind(own, **self.features_extractor_kwargs)
        except (AssertionError, AttributeError, RuntimeError) as error:
            raise ValueError(
                f"expected a features_extractor_class that encodes one agent's own observation, {own}, but "
                f"{kind.__name__} does not take it ({str(error).splitlines()[0]}); leave it out (ObservationEncoder "
                "chooses by the space), or pass sb3_saf.LightEncoder, MLPEncoder, or a BaseFeaturesExtractor for that "
                "space. SB3's CombinedExtractor is for Dict observations, whose entries policies of teams take apart"
            ) from error

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor | None = None) -> th.Tensor:
        """
        Encode own observations.

        :param obs: rows, or only own observations
        :param features_extractor: must be the policy's own, or None
        :return: (B, d)
        """
        if features_extractor is not None and features_extractor is not self.features_extractor:
            raise ValueError("a team policy encodes with its own features_extractor; call the other extractor directly")
        return self.encode_own(obs).of_rows()

    # --- inputs of predict ------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[Any, Any]:
        """
        Act as SB3's ``predict``: on rows, or on what the game itself gives.

        :param observation: rows, some of their entries, or only own observations; or the game's own

            - ``{agent: observation}`` of some or all agents in any order, as ``reset`` and ``step`` of a ParallelEnv
              give them. Without names (some engines have none), an actor that reads the index needs all agents in index
              order
            - ``(observations, infos)``, both by agent, where action masks are in infos
            - one agent's observation, if its form tells which kind of agent it is; an actor that depends on the agent
              needs ``{agent: observation}``

            The game's Dicts, Tuples, unequal spaces and channel-last pictures become rows as in ``make_team_env``, and
            actions are those of the game. A model trained on tile codes also takes the pixels of the same game
        :param state: what agents with memory remember, as in SB3; of observations by agent, the state returned for the
            step before, ``{agent: state}``. None where episodes begin; agents that it lacks begin
        :param episode_start: as in SB3, of observations by agent also ``{agent: bool}``
        :param deterministic: as in SB3
        :param action_masks: of policies with masks in the form of the observation, or one for all agents, with None for
            an agent that may do everything; of MaskablePPO's also for rows. An action must be allowed by those in
            observations and infos, too
        :return: actions and the next state; ``{agent: action}`` for observations by agent
        :raises ValueError: for masks that the policy cannot take, and for states and starts of other rows
        """
        given = self.given_by_game(observation, action_masks)
        if given is not None:
            return given.act(self._predict_rows, state, episode_start, deterministic)
        check_form_of_state(False, state, episode_start)
        if isinstance(observation, Mapping):  # critics' entries have shapes that depend on the size of the team
            unread = {TEAM_KEY, ACTIVE_KEY, STATE_KEY} | (set() if self.acts_by_index else {AGENT_KEY})
            observation = {key: value for key, value in observation.items() if key not in unread}
        if action_masks is None:
            return self._predict_rows(observation, state, episode_start, deterministic)
        if not isinstance(self, MaskableActorCriticPolicy):
            raise ValueError(f"expected masks of actions in the rows, as {ACTION_MASK_KEY!r}, got action_masks")
        return self._predict_rows(observation, state, episode_start, deterministic, action_masks=action_masks)

    def given_by_game(self, observation: Any, action_masks: Any = None) -> Given | None:
        """Convert what a game gives to rows (see :meth:`predict`); None for rows."""
        team = self.team_spaces
        has_masks = team.action_mask is not None
        form = RowForm(team.n_agents, team.names, team.conversions, team.own_shape, has_masks, ALL_KEYS)
        takes_masks = has_masks or isinstance(self, MaskableActorCriticPolicy)
        return given_by_game(form, observation, action_masks, takes_masks)

    def _predict_rows(
        self, rows: Any, state: Any, episode_start: np.ndarray | None, deterministic: bool, **kwargs: Any
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Act on rows, as SB3's ``predict``."""
        return super().predict(rows, state, episode_start, deterministic, **kwargs)

    @property
    def acts_by_index(self) -> bool:
        """Whether actions depend on the agent's index; otherwise the policy acts in teams of any size."""
        return True

    def obs_to_tensor(self, observation: Observation) -> tuple[PyTorchObs, bool]:
        """
        Convert NumPy observations to tensors.

        :param observation: rows, some of their entries, or only own observations; a batch or a single one. With masks,
            also in PettingZoo's form {"observation", "action_mask"}
        :return: dict of tensors with a batch axis, and whether the observation was a batch
        """
        entries = observation if isinstance(observation, Mapping) else {OBS_KEY: observation}
        keys = self.team_spaces.keys
        if set(entries) == CLASSIC and ACTION_MASK_KEY in keys:
            entries = {OBS_KEY: entries["observation"], ACTION_MASK_KEY: entries[ACTION_MASK_KEY]}
        unknown = [key for key in entries if key not in keys]
        if unknown:
            raise ValueError(f"expected observations with the keys {', '.join(map(repr, keys))}, got {unknown[0]!r}")
        arrays = {key: np.asarray(value) for key, value in entries.items()}
        if OBS_KEY in arrays:
            arrays[OBS_KEY] = own_observations(arrays[OBS_KEY], self.team_spaces.own)
        if AGENT_KEY in arrays:
            agent, n_agents = arrays[AGENT_KEY], self.team_spaces.n_agents
            agent = arrays[AGENT_KEY] = agent[:, 0] if agent.ndim == 2 and agent.shape[1] == 1 else agent
            if agent.size and (agent.min() < 0 or agent.max() >= n_agents):
                raise ValueError(
                    f"{AGENT_KEY!r} must be in 0..{n_agents - 1}, got {agent}: this policy depends on the index of an "
                    f"agent, and was trained with {n_agents}"
                )
        tensors, is_batch = super().obs_to_tensor(arrays)
        assert isinstance(tensors, dict)
        if isinstance(observation, TerminalRow):
            tensors = TerminalRow(tensors, observation.row)
        if len({len(tensor) for tensor in tensors.values()}) > 1:
            lengths = ", ".join(f"{key!r} {len(tensor)}" for key, tensor in tensors.items())
            raise ValueError(f"expected as many rows under each key of an observation, got {lengths}")
        return tensors, is_batch

    # --- entries of rows --------------------------------------------------------------------------------------------

    def _own(self, obs: PyTorchObs) -> th.Tensor:
        """Return own observations, (B, *shape)."""
        own = obs if isinstance(obs, th.Tensor) else entry_of(obs, OBS_KEY, "the actor")
        return own.reshape(-1, *self.team_spaces.own_shape)

    def _team(self, obs: PyTorchObs) -> th.Tensor:
        """Return joint observations, (B, N, *shape)."""
        return entry_of(obs, TEAM_KEY, "the critic").reshape(-1, *self.team_spaces.team.shape)

    def _agent(self, obs: PyTorchObs) -> th.Tensor:
        """Return the agents' indices, (B,); buffers store them as (B, 1), some as floats."""
        return entry_of(obs, AGENT_KEY, "an actor or critic that depends on the agent").reshape(-1).long()

    def _active(self, obs: PyTorchObs) -> th.Tensor | None:
        """Return the active agents of the rows' teams, (B, N) bool; None if all always are."""
        if self.team_spaces.active is None:
            return None
        return entry_of(obs, ACTIVE_KEY, "the critic").reshape(-1, self.team_spaces.n_agents) != 0

    def _takes_part(self, obs: PyTorchObs) -> th.Tensor | None:
        """Return whether the rows' own agents are active, (B, 1) bool; None if all always are."""
        active = self._active(obs)
        return None if active is None else active.gather(1, self._agent(obs).unsqueeze(1))

    def _starts(self, obs: PyTorchObs, episode_start: Any = None) -> th.Tensor:
        """Return the rows whose episode begins, (B,) bool: by ``episode_start`` (B,) or their own entry."""
        n_rows = len(self._own(obs))
        starts = th.zeros(n_rows, dtype=th.bool, device=self.device)
        if not isinstance(obs, th.Tensor) and EPISODE_START_KEY in obs:
            starts = obs[EPISODE_START_KEY].reshape(-1) != 0
        if episode_start is not None:
            begins = np.reshape(episode_start, -1).astype(bool)
            if len(begins) not in (1, n_rows):
                raise ValueError(f"expected episode_start of {n_rows} rows, one for each agent, got {len(begins)}")
            starts = starts | th.as_tensor(begins, device=self.device)
        return starts

    def _action_mask(self, obs: PyTorchObs) -> th.Tensor | None:
        """Return the rows' legal actions, (B, A) bool; None if all always are."""
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
        if stuck.any():
            raise ValueError(
                f"expected at least one legal action in each {ACTION_MASK_KEY!r}, got none in row "
                f"{int(stuck.nonzero()[0])} of {len(mask)}"
            )
        return mask

    # --- encoding ---------------------------------------------------------------------------------------------------

    def encode_own(self, obs: PyTorchObs) -> EncodedRows:
        """Encode the own observations of rows, or plain own observations."""
        return self.row_encoder.rows(self._own(obs))

    def encode_teams(self, obs: PyTorchObs, of_step: bool = False) -> tuple[EncodedRows, EncodedTeams]:
        """
        Encode the rows' own observations and those of their teams.

        Whole teams (minibatches of TeamRolloutBuffer, rows of a step) are used directly. In SB3's shuffled minibatches,
        teams are found by their joint observation.

        :param of_step: whether rows in the order of whole teams are those of a step of the environment, where one joint
            observation of each team is compared with its rows; otherwise, all of them
        """
        if isinstance(obs, TeamMinibatch):
            observations, rows, active, _ = obs.teams
            members = self.row_encoder.rows(observations.flatten(0, 1))
            own = members if rows is None else members.at(rows)
            arranged = members.arranged(observations.shape[:2])
            return own, EncodedTeams(members.features, arranged, rows, active)
        own, active = self.encode_own(obs), self._active(obs)
        if not self._are_whole_teams(obs, of_step):
            return own, self.row_encoder.joint_rows(self._team(obs), self._agent(obs), own, active)
        n_agents = self.team_spaces.n_agents
        teams = own.arranged((own.n_rows // n_agents, n_agents))
        return own, EncodedTeams(own.features, teams, None, None if active is None else active[::n_agents])

    def _are_whole_teams(self, obs: PyTorchObs, of_step: bool) -> bool:
        """Return whether rows are whole teams with agents in index order, as in a step of all games."""
        n_agents, team, agent, own = self.team_spaces.n_agents, self._team(obs), self._agent(obs), self._own(obs)
        if len(agent) % n_agents or team.requires_grad or own.dtype != team.dtype:
            return False
        n_teams, shape = len(agent) // n_agents, self.team_spaces.own_shape
        in_order = th.arange(n_agents, device=agent.device).expand(n_teams, -1)
        if not th.equal(agent.view(n_teams, n_agents), in_order):
            return False
        if of_step:  # one row of each team has all of it: wrappers may have changed own observations since
            return th.equal(own.view(n_teams, n_agents, *shape), team[::n_agents])
        active = self._active(obs)
        if active is not None:
            by_team = active.view(n_teams, n_agents, n_agents)
            if not th.equal(by_team, by_team[:, :1].expand_as(by_team)):
                return False
        by_team = team.view(n_teams, n_agents, n_agents, *shape)
        return th.equal(by_team, own.view(n_teams, 1, n_agents, *shape).expand_as(by_team))

    def _encode(self, observations: th.Tensor) -> th.Tensor:
        """Return features (K, d) of own observations (K, *shape)."""
        return self._in_chunks(self.features_extractor, observations, self.team_spaces.own)

    def _in_chunks(
        self, module: Callable[[Any], th.Tensor], observations: th.Tensor, space: spaces.Space[Any]
    ) -> th.Tensor:
        """Return outputs (K, ...) of a module for observations (K, *shape), as SB3 preprocesses them."""
        size = _CHUNK_OF_CONVOLUTIONS if self.chunk_size == "auto" else self.chunk_size
        is_cut = observations.device.type == "cpu" and size is not None and len(observations) > size
        if is_cut and self.chunk_size == "auto":
            is_cut = isinstance(module, nn.Module) and any(isinstance(one, nn.Conv2d) for one in module.modules())
        if size is None or not is_cut:
            return encoded(module, observations, space, self.normalize_images)
        parts = th.split(observations, size)
        return th.cat([encoded(module, part, space, self.normalize_images) for part in parts])


def own_observations(observation: np.ndarray, space: spaces.Space[Any]) -> np.ndarray:
    """
    Return own observations for ``predict``; a model trained on tile codes also takes the game's pixels.

    :raises ValueError: for NaN, and for tile codes that the atlas lacks
    """
    atlas = getattr(space, "atlas", None)
    if atlas is not None:
        height, width = (cells * atlas.shape[1] for cells in space.shape or ())
        if observation.shape[-3:] in ((height, width, atlas.shape[3]), (atlas.shape[3], height, width)):
            observation = pixels_to_codes(observation, atlas).astype(space.dtype)
    if observation.dtype.kind == "f" and not np.isfinite(observation).all():
        raise ValueError(f"{OBS_KEY!r} must be finite, got {observation[~np.isfinite(observation)][0]}")
    if atlas is not None and observation.shape[-2:] == space.shape:
        largest = observation.max(initial=0)
        if observation.min(initial=0) < 0 or largest >= len(atlas):
            raise ValueError(f"{OBS_KEY!r} must be tile codes in 0..{len(atlas) - 1}, got {largest}")
    return observation


def entry_of(obs: PyTorchObs, key: str, reader: str) -> th.Tensor:
    """Return an entry of rows, or raise an error that ``reader`` needs it."""
    if isinstance(obs, th.Tensor) or (key not in obs and not isinstance(obs, TeamMinibatch)):
        index = f", {{{OBS_KEY!r}: ..., {AGENT_KEY!r}: its index}}, or the observations of all agents by name"
        keys = "an array" if isinstance(obs, th.Tensor) else ", ".join(map(repr, obs)) or "nothing that it reads"
        raise ValueError(
            f"expected the observation to have {key!r}, which {reader} reads, got {keys}; pass whole rows of "
            f"sb3_saf.CentralizedValueWrapper{index if key == AGENT_KEY else ''}"
        )
    return obs[key]
