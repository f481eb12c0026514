"""Games of one process (SuperSuit's ``ConcatVecEnv`` with fixes) and the source they are made from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import numpy.typing as npt
from supersuit.vector import ConcatVecEnv

from sb3_saf.envs.game_copies import Way, find_way
from sb3_saf.envs.game_form import GameForm
from sb3_saf.envs.supersuit_game import Info, Infos, TeamMarkovVectorEnv


class Question(NamedTuple):
    """
    Query to a game.

    :param game: index among all E games
    :param function: of :mod:`sb3_saf.envs.game_layers`, called with the game
    :param args: further arguments
    """

    game: int
    function: Callable[..., Any]
    args: tuple[Any, ...]


class Played(NamedTuple):
    """
    Results of a step of some games, by row.

    :param observations: observations of the rows
    :param rewards: float32
    :param dones: bool
    :param infos: infos of the rows
    :param reset_infos: infos of the last reset of each row's game
    :param notes: texts of warnings to issue
    """

    observations: Any
    rewards: npt.NDArray[np.float32]
    dones: npt.NDArray[np.bool_]
    infos: Infos
    reset_infos: Infos
    notes: list[str]


class GameSource:
    """
    Factory or environment from which games are made.

    It is stored pickled if possible, so that a function that returns an existing environment makes copies of it.

    :param make_env: the factory or the environment
    :param is_factory: whether ``make_env`` is a factory
    :param n_cpus: number of processes in which games will be made; with one process a factory need not be picklable
        (for instance of a local class with ``functools.lru_cache`` on its methods)
    :raises ValueError: if it cannot be copied, with a fix
    """

    def __init__(self, make_env: Any, is_factory: bool, n_cpus: int) -> None:
        self._is_factory = is_factory
        self._pickled: bytes | None = None
        self._original: Any = None
        try:
            self._pickled = cloudpickle.dumps(make_env)
        except Exception as error:
            if n_cpus > 1:
                raise ValueError(
                    f"n_cpus={n_cpus} sends {make_env} to worker processes, but pickling it failed ({error}); move "
                    "what it uses to the top level of a module (functools.lru_cache on methods of a class inside a "
                    "function is such a thing), or use n_cpus=1, where nothing is sent"
                ) from error
            self._original = make_env if is_factory else _deep_copy(make_env)

    def build(self) -> Any:
        """Make a game."""
        if self._pickled is not None:
            content = cloudpickle.loads(self._pickled)
            return content() if self._is_factory else content
        return self._original() if self._is_factory else deepcopy(self._original)


def _deep_copy(env: Any) -> Any:
    try:
        return deepcopy(env)
    except Exception as error:
        raise ValueError(
            f"each game needs its own copy of {env}, but copying it failed ({error}); "
            "pass a function that makes the environment instead"
        ) from error


class TeamConcatVecEnv(ConcatVecEnv):
    """
    Games of this process, one after another.

    Changes to :class:`supersuit.vector.ConcatVecEnv`: each game gets its own seed and options, attributes and methods
    of games are accessible, and all games are closed even if closing one fails.

    :param source: makes the games
    :param form: form of the games
    :param indices: indices of the games among all E
    :raises ValueError: if the source returns the same environment twice
    """

    def __init__(self, source: GameSource, form: GameForm, indices: Sequence[int]) -> None:
        self._notes: list[str] = []
        self._indices = indices
        self.vec_envs: list[TeamMarkovVectorEnv] = []  # until Gymnasium 1.2, close also runs if construction failed
        super().__init__(
            [lambda index=index: TeamMarkovVectorEnv(source.build(), form, index, self._notes) for index in indices]
        )
        self._n_agents = len(form.agents)
        self._new_game = lambda: TeamMarkovVectorEnv(source.build(), form, indices[0], [])
        self._way: Way | None = None
        _check_all_differ(self.vec_envs)

    def reset_all(self, seeds: Sequence[int | None], options: Sequence[Info | None]) -> tuple[Any, Infos]:
        """Begin an episode in every game of this process; seeds and options are those of all E games."""
        games = zip(self._indices, self.vec_envs, strict=True)
        started = [game.reset(seed=seeds[index], options=options[index]) for index, game in games]
        observations, infos = zip(*started, strict=True)
        return self.concat_obs(observations), [info for game in infos for info in game]

    def play(self, actions: npt.NDArray[Any]) -> Played:
        """Step every game of this process; actions are those of the B rows of all games."""
        first, last = self._indices[0], self._indices[-1] + 1
        rows = actions[first * self._n_agents : last * self._n_agents]
        observations, rewards, terminations, truncations, infos = self.step(rows)
        reset_infos = [info for game in self.vec_envs for info in game.reset_infos]
        return Played(observations, rewards, terminations | truncations, infos, reset_infos, self._notes)

    def ask(self, questions: Iterable[Question]) -> dict[int, Any]:
        """Answer the queries to games of this process, keyed by their position in ``questions``."""
        games = dict(zip(self._indices, self.vec_envs, strict=True))
        return {
            place: function(games[game].par_env, *args)
            for place, (game, function, args) in enumerate(questions)
            if game in games
        }

    def snapshots(self) -> list[dict[str, Any]]:
        """Copy the games of this process; raise CheckpointError if they cannot be copied."""
        if self._way is None:
            self._way = find_way(self._new_game)
        return [game.snapshot(self._way) for game in self.vec_envs]

    def restore(self, snapshots: Sequence[Mapping[str, Any]]) -> None:
        """Restore the games of this process from snapshots of all E games."""
        for index, game in zip(self._indices, self.vec_envs, strict=True):
            game.restore(snapshots[index])

    def close(self) -> None:
        """Close all games, once; if closing one fails, raise its error at the end."""
        self.closed = True
        with ExitStack() as closing:
            for game in reversed(self.vec_envs):  # callbacks run in reverse order
                closing.callback(game.close)


def _check_all_differ(games: Sequence[TeamMarkovVectorEnv]) -> None:
    n_objects = len({id(game.par_env.unwrapped) for game in games})
    if n_objects < len(games):
        raise ValueError(
            "expected a function that makes a new environment at each call, got one that returned the same object "
            f"for {len(games) - n_objects + 1} games"
        )


def joined(parts: Sequence[Any]) -> Any:
    """Join observations of the rows of several processes."""
    if len(parts) == 1:
        return parts[0]
    if isinstance(parts[0], Mapping):
        return {key: joined([part[key] for part in parts]) for key in parts[0]}
    if isinstance(parts[0], tuple):
        return tuple(joined(entries) for entries in zip(*parts, strict=True))
    return np.concatenate(parts)
