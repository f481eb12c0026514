"""What a user asks the zoo for, in the zoo's own words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_saf.training.settings import Settings, load_settings
from sb3_saf.training.yaml_files import Size, merge


@dataclass(frozen=True)
class Request:
    """
    What the user asked for and RL-Zoo3 has no words for.

    :param algo: name in ``ALGOS``
    :param env_id: the environment
    :param size: the size
    :param env_kwargs: parameters of the level
    :param eval_env_kwargs: what differs in the level of evaluation
    :param overrides: settings that win over the files
    :param config: a file in place of the algorithm's
    :param eval_freq: game steps between evaluations; 0 or less for none, None for 20 in a run
    :param save_freq: game steps between saved models; 0 or less for none
    :param inspect_freq: game steps between looks into the policy for TensorBoard; 0 or less for none, None for 10
    :param checkpoint_freq: game steps between checkpoints to go on from; 0 or less for none, None for 10 in a run
    :param resume: folder of a run to go on with; None for a new one
    :param seed: the run's seed; None if any will do
    :param deterministic_eval: whether evaluation takes the most likely actions
    :param trial: number of the trial to train again, or ``"best"``
    :param options: all options as given, to be kept
    :param command: the command, to be kept
    """

    algo: str
    env_id: str
    size: Size = "paper"
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    eval_env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    overrides: Mapping[str, Any] = field(default_factory=dict)
    config: Path | None = None
    eval_freq: int | None = None
    save_freq: int = -1
    inspect_freq: int | None = None
    checkpoint_freq: int | None = None
    resume: Path | None = None
    seed: int | None = None
    deterministic_eval: bool = False
    trial: int | str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""

    def settings(self, sampled: Mapping[str, Any] | None = None, *, evaluation: bool = False) -> Settings:
        """
        The settings asked for.

        :param sampled: settings of a trial; what the user gave wins over them
        :param evaluation: with the level of evaluation
        """
        env_kwargs = {**self.env_kwargs, **(self.eval_env_kwargs if evaluation else {})}
        overrides = merge(sampled or {}, self.overrides)
        return load_settings(self.algo, self.env_id, self.size, env_kwargs, overrides, self.config)
