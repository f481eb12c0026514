"""
TensorBoard output of inspection: scalars, pictures, hyperparameters, a text that explains the tags, and a layout.

It is written through SB3's logger formats to the run's event file, by a separate logger, so that training's pending
records are unchanged.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, Final, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, HumanOutputFormat, Logger, TensorBoardOutputFormat

from sb3_saf.inspection.recording import OurPolicy
from sb3_saf.teams.vec_env import require_n_agents

#: Formats for numbers only.
_NUMBERS_ONLY: Final = ("stdout", "log", "json", "csv")

#: Hyperparameters to show, if the algorithm has them.
_SHOWN: Final = (
    *("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm"),
    *("buffer_size", "learning_starts", "target_update_interval", "exploration_fraction"),
)
#: Scalars to show with the hyperparameters.
_METRICS: Final = ("team/return", "critic/explained_variance", "pool/entropy", "pool/difference")

#: Explanation of the groups of tags on the Text page.
_TEXT: Final = """
The x-axis of every chart counts **game steps**, of all parallel games together. Stable-Baselines3's
`time/total_timesteps` counts agents' steps: game steps times the number of agents.

Each policy, each slot and each kind of message is a run of that name below the training's, so that a chart such as
`pool/chosen` has a line of its own colour for each.

| tags | meaning |
| --- | --- |
| `team/return` | mean team return of a fixed set of episodes; `_low` and `_high` are its 95 % interval (Student's t) |
| `rollout/ep_rew_mean` | mean team return of the last 100 training episodes |
| `pool/chosen` | how often each policy of the pool is chosen |
| `pool/entropy` | entropy of the choice: 0 decided, 1 all policies blended |
| `pool/entropy_of_mean` | entropy of the mean choice: 0 if the pool has collapsed to one policy |
| `pool/difference` | how differently policies act: 0 alike, 1 never alike |
| `pool/zone_dependence` | how much the zone tells about the chosen policy: 0 nothing, 1 everything |
| `pool_by_zone/zone_z` | how often each policy is chosen in zone z |
| `knowledge_source/write_entropy`, `read_entropy` | attention of slots over agents, of agents over slots: 1 uniform |
| `knowledge_source/read` | how much each slot is read |
| `message/strength` | norm of the message that an agent reads |
| `message/value_error` | error of values with the message as read, with zeros in its place, with another game's |
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
        "how often each policy is chosen": [r"pool/chosen"],
        "entropy of the choice (0 decided, 1 blended)": [r"pool/entropy"],
        "entropy of the mean choice (0 one policy for all)": [r"pool/entropy_of_mean"],
        "difference between policies (0 copies)": [r"pool/difference"],
        "dependence of the choice on zones (0 none)": [r"pool/zone_dependence"],
    },
    "Knowledge source": {
        "how much each slot is read": [r"knowledge_source/read"],
        "value error: message as read, zeroed, shuffled": [r"message/value_error"],
        "strength of messages": [r"message/strength"],
        "entropy of writing (1 slots average the team)": [r"knowledge_source/write_entropy"],
        "entropy of reading (1 all slots alike)": [r"knowledge_source/read_entropy"],
    },
    "Critic": {
        "explained variance (1 is right)": [r"critic/explained_variance"],
        "slope (1 is right)": [r"critic/slope"],
        "bias: value minus return": [r"critic/bias"],
        "error (root mean square)": [r"critic/error"],
    },
}
#: Groups logged after the layout is made: by algorithms, and by critics whose returns were equal until then.
_LATER: Final = ("rollout/", "time/", "train/", "lambda/", "critic/")
#: Charts of algorithms with Q_tot.
_VALUE_CHARTS: Final[dict[str, dict[str, list[str]]]] = {
    "Mixer": {
        "weight of each agent's advantage (lambda)": [r"lambda/agent_\d+"],
        "training: Q_tot and its error": [r"train/q_tot", r"train/td_error"],
        "training: share of random actions": [r"rollout/exploration_rate"],
    },
}


_BAND: Final = ("team/return", "team/return_low", "team/return_high")
#: Tags that are lines of one chart. TensorBoard has one colour per run, so each line is written as a separate run.
_OF_LINES: Final = re.compile(
    r"(?P<chart>.+)/(?P<line>(policy|slot)_\d+)|(?P<errors>message/value_error)_?(?P<with>.*)"
)


class Line(NamedTuple):
    """Target of a scalar that is one of several lines: its tag, and a run below the training's."""

    chart: str
    run: str


def line_of(tag: str) -> Line | None:
    """Return the line of a tag; None if the tag has its own chart."""
    match = _OF_LINES.fullmatch(tag)
    if match is None:
        return None
    return Line(match["chart"] or match["errors"], match["line"] or f"message_{match['with'] or 'as_read'}")


