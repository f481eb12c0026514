"""
Values of a rollout's steps, computed many steps at a time.

Values are not needed before the end of a rollout, where advantages are computed. For the few rows of a single step, the
overhead of calling the critic dominates; evaluating many steps together takes a fraction of the time.

Letters: E games, N agents, B = E N rows, U states of the critic for a team; M, Ma, Mc sizes of the memory of a game, of
the actor, and of one of the critic's states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import torch as th

from sb3_saf.networks.row_encoder import Encoded
from sb3_saf.teams.rows import ACTIVE_KEY, AGENT_KEY

#: Rows whose values are computed at once: enough to amortise the calls, few enough for the cache.
ROWS_AT_ONCE: Final = 1024


@dataclass
class Step:
    """
    Critic's input of one step of all games, and the memory before it.

    :param obs: entries of the rows that critics read (agent indices, active agents)
    :param encoded: their encoded observations, without the observations themselves
    :param starts: (B,) bool, rows whose episode begins with the step; None for policies without memory
    :param actor: (B, Ma) the actor's memory before the step
    :param critic: (E U, Mc) the critic's memory before the step, if it has one; known when values are computed
    :param values: (B, 1) values, as soon as they are computed
    :param n_games: E, for policies with memory
    """

    obs: dict[str, th.Tensor]
    encoded: Encoded
    starts: th.Tensor | None = None
    actor: th.Tensor | None = None
    critic: th.Tensor | None = None
    values: th.Tensor | None = None
    n_games: int = 0

    @classmethod
    def of(cls, obs: th.Tensor | Mapping[str, th.Tensor], encoded: Encoded) -> Step:
        """Return the critic's input of a step; critics read features, so observations are dropped."""
        entries = {} if isinstance(obs, th.Tensor) else obs
        own = encoded.own._replace(observations=encoded.own.features.new_empty(0))
        return cls({key: entries[key] for key in (AGENT_KEY, ACTIVE_KEY) if key in entries}, encoded._replace(own=own))

    @property
    def memory(self) -> th.Tensor | None:
        """Memory of the games before the step, (E, M): that of all agents, then the critic's."""
        parts = [part.reshape(self.n_games, -1) for part in (self.actor, self.critic) if part is not None]
        return th.cat(parts, dim=1) if parts else None


#: Maps the critic's inputs of several steps to the values of each, (B, 1).
Compute: TypeAlias = Callable[[Sequence[Step]], list[th.Tensor]]


class LaterValues(th.Tensor):
    """
    Lazily computed values of one step, (B, 1).

    Any use as a tensor computes them for this step only; ``TeamRolloutBuffer`` computes those of many steps together.
    """

    step: Step
    compute: Compute
    known: th.Tensor | None

    @classmethod
    def of(cls, step: Step, like: th.Tensor, compute: Compute) -> LaterValues:
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


def compute_together(steps: Sequence[LaterValues]) -> list[th.Tensor]:
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
