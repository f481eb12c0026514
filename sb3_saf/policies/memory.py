"""
Memory of policies while games are played and over the sequences of a rollout; other policies run nothing of it.

Letters: E games, N agents, B = E N rows, L steps of S sequences, G = L S teams, U states of the critic for a team;
M, Ma, Mc sizes of the memory of a game, of the actor, and of one of the critic's states.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_saf.buffers.rollout import ROWS_AT_ONCE, Step, TeamMinibatch
from sb3_saf.networks.critic import OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.layers import gather
from sb3_saf.networks.memory import MEMORY_NAMES, Memory, MemoryName
from sb3_saf.networks.row_encoder import Encoded, EncodedRows, EncodedTeams, joined_teams
from sb3_saf.policies.rows import TeamRowsPolicy
from sb3_saf.teams.checks import check_choice
from sb3_saf.teams.rows import EPISODE_START_KEY, TerminalRow

#: Action masks of MaskablePPO, (B, M).
Masks = npt.NDArray[Any] | th.Tensor


@dataclass
class RunningMemory:
    """
    Memory of a policy in the games that it plays.

    :param actor: (B, Ma) memory of the agents after the last step; None before the first
    :param critic: (E U, Mc) memory of the critic before the first of the waiting steps, if it has one
    :param waiting: steps whose values are not computed yet
    """

    actor: th.Tensor | None = None
    critic: th.Tensor | None = None
    waiting: list[Step] = field(default_factory=list)


def starts_of_states(starts: th.Tensor, n_states: int) -> th.Tensor:
    """
    Return where the memory of a critic's states begins: with its agent's episode, or with those of the whole team.

    :param starts: (..., N) bool
    :param n_states: U, N or 1
    :return: (..., U) bool
    """
    return starts if starts.shape[-1] == n_states else starts.all(dim=-1, keepdim=True)


class RememberingPolicy(TeamRowsPolicy):
    """Base of policies whose actor, and critic, can have a memory; without ``memory`` nothing of this is used."""

    value_net: OwnValueHead | TeamCritic | StateCritic
    memory: MemoryName | None
    memory_size: int
    critic_memory: bool
    actor_memory: Memory | None
    #: Memory in the games that are played.
    running: RunningMemory
    #: Whether the policy's algorithms take TeamRolloutBuffer, which ``normalize_values`` and ``memory`` need.
    takes_team_buffer: ClassVar[bool] = False

    def _check_memory(self) -> None:
        """Raise ValueError for a policy that cannot have a memory."""
        check_choice("memory", self.memory, MEMORY_NAMES)
        if not self.takes_team_buffer:
            raise ValueError(
                f"memory={self.memory!r} needs TeamRolloutBuffer, which {type(self).__name__}'s algorithms do not "
                "take: use PPO, A2C or TRPO with SAFPolicy, MAPPOPolicy or IPPOPolicy, which read action masks from "
                "observations"
            )
        if not self.team_spaces.has_starts:
            raise ValueError(
                f"memory={self.memory!r} needs rows with {EPISODE_START_KEY!r}, got {self.team_spaces.keys}; build the "
                "environment with sb3_saf.make_team_env, or wrap it in sb3_saf.CentralizedValueWrapper"
            )

    @property
    def _remembering_critic(self) -> TeamCritic | None:
        """The critic, if it has a memory."""
        critic = self.value_net
        return critic if isinstance(critic, TeamCritic) and critic.memory is not None else None

    @abstractmethod
    def _raw_values(self, obs: PyTorchObs, outputs: th.Tensor) -> th.Tensor: ...

    @abstractmethod
    def _distribution(
        self, obs: PyTorchObs, own: EncodedRows, action_masks: Masks | None = None, latents: th.Tensor | None = None
    ) -> Distribution: ...

    def _predict_rows(
        self, rows: Any, state: Any, episode_start: np.ndarray | None, deterministic: bool, **kwargs: Any
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """See the base class; ``state`` is a tuple of one array, the actor's memory (B, Ma) after the last step."""
        if self.actor_memory is None:
            return super()._predict_rows(rows, state, episode_start, deterministic, **kwargs)
        self.set_training_mode(False)
        obs, is_batch = self.obs_to_tensor(rows)
        with th.no_grad():
            own = self.encode_own(obs)
            memory = None if state is None else th.as_tensor(state[0], device=self.device)
            latents, memory = self.remember(own.of_rows(), memory, self._starts(obs, episode_start))
            actions = self._distribution(obs, own, latents=latents).get_actions(deterministic=deterministic)
        array = actions.cpu().numpy().reshape((-1, *(self.action_space.shape or ())))
        if isinstance(self.action_space, spaces.Box):
            array = np.clip(array, self.action_space.low, self.action_space.high)
        return (array if is_batch else array.squeeze(axis=0)), (memory.cpu().numpy(),)

    # --- games that are played --------------------------------------------------------------------------------------

    def remember(
        self, features: th.Tensor, memory: th.Tensor | None = None, starts: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Run one step of the actor's memory.

        :param features: (B, d) features of own observations
        :param memory: (B, Ma) before the step; None where episodes begin
        :param starts: (B,) bool, rows whose episode begins with the step
        :return: inputs of the actor's heads (B, H), and the memory after the step (B, Ma)
        """
        assert self.actor_memory is not None
        memory = features.new_zeros(len(features), self.actor_memory.state_dim) if memory is None else memory
        return self.actor_memory.step(features, memory, starts)

    @contextmanager
    def remembering(self, memory: RunningMemory) -> Iterator[None]:
        """
        Let :meth:`forward` and :meth:`predict_values` use the memory of other games than those of the training.

        :param memory: advanced by :meth:`forward`
        """
        games, self.running = self.running, memory
        try:
            yield
        finally:
            self.running = games

    def checkpoint_state(self) -> dict[str, th.Tensor | None]:
        """Return the memory of the running games between two rollouts."""
        return {"actor": self.running.actor, "critic": self.running.critic}

    def load_checkpoint_state(self, state: Mapping[str, th.Tensor | None]) -> None:
        """Continue from a state (see :meth:`checkpoint_state`)."""
        actor, critic = (part if part is None else part.to(self.device) for part in (state["actor"], state["critic"]))
        self.running = RunningMemory(actor, critic)

    def _advance(self, obs: PyTorchObs, encoded: Encoded) -> tuple[Step, th.Tensor]:
        """
        Run one step of the memory of the agents in the running games, which begin anew if their number differs.

        :return: the critic's input, and the inputs of the actor's heads (B, H)
        """
        assert self.actor_memory is not None
        features, n_rows, critic = encoded.own.features, encoded.own.n_rows, self._remembering_critic
        if self.running.actor is None or len(self.running.actor) != n_rows:
            self.running.actor = features.new_zeros(n_rows, self.actor_memory.state_dim)
            self.running.waiting.clear()
            if critic is not None and critic.memory is not None:
                n_states = n_rows // self.team_spaces.n_agents * critic.n_states
                self.running.critic = features.new_zeros(n_states, critic.memory.state_dim)
        step = Step.of(obs, encoded)
        step.starts, step.actor = self._starts(obs), self.running.actor
        if critic is not None:
            if encoded.teams is None or encoded.teams.rows is not None:
                raise ValueError("expected the rows of whole teams in index order, which a critic with memory reads")
            self.running.waiting.append(step)
        latents, memory = self.remember(encoded.own.of_rows(), step.actor, step.starts)
        self.running.actor = memory.detach()
        return step, latents

    @th.no_grad()
    def _compute_waiting(self) -> None:
        """Compute the values of the waiting steps, and the critic's memory before each and after the last."""
        critic = self._remembering_critic
        if critic is None:
            return
        steps, self.running.waiting = self.running.waiting, []
        net, memory = critic.memory, self.running.critic
        at_once = max(1, ROWS_AT_ONCE // steps[0].encoded.own.n_rows) if steps else 1
        for first in range(0, len(steps), at_once):
            some = steps[first : first + at_once]
            teams = joined_teams([step.encoded.teams for step in some if step.encoded.teams is not None])
            states = critic.states(teams.features, teams.members, teams.active)
            outputs = []
            for step, inputs in zip(some, states.view(len(some), -1, states.shape[2]), strict=True):
                assert step.starts is not None and memory is not None and net is not None
                step.critic = memory
                starts = starts_of_states(step.starts.view(-1, self.team_spaces.n_agents), critic.n_states)
                output, memory = net.step(inputs, memory, starts.reshape(-1))
                outputs.append(output)
            values = critic.values(th.cat(outputs).view(*states.shape[:2], -1)).flatten()
            obs = {key: th.cat([step.obs[key] for step in some]) for key in some[0].obs}
            for step, part in zip(some, self._raw_values(obs, values).chunk(len(some)), strict=True):
                step.values = part
        self.running.critic = memory

    @th.no_grad()
    def _values_of_running_games(self, obs: PyTorchObs, critic: TeamCritic) -> th.Tensor:
        """Return values (B, 1) of the next step of all games, of last rows, or of rows of games that begin."""
        self._compute_waiting()
        n_agents, agent, flags, net = self.team_spaces.n_agents, self._agent(obs), self._starts(obs), critic.memory
        assert net is not None
        memory, starts = self.running.critic, None
        if not isinstance(obs, TerminalRow) and self._are_whole_teams(obs, of_step=False):
            _, teams = self.encode_teams(obs)
            starts = starts_of_states(flags.view(-1, n_agents), critic.n_states)
            if memory is not None and len(memory) != starts.numel():
                memory = None
        else:
            # The team of every row by itself: equal ones may be of games with other memories.
            members = self.row_encoder.rows(self._team(obs).flatten(0, 1))
            rows = th.arange(len(agent), device=agent.device) * n_agents + agent
            arranged = members.arranged((len(agent), n_agents))
            teams = EncodedTeams(members.features, arranged, rows, self._active(obs))
            if critic.n_states == n_agents:
                starts = flags.unsqueeze(1).expand(-1, n_agents)
            if memory is not None and isinstance(obs, TerminalRow):
                games = th.as_tensor(obs.row, device=memory.device).reshape(-1) // n_agents
                memory = memory.view(-1, critic.n_states, net.state_dim)[games].flatten(0, 1)
            else:
                memory = None
        states = critic.states(teams.features, teams.members, teams.active)
        inputs = states.flatten(0, 1)
        if memory is None:
            memory = inputs.new_zeros(len(inputs), net.state_dim)
        outputs, _ = net.step(inputs, memory, None if starts is None else starts.reshape(-1))
        return self._raw_values(obs, teams.of_rows(critic.values(outputs.view(*states.shape[:2], -1))))

    # --- sequences of a rollout -------------------------------------------------------------------------------------

    def _latents_of_sequences(self, obs: PyTorchObs, encoded: Encoded, twice: bool = False) -> th.Tensor:
        """Return the inputs (B, H) of the actor's heads for a minibatch of sequences; TRPO differentiates twice."""
        assert self.actor_memory is not None
        teams = encoded.teams
        if teams is None:  # the critic does not read them
            _, teams = self.encode_teams(obs)
        features = gather(teams.features, teams.members)
        return teams.of_rows(self._over_time(self.actor_memory, features, obs, teams.active, twice))

    def _over_time(
        self, net: Memory, states: th.Tensor, obs: PyTorchObs, active: th.Tensor | None, twice: bool = False
    ) -> th.Tensor:
        """
        Run the memory of the actor or of the critic over the steps of a minibatch.

        :param states: (G, U, d) its inputs
        :param active: (G, N) bool, agents that take part; None if all do
        :return: (G, U, H)
        """
        if not isinstance(obs, TeamMinibatch) or obs.teams.sequences is None:
            raise ValueError(
                f"memory={self.memory!r} needs minibatches of sequences: pass rollout_buffer_class="
                "sb3_saf.TeamRolloutBuffer; PPO(policy, env, **sb3_saf.ppo_settings(env)) sets it"
            )
        assert self.actor_memory is not None
        starts, memory = obs.teams.sequences
        length, _, n_agents = starts.shape
        of_actor, of_critic = memory.tensor_split([n_agents * self.actor_memory.state_dim], dim=1)
        if active is not None and states.shape[1] == n_agents:
            starts = starts & active.view(starts.shape)  # what inactive agents remember is not used
        outputs, _ = net(
            states.reshape(length, -1, states.shape[2]),
            (of_actor if net is self.actor_memory else of_critic).reshape(-1, net.state_dim),
            starts_of_states(starts, states.shape[1]).reshape(length, -1),
            twice,
        )
        return outputs.view(*states.shape[:2], -1)
