"""
Base of policies for RecurrentPPO: actors and critics with LSTMs (the paper's policies condition on histories).

Letters: B rows (sequences one after another, padded by sb3-contrib to one length), N agents, S size of a critic's
state, H size of the LSTMs' output.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_saf.networks.actor import ActorNetwork
from sb3_saf.networks.critic import OwnValueHead, StateCritic, TeamCritic, TeamStates
from sb3_saf.networks.row_encoder import EncodedRows
from sb3_saf.policies.base import Encoded, NetArch, TeamPolicy
from sb3_saf.teams.checks import check_count

LstmStates = tuple[th.Tensor, ...]


class RecurrentCritic(nn.Module):
    """
    LSTM over the critic's state of the row's agent at each step, then a value head.

    :param team_states: computes the LSTM's input, (B, S) of the rows' agents; None for own features
    :param lstm: LSTM from S to H
    :param head: value head on H
    """

    def __init__(self, team_states: TeamStates | None, lstm: nn.LSTM, head: OwnValueHead):
        super().__init__()
        self.team_states = team_states
        self.lstm = lstm
        self.head = head


class TeamRecurrentPolicy(TeamPolicy, RecurrentActorCriticPolicy):  # type: ignore[misc]  # value_net, log_std: ours
    """
    Policy for RecurrentPPO on rows of teams.

    Actor: features of the agent's own observation, an LSTM shared by all agents, then selection and pool (or the single
    policy). Actions depend on the agent's own observation and hidden state only.

    Critic: sb3-contrib keeps one hidden state per row and shuffles rows, so the hidden states of teammates are not
    available. They are not needed: the row holds the observations of the whole team, and the critic's LSTM runs over
    the critic's state of each step. For SAF that is s_i^SAF, so the knowledge source precedes the LSTM; for MAPPO [z_1,
    ..., z_N] and the agent's index; for IPPO z_i. A value head on the LSTM's output follows.

    Equal observations are encoded once, as in other team policies; the LSTMs run on every row.

    Takes the arguments of :class:`TeamPolicy` and, by keyword, the fields of its parts.

    :param observation_space: Dict of ``obs``, ``team`` and ``agent``
    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden sizes of actor and critic heads on the LSTMs' outputs; see the base class
    :param lstm_hidden_size: H
    :param n_lstm_layers: layers of each LSTM
    :param enable_critic_lstm: False uses the critic of PPO's policies, without memory
    :param shared_lstm: must be False: actor and critic have different inputs
    :param lstm_kwargs: further arguments of both LSTMs
    :param kwargs: arguments of :class:`TeamPolicy`
    """

    value_net: OwnValueHead | TeamCritic | StateCritic | RecurrentCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        *,
        lstm_hidden_size: int = 256,
        n_lstm_layers: int = 1,
        enable_critic_lstm: bool = True,
        shared_lstm: bool = False,
        lstm_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ):
        if shared_lstm:
            raise ValueError(
                "team policies have no LSTM shared by actor and critic, which read different things: leave "
                "shared_lstm=False; enable_critic_lstm=False leaves the critic without memory"
            )
        check_count("lstm_hidden_size", lstm_hidden_size)
        check_count("n_lstm_layers", n_lstm_layers)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch,
            lstm_hidden_size=lstm_hidden_size,
            n_lstm_layers=n_lstm_layers,
            # sb3-contrib makes no critic network for a shared LSTM: it is made below.
            shared_lstm=True,
            enable_critic_lstm=False,
            lstm_kwargs=dict(lstm_kwargs or {}),
            **kwargs,
        )
        self.critic_remembers = enable_critic_lstm
        self._build_critic(lr_schedule)

    # --- construction -----------------------------------------------------------------------------------------------

    def _build(self, lr_schedule: Schedule) -> None:
        # sb3-contrib makes the actor's LSTM after this. The critic is made last, see the base class.
        self._build_actor()

    def _make_actor(self) -> ActorNetwork:
        return self.parts.actor(self._network_spec()._replace(features_dim=self.lstm_output_dim))

    def _make_critic(self) -> OwnValueHead | TeamCritic | StateCritic | RecurrentCritic:  # type: ignore[override]
        if not self.critic_remembers:
            return super()._make_critic()
        spec = self._network_spec()
        team_states = self.parts.team_states(spec)
        # RecurrentPPO stores both hidden states in arrays of one shape.
        lstm = nn.LSTM(
            spec.features_dim if team_states is None else team_states.states_dim,
            self.lstm_actor.hidden_size,
            num_layers=self.lstm_actor.num_layers,
            **self.lstm_kwargs,
        )
        return RecurrentCritic(team_states, lstm, OwnValueHead(spec, lstm.hidden_size, self.parts.heads))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "lstm_hidden_size": self.lstm_actor.hidden_size,
            "n_lstm_layers": self.lstm_actor.num_layers,
            "enable_critic_lstm": self.critic_remembers,
            "lstm_kwargs": self.lstm_kwargs,
        }

    # --- what sb3-contrib calls -------------------------------------------------------------------------------------

    def forward(  # type: ignore[override]
        self, obs: PyTorchObs, lstm_states: RNNStates, episode_starts: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, RNNStates]:
        """
        Act and estimate values.

        :param obs: rows
        :param lstm_states: hidden and cell states of actor and critic, each (layers, sequences, H)
        :param episode_starts: (B,) 1.0 where an episode starts, which resets the states
        :param deterministic: whether to take the most likely actions
        :return: actions (B, ...), values (B, 1), log-likelihoods (B,) and the next states
        """
        encoded = self._encoded(obs)
        distribution, actor_states = self._recall_distribution(obs, encoded.own, lstm_states.pi, episode_starts)
        values, critic_states = self._recall_values(obs, encoded, lstm_states.vf, episode_starts)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        actions = actions.reshape((-1, *(self.action_space.shape or ())))
        return actions, values, log_prob, RNNStates(actor_states, critic_states)

    def evaluate_actions(  # type: ignore[override]
        self, obs: PyTorchObs, actions: th.Tensor, lstm_states: RNNStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Evaluate actions of sequences, one after another; see the base class, and :meth:`forward` for the states."""
        self._check_minibatch(obs)
        encoded = self._encoded(obs)
        distribution, _ = self._recall_distribution(obs, encoded.own, lstm_states.pi, episode_starts)
        values, _ = self._recall_values(obs, encoded, lstm_states.vf, episode_starts)
        return values, self._likelihood(distribution, actions), distribution.entropy()

    def get_distribution(  # type: ignore[override]
        self, obs: PyTorchObs, lstm_states: LstmStates, episode_starts: th.Tensor
    ) -> tuple[Distribution, LstmStates]:
        """Return the action distribution and the actor's next states (see the base class)."""
        return self._recall_distribution(obs, self.encode_own(obs), lstm_states, episode_starts)

    def predict_values(  # type: ignore[override]
        self, obs: PyTorchObs, lstm_states: LstmStates, episode_starts: th.Tensor
    ) -> th.Tensor:
        """Return values (B, 1); ``lstm_states`` are the critic's."""
        return self._recall_values(obs, self._encoded(obs), lstm_states, episode_starts)[0]

    def remember(
        self, features: th.Tensor, lstm_states: LstmStates, episode_starts: th.Tensor | None = None
    ) -> tuple[th.Tensor, LstmStates]:
        """
        Run one step of the actor's LSTM.

        :param features: (B, d) features of own observations
        :param lstm_states: the actor's states, (layers, B, H) each
        :param episode_starts: (B,) 1.0 where an episode starts, which resets the states; None if none starts
        :return: the actor's input (B, H), and the next states
        """
        starts = th.zeros(len(features), device=features.device) if episode_starts is None else episode_starts
        return self._process(features, lstm_states, starts, self.lstm_actor)

    # --- memory -----------------------------------------------------------------------------------------------------

    @property
    def _critic_reads_teams(self) -> bool:
        critic = self.value_net
        if isinstance(critic, RecurrentCritic):
            return critic.team_states is not None
        return super()._critic_reads_teams

    def _recall_distribution(
        self, obs: PyTorchObs, own: EncodedRows, lstm_states: LstmStates, episode_starts: th.Tensor
    ) -> tuple[Distribution, LstmStates]:
        latent, states = self._process(own.of_rows(), lstm_states, episode_starts, self.lstm_actor)
        agent = self._agent(obs) if self.actor.reads_agent else None
        masks = self._action_mask(obs, padded=True)
        return self._distribution_of(lambda module: module(latent, agent), masks), states

    def _recall_values(
        self, obs: PyTorchObs, encoded: Encoded, lstm_states: LstmStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, LstmStates]:
        critic = self.value_net
        if not isinstance(critic, RecurrentCritic):
            return self._values(obs, encoded), lstm_states
        latent, states = self._process(_critic_inputs(critic, encoded), lstm_states, episode_starts, critic.lstm)
        agent = self._agent(obs) if critic.head.reads_agent else None
        return self._raw_values(obs, critic.head(latent, agent)), states

    def _process(
        self, inputs: th.Tensor, lstm_states: LstmStates, episode_starts: th.Tensor, lstm: nn.LSTM
    ) -> tuple[th.Tensor, LstmStates]:
        """Return outputs (B, H) of an LSTM for inputs (B, ...), sequence by sequence, and its last states."""
        outputs, states = self._process_sequence(inputs, lstm_states, episode_starts, lstm)  # type: ignore[arg-type]
        return outputs, states  # type: ignore[return-value]  # sb3-contrib's annotation says one tensor


def _critic_inputs(critic: RecurrentCritic, encoded: Encoded) -> th.Tensor:
    """Return the inputs (B, S) of the critic's LSTM."""
    teams = encoded.teams
    if critic.team_states is None:
        return encoded.own.of_rows()
    assert teams is not None
    return teams.of_rows(critic.team_states.states(teams.features, teams.members, teams.active))
