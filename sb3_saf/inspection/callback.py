"""
Inspection of a team: recorded episodes as scalars, figures and a film, and the callback that writes them to
TensorBoard during training.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import logger
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.callbacks import copy_normalization, show_game_steps, team_steps
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.inspection import figures
from sb3_saf.inspection import scalars as numbers
from sb3_saf.inspection.recording import (
    EpisodeRecording,
    ReturnScale,
    record_episodes,
    require_our_policy,
    return_scale,
    zone_colours,
)
from sb3_saf.inspection.tensorboard import Page, hyperparameters
from sb3_saf.qplex.policies import QPLEXPolicy
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.vec_env import layers, require_n_agents

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Inspection(NamedTuple):
    """
    Recorded episodes of a team, with scalars and figures.

    :param recording: every step, as arrays
    :param action_space: one agent's action space
    :param scale: unit of team returns
    :param colours: colours of the zones; None if the environment has none
    :param gae_lambda: lambda of the critic's training targets
    """

    recording: EpisodeRecording
    action_space: spaces.Space[Any]
    scale: ReturnScale
    colours: Sequence[figures.Colour] | None
    gae_lambda: float

    @property
    def scalars(self) -> dict[str, float]:
        """Scalars by their names in TensorBoard (``docs/tensorboard.md``)."""
        return {
            **numbers.team_scalars(self.recording, self.scale),
            **numbers.pool_scalars(self.recording, self.action_space),
            **numbers.knowledge_scalars(self.recording),
            **numbers.critic_scalars(self.recording, self.gae_lambda),
            **numbers.message_scalars(self.recording),
        }

    @property
    def figures(self) -> dict[str, Figure]:
        """Figures by their names in TensorBoard. Needs matplotlib."""
        recording, counted = self.recording, self.recording.counted
        values, returns = recording.values[counted], recording.returns[counted]
        plots = {"critic/calibration": figures.calibration(values, returns, numbers.calibrate(values, returns))}
        if recording.pool_weights is not None and recording.pool_actions is not None:
            weights = recording.pool_weights[counted]
            agents = np.broadcast_to(np.arange(counted.shape[1]) % recording.n_agents, counted.shape)[counted]
            by_agent = numbers.selection_by_group(weights, agents, recording.n_agents)
            plots["pool/by_agent"] = figures.chosen_by_agent(by_agent)
            distances = numbers.policy_distances(self.action_space, recording.pool_actions[counted])
            plots["pool/differences"] = figures.policy_differences(distances)
            if recording.zones is not None:
                zones = recording.zones[counted]
                n_zones = max(int(zones.max(initial=0)) + 1, len(self.colours or ()))
                by_zone = numbers.selection_by_group(weights, zones, n_zones)
                plots["pool/by_zone"] = figures.chosen_by_zone(by_zone, self.colours)
        if recording.write_attention is not None:
            plots["knowledge_source/attention"] = figures.attention(**numbers.attentions(recording))
            # The first game up to the end of its first episode.
            game = int(np.flatnonzero(recording.counted_games.any(axis=0))[0])
            ends = recording.ends.reshape(len(recording.ends), -1, recording.n_agents)[:, game].all(axis=1)
            episode = recording.write_attention[: int(np.flatnonzero(ends)[0]) + 1, game]
            plots["knowledge_source/one_episode"] = figures.attention_over_time(episode)
        return plots

    @property
    def film(self) -> bytes | None:
        """The first episode as a GIF; None if the environment draws no pictures. Needs Pillow."""
        return figures.gif(self.recording.pictures) if self.recording.pictures else None


def inspect_team(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    n_eval_episodes: int = 16,
    seed: int = 20_000,
    deterministic: bool = False,
    *,
    pictures: bool = True,
    observations: bool = True,
) -> Inspection:
    """
    Inspect a team: play episodes, and record its observations, actions and network outputs.

    :class:`~sb3_saf.InspectionCallback` writes the same to TensorBoard. The result has ``scalars`` by name, ``figures``
        drawn on access, ``film``, the first episode as a GIF, and ``recording`` with every step.

    :param model: model with a policy of this package
    :param eval_env: environment of teams, for instance from ``make_team_env`` with ``n_envs=16`` and, for a film,
        ``render_mode="rgb_array"``
    :param n_eval_episodes: team episodes to play
    :param seed: seed of the episodes
    :param deterministic: whether the policy takes its most likely actions
    :param pictures: whether to draw the first game
    :param observations: whether to record the agents' own observations
    :raises ValueError: if the policy is not of this package or ``eval_env`` has no teams
    """
    recording = record_episodes(
        model.policy,
        eval_env,
        n_eval_episodes,
        seed,
        deterministic,
        gamma=float(getattr(model, "gamma", 1.0)),
        normalizer=model.get_vec_normalize_env(),
        observations=observations,
        pictures=pictures,
    )
    gae_lambda = float(getattr(model, "gae_lambda", 1.0))
    return Inspection(recording, model.policy.action_space, return_scale(eval_env), zone_colours(eval_env), gae_lambda)


class InspectionCallback(BaseCallback):
    """
    Inspect SAF, MAPPO, IPPO and QPLEX during training.

    Every ``every_game_steps``, and before and after training, the policy plays a fixed set of team episodes. The run's
    TensorBoard file gets team returns; the pool's selection by zone and by agent; attention and messages of the
    knowledge source; the critic's calibration, with and without messages; an episode as a film; hyperparameters; a
    text that explains the tags; and a layout of the custom scalars page. ``docs/tensorboard.md`` explains the results.
    Parts that a policy or an environment lacks are omitted.

    Training is not affected: its random generators are unchanged.

    :param eval_env: separate environment of teams, for instance from ``make_team_env`` with ``n_envs=16`` and, for
        pictures of episodes, ``render_mode="rgb_array"``
    :param every_game_steps: game steps (of training, summed over all parallel games) between inspections
    :param n_eval_episodes: team episodes per inspection
    :param seed: seed of the episodes, which are the same at every inspection
    :param deterministic: whether the policy takes its most likely actions, as QPLEX always does; others sample in
        training
    :param pictures: whether to draw figures and episodes, which needs matplotlib and Pillow; False writes numbers only
    :param hparams: additional hyperparameters to show, such as the task and its level
    :param verbose: 1 prints a line per inspection
    :raises ValueError: if ``eval_env`` has no teams or an argument is out of range; when training starts, if the policy
        is not of this package or ``eval_env`` does not match the training environment
    """

    only_shows = True  # has no state in checkpoints

    def __init__(
        self,
        eval_env: VecEnv,
        every_game_steps: int = 50_000,
        n_eval_episodes: int = 16,
        seed: int = 20_000,
        deterministic: bool = False,
        pictures: bool = True,
        hparams: Mapping[str, object] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.n_agents = require_n_agents(eval_env)
        self.every_game_steps = check_count("every_game_steps", every_game_steps)
        check_count("n_eval_episodes", n_eval_episodes)
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ValueError(f"seed must be an integer of at least 0, got {seed!r}")
        if pictures:
            try:
                import matplotlib  # noqa: F401
                import PIL  # noqa: F401
            except ImportError as error:
                raise ImportError(
                    f"InspectionCallback draws with matplotlib and Pillow ({error}): pip install 'sb3-saf[render]', or "
                    "pass pictures=False for numbers only"
                ) from error
        self.eval_env = eval_env
        self.pictures = pictures
        self.hparams = dict(hparams or {})
        self.n_eval_episodes, self.seed, self.deterministic = n_eval_episodes, int(seed), deterministic
        #: Seconds spent so far.
        self.seconds = 0.0
        self._next = 0
        self._last: int | None = None

    # --- timing -----------------------------------------------------------------------------------------------------

    def _init_callback(self) -> None:
        require_our_policy(self.model.policy)
        _check_fits(self.training_env, self.eval_env)

    def _on_training_start(self) -> None:
        show_game_steps(self.model)
        self._page = Page(self.model, self.n_agents)
        self._started = time.perf_counter()
        self.seconds = 0.0
        if not self._page.has_tensorboard:
            warnings.warn(
                "The model writes no TensorBoard file, so nothing shows what InspectionCallback draws: pass "
                "tensorboard_log='...' to the algorithm.",
                UserWarning,
                stacklevel=2,
            )
        scalars = self._inspect()
        policy = require_our_policy(self.model.policy)
        self._page.explain(scalars, value_based=isinstance(policy, QPLEXPolicy))
        self._page.show("hparams", hyperparameters(self.model, policy, self.hparams, scalars))
        self._page.write(self.num_timesteps)

    def _on_step(self) -> bool:
        if team_steps(self.model) >= self._next:
            self._inspect()
        return True

    def _on_training_end(self) -> None:
        # RL-Zoo3 ends callbacks even if training never began; an error here would hide the cause.
        if self._last is not None and self._last != team_steps(self.model):
            self._inspect()

    # --- content ----------------------------------------------------------------------------------------------------

    def _inspect(self) -> dict[str, float]:
        """Play, write, and return the scalars."""
        began = time.perf_counter()
        now = team_steps(self.model)
        self._last, self._next = now, (now // self.every_game_steps + 1) * self.every_game_steps
        copy_normalization(self.training_env, self.eval_env)
        inspection = inspect_team(
            self.model,
            self.eval_env,
            self.n_eval_episodes,
            self.seed,
            self.deterministic,
            pictures=self.pictures,
            observations=False,
        )
        scalars = inspection.scalars
        if self.pictures and self._page.has_tensorboard:
            self._page.show("team/return_of_each_episode", th.tensor(inspection.recording.episode_returns))
            if self.model.ep_info_buffer:
                recent = th.tensor([float(episode["r"]) for episode in self.model.ep_info_buffer])
                self._page.show("rollout/team_return_of_each_episode", recent)
            for tag, figure in inspection.figures.items():
                self._page.show(tag, logger.Figure(figure, close=True))
            if (film := inspection.film) is not None:
                self._page.gif("episode/film", film, team_steps(self.model))
        self._page.scalars(scalars)
        self.seconds += time.perf_counter() - began
        self._page.scalars({"time/inspection_seconds": self.seconds})
        if now:  # before, there is no training time of which it could be a fraction
            self._page.scalars({"time/inspection_share": self.seconds / (time.perf_counter() - self._started)})
        self._page.write(self.num_timesteps)
        if self.verbose:
            print(
                f"Inspection after {now} game steps: team return {scalars['team/return']:.2f} "
                f"({time.perf_counter() - began:.1f} s)"
            )
        return scalars


def _check_fits(training_env: VecEnv, eval_env: VecEnv) -> None:
    if training_env.unwrapped is eval_env.unwrapped:
        raise ValueError(
            "eval_env is the training environment; inspections would play on its games: make another one, for instance "
            "with sb3_saf.make_team_env and a seed of its own"
        )
    for name in ("observation_space", "action_space"):
        of_training, of_eval = getattr(training_env, name), getattr(eval_env, name)
        if of_training != of_eval:
            raise ValueError(
                f"expected eval_env to have the {name} of the training environment, {of_training}, got {of_eval}; make "
                "both with the same arguments"
            )
    limits = [
        next((layer.time_limit for layer in layers(env) if isinstance(layer, CentralizedValueWrapper)), None)
        for env in (training_env, eval_env)
    ]
    if None not in limits and limits[0] != limits[1]:
        raise ValueError(
            f"expected eval_env to treat time limits as training does (time_limit={limits[0]!r}), got {limits[1]!r}: "
            "the critic would be compared with returns that it does not learn"
        )
