"""Linear schedule of the entropy coefficient; SB3 has schedules of the learning rate and the clip range only."""

from __future__ import annotations

import math
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.teams.errors import SettingsError


class EntropySchedule(BaseCallback):
    """
    Change the entropy coefficient linearly from the model's ``ent_coef`` to ``end`` over the training.

    An entropy bonus keeps agents exploring, but what it adds to their actions remains in the trained team, whose most
    likely actions may then be worse than drawn ones. With a bonus that decreases to 0 they lose less (results page).

    Each update uses the value at the end of its rollout, as SB3 does for learning rates, and logs it as
    ``train/ent_coef``. Outside updates the model has its own value, so that saved models and longer runs keep it. SB3
    calls no callback when an exception ends ``learn``: after Ctrl-C within an update the lower value stays in the
    model, unless ``sb3_saf.resumable_learn`` or ``sb3_saf.train`` trains it, which restore it.

    In settings: ``callback: sb3_saf.EntropySchedule``.

    :param end: value at the end of training, at least 0
    :raises ValueError: if ``end`` is no such number, or the algorithm has no ``ent_coef`` that differs from it
    """

    def __init__(self, end: float = 0.0) -> None:
        super().__init__()
        if isinstance(end, bool) or not isinstance(end, (int, float)) or not 0 <= end < math.inf:
            raise ValueError(f"end must be a number of at least 0, got {end!r}")
        self.end = end
        self._start = 0.0

    def _init_callback(self) -> None:
        found = getattr(self.model, "ent_coef", None)
        if not isinstance(found, (int, float)):
            raise SettingsError(
                f"EntropySchedule changes the entropy coefficient of PPO and A2C; {type(self.model).__name__} has "
                f"{'none' if found is None else f'ent_coef={found!r}'}; leave the callback out"
            )
        if found == self.end:
            raise SettingsError(
                f"EntropySchedule has nothing to change: ent_coef is {found} from the start, as end; give the "
                "algorithm another, such as ent_coef=0.01"
            )
        self._start = float(found)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        self.logger.record("train/ent_coef", model.ent_coef)  # SB3 writes it beside the losses of the last update
        model.ent_coef = self._start

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        done = self.num_timesteps / self.locals["total_timesteps"]
        model.ent_coef = self._start + min(done, 1.0) * (self.end - self._start)

    def _on_training_end(self) -> None:
        model: Any = self.model
        model.ent_coef = self._start
