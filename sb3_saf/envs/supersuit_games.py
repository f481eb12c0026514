"""
Games as rows, on SuperSuit's classes.

SuperSuit's ``MarkovVectorEnv`` (the agents of a game as rows) and ``ConcatVecEnv`` (several games) are base classes
here: they give actions to games, join their rows and draw. Episodes, ends, infos, seeds, attributes and processes are
our own code.
"""

from __future__ import annotations

import io
import pickle
import random
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from copy import deepcopy
from functools import partial
from typing import Any, Final, TypeAlias

import cloudpickle
import numpy as np
import numpy.typing as npt
from gymnasium.utils import EzPickle
from gymnasium.vector.utils import iterate
from stable_baselines3.common.utils import set_random_seed
from supersuit.vector import ConcatVecEnv, MarkovVectorEnv

from sb3_saf.envs import audit
from sb3_saf.envs.audit import check_is_parallel
from sb3_saf.envs.game_copies import Way, find_way, is_found_by_name, packed, pickled, unpacked, unpickled
from sb3_saf.envs.game_reader import AnyParallelEnv, GameReader
from sb3_saf.envs.gymnasium_team import as_parallel
from sb3_saf.teams.conversion import MASK_NAMES, AgentConversion
from sb3_saf.teams.rows import ACTIVE_KEY, TERMINAL_OBSERVATION, TRUNCATED

Info: TypeAlias = "dict[str, Any]"
Infos: TypeAlias = "list[Info]"

#: Keys of infos that Stable-Baselines3 or this package uses. A game's own entries with these names are renamed.
RESERVED_KEYS: Final = frozenset({TERMINAL_OBSERVATION, TRUNCATED, ACTIVE_KEY, "episode"})

_MASKS = frozenset(MASK_NAMES)
_UNCHANGING = (type(None), bool, int, float, str, np.bool_, np.int64, np.float32, np.float64)


# ---- one game