class Page:
    """Writer to the formats of a model's logger, except the screen."""

    def __init__(self, model: BaseAlgorithm, n_agents: int) -> None:
        formats = [each for each in model.logger.output_formats if not isinstance(each, HumanOutputFormat)]
        self._logger = Logger(model.logger.dir, formats)
        self._writers: list[Any] = [each.writer for each in formats if isinstance(each, TensorBoardOutputFormat)]
        self._n_agents = n_agents
        self._lines: dict[Line, float] = {}
        self._writers_of_lines: dict[str, Any] = {}

    @property
    def has_tensorboard(self) -> bool:
        """Whether there is a format for pictures."""
        return bool(self._writers)

    def scalars(self, scalars: Mapping[str, float]) -> None:
        """Record numbers, for TensorBoard and for files."""
        for tag, value in scalars.items():
            line = line_of(tag)
            self._logger.record(tag, value, exclude=None if line is None else ("tensorboard",))
            if line is not None:
                self._lines[line] = value

    def show(self, tag: str, value: object) -> None:
        """Record a figure, an image, a histogram or hyperparameters, for TensorBoard only."""
        self._logger.record(tag, value, exclude=_NUMBERS_ONLY)

    def gif(self, tag: str, encoded: bytes, step: int) -> None:
        """Write an encoded GIF."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        image = Summary.Image(encoded_image_string=encoded, colorspace=3)
        for writer in self._writers:
            writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def explain(self, tags: Iterable[str], value_based: bool) -> None:
        """
        Write the Text page, and the layout of the custom scalars page with the charts for which this run has scalars.

        :param value_based: whether the run learns Q_tot
        """
        for writer in self._writers:
            writer.add_text("about", _TEXT)
            writer.add_custom_scalars(layout(tags, value_based))

    def write(self, step: int) -> None:
        """Write the recorded values; ``step`` counts agent steps, as in SB3, the x-axis game steps."""
        self._logger.dump(step)
        for line, value in self._lines.items():
            for board in self._writers:
                lines = self._writer_of(os.path.join(board.get_logdir(), line.run), step)
                lines.add_scalar(line.chart, value, step // self._n_agents)
        for writer in self._writers_of_lines.values():
            writer.flush()
        self._lines.clear()

    def _writer_of(self, folder: str, step: int) -> Any:
        if folder not in self._writers_of_lines:
            from torch.utils.tensorboard import SummaryWriter

            # Hides what an interrupted run wrote after its last checkpoint, which is written again.
            self._writers_of_lines[folder] = SummaryWriter(folder, purge_step=step // self._n_agents)
        return self._writers_of_lines[folder]


def layout(tags: Iterable[str], value_based: bool) -> dict[str, dict[str, list[Any]]]:
    """
    Lay out the custom scalars page.

    :param value_based: whether the run learns Q_tot
    :return: for ``SummaryWriter.add_custom_scalars``
    """
    tags = [tag if (line := line_of(tag)) is None else line.chart for tag in tags]
    groups: dict[str, dict[str, list[Any]]] = {}
    if set(_BAND) <= set(tags):
        # A separate group, because the page shows bands after all lines of their group.
        groups["Team return"] = {"evaluation, with 95 % interval": ["Margin", list(_BAND)]}
    for group, charts in (_CHARTS | (_VALUE_CHARTS if value_based else {})).items():
        # Those for which the run has scalars, from inspection or from the algorithm's logs.
        lines = {
            name: patterns
            for name, patterns in charts.items()
            if any(p.startswith(_LATER) or any(re.fullmatch(p, tag) for tag in tags) for p in patterns)
        }
        if lines:
            groups[group] = {name: ["Multiline", [f"^{p}$" for p in patterns]] for name, patterns in lines.items()}
    zones = sorted({tag.split("/")[1] for tag in tags if tag.startswith("pool_by_zone/")})
    if zones:
        groups["Policy pool by zone"] = {
            f"how often each policy is chosen in {zone.replace('_', ' ')}": [
                "Multiline",
                [rf"^pool_by_zone/{zone}$"],
            ]
            for zone in zones
        }
    return groups


def hyperparameters(
    model: BaseAlgorithm, policy: OurPolicy, more: Mapping[str, object], scalars: Mapping[str, float]
) -> HParam:
    """
    Describe a run for the HParams page: the user's hyperparameters, then seed and method, then all others.

    TensorBoard sorts the columns by name, so the first ones have a number as prefix: ``1 task``.

    :param more: the user's hyperparameters, such as the task and its level
    """
    env = model.get_env()
    assert env is not None
    n_agents = require_n_agents(env)
    first = {**more, "seed": model.seed, "method": f"{type(model).__name__} {type(policy).__name__}", **more}
    width = len(str(len(first)))
    settings: dict[str, object] = {
        **{f"{number:0{width}} {name}": value for number, (name, value) in enumerate(first.items(), 1)},
        "n_agents": n_agents,
        "n_games": env.num_envs // n_agents,
        **asdict(policy.parts),
        "features_extractor": type(policy.features_extractor).__name__,
        "learning_rate": model.lr_schedule(1.0),
        **{name: getattr(model, name, None) for name in _SHOWN},
        "train_freq": getattr(getattr(model, "train_freq", None), "frequency", None),
    }
    values = {
        name: value if isinstance(value, (bool, str, float, int)) else str(value)
        for name, value in settings.items()
        if value is not None
    }
    return HParam(values, {tag: float(scalars[tag]) for tag in _METRICS if tag in scalars})
