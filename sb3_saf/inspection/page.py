"""
Where things are written: through SB3's logger formats, into the run's own event file.

A logger of our own in front of the model's formats, so that what training has recorded and not yet dumped stays there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, HumanOutputFormat, Logger, TensorBoardOutputFormat

from sb3_saf.envs.teams import require_n_agents
from sb3_saf.inspection.kinds import OurPolicy

#: Formats that hold numbers only.
_NOT_FOR: Final = ("stdout", "log", "json", "csv")

#: Hyperparameters that are shown, of algorithms that have them.
_NUMBERS: Final = (
    *("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm"),
    *("buffer_size", "learning_starts", "update_interval", "target_update_interval", "exploration_fraction"),
)

#: Charts of the custom scalars page: group, chart, regular expressions of tags.
_CHARTS: Final[dict[str, dict[str, list[str]]]] = {
    "Team": {
        "evaluation: share of the largest return": [r"team/share_of_.+"],
        "training: mean return of the last 100 episodes": [r"rollout/ep_rew_mean"],
        "training: game steps per second": [r"time/game_steps_per_second"],
        "evaluation: episode length (game steps)": [r"team/episode_length"],
    },
    "Policy pool": {
        "how often each policy is chosen": [r"pool/chosen/policy_\d+"],
        "entropy of the choice (0 decided, 1 blended)": [r"pool/entropy", r"pool/entropy_of_mean"],
        "difference between policies, dependence on zones": [r"pool/difference", r"pool/zone_dependence"],
    },
    "Knowledge source": {
        "entropy of writing and reading (1 uniform)": [r"knowledge_source/(write|read)_entropy(_of_mean)?"],
        "how much each slot is read": [r"knowledge_source/read/slot_\d+"],
        "value error with and without the message": [r"message/value_error.*"],
    },
    "Critic": {
        "explained variance and slope (1 is right)": [r"critic/explained_variance.*", r"critic/slope"],
        "mean value and mean return": [r"critic/mean_value", r"critic/mean_return"],
        "error (root mean square)": [r"critic/error", r"critic/td_error"],
    },
}
#: Groups that algorithms log themselves, later than the layout is made.
_OF_ALGORITHMS: Final = ("rollout/", "time/", "train/", "lambda/")
#: Charts of algorithms that learn Q_tot.
_VALUE_CHARTS: Final[dict[str, dict[str, list[str]]]] = {
    "Mixer": {
        "weight of each agent's advantage (lambda)": [r"lambda/agent_\d+"],
        "training: Q_tot and its error": [r"train/q_tot", r"train/td_error"],
        "training: share of random actions": [r"rollout/exploration_rate"],
    },
}


class Page:
    """
    Writes to the formats of a model's logger, but not to the screen.

    :param model: in ``learn``, with its logger set up
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        formats = [each for each in model.logger.output_formats if not isinstance(each, HumanOutputFormat)]
        self._logger = Logger(model.logger.dir, formats)
        self._boards = [each for each in formats if isinstance(each, TensorBoardOutputFormat)]

    @property
    def has_tensorboard(self) -> bool:
        """Whether anybody will see pictures."""
        return bool(self._boards)

    def scalars(self, scalars: Mapping[str, float]) -> None:
        """Numbers, for TensorBoard and for files."""
        for tag, value in scalars.items():
            self._logger.record(tag, value)

    def show(self, tag: str, value: object) -> None:
        """A figure, an image, a histogram or hyperparameters, for TensorBoard alone."""
        self._logger.record(tag, value, exclude=_NOT_FOR)

    def gif(self, tag: str, encoded: bytes, step: int) -> None:
        """An animated image, as it is."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        image = Summary.Image(encoded_image_string=encoded, colorspace=3)
        for board in self._boards:
            writer = board.writer._get_file_writer()
            writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def arrange(self, tags: Mapping[str, float], value_based: bool) -> None:
        """
        Lay out the custom scalars page, leaving out charts that this run has nothing for.

        :param tags: of the run's first inspection
        :param value_based: whether the run learns Q_tot
        """
        layout: dict[str, dict[str, list[Any]]] = {}
        for category, charts in {**_CHARTS, **(_VALUE_CHARTS if value_based else {})}.items():
            kept = {
                name: ["Multiline", [f"^{pattern}$" for pattern in patterns]]
                for name, patterns in charts.items()
                if any(_is_coming(pattern, tags) for pattern in patterns)
            }
            if kept:
                layout[category] = kept
        band = ["team/return", "team/return_low", "team/return_high"]
        if set(band) <= set(tags):
            # A group of its own, because the page shows bands after all lines of their group.
            layout = {"Team return": {"evaluation, with 95 % interval": ["Margin", band]}, **layout}
        zones = sorted({tag.rsplit("/", 1)[0] for tag in tags if tag.startswith("pool_by_zone/")})
        if zones:
            layout["Policy pool by zone"] = {
                f"how often each policy is chosen in {zone.split('/')[1].replace('_', ' ')}": [
                    "Multiline",
                    [rf"^{zone}/policy_\d+$"],
                ]
                for zone in zones
            }
        for board in self._boards:
            board.writer.add_custom_scalars(layout)

    def write(self, step: int) -> None:
        """
        Write what was recorded.

        :param step: of the x-axis: agents' steps, as everything that SB3 writes
        """
        self._logger.dump(step)


def _is_coming(pattern: str, tags: Iterable[str]) -> bool:
    """Whether a run has scalars for a pattern: among what is inspected, or from the algorithm's own logs."""
    return pattern.startswith(_OF_ALGORITHMS) or any(re.fullmatch(pattern, tag) for tag in tags)


def hyperparameters(model: BaseAlgorithm, policy: OurPolicy, more: Mapping[str, object]) -> dict[str, Any]:
    """
    What describes a run: the algorithm's numbers, the fields of the policy's parts, the sizes.

    :param model: the algorithm
    :param policy: its policy
    :param more: the user's own, such as the task and its level
    """
    from dataclasses import asdict

    env = model.get_env()
    assert env is not None
    n_agents = require_n_agents(env)
    found: dict[str, object] = {
        "algorithm": type(model).__name__,
        "policy": type(policy).__name__,
        "n_agents": n_agents,
        "n_games": env.num_envs // n_agents,
        "features_extractor": type(policy.features_extractor).__name__,
        "learning_rate": model.lr_schedule(1.0),
        "seed": model.seed,
    }
    for name in _NUMBERS:
        found[name] = getattr(model, name, None)
    found |= asdict(policy.parts) | dict(more)
    return {name: _plain(value) for name, value in found.items() if value is not None}


def hparams(values: Mapping[str, Any], metrics: Mapping[str, float]) -> HParam:
    """
    SB3's HParam, which shows the scalars of the given tags beside the hyperparameters.

    :param values: hyperparameters
    :param metrics: tags that the run writes
    """
    wanted = ("team/return", "critic/explained_variance", "pool/entropy", "pool/difference", "message/value_error")
    return HParam(dict(values), {tag: float(metrics[tag]) for tag in wanted if tag in metrics})


def _plain(value: object) -> bool | str | float | int:
    """TensorBoard takes nothing else."""
    return value if isinstance(value, (bool, str, float, int)) else str(value)