class TeamMarkovVectorEnv(MarkovVectorEnv):
    """
    The agents of one game as rows that end together, see :class:`~sb3_saf.envs.supersuit_vec_env.SuperSuitVecEnv`.

    An agent that has ended or not joined yet keeps its row, with zeros, or with ``"active"`` a copy of another's.
    """

    par_env: AnyParallelEnv
    closed: bool

    def __init__(self, env: AnyParallelEnv, reader: GameReader, index: int, notes: list[str]) -> None:
        check_is_parallel(env, is_factory=True)
        # Not the base class's constructor, which wants a game whose own spaces are those of rows.
        self.par_env, self.num_envs = env, len(reader.agents)
        self.metadata = getattr(env, "metadata", {})
        if not hasattr(env.unwrapped, "render_mode"):
            env.unwrapped.render_mode = None
        self.render_mode = env.unwrapped.render_mode
        self.observation_space, self.action_space = reader.rows.to_row_space(), reader.action_space
        self.agents = reader.agents
        #: Infos of the last reset, one per row.
        self.reset_infos: Infos = []
        self._index = index
        self._reader = reader
        self._notes = notes
        self._count_step(0)
        self._ended: set[Any] = set()
        #: Agents that take part, in the order of the rows: a set with an order.
        self._playing: dict[Any, None] = {}

    def _count_step(self, number: int) -> None:
        self._n_steps = number
        #: Game and step, for messages.
        self._place = f"in game {self._index} at step {number}"

    def reset(self, seed: int | None = None, options: Info | None = None) -> tuple[Any, Infos]:
        """
        Begin an episode.

        :param seed: seed of the game, None to continue its random stream
        :return: observations and infos of the N rows
        """
        observations, infos = audit.reset(self.par_env, seed, options)
        self._count_step(0)
        audit.check_agents(self.par_env, self.agents, f"at a reset of game {self._index}")
        self._ended.clear()
        self._playing = self._find_playing()
        if not self._playing:
            raise ValueError(f"expected at least one name in agents after reset of game {self._index}, got none")
        self.reset_infos = self._infos(infos, self._playing, reserved=frozenset())
        return self._rows(observations, infos, self._playing, self._playing), self.reset_infos

    def step(self, actions: npt.NDArray[Any]) -> tuple[Any, Any, Any, Any, Infos]:
        """Step the game with the actions of the N rows (see PettingZoo); the next episode begins automatically."""
        acted = self._playing
        self._count_step(self._n_steps + 1)
        result = self.par_env.step(
            {agent: self._action(agent, actions[i]) for i, agent in enumerate(self.agents) if agent in acted}
        )
        observations, rewards, terminations, truncations, infos = audit.step_results(self.par_env, result)
        paid = [audit.reward_of(rewards, agent, self._place, agent in acted) for agent in self.agents]
        terminated = {agent for agent in acted if audit.end_of("terminations", terminations, agent, self._place)}
        truncated = {agent for agent in acted if audit.end_of("truncations", truncations, agent, self._place)}
        truncated -= terminated
        respawned = audit.respawn_note(self.par_env, self._ended, terminations, truncations, self._place)
        if respawned and not self._notes:
            self._notes.append(respawned)
        self._ended |= terminated | truncated
        self._playing = self._find_playing()
        flags = ("terminations", terminations), ("truncations", truncations)
        for agent in self._playing.keys() - acted.keys():  # the flags of agents that are listed count, too
            if any(audit.end_of(name, given, agent, self._place) for name, given in flags):
                self._ended.add(agent)
                del self._playing[agent]
        row_infos = self._infos(infos, acted)
        over = not self._playing
        if over or terminated or truncated:
            last = self._rows(observations, infos, acted, truncated, over=True)
            for agent, info, row in zip(self.agents, row_infos, iterate(self.observation_space, last), strict=True):
                if over or agent in terminated or agent in truncated:
                    info[TERMINAL_OBSERVATION] = row
                    info[TRUNCATED] = agent in truncated
        # Rows are copies, so games may reuse their arrays in the reset.
        rows = self.reset()[0] if over else self._rows(observations, infos, self._playing, self._playing)
        ends_by_limit = np.array([over and agent in truncated for agent in self.agents])
        return rows, np.array(paid, dtype=np.float32), over & ~ends_by_limit, ends_by_limit, row_infos

    def _rows(
        self, observations: Any, infos: Any, shown: Container[Any], active: Container[Any], over: bool = False
    ) -> Any:
        return self._reader.read(self.par_env, observations, infos, shown, active, self._place, over)

    def _action(self, agent: Any, action: Any) -> Any:
        conversion = self._reader.conversions[agent]
        if conversion.keeps_actions:
            return action
        try:
            return conversion.game_action(action)
        except ValueError as error:
            raise ValueError(f"action of {agent} {self._place}: {error}") from None

    def close(self) -> None:
        """Close the game, once."""
        if not self.closed:
            self.closed = True
            super().close()

    def _find_playing(self) -> dict[Any, None]:
        """Return the agents that take part; an agent that has ended does not return."""
        present = audit.present_agents(self.par_env, self.agents, self._place)
        return {agent: None for agent in self.agents if agent in present and agent not in self._ended}

    def _infos(
        self, infos: Mapping[Any, Any], acted: Container[Any], reserved: frozenset[str] = RESERVED_KEYS
    ) -> Infos:
        """Copy the infos of all rows, since games may reuse theirs; rename ``reserved`` keys."""
        rows = []
        for agent in self.agents:
            info = _copied(audit.info_of(infos, agent, self._place), agent)
            for key in reserved.intersection(info):
                info[f"game_{key}"] = info.pop(key)
            if agent not in acted:
                info[ACTIVE_KEY] = False
            if self._reader.watches_masks and not self._notes and not _MASKS.isdisjoint(info):
                self._notes.append(
                    f"the info of {agent} has action masks {self._place}, which the infos of a trial episode had not: "
                    "they are not used; give them from the first reset on, or pass action_masks=True"
                )
            rows.append(info)
        return rows

    def masks_of_method(self) -> list[Any] | None:
        """Return the rows' masks of the game's method ``action_masks``; None if it has none that gives masks."""
        with suppress(Exception):  # whoever learns with these masks is told
            if audit.has_masks_method(self.par_env):
                return masks_of_method(self.par_env, self.agents, tuple(self._reader.conversions.values()))
        return None

    def snapshot(self, way: Way) -> dict[str, Any]:
        """Return the complete state of the game, in a way of :func:`~sb3_saf.envs.game_copies.find_way`."""
        if way == "pickle":
            content = {"pickled": pickled(self.par_env)}
        else:
            content = {"state": audit.game_attribute(self.par_env, "get_state")()}
        return {"n_steps": self._n_steps, "ended": [agent in self._ended for agent in self.agents], **content}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot; the infos of the last reset are not part of it."""
        if "pickled" in snapshot:
            self.par_env = unpickled(snapshot["pickled"], self.par_env)
        else:
            audit.reset(self.par_env, None, None)
            audit.game_attribute(self.par_env, "set_state")(snapshot["state"])
        self._count_step(snapshot["n_steps"])
        self._ended = {agent for agent, ended in zip(self.agents, snapshot["ended"], strict=True) if ended}
        self._playing = self._find_playing()
        self.reset_infos = [{} for _ in self.agents]


def masks_of_method(env: Any, agents: Sequence[Any], conversions: Sequence[AgentConversion]) -> list[Any]:
    """Return the masks of a game's method ``action_masks``; any action of agents that it leaves out is legal."""
    masks = audit.game_attribute(env, "action_masks")()
    if not isinstance(masks, Mapping):
        masks = dict.fromkeys(agents, masks)
    return [
        conversion.mask(masks.get(agent, np.ones(sum(conversion.action.choices)))).astype(bool)
        for agent, conversion in zip(agents, conversions, strict=True)
    ]


