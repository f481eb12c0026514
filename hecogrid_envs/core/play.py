"""The compiled function that plays all games of a batch, or some of them."""

from __future__ import annotations

from typing import Any, Final

from hecogrid_envs.core.generation import begin, new_level, redraw
from hecogrid_envs.core.jit import cached, hot, inlined, kernel, source_key
from hecogrid_envs.core.rng import below
from hecogrid_envs.core.rules import act
from hecogrid_envs.core.types import BEGIN, REDRAW, RESET, RESTART, STEP, TILES, U8, Buffers, Games, World, whole
from hecogrid_envs.core.view import draw_pictures, observe_tiles


def _compiled_play(sources: int) -> Any:
    """Compile :func:`play` for a source key (:func:`~hecogrid_envs.core.jit.source_key`)."""

    @cached()
    def play(
        games: Games, world: World, buffers: Buffers, task: int, views: U8, last_views: U8, first: int, end: int
    ) -> None:
        """
        Do one task for games ``first`` to ``end - 1``, n games.

        :param task: a sum of ``STEP``, ``RESTART`` (a new level for games that are over) or ``RESET`` (for those that
            ``buffers.fresh`` marks), ``BEGIN`` (an episode from the present terrain, positions, directions and keys),
            ``REDRAW`` (derive the data of views), and ``TILES`` or ``PICTURES``
        :param views: (n * N * V * V,) codes or (n * N * V t * V t * 3,) pixels to write; empty if the task has no views
        :param last_views: as ``views``; only final views of games that are over are written, to their rows; empty for
            none
        """
        _key = sources  # read, so that it is part of the closure
        if task & STEP:
            _step_games(games, world, buffers.actions, first, end)
        if task & RESTART:
            _mark_games_over(games, world, buffers.fresh, first, end)
        if task & (RESTART | RESET):
            size = len(last_views) // (end - first)
            for e in range(first, end):
                if buffers.fresh[e]:
                    last = last_views[(e - first) * size : (e - first + 1) * size]
                    _renew(games, world, buffers, task, last, e)
        if task & (BEGIN | REDRAW):
            for e in range(first, end):
                if task & BEGIN:
                    begin(games, world, e)
                else:
                    redraw(games, world, e)
        if len(views):
            _observe(games, world, buffers, task, views, first, end)

    return play


play: Final[Any] = _compiled_play(source_key())


@kernel
def _renew(games: Games, world: World, buffers: Buffers, task: int, last_views: U8, e: int) -> None:
    """Write the final views of game ``e`` if requested, then give it a new level."""
    if len(last_views):
        _observe(games, world, buffers, task, last_views, e, e + 1)
    collected = games.collected_now[e]
    new_level(games, world, e)
    if task & RESTART:
        games.collected_now[e] = collected  # in the last step; still to be read


@kernel
def _observe(games: Games, world: World, buffers: Buffers, task: int, out: U8, first: int, end: int) -> None:
    """Write views as codes if ``task`` says ``TILES``, else as pixels."""
    if task & TILES:
        observe_tiles(games, world, out, first, end)
    else:
        codes = buffers.codes[first * world.n_agents * world.view_size**2 :]
        observe_tiles(games, world, codes, first, end)
        draw_pictures(
            codes, games.direction, world.atlas, world.turn_bytes, world.view_size, world.tile, out, first, end
        )


@hot
def _step_games(games: Games, world: World, actions: U8, first: int, end: int) -> None:
    """Play one step of games ``first`` to ``end - 1``; ``actions`` (E * N,) are integers from 0 to 6."""
    for e in range(first, end):
        if world.random_order:
            _shuffle_order(games, world, e)
        games.collected_now[e] = 0
        for turn in range(world.n_agents):
            agent = whole(games.order[e, turn])
            act(games, world, e, agent, actions[e * world.n_agents + agent])
        games.collected[e] += games.collected_now[e]
        games.steps[e] += 1


@hot
def _mark_games_over(games: Games, world: World, over: U8, first: int, end: int) -> None:
    """Write 1 to ``over`` (E,) for games whose time is up, 0 for the others of ``first`` to ``end - 1``."""
    for e in range(first, end):
        over[e] = games.steps[e] >= world.max_cycles


@inlined
def _shuffle_order(games: Games, world: World, e: int) -> None:
    for agent in range(world.n_agents):
        games.order[e, agent] = agent
    for k in range(world.n_agents - 1, 0, -1):
        other = below(games.rng, e, k + 1)
        games.order[e, k], games.order[e, other] = games.order[e, other], games.order[e, k]
