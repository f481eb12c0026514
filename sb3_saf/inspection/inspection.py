"""Inspection of a team: its recorded episodes as scalars, figures and a film."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.inspection import figures
from sb3_saf.inspection import scalars as numbers
from sb3_saf.inspection.recording import (
    EpisodeRecording,
    Picture,
    ReturnScale,
    Zones,
    record_episodes,
    return_scale,
    zone_colours,
)

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
        unit = self.scale.unit and f"{self.scale.unit} {'of the team' if recording.of_team else 'per agent'}"
        calibration = figures.calibration(values, returns, numbers.calibrate(values, returns), unit)
        return {"critic/calibration": calibration, **self._of_the_pool(), **self._of_the_knowledge_source()}

    @property
    def film(self) -> bytes | None:
        """The first episode as a GIF; None if the environment draws no pictures. Needs Pillow."""
        return figures.gif(self.recording.pictures) if self.recording.pictures else None

    @property
    def strip(self) -> Picture | None:
        """Six moments of the first episode, (height, width, 3); None if the environment draws no pictures."""
        return figures.strip(self.recording.pictures) if self.recording.pictures else None

    def _of_the_pool(self) -> dict[str, Figure]:
        recording, counted = self.recording, self.recording.counted
        if recording.pool_weights is None or recording.pool_actions is None:
            return {}
        weights = recording.pool_weights[counted]
        agents = np.broadcast_to(np.arange(counted.shape[1]) % recording.n_agents, counted.shape)[counted]
        by_agent = numbers.selection_by_group(weights, agents, recording.n_agents)
        distances = numbers.policy_distances(self.action_space, recording.pool_actions[counted])
        plots = {
            "pool/by_agent": figures.chosen_by_agent(by_agent),
            "pool/differences": figures.policy_differences(distances),
        }
        if recording.zones is not None:
            zones = recording.zones[counted]
            n_zones = max(int(zones.max(initial=0)) + 1, len(self.colours or ()))
            by_zone = numbers.selection_by_group(weights, zones, n_zones)
            plots["pool/by_zone"] = figures.chosen_by_zone(by_zone, self.colours)
        return plots

    def _of_the_knowledge_source(self) -> dict[str, Figure]:
        recording = self.recording
        write, read = numbers.write_attention(recording), numbers.read_attention(recording)
        if write is None or read is None or recording.write_attention is None:
            return {}
        # The first game up to the end of its first episode.
        game = int(np.flatnonzero(recording.counted_games.any(axis=0))[0])
        ends = recording.ends.reshape(len(recording.ends), -1, recording.n_agents)[:, game].all(axis=1)
        episode = recording.write_attention[: int(np.flatnonzero(ends)[0]) + 1, game]
        return {
            "knowledge_source/attention": figures.attention(write, read),
            "knowledge_source/one_episode": figures.attention_over_time(episode),
        }


def inspect_team(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    n_eval_episodes: int = 16,
    seed: int = 20_000,
    deterministic: bool = False,
    zones: Zones = None,
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
    :param zones: as in :class:`~sb3_saf.InspectionCallback`
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
        zones=zones,
        normalizer=model.get_vec_normalize_env(),
        observations=observations,
        pictures=pictures,
    )
    gae_lambda = float(getattr(model, "gae_lambda", 1.0))
    return Inspection(recording, model.policy.action_space, return_scale(eval_env), zone_colours(eval_env), gae_lambda)