def _copied(info: Mapping[str, Any], agent: Any) -> Info:
    """Copy an info."""
    if not info or all(type(value) in _UNCHANGING for value in info.values()):
        return dict(info)  # equivalent to a deep copy, and ten times faster
    try:
        return deepcopy(dict(info))
    except Exception as error:
        raise TypeError(
            f"the info of {agent} cannot be copied ({error}), it is {info}; leave out what cannot be copied"
        ) from error


# ---- the games of one process


def game_factory(make_env: Any, is_factory: bool, n_cpus: int) -> Callable[[], Any]:
    """
    Return a function that makes a game, a ParallelEnv.

    It holds a pickle if possible, so that a function that returns an existing environment makes copies of it.

    :param n_cpus: number of processes in which games will be made; with one process a factory need not be picklable
        (for instance of a local class with ``functools.lru_cache`` on its methods)
    :raises ValueError: if it cannot be copied, with a fix
    """
    state = None if is_factory else _set_later(make_env)
    try:
        if n_cpus > 1:
            cloudpickle.dumps(make_env)
        file = io.BytesIO()
        classes: dict[int, type] = {}
        _Pickler(file, classes).dump(make_env)
        return partial(_unpickled_game, file.getvalue(), classes, is_factory, state)
    except Exception as error:
        if n_cpus > 1:
            raise ValueError(
                f"n_cpus={n_cpus} sends {make_env} to worker processes, but pickling it failed ({error}); move "
                "what it uses to the top level of a module (functools.lru_cache on methods of a class inside a "
                "function is such a thing), or use n_cpus=1, where nothing is sent"
            ) from error
    make = make_env if is_factory else partial(_copied_game, _copied_game(make_env))
    return lambda: as_parallel(_with_state(make(), state))


class _Pickler(cloudpickle.Pickler):
    """
    Pickler that leaves classes of scripts, notebooks and functions out: where they are unpickled, cloudpickle sets the
    attributes of the class that is there to those of the pickle.

    :param classes: gets them, by id
    """

    def __init__(self, file: io.BytesIO, classes: dict[int, type]) -> None:
        super().__init__(file)
        self._classes = classes

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, type) or (is_found_by_name(obj) and obj.__module__ != "__main__"):
            return None
        self._classes[id(obj)] = obj
        return id(obj)


class _Unpickler(pickle.Unpickler):
    """Unpickler for the output of :class:`_Pickler`."""

    def __init__(self, data: bytes, classes: Mapping[int, type]) -> None:
        super().__init__(io.BytesIO(data))
        self._classes = classes

    def persistent_load(self, pid: Any) -> type:
        return self._classes[pid]


def _unpickled_game(pickled_env: bytes, classes: Mapping[int, type], is_factory: bool, state: bytes | None) -> Any:
    content = _Unpickler(pickled_env, classes).load()
    return as_parallel(content() if is_factory else _with_state(content, state))


def _with_state(env: Any, state: bytes | None) -> Any:
    return env if state is None else unpacked(state, env)


