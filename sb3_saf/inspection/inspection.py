"""One look into a team: its episodes, as numbers, figures and a film."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_saf.envs.teams import check_count
from sb3_saf.inspection import figures, film, report
from sb3_saf.inspection.calibration import calibrate, lambda_returns
from sb3_saf.inspection.doors import Picture, ReturnScale, Zones, check_zones, return_scale, zone_colours, zone_function
from sb3_saf.inspection.episodes import Played, Player
from sb3_saf.inspection.kinds import require_our_policy
from sb3_saf.inspection.pool import chosen_by, differences
from sb3_saf.randomness import own_randomness

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Inspection(NamedTuple):
    """
    What was seen of a team, and how to show it.

    :param played: every step, as arrays
    :param action_space: one agent's
    :param scale: what team returns count
    :param colours: of the zones; None if the environment has none
    :param gamma: discount of the returns that values are compared with
    :param gae_lambda: of the targets that the critic learns
    """

    played: Played
    action_space: spaces.Space[Any]
    scale: ReturnScale
    colours: Sequence[figures.Colour] | None
    gamma: float
    gae_lambda: float

    @property
    def scalars(self) -> dict[str, float]:
        """Everything that is a number, by the names that TensorBoard shows (``docs/tensorboard.md``)."""
        return {
            **report.team_scalars(self.played, self.scale),
            **report.pool_scalars(self.played, self.action_space),
            **report.knowledge_scalars(self.played),
            **report.critic_scalars(self.played, self.gamma, self.gae_lambda),
            **report.message_scalars(self.played, self.gamma),
        }

    @property
    def figures(self) -> dict[str, Figure]:
        """What there is to draw, by the names that TensorBoard shows. Needs matplotlib."""
        return {"critic/calibration": self._calibration(), **self._of_the_pool(), **self._of_the_knowledge_source()}

    @property
    def film(self) -> bytes | None:
        """The first episode as a GIF; None if the environment draws no pictures. Needs Pillow."""
        return film.gif(self.played.pictures) if self.played.pictures else None

    @property
    def strip(self) -> Picture | None:
        """Six moments of the first episode, (height, width, 3); None if the environment draws no pictures."""
        return film.strip(self.played.pictures) if self.played.pictures else None

    def _calibration(self) -> Figure:
        counted = self.played.counted
        values, returns = self.played.values[counted], lambda_returns(self.played, self.gamma)[counted]
        unit = self.scale.unit and f"{self.scale.unit} {'of the team' if self.played.of_team else 'per agent'}"
        return figures.calibration(values, returns, calibrate(values, returns), unit)

    def _of_the_pool(self) -> dict[str, Figure]:
        played, counted = self.played, self.played.counted
        if played.weights is None or played.actions is None:
            return {}
        by_agent = chosen_by(played.weights[counted], report.counted_agents(played), played.n_agents)
        drawn = {
            "pool/by_agent": figures.chosen_by_agent(by_agent),
            "pool/differences": figures.policy_differences(differences(self.action_space, played.actions[counted])),
        }
        if played.zones is not None:
            zones = played.zones[counted]
            n_zones = max(int(zones.max(initial=0)) + 1, len(self.colours or ()))
            by_zone = chosen_by(played.weights[counted], zones, n_zones)
            drawn["pool/by_zone"] = figures.chosen_by_zone(by_zone, self.colours)
        return drawn

    def _of_the_knowledge_source(self) -> dict[str, Figure]:
        write, read = report.write_attention(self.played), report.read_attention(self.played)
        if write is None or read is None or self.played.write is None:
            return {}
        return {
            "knowledge_source/attention": figures.attention(write, read),
            "knowledge_source/one_episode": figures.attention_over_time(_first_episode(self.played, self.played.write)),
        }


def inspect_team(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    n_eval_episodes: int = 16,
    seed: int = 20_000,
    deterministic: bool = False,
    zones: Zones = None,
) -> Inspection:
    """
    Look into a team: play episodes, and keep what its policy does and thinks.

    The same as :class:`~sb3_saf.InspectionCallback` writes to TensorBoard, once and in hand. ``scalars`` of what comes
    back are numbers by name, ``figures`` are drawn when asked for, ``film`` is the first episode as a GIF, ``played``
    has every step as arrays.

    :param model: with a policy of this package
    :param eval_env: environment of teams, for instance from ``make_team_env`` with ``n_envs=16`` and, for a film,
        ``render_mode="rgb_array"``
    :param n_eval_episodes: team episodes to play
    :param seed: of the episodes
    :param deterministic: whether the policy takes its most likely actions
    :param zones: as in :class:`~sb3_saf.InspectionCallback`
    :raises ValueError: if the policy is none of this package's or ``eval_env`` is not made of teams
    """
    require_our_policy(model.policy)
    check_zones(zones)
    check_count("n_eval_episodes", n_eval_episodes)
    player = Player(eval_env, n_eval_episodes, seed, deterministic, zone_function(eval_env, zones))
    return inspect_with(player, model, model.get_vec_normalize_env())


def inspect_with(
    player: Player, model: BaseAlgorithm, normalising: VecNormalize | None, draw: bool = True
) -> Inspection:
    """
    Play a player's episodes; no generator that training draws from moves.

    :param player: plays
    :param model: to look into
    :param normalising: what normalises the rewards that the critic learns from, if anything does
    :param draw: whether to draw the first game
    """
    policy = require_our_policy(model.policy)
    training = policy.training
    policy.set_training_mode(False)
    with own_randomness(player.seed, model.device):
        played = player.play(policy, normalising, draw=draw)
    policy.set_training_mode(training)
    return Inspection(
        played,
        policy.action_space,
        return_scale(player.env),
        zone_colours(player.env),
        float(getattr(model, "gamma", 1.0)),
        float(getattr(model, "gae_lambda", 1.0)),
    )


def _first_episode(played: Played, attention: np.ndarray) -> np.ndarray:
    """(T', ...) of the first game that was played, up to the end of its first episode."""
    game = int(np.flatnonzero(report.counted_games(played).any(axis=0))[0])
    ends = played.ends.reshape(len(played.ends), -1, played.n_agents)[:, game].all(axis=1)
    return attention[: int(np.flatnonzero(ends)[0]) + 1, game]
