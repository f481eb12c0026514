"""
Values of a rollout's steps, computed many steps at a time.

Values are not needed before the end of a rollout, where advantages are computed. For the few rows of a single step, the
overhead of calling the critic dominates; evaluating many steps together takes a fraction of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

import torch as th

#: Rows whose values are computed at once: enough to amortise the calls, few enough for the cache.
ROWS_AT_ONCE: Final = 1024


class AnyStep(Protocol):
    """Input of a critic."""

    @property
    def memory(self) -> th.Tensor | None:
        """
        The memory (E, M) of games before the step; None for policies without memory.

        It is complete when the values of the step are computed.
        """


Step = TypeVar("Step", bound=AnyStep)
#: Maps the critic's inputs of several steps to the values of each, (B, 1).
Compute = Callable[[Sequence[Step]], list[th.Tensor]]


class LaterValues(th.Tensor, Generic[Step]):
    """
    Lazily computed values of one step, (B, 1).

    Any use as a tensor computes them for this step only; ``TeamRolloutBuffer`` computes those of many steps together.
    """

    step: Step
    compute: Compute[Step]
    known: th.Tensor | None

    @classmethod
    def of(cls, step: Step, like: th.Tensor, compute: Compute[Step]) -> LaterValues[Step]:
        """
        Make values to be computed later.

        :param step: input of the critic
        :param like: (B, ...) tensor with their device and number of rows
        :param compute: the critic
        """
        later = like.new_empty(len(like), 1).as_subclass(cls)
        later.step, later.compute, later.known = step, compute, None
        return later

    @classmethod
    def __torch_function__(
        cls, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Compute the values and call the function with them."""
        return func(*map(_known, args), **{name: _known(value) for name, value in (kwargs or {}).items()})


def compute_together(steps: Sequence[LaterValues[Any]]) -> list[th.Tensor]:
    """
    Compute the values of several steps of one policy.

    :return: values (B, 1) of each step
    """
    waiting = [step for step in steps if step.known is None]
    if waiting:
        for step, values in zip(waiting, waiting[0].compute([step.step for step in waiting]), strict=True):
            step.known = values
    return [_known(step) for step in steps]


def _known(argument: Any) -> Any:
    if isinstance(argument, (list, tuple)):
        return type(argument)(map(_known, argument))
    if not isinstance(argument, LaterValues):
        return argument
    if argument.known is None:
        (argument.known,) = argument.compute([argument.step])
    return argument.known