def _set_later(env: Any) -> bytes | None:
    """Return the state of an EzPickle, whose own copies have the arguments of its constructor only; None for others."""
    if not any(isinstance(layer, EzPickle) for layer in audit.layers_of(env)):
        return None
    with _copying(env):
        return packed(env, env)


def _copied_game(env: Any) -> Any:
    with _copying(env):
        return deepcopy(env)


@contextmanager
def _copying(env: Any) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"each game needs its own copy of {env}, but copying it failed ({error}); "
            "pass a function that makes the environment instead"
        ) from error


class TeamConcatVecEnv(ConcatVecEnv):
    """
    Games of one process, one after another.

    Changes to :class:`supersuit.vector.ConcatVecEnv`: each game gets its own seed and options, attributes and methods
    of games are accessible, and all games are closed even if closing one fails.

    :param indices: indices of the games among all E
    :param is_worker: whether the process has no other games: it then seeds the global generators of Python, NumPy and
        torch, from which games may draw, since processes are forked with equal ones
    :raises ValueError: if the same environment is made twice
    """

    def __init__(
        self, make_game: Callable[[], Any], reader: GameReader, indices: Sequence[int], is_worker: bool = False
    ) -> None:
        self._notes: list[str] = []
        self._indices = indices
        self._is_worker = is_worker
        if is_worker:
            set_random_seed((random.getrandbits(32) + indices[0]) % 2**32)
        self.vec_envs: list[TeamMarkovVectorEnv] = []  # until Gymnasium 1.2, close also runs if construction failed
        super().__init__(
            [lambda index=index: TeamMarkovVectorEnv(make_game(), reader, index, self._notes) for index in indices]
        )
        self._n_agents = len(reader.agents)
        self._new_game = lambda: TeamMarkovVectorEnv(make_game(), reader, indices[0], [])
        self._way: Way | None = None
        n_objects = len({id(audit.layers_of(game.par_env)[-1]) for game in self.vec_envs})
        if n_objects < len(self.vec_envs):
            raise ValueError(
                "expected a function that makes a new environment at each call, got one that returned the same object "
                f"for {len(self.vec_envs) - n_objects + 1} games"
            )

    def run(self, name: str, *args: Any) -> list[Any]:
        """Call a method in all processes, as :class:`WorkerGames` does."""
        return [getattr(self, name)(*args)]

    def reset_all(self, seeds: Sequence[int | None], options: Sequence[Info | None]) -> tuple[Any, Infos]:
        """Begin an episode in every game of this process; seeds and options are those of all E games."""
        if self._is_worker and (seed := seeds[self._indices[0]]) is not None:
            set_random_seed(seed)
        games = zip(self._indices, self.vec_envs, strict=True)
        started = [game.reset(seed=seeds[index], options=options[index]) for index, game in games]
        observations, infos = zip(*started, strict=True)
        return self.concat_obs(observations), [info for game in infos for info in game]

    def play(
        self, actions: npt.NDArray[Any]
    ) -> tuple[Any, npt.NDArray[Any], npt.NDArray[Any], Infos, Infos, list[str]]:
        """
        Step every game of this process.

        :param actions: of the B rows of all games
        :return: rows, rewards (float32), dones (bool), infos, infos of the last resets, and texts of warnings to issue
        """
        first, last = self._indices[0], self._indices[-1] + 1
        rows = actions[first * self._n_agents : last * self._n_agents]
        observations, rewards, terminations, truncations, infos = self.step(rows)
        reset_infos = [info for game in self.vec_envs for info in game.reset_infos]
        return observations, rewards, terminations | truncations, infos, reset_infos, self._notes

    def ask(self, games: Iterable[int], function: Callable[..., Any], *args: Any) -> dict[int, Any]:
        """Call a function with each of some games, those of this process, and arguments; return answers by game."""
        asked = set(games)
        own = zip(self._indices, self.vec_envs, strict=True)
        return {index: function(game.par_env, *args) for index, game in own if index in asked}

    def snapshots(self, begun: bool) -> list[dict[str, Any]]:
        """Copy the games of this process, none before their first reset; CheckpointError if they cannot be copied."""
        if self._way is None:
            self._way = find_way(self._new_game)
        return [game.snapshot(self._way) for game in self.vec_envs] if begun else []

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
