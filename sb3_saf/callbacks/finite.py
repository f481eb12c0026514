"""NaN and infinity stop training before they reach the weights."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from functools import partial
from types import FrameType
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from torch.utils.hooks import RemovableHandle

from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.errors import NonFiniteError

#: What SB3's rollout buffers hold, in the order in which one makes the next.
_ROLLOUT: Final = ("observations", "rewards", "values", "log_probs", "returns", "advantages")


class FiniteCallback(BaseCallback):
    """
    Stop training at NaN or infinity, with the step and the tensor's name, while the weights are still good.

    Looked at are gradients before every step of the optimiser, weights after it, rollouts before every update, losses
    and the policy's statistics after it. Observations and rewards of teams are looked at when the environment gives
    them, by ``CentralizedValueWrapper``.

    Sums are what is looked at: NaN and infinity stay in them, and memory is read once. Per gradient step that is two
    numbers of each parameter, and two that leave the GPU.

    ``resumable_learn`` uses it by itself.
    """

    def __init__(self) -> None:
        super().__init__()
        self._handles: list[RemovableHandle] = []
        self._sums: dict[str, th.Tensor] = {}
        self._weights: dict[str, th.Tensor] = {}
        self._checked_update = -1

    def _on_training_start(self) -> None:
        self._let_go()
        policy: Any = self.model.policy
        learning = {name: weight for name, weight in policy.named_parameters() if weight.requires_grad}
        for name, parameter in learning.items():
            self._handles.append(parameter.register_post_accumulate_grad_hook(partial(self._note, name)))
        self._weights = learning
        self._handles.append(policy.optimizer.register_step_pre_hook(self._check_gradients))
        self._handles.append(policy.optimizer.register_step_post_hook(self._check_weights))

    def _on_training_end(self) -> None:
        self._check_update()
        self._let_go()

    def _let_go(self) -> None:
        while self._handles:
            self._handles.pop().remove()

    def _on_step(self) -> bool:
        return True

    # --- gradients --------------------------------------------------------------------------------------------------

    def _note(self, name: str, parameter: th.Tensor) -> None:
        """Before gradients are clipped: a single NaN in their norm would spread to all of them."""
        assert parameter.grad is not None
        self._sums[name] = parameter.grad.sum()

    def _check_gradients(self, *_: object) -> None:
        sums, self._sums = self._sums, {}
        if not sums or math.isfinite(float(th.stack(list(sums.values())).sum())):
            return
        for name, value in sums.items():  # from the loss backwards, so the first is the nearest to it
            if not bool(value.isfinite()):
                losses = ", ".join(f"{loss} {number:.3g}" for loss, number in _losses(self.model).items())
                self._stop(f"the gradient of {name}", float(value), losses and f"; {losses}")

    def _check_weights(self, *_: object) -> None:
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
        """Once per update: an algorithm off-policy begins a rollout at every step."""
        if self.model._n_updates == self._checked_update:
            return
        self._checked_update = self.model._n_updates
        for name, value in self.model.logger.name_to_value.items():
            if name.startswith("train/") and "loss" in name and not math.isfinite(value):
                self._stop(name, value)
        with th.no_grad():
            for name, parameter in self.model.policy.state_dict().items():
                if parameter.is_floating_point() and not math.isfinite(value := float(parameter.sum())):
                    self._stop(f"the weight {name}", value)

    def _on_rollout_end(self) -> None:
        for name, array in _floats(getattr(self.model, "rollout_buffer", None)):
            with np.errstate(invalid="ignore"):  # infinity less infinity
                value = float(array.sum(dtype=np.float64))
            if not math.isfinite(value):
                self._stop(f"{name} of the rollout", value)

    def _stop(self, name: str, value: float, more: str = "") -> None:
        steps = game_steps(self.model)
        when = f"step {self.model.num_timesteps:,}" if steps is None else f"game step {steps:,}"
        raise NonFiniteError(
            f"{name} must be finite, got {value} at {when}, after {self.model._n_updates} updates{more}; training "
            "stops here, for learning from it would ruin the model: look for a learning rate that is too high, rewards "
            "that are too large, or an encoder or loss of your own that divides by zero"
        )


def _floats(buffer: object) -> Iterator[tuple[str, np.ndarray[Any, np.dtype[np.floating[Any]]]]]:
    """Arrays of a rollout that may hold NaN, by name."""
    for name in _ROLLOUT:
        value = getattr(buffer, name, None)
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for key, array in parts:
            if isinstance(array, np.ndarray) and array.dtype.kind == "f":
                yield f"{name} {key}".strip(), array


def _losses(model: BaseAlgorithm) -> dict[str, float]:
    """Losses of the update that is going on. SB3 has them in variables of ``train`` alone."""
    frame: FrameType | None = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_name == "train" and frame.f_locals.get("self") is model:
            found = frame.f_locals.items()
            return {name: value.item() for name, value in found if "loss" in name and _is_number(value)}
        frame = frame.f_back
    return {}


def _is_number(value: object) -> bool:
    return isinstance(value, th.Tensor) and value.numel() == 1
