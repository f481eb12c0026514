"""
PQN-VDN: value factorisation on rollouts, without replay buffer and target networks (arXiv 2407.04811).

Letters: T steps, E games, N agents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from torch import nn

from sb3_saf.buffers.replay import TeamSteps
from sb3_saf.networks.layers import NormalizedReLU
from sb3_saf.policies.parts import AlgorithmSpec, Declaration
from sb3_saf.qplex.learning import joint_values
from sb3_saf.qplex.mixers import MixerName
from sb3_saf.qplex.policies import QPLEXParts, QPLEXPolicy
from sb3_saf.qplex.qplex import QPLEX
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.rows import TeamSpaces


@dataclass(frozen=True)
class PQNParts(QPLEXParts):
    """QPLEX's settings with VDN's mixer, without memory and pool."""

    mixer: MixerName = "vdn"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.memory is not None or self.n_policies > 1:
            raise ValueError(
                f"PQN has neither memory nor a pool, got memory={self.memory!r} and n_policies={self.n_policies}; "
                "leave them out, or use QPLEX"
            )


class PQNPolicy(QPLEXPolicy):
    """
    Policy of PQN: :class:`QPLEXPolicy` whose heads normalise their layers, which keeps values stable without target
    networks, and with VDN's mixer. Other parameters are those of :class:`QPLEXPolicy`.

    :param optimizer_class: optimizer; published is RAdam, whose steps take longer than those of Adam
    :param optimizer_kwargs: its arguments without the learning rate; None for ``fused=True`` of Adam
    :param kwargs: other arguments of :class:`QPLEXPolicy`, and fields of :class:`PQNParts`
    """

    parts_class: ClassVar[type[QPLEXParts]] = PQNParts

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = NormalizedReLU,
        *,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        if optimizer_kwargs is None and optimizer_class is th.optim.Adam:
            optimizer_kwargs = {"fused": True}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch,
            activation_fn,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.target_networks = nn.ModuleList()  # there are none


class PQN(QPLEX):
    """
    PQN-VDN: agents' action values whose sum is trained on lambda returns of rollouts of many games.

    It needs many games, and no stored steps of earlier policies. It trains on the environments of :class:`QPLEX`, and
    explores, predicts and is saved in the same way.

    **Units**: ``batch_size`` counts *game steps*, ``rollout_steps`` those of each game. ``total_timesteps`` counts rows
    (game steps times N), as in SB3.

    Other parameters are those of :class:`QPLEX`.

    :param policy: ``"PQNPolicy"``
    :param mixer: ``"vdn"``, ``"qmix"`` or ``"qplex"``; None uses ``policy_kwargs`` (VDN by default)
    :param rollout_steps: T, steps of each game in a rollout
    :param batch_size: game steps of a minibatch, at most all of the rollout; the last one of an epoch may be smaller
    :param n_epochs: passes over each rollout
    :param td_lambda: weight of later values in returns: 0 for those of the next step, 1 for whole rollouts
    :param policy_kwargs: arguments of the policy, see :class:`PQNPolicy`
    :raises ValueError: for environments without teams, actions that are not Discrete, and invalid numbers
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {PQNPolicy.__name__: PQNPolicy}

    def __init__(
        self,
        policy: str | type[PQNPolicy],
        env: GymEnv | str | None,
        mixer: MixerName | None = None,
        learning_rate: float | Schedule = 5e-4,
        rollout_steps: int = 16,
        batch_size: int = 64,
        n_epochs: int = 4,
        gamma: float = 0.99,
        td_lambda: float = 0.5,
        exploration_fraction: float = 0.2,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.1,
        max_grad_norm: float = 10.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            mixer,
            learning_rate,
            learning_starts=0,
            batch_size=batch_size,
            gamma=gamma,
            exploration_fraction=exploration_fraction,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.rollout_steps, self.n_epochs, self.td_lambda = rollout_steps, n_epochs, td_lambda
        if _init_setup_model:
            self._setup_model()

    def _check_settings(self) -> None:
        for name in ("rollout_steps", "n_epochs", "batch_size"):
            check_count(name, getattr(self, name))
        self._check_ranges()
        if not 0 <= self.td_lambda <= 1:
            raise ValueError(f"td_lambda must be from 0 to 1, got {self.td_lambda!r}")
        n_agents = TeamSpaces.from_observation_space(self.observation_space).n_agents
        self.buffer_size = self.rollout_steps * (self.n_envs // n_agents)  # one rollout

    def _rows_until(self, begun: int, total_timesteps: int) -> int:
        """Return the rows to the end of a rollout, to which SB3's PPO trains, too."""
        rows = self.rollout_steps * self.n_envs
        return -(-(begun + total_timesteps) // rows) * rows - begun

    def _on_step(self) -> None:
        self._update_exploration_rate()

    def load_replay_buffer(self, path: object, truncate_last_traj: bool = True) -> None:
        """Raise ValueError: a rollout is used once, so no steps are kept."""
        raise ValueError("PQN keeps no steps between rollouts, so it loads no replay buffer: leave it out")

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Learn from the rollout, if it is complete.

        :param gradient_steps: unused; determined by ``n_epochs`` and ``batch_size``
        :param batch_size: game steps of a minibatch
        """
        buffer = self._buffer()
        if buffer.size() < self.rollout_steps:
            return
        self._update_learning_rate(self.policy.optimizer)
        rollout, shape = buffer.every_step(), (self.rollout_steps, self.n_games)
        with th.no_grad():
            every = th.arange(len(rollout.rewards), device=self.device).split(batch_size)
            following = th.cat([joint_values(self.policy, _select(rollout.after, rows)) for rows in every])
        slots = buffer.slots(np.arange(self.rollout_steps))
        ended = buffer.ended[slots]
        ended[:-1] |= buffer.starts[slots[1:]]  # also where learn was called again
        rewards, following, dones = (part.view(shape) for part in (rollout.rewards, following, rollout.dones))
        cuts = th.as_tensor(ended, device=self.device)
        returns = lambda_returns(rewards, following, dones, cuts, self.gamma, self.td_lambda).flatten()
        errors = []
        self.policy.set_training_mode(True)
        for _ in range(self.n_epochs):
            # SB3 seeds only NumPy's global generator from the run's seed.
            order = th.as_tensor(np.random.permutation(len(returns)), device=self.device)  # noqa: NPY002
            for rows in order.split(batch_size):
                q_tot = joint_values(self.policy, _select(rollout.now, rows), rollout.actions[rows])
                error = q_tot - returns[rows]
                self.policy.optimizer.zero_grad()
                error.square().mean().backward()
                th.nn.utils.clip_grad_norm_(self.policy.parameter_pairs()[0], self.max_grad_norm)
                self.policy.optimizer.step()
                errors.append(error.detach())
        buffer.reset()
        self._n_updates += len(errors)
        every_error = th.cat(errors)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", every_error.square().mean().item())
        self.logger.record("train/td_error", every_error.abs().mean().item())
        self.logger.record("train/q_tot", (every_error.mean() + returns.mean()).item())


def lambda_returns(
    rewards: th.Tensor,
    following: th.Tensor,
    terminal: th.Tensor,
    ended: th.Tensor,
    gamma: float,
    td_lambda: float,
) -> th.Tensor:
    """
    Compute G_t = r_t + gamma (1 - terminal_t) ((1 - lambda) V_{t+1} + lambda G_{t+1}), with V_{t+1} in the place of
    G_{t+1} where an episode or the rollout ends.

    :param rewards: (T, E) team rewards
    :param following: (T, E) V_{t+1}, the value of the greedy joint action after the step
    :param terminal: (T, E) 1.0 where nothing follows
    :param ended: (T, E) bool, steps after which another episode begins, also after a time limit
    :return: (T, E)
    """
    returns, later = th.empty_like(rewards), following[-1]
    for step in reversed(range(len(rewards))):
        later = th.where(ended[step], following[step], later)
        value = (1 - td_lambda) * following[step] + td_lambda * later
        returns[step] = later = rewards[step] + gamma * (1 - terminal[step]) * value
    return returns


def _select(steps: TeamSteps, rows: th.Tensor) -> TeamSteps:
    return TeamSteps(*(None if part is None else part[rows] for part in steps))  # type: ignore[arg-type]


DECLARATION: Final = Declaration("PQN", {PQN: (PQNPolicy,)}, {"pqn": AlgorithmSpec(PQN, "PQNPolicy", "pqn")})
