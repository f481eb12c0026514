"""
What inspection writes to TensorBoard: scalars, pictures, hyperparameters, a text that explains the tags, and a layout.

It goes through SB3's logger formats into the run's own event file, by a logger beside the model's: what training has
recorded and not yet dumped stays there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, Final

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, HumanOutputFormat, Logger, TensorBoardOutputFormat

from sb3_saf.envs.teams import require_n_agents
from sb3_saf.inspection.reading import OurPolicy

#: Formats that hold numbers only.
_NUMBERS_ONLY: Final = ("stdout", "log", "json", "csv")

#: Hyperparameters that are shown, of algorithms that have them.
_SHOWN: Final = (
    *("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm"),
    *("buffer_size", "learning_starts", "update_interval", "target_update_interval", "exploration_fraction"),
)
#: Scalars that are shown beside hyperparameters.
_METRICS: Final = (
    *("team/return", "critic/explained_variance", "pool/entropy", "pool/difference", "message/value_error"),
)

#: What the groups of tags mean, shown on the Text page.
_TEXT: Final = """
The x-axis of every chart counts **agents' steps**, as Stable-Baselines3 does: game steps times the number of agents.
`time/game_steps` is the same in game steps.

| tags | meaning |
| --- | --- |
| `team/return` | mean team return of a fixed set of episodes; `_low` and `_high` are its 95 % interval (Student's t) |
| `rollout/ep_rew_mean` | mean team return of the last 100 training episodes |
| `pool/chosen/policy_k` | how often policy k of the pool is chosen |
| `pool/entropy` | entropy of the choice: 0 decided, 1 all policies blended |
| `pool/entropy_of_mean` | entropy of the mean choice: 0 if the pool has collapsed to one policy |
| `pool/difference` | how differently policies act: 0 alike, 1 never alike |
| `pool/zone_dependence` | how much the zone tells about the chosen policy: 0 nothing, 1 everything |
| `pool_by_zone/zone_z/policy_k` | how often policy k is chosen in zone z |
| `knowledge_source/write_entropy`, `read_entropy` | attention of slots over agents, of agents over slots: 1 uniform |
| `knowledge_source/read/slot_l` | how much slot l is read |
| `message/strength` | norm of the message that an agent reads |
| `message/value_error` | error of values; `_zeroed`, `_shuffled`: with another message in place of the one read |
| `critic/explained_variance` | 1 for a critic that predicts every return, 0 for one that says a constant |
| `critic/slope`, `critic/bias` | 1 and 0 for a calibrated critic |
| `lambda/agent_i`, `train/q_tot` | QPLEX: weight of agent i's advantage, value of the team |
"""

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
        "strength of messages": [r"message/strength"],
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


_BAND: Final = ("team/return", "team/return_low", "team/return_high")


class Page:
    """
    Writes to the formats of a model's logger, but not to the screen.

    :param model: in ``learn``, with its logger set up
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        formats = [each for each in model.logger.output_formats if not isinstance(each, HumanOutputFormat)]
        self._logger = Logger(model.logger.dir, formats)
        self._writers: list[Any] = [each.writer for each in formats if isinstance(each, TensorBoardOutputFormat)]

    @property
    def has_tensorboard(self) -> bool:
        """Whether pictures are written anywhere."""
        return bool(self._writers)

    def scalars(self, scalars: Mapping[str, float]) -> None:
        """Record numbers, for TensorBoard and for files."""
        for tag, value in scalars.items():
            self._logger.record(tag, value)

    def show(self, tag: str, value: object) -> None:
        """Record a figure, an image, a histogram or hyperparameters, for TensorBoard alone."""
        self._logger.record(tag, value, exclude=_NUMBERS_ONLY)

    def gif(self, tag: str, encoded: bytes, step: int) -> None:
        """Write an animated image as it is."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        image = Summary.Image(encoded_image_string=encoded, colorspace=3)
        for writer in self._writers:
            writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def explain(self, tags: Iterable[str], value_based: bool) -> None:
        """
        Write the Text page, and the layout of the custom scalars page without charts that this run has nothing for.

        :param tags: of the run's first inspection
        :param value_based: whether the run learns Q_tot
        """
        for writer in self._writers:
            writer.add_text("about", _TEXT)
            writer.add_custom_scalars(layout(tags, value_based))

    def write(self, step: int) -> None:
        """
        Write what was recorded.

        :param step: of the x-axis: agents' steps, as everything that SB3 writes
        """
        self._logger.dump(step)


def layout(tags: Iterable[str], value_based: bool) -> dict[str, dict[str, list[Any]]]:
    """
    Lay out the custom scalars page.

    :param tags: of the run's first inspection
    :param value_based: whether the run learns Q_tot
    :return: for ``SummaryWriter.add_custom_scalars``
    """
    tags = list(tags)
    groups: dict[str, dict[str, list[Any]]] = {}
    if set(_BAND) <= set(tags):
        # A group of its own, because the page shows bands after all lines of their group.
        groups["Team return"] = {"evaluation, with 95 % interval": ["Margin", list(_BAND)]}
    for group, charts in (_CHARTS | (_VALUE_CHARTS if value_based else {})).items():
        kept = {name: patterns for name, patterns in charts.items() if any(_is_coming(p, tags) for p in patterns)}
        if kept:
            groups[group] = {name: ["Multiline", [f"^{p}$" for p in patterns]] for name, patterns in kept.items()}
    zones = sorted({tag.split("/")[1] for tag in tags if tag.startswith("pool_by_zone/")})
    if zones:
        groups["Policy pool by zone"] = {
            f"how often each policy is chosen in {zone.replace('_', ' ')}": [
                "Multiline",
                [rf"^pool_by_zone/{zone}/policy_\d+$"],
            ]
            for zone in zones
        }
    return groups


def _is_coming(pattern: str, tags: Iterable[str]) -> bool:
    """Return whether a run has scalars for a pattern: from inspection, or from the algorithm's own logs."""
    return pattern.startswith(_OF_ALGORITHMS) or any(re.fullmatch(pattern, tag) for tag in tags)


def hyperparameters(
    model: BaseAlgorithm, policy: OurPolicy, more: Mapping[str, object], scalars: Mapping[str, float]
) -> HParam:
    """
    Describe a run for the HParams page: task and level first, then seed and method, then all else.

    :param model: the algorithm
    :param policy: its policy
    :param more: the user's own, such as the task and its level
    :param scalars: that the run writes
    """
    env = model.get_env()
    assert env is not None
    n_agents = require_n_agents(env)
    found: dict[str, object] = {
        **more,
        "seed": model.seed,
        "algorithm": type(model).__name__,
        "policy": type(policy).__name__,
        "n_agents": n_agents,
        "n_games": env.num_envs // n_agents,
        **asdict(policy.parts),
        "features_extractor": type(policy.features_extractor).__name__,
        "learning_rate": model.lr_schedule(1.0),
        **{name: getattr(model, name, None) for name in _SHOWN},
    }
    kept = {
        name: value if isinstance(value, (bool, str, float, int)) else str(value)
        for name, value in found.items()
        if value is not None
    }
    return HParam(kept, {tag: float(scalars[tag]) for tag in _METRICS if tag in scalars})
