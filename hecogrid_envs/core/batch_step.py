"""The compiled loops over games."""

from __future__ import annotations

from hecogrid_envs.core.jit import hot, inlined
from hecogrid_envs.core.rng import below
from hecogrid_envs.core.rules import act
from hecogrid_envs.core.types import U8, Games, RuleBook, whole


@hot
def step_games(games: Games, book: RuleBook, actions: U8, first: int, end: int) -> None:
    """
    Play one step of games ``first`` to ``end - 1``.

    :param actions: (E * N,) action integers, 0 to 6
    """
    for e in range(first, end):
        if book.random_order:
            _shuffle_order(games, book, e)
        games.paid[e] = 0
        for turn in range(book.n_agents):
            agent = whole(games.order[e, turn])
            act(games, book, e, agent, actions[e * book.n_agents + agent])
        games.collected[e] += games.paid[e]
        games.steps[e] += 1


@hot
def mark_games_over(games: Games, book: RuleBook, over: U8, first: int, end: int) -> None:
    """
    Find games whose time is up.

    :param over: (E,) 1 to write for them, 0 for others
    """
    for e in range(first, end):
        over[e] = games.steps[e] >= book.max_cycles


@inlined
def _shuffle_order(games: Games, book: RuleBook, e: int) -> None:
    for agent in range(book.n_agents):
        games.order[e, agent] = agent
    for k in range(book.n_agents - 1, 0, -1):
        other = below(games.rng, e, k + 1)
        games.order[e, k], games.order[e, other] = games.order[e, other], games.order[e, k]
