"""Callback that stops training at NaN and infinity before they reach the weights."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch.utils.hooks import RemovableHandle

from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.teams.errors import NonFiniteError

#: Arrays of SB3's rollout buffers, in the order of computation.
_ROLLOUT: Final = ("observations", "rewards", "values", "log_probs", "returns", "advantages")


class FiniteCallback(BaseCallback):
    """
    Stop training at NaN or infinity, with the step and the tensor's name, before the weights are damaged.

    It checks gradients before every step of the optimiser, weights after it, rollouts before every update, losses and
    the policy's statistics after it. ``CentralizedValueWrapper`` checks observations and rewards of teams.

    It checks sums, which keep NaN and infinity and read memory once. Per gradient step that is two sums per parameter,
    and two numbers copied from the GPU.

    ``resumable_learn`` adds it automatically.
    """

    def __init__(self) -> None:
        super().__init__()
        self._handles: list[RemovableHandle] = []
        self._sums: dict[str, th.Tensor] = {}
        self._weights: dict[str, th.Tensor] = {}
        self._losses: dict[str, float] = {}
        self._n_optimizer_steps = 0
        self._n_checked = -1

    def _on_training_start(self) -> None:
        self._remove_hooks()
        policy: Any = self.model.policy
        learning = {name: weight for name, weight in policy.named_parameters() if weight.requires_grad}
        for name, parameter in learning.items():
            self._handles.append(parameter.register_post_accumulate_grad_hook(partial(self._note, name)))
        self._weights = learning
        self._handles.append(policy.optimizer.register_step_pre_hook(self._check_gradients))
        self._handles.append(policy.optimizer.register_step_post_hook(self._check_weights))

    def _on_training_end(self) -> None:
        self._check_update()
        self._remove_hooks()

    def _remove_hooks(self) -> None:
        while self._handles:
            self._handles.pop().remove()

    def _on_step(self) -> bool:
        return True

    # --- gradients --------------------------------------------------------------------------------------------------

    def _note(self, name: str, parameter: th.Tensor) -> None:
        """Record the sum of a gradient before clipping, which would spread a single NaN to all gradients."""
        assert parameter.grad is not None
        self._sums[name] = parameter.grad.sum()

    def _check_gradients(self, *_: object) -> None:
        sums, self._sums = self._sums, {}
        if not sums or math.isfinite(float(th.stack(list(sums.values())).sum())):
            return
        for name, value in sums.items():  # in backward order, so the first is the nearest to the loss
            if not bool(value.isfinite()):
                self._stop(f"the gradient of {name}", float(value))

    def _check_weights(self, *_: object) -> None:
        self._n_optimizer_steps += 1
        with th.no_grad():
            if math.isfinite(float(th.stack([weight.sum() for weight in self._weights.values()]).sum())):
                return
            for name, weight in self._weights.items():
                if not math.isfinite(value := float(weight.sum())):
                    self._stop(f"the weight {name}", value)

    # --- rollouts, losses, statistics -------------------------------------------------------------------------------

    def _on_rollout_start(self) -> None:
        self._check_update()

    def _check_update(self) -> None:
        """Check once per update: off-policy algorithms begin a rollout at every step."""
        if self._n_optimizer_steps == self._n_checked:
            return
        self._n_checked = self._n_optimizer_steps
        logged = self.model.logger.name_to_value.items()
        self._losses = {name: value for name, value in logged if name.startswith("train/") and "loss" in name}
        for name, value in self._losses.items():
            if not math.isfinite(value):
                self._stop(name, value)
        with th.no_grad():
            for name, parameter in self.model.policy.state_dict().items():
                if parameter.is_floating_point() and not math.isfinite(value := float(parameter.sum())):
                    self._stop(f"the weight {name}", value)

    def _on_rollout_end(self) -> None:
        for name, array in _floats(getattr(self.model, "rollout_buffer", None)):
            with np.errstate(invalid="ignore"):  # infinity minus infinity
                value = float(array.sum(dtype=np.float64))
            if not math.isfinite(value):
                self._stop(f"{name} of the rollout", value)

    def _stop(self, name: str, value: float) -> None:
        steps = game_steps(self.model)
        when = f"step {self.model.num_timesteps:,}" if steps is None else f"game step {steps:,}"
        losses = ", ".join(f"{loss} {number:.3g}" for loss, number in self._losses.items())
        before = f" (the update before had {losses})" if losses else ""
        raise NonFiniteError(
            f"{name} must be finite, got {value} at {when}, after {self._n_optimizer_steps} steps of the "
            f"optimizer{before}; training stops here, for learning from it would ruin the model: look for a learning "
            "rate that is too high, rewards that are too large, or an encoder or loss of your own that divides by zero"
        )


def _floats(buffer: object) -> Iterator[tuple[str, np.ndarray[Any, np.dtype[np.floating[Any]]]]]:
    """Yield the float arrays of a rollout by name."""
    for name in _ROLLOUT:
        value = getattr(buffer, name, None)
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for key, array in parts:
            if isinstance(array, np.ndarray) and array.dtype.kind == "f":
                yield f"{name} {key}".strip(), array
