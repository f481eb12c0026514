"""QPLEX for Stable-Baselines3: value factorisation on team transitions (arXiv 2008.01062)."""

from __future__ import annotations

import io
import pathlib
import warnings
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    Schedule,
    TrainFreq,
)
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.callbacks import GAME_STEPS_TAG
from sb3_saf.policies.parts import AlgorithmSpec, Declaration, memory_variants
from sb3_saf.qplex.learning import team_errors
from sb3_saf.qplex.mixers import MixerName
from sb3_saf.qplex.policies import QPLEXPolicy, QPLEXPoolPolicy, State
from sb3_saf.teams.checks import check_count, check_whole_teams
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    OBS_KEY,
    STATE_KEY,
    TERMINAL_OBSERVATION,
    Array,
    TeamSpaces,
)
from sb3_saf.teams.vec_env import team_dones

SelfQPLEX = TypeVar("SelfQPLEX", bound="QPLEX")

_STORED_KEYS: Final[tuple[str, ...]] = (OBS_KEY, AGENT_KEY, ACTION_MASK_KEY, ACTIVE_KEY, STATE_KEY)


class QPLEX(OffPolicyAlgorithm):
    """
    QPLEX, QMIX and VDN: a mixer combines the agents' action values to the team's, trained on the sum of their rewards.

    It trains on the same environments as PPO with SAFPolicy (``make_team_env``); actions must be Discrete.

    **Units**: ``buffer_size``, ``learning_starts``, ``batch_size``, ``train_freq`` and ``target_update_interval`` count
    *game steps*, summed over all parallel games. ``total_timesteps`` counts rows (game steps times N), as in SB3.

    **Exploration**: epsilon-greedy over legal actions, independently per agent, also in
    ``predict(deterministic=False)``.

    :param policy: ``"QPLEXPolicy"`` or ``"QPLEXPoolPolicy"`` (Q heads from a pool)
    :param env: vector environment of teams
    :param mixer: ``"qplex"``, ``"qmix"`` or ``"vdn"``; None uses ``policy_kwargs`` (QPLEX by default)
    :param learning_rate: learning rate, or a schedule of it
    :param buffer_size: capacity of the replay buffer in game steps
    :param learning_starts: game steps before learning begins; until then actions are random
    :param batch_size: game steps per update (with memory: those that enter the loss, in sequences)
    :param tau: soft update coefficient of the target networks; 1 copies the online networks
    :param gamma: discount per game step
    :param train_freq: game steps between updates
    :param gradient_steps: gradient steps per update; -1 for as many as game steps in between
    :param replay_buffer_class: TeamReplayBuffer or a subclass of it
    :param replay_buffer_kwargs: its further arguments
    :param target_update_interval: game steps between updates of the target networks
    :param exploration_fraction: fraction of training over which the probability of random actions decreases
    :param exploration_initial_eps: probability at the start
    :param exploration_final_eps: probability after that fraction
    :param max_grad_norm: maximum norm of the gradient
    :param stats_window_size: number of team episodes in ``rollout/ep_rew_mean``
    :param tensorboard_log: folder for TensorBoard; None for none
    :param policy_kwargs: arguments of the policy, see :class:`QPLEXPolicy` and :class:`QPLEXParts`
    :param verbose: 0 for silence, 1 for information, 2 for debugging
    :param seed: seed of weights, exploration, sampling and games
    :param device: device of the networks
    :param _init_setup_model: whether to build the networks now
    :raises ValueError: for environments without teams, actions that are not Discrete, and invalid numbers
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        policy.__name__: policy for policy in (QPLEXPolicy, QPLEXPoolPolicy)
    }
    policy: QPLEXPolicy
    replay_buffer: TeamReplayBuffer | None
    action_space: spaces.Discrete

    def __init__(
        self,
        policy: str | type[QPLEXPolicy],
        env: GymEnv | str | None,
        mixer: MixerName | None = None,
        learning_rate: float | Schedule = 5e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 1_000,
        batch_size: int = 64,
        tau: float = 1.0,
        gamma: float = 0.99,
        train_freq: int = 16,
        gradient_steps: int = 1,
        replay_buffer_class: type[TeamReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        target_update_interval: int = 4_000,
        exploration_fraction: float = 0.3,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        max_grad_norm: float = 10.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        if isinstance(policy, str) and policy not in self.policy_aliases:
            names = ", ".join(repr(name) for name, kind in self.policy_aliases.items() if name == kind.__name__)
            raise ValueError(
                f"expected one of {type(self).__name__}'s policies, {names}, got {policy!r}; PPO trains the others"
            )
        if mixer is not None:
            policy_kwargs = {**(policy_kwargs or {}), "mixer": mixer}
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]  # None while loading
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=replay_buffer_class or TeamReplayBuffer,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )
        self.target_update_interval = target_update_interval
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.max_grad_norm = max_grad_norm
        self.exploration_rate = exploration_initial_eps
        #: Memory of the agents during rollouts, None without memory.
        self.agent_state: State | None = None
        if _init_setup_model:
            self._setup_model()

    # --- setting up -------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        self._check_settings()
        spaces_ = TeamSpaces.from_observation_space(self.observation_space)
        self.n_agents = spaces_.n_agents
        self.n_games = check_whole_teams(self.n_envs, self.n_agents, "give an environment of whole teams")
        if not isinstance(self.action_space, spaces.Discrete) or self.action_space.start != 0:
            raise ValueError(
                f"{type(self).__name__} needs Discrete actions that count from 0, got {self.action_space}; for other "
                'actions use PPO with "SAFPolicy", "MAPPOPolicy" or "IPPOPolicy"'
            )
        super()._setup_model()
        if not isinstance(self.policy, QPLEXPolicy):
            raise ValueError(
                f"expected one of {', '.join(map(repr, self.policy_aliases))} or a subclass of QPLEXPolicy, got "
                f"{type(self.policy).__name__}"
            )
        buffer = self._buffer()
        if self.verbose >= 1:
            steps = buffer.buffer_size * buffer.n_games
            print(f"Buffer of {steps:,} game steps: {buffer.nbytes / 1e6:,.1f} MB")

    def _check_settings(self) -> None:
        for name in ("buffer_size", "batch_size", "train_freq", "target_update_interval"):
            value = getattr(self, name)
            if isinstance(value, TrainFreq):  # as loaded
                continue
            if isinstance(value, tuple):
                raise ValueError(f"{name} must be a number of game steps, got {value!r}")
            check_count(name, value)
        self._check_ranges()
        if self.batch_size > self.buffer_size:
            raise ValueError(
                f"batch_size must be at most buffer_size, got {self.batch_size} and {self.buffer_size} game steps; "
                "lower the one or raise the other"
            )
        if not issubclass(self.replay_buffer_class or TeamReplayBuffer, TeamReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must be TeamReplayBuffer or a subclass of it, got {self.replay_buffer_class}; "
                "SB3's own buffers store single rows"
            )

    def _check_ranges(self) -> None:
        """Raise ValueError for numbers with which nothing is learned."""
        shares = "gamma", "exploration_fraction", "exploration_initial_eps", "exploration_final_eps"
        ranges = {
            **{name: (0 <= getattr(self, name) <= 1, "from 0 to 1") for name in shares},
            "tau": (0 < self.tau <= 1, "above 0 and at most 1"),
            "max_grad_norm": (self.max_grad_norm > 0, "above 0"),
            "learning_starts": (self.learning_starts >= 0, "at least 0"),
            "gradient_steps": (self.gradient_steps >= 1 or self.gradient_steps == -1, "at least 1, or -1"),
        }
        for name, (is_right, words) in ranges.items():
            if not is_right:
                raise ValueError(f"{name} must be {words}, got {getattr(self, name)!r}")

    def _buffer(self) -> TeamReplayBuffer:
        assert self.replay_buffer is not None
        return self.replay_buffer

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer from a pickle file. Unpickling runs code from the file: load trusted files only.

        :param path: path of the file
        :param truncate_last_traj: unused, see SB3
        :raises ValueError: if the buffer belongs to other teams
        """
        warnings.warn(f"{path} is unpickled, which runs code from it; load what you trust", UserWarning, stacklevel=2)
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded: Any = self.replay_buffer
        form = self.n_envs, self.observation_space, self.action_space
        got = loaded.n_envs, loaded.observation_space, loaded.action_space
        if not isinstance(loaded, TeamReplayBuffer) or got != form:
            self.replay_buffer = before
            raise ValueError(
                f"expected a TeamReplayBuffer of rows and spaces {form}, got {type(loaded).__name__} of {got}; train "
                "on as many games as before, with their spaces"
            )

    def _game_steps(self) -> int:
        return self.num_timesteps // self.n_agents

    def _crossed(self, interval: int) -> int:
        """Count the multiples of ``interval`` game steps reached by the last step of all games."""
        steps = self._game_steps()
        return steps // interval - (steps - self.n_games) // interval

    def dump_logs(self) -> None:
        """Write log data including game steps."""
        self.logger.record(GAME_STEPS_TAG, self._game_steps())
        super().dump_logs()

    # --- playing ----------------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: Any,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[Any, State | None]:
        """
        Act from own observations.

        :param observation: rows, or observations of the game; see :meth:`TeamRowsPolicy.predict`
        :param state: state of policies with memory
        :param episode_start: (B,) where an episode starts
        :param deterministic: False explores with the current exploration rate, each agent independently
        :return: actions and the next state
        """
        given = self.policy.given_by_game(observation)
        if given is not None:
            return given.act(self.predict, state, episode_start, deterministic)
        actions, state = self.policy.predict(observation, state, episode_start, deterministic)
        if deterministic or not self.exploration_rate:
            return actions, state
        masks = observation.get(ACTION_MASK_KEY) if isinstance(observation, dict) else None
        explored = self._explore(np.atleast_1d(actions), self.exploration_rate, masks)
        if state is not None:
            state = (*state[:-1], explored.copy())
        return explored.reshape(actions.shape), state

    def _explore(self, actions: Array, rate: float, masks: Array | None) -> Array:
        """Replace each of the actions (B,) with probability ``rate`` by a random legal action."""
        # SB3 seeds only NumPy's global generator from the run's seed.
        explores = np.random.random(len(actions)) < rate  # noqa: NPY002
        if masks is None:
            others = np.random.randint(0, int(self.action_space.n), size=len(actions))  # noqa: NPY002
        else:
            legal = np.asarray(masks).reshape(len(actions), -1) != 0
            others = np.where(legal, np.random.random(legal.shape), -1.0).argmax(axis=1)  # noqa: NPY002
        return np.where(explores, others, actions)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """
        Play one step of all games, and count game steps and team episodes; see SB3.

        :param train_freq: unused; :meth:`train` decides when updates are due
        :param action_noise: unused
        :param learning_starts: game steps of random actions
        """
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        if self.agent_state is not None and len(self.agent_state[0]) != env.num_envs:
            self.agent_state = None  # another environment
        assert isinstance(self._last_obs, dict)
        actions, state = self.policy.predict(self._last_obs, self.agent_state, self._last_episode_starts)
        rate = 1.0 if self._game_steps() < learning_starts else self.exploration_rate
        actions = self._explore(actions, rate, self._last_obs.get(ACTION_MASK_KEY))
        self.agent_state = None if state is None else (*state[:-1], actions.copy())
        new_obs, rewards, dones, infos = env.step(actions)
        assert isinstance(new_obs, dict) and isinstance(replay_buffer, TeamReplayBuffer)
        dones = team_dones(dones, self.n_agents, alone=True).repeat(self.n_agents)
        self.num_timesteps += env.num_envs
        callback.update_locals(locals())
        goes_on = callback.on_step()
        self._update_info_buffer(infos, dones)
        keys = [key for key in _STORED_KEYS if key in new_obs]
        after = {key: new_obs[key] for key in keys}
        ended = np.flatnonzero(dones).tolist()
        if ended:
            after = {key: part.copy() for key, part in after.items()}
        for row in ended:
            for key in keys:
                after[key][row] = infos[row][TERMINAL_OBSERVATION][key]
        starts = self._last_episode_starts
        replay_buffer.add(self._last_obs, after, actions, rewards, dones, infos, episode_starts=starts)
        self._last_obs, self._last_episode_starts = new_obs, dones
        if not goes_on:  # stored all the same: training may go on from here
            return RolloutReturn(self.n_games, 0, continue_training=False)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        self._on_step()
        n_episodes = int(np.count_nonzero(dones)) // self.n_agents
        self._episode_num += n_episodes
        callback.on_rollout_end()
        if (
            log_interval is not None
            and self._episode_num // log_interval > (self._episode_num - n_episodes) // log_interval
        ):
            self.dump_logs()
        return RolloutReturn(self.n_games, n_episodes, continue_training=True)

    def _on_step(self) -> None:
        """Update the target networks and the exploration rate."""
        for _ in range(self._crossed(self.target_update_interval)):
            polyak_update(*self.policy.parameter_pairs(), self.tau)
        self._update_exploration_rate()
        self.logger.record("rollout/replay_buffer_size", self._buffer().n_stored)

    def _update_exploration_rate(self) -> None:
        share = 1.0 - self._current_progress_remaining
        fallen = min(1.0, share / self.exploration_fraction) if self.exploration_fraction > 0 else 1.0
        change = self.exploration_final_eps - self.exploration_initial_eps
        self.exploration_rate = self.exploration_initial_eps + fallen * change
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    # --- learning ---------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Do the updates that are due after one step of all games.

        :param gradient_steps: unused; determined by the attributes ``gradient_steps`` and ``train_freq``
        :param batch_size: game steps per gradient step
        """
        assert isinstance(self.train_freq, TrainFreq)
        interval = self.train_freq.frequency
        due = self._crossed(interval)
        if not due or self._game_steps() <= self.learning_starts:
            return
        self.policy.set_training_mode(True)
        self.policy.target_networks.eval()
        self._update_learning_rate(self.policy.optimizer)
        n_steps = due * (interval if self.gradient_steps < 0 else self.gradient_steps)
        parts, buffer = self.policy.parts, self._buffer()
        for _ in range(n_steps):
            if parts.memory is None:
                samples = buffer.sample(batch_size)
            else:
                n_sequences = max(1, batch_size // parts.sequence_length)
                samples = buffer.sample_sequences(n_sequences, parts.sequence_length, parts.burn_in)
            error = team_errors(self.policy, samples, self.gamma)
            self.policy.optimizer.zero_grad()
            error.loss.backward()
            th.nn.utils.clip_grad_norm_(self.policy.parameter_pairs()[0], self.max_grad_norm)
            self.policy.optimizer.step()
        self._n_updates += n_steps
        record = self.logger.record  # the last gradient step, as means over the batch
        record("train/n_updates", self._n_updates, exclude="tensorboard")
        record("train/loss", error.loss.item())
        record("train/td_error", error.td.abs().mean().item())
        record("train/q_tot", error.q_tot.mean().item())
        if error.weights is not None:
            for agent, weight in enumerate(error.weights.nanmean(dim=0).tolist()):
                if weight == weight:  # it takes part
                    record(f"lambda/agent_{agent}", weight)

    def learn(
        self: SelfQPLEX,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfQPLEX:
        """Train as in SB3; ``total_timesteps`` counts rows (game steps times N), ``log_interval`` team episodes."""
        if self._vec_normalize_env is not None:
            raise ValueError(
                f"{type(self).__name__} does not train on VecNormalize, whose statistics change while steps are "
                "stored; scale in games"
            )
        begun = 0 if reset_num_timesteps else self.num_timesteps
        rows = self._rows_until(begun, total_timesteps)
        game_steps = (begun + rows) // self.n_agents
        if reset_num_timesteps and 0 < game_steps <= self.learning_starts:
            warnings.warn(
                f"nothing is learned in {game_steps:,} game steps with learning_starts={self.learning_starts:,}; lower "
                "it, or train longer",
                stacklevel=2,
            )
        name = tb_log_name or type(self).__name__
        return super().learn(rows, callback, log_interval, name, reset_num_timesteps, progress_bar)

    def _rows_until(self, begun: int, total_timesteps: int) -> int:
        """Return the rows to train on, after ``begun`` of them."""
        return total_timesteps

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


def _with_mixer(mixer: MixerName, policy: str = "QPLEXPolicy") -> AlgorithmSpec:
    return AlgorithmSpec(QPLEX, policy, "qplex", {"mixer": mixer})


DECLARATION: Final = Declaration(
    "QPLEX",
    {QPLEX: (QPLEXPolicy, QPLEXPoolPolicy)},
    {
        "qplex": _with_mixer("qplex"),
        "qplex-pool": _with_mixer("qplex", "QPLEXPoolPolicy"),
        "qmix": _with_mixer("qmix"),
        "vdn": _with_mixer("vdn"),
        **memory_variants(_with_mixer("vdn"), "vdn"),
        **memory_variants(_with_mixer("qmix"), "qmix"),
        **memory_variants(_with_mixer("qplex"), "qplex"),
    },
)
