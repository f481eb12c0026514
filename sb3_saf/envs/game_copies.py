"""
Copies of games in progress: how a game's state is copied, and whether the copy continues like the original.

A game with ``get_state()`` and ``set_state(state)`` gives plain data; any other game is pickled. Unpickling runs code
from the file, so pickled games are signed with the user's secret key; unsigned ones are refused.
"""

from __future__ import annotations

import copyreg
import hmac
import math
import os
import pickle
import secrets
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from copy import deepcopy
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

import cloudpickle
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle

from sb3_saf.envs.audit import layers_of, legal_sample, settings_of
from sb3_saf.teams.checks import CheckpointError
from sb3_saf.teams.files import decode, encode
from sb3_saf.teams.randomness import generator_states, own_randomness, set_generator_states
from sb3_saf.teams.rows import ACTION_MASK_KEY

if TYPE_CHECKING:
    from sb3_saf.envs.supersuit_games import TeamMarkovVectorEnv

#: How a game is copied: by its own methods, or by pickling.
Way = Literal["get_state", "pickle"]

#: Steps that a game plays before it is copied, and that game and copy play afterwards.
TRIAL_STEPS: Final = 30
#: Time limit in seconds for each of the two.
TRIAL_SECONDS: Final = 2.0

_KEY_BYTES: Final = 32


class ForeignGamesError(CheckpointError):
    """Raised for pickled games without this user's signature."""


# --- pickled games ----------------------------------------------------------------------------------------------------


#: An attribute of a game, or of a wrapper around it: number of the layer, name.
_Place: TypeAlias = tuple[int, str]


def is_found_by_name(one: type) -> bool:
    """Return whether a class is found in its module by its name, as those inside of functions are not."""
    return getattr(sys.modules.get(one.__module__), one.__qualname__, None) is one


class _Pickler(cloudpickle.Pickler):
    """
    Pickler that also stores the state of :class:`gymnasium.utils.EzPickle`, which stores constructor arguments only.

    :param left_out: objects, by id, that are taken from the game into which the state is loaded
    """

    def __init__(self, file: BytesIO, left_out: Mapping[int, _Place]) -> None:
        super().__init__(file)
        self._left_out = left_out

    def persistent_id(self, obj: Any) -> _Place | None:
        return self._left_out.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) and is_found_by_name(obj):
            return NotImplemented  # by name, also if it is of a script: see supersuit_games
        if isinstance(obj, EzPickle) and type(obj).__getstate__ is EzPickle.__getstate__:
            # Attributes are set one by one, without the class's own __setstate__.
            return copyreg.__newobj__, (type(obj),), dict(vars(obj)), None, None, _set_attributes  # type: ignore[attr-defined]
        return super().reducer_override(obj)


def _set_attributes(obj: object, attributes: dict[str, Any]) -> None:
    vars(obj).update(attributes)


class _Unpickler(pickle.Unpickler):
    """Unpickler for the output of :class:`_Pickler`."""

    def __init__(self, data: bytes, game: Any) -> None:
        super().__init__(BytesIO(data))
        self._layers = layers_of(game)

    def persistent_load(self, pid: Any) -> Any:
        attributes, name = vars(self._layers[pid[0]]), pid[1]
        if name not in attributes:
            warnings.warn(
                f"the game's {name} was made after its reset and cannot be pickled: it is None after the resumption",
                UserWarning,
                stacklevel=2,
            )
        return attributes.get(name)


def pickled(game: Any) -> npt.NDArray[np.uint8]:
    """
    Pickle a game and the global random generators of this process, which the game may use.

    :func:`find_way` tests that the copy behaves equally.
    """
    return np.frombuffer(packed((game, generator_states()), game), dtype=np.uint8)


def unpickled(data: npt.NDArray[np.uint8], game: Any) -> Any:
    """Unpickle a game and restore the global random generators; only for signed data."""
    found, states = unpacked(data.tobytes(), game)
    set_generator_states(states)
    return found


def packed(data: Any, game: Any) -> bytes:
    """
    Pickle data that contain a game, with all that was set after its construction, which its class may leave out.

    Attributes that cannot be pickled (fonts, surfaces, windows) are left out and taken from a new game.
    """
    try:
        return _dump(data, {})
    except Exception:
        return _dump(data, _unpicklable(game))


def unpacked(data: bytes, game: Any) -> Any:
    """Unpickle what :func:`packed` returned, with the help of a new game."""
    return _Unpickler(data, game).load()


def _dump(data: Any, left_out: Mapping[int, _Place]) -> bytes:
    file = BytesIO()
    _Pickler(file, left_out).dump(data)
    return file.getvalue()


def _unpicklable(game: Any) -> dict[int, _Place]:
    """Find the attributes of a game and of its wrappers that cannot be pickled."""
    layers = layers_of(game)
    own = {id(layer) for layer in layers}
    found = {}
    for number, layer in enumerate(layers):
        for name, value in getattr(layer, "__dict__", {}).items():
            try:
                _dump(value, dict.fromkeys(own, (number, name)))
            except Exception:
                found[id(value)] = (number, name)
    return found


# --- signatures -------------------------------------------------------------------------------------------------------


def key_file() -> Path:
    """Return the path of the user's key, which is created at first use."""
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "sb3_saf" / "key"


@cache
def _key(path: Path) -> bytes:
    """Return the user's key, or a key for this process only if it cannot be stored."""
    new = secrets.token_bytes(_KEY_BYTES)
    temporary = path.with_name(f".key-{os.getpid()}-{secrets.token_hex(4)}")
    with suppress(OSError):
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(new)
            try:
                os.link(temporary, path)  # atomic; fails if another process was faster
            finally:
                temporary.unlink()
    with suppress(OSError):
        kept = path.read_bytes()
        if len(kept) == _KEY_BYTES:
            return kept
    return new


def signature(data: npt.NDArray[np.uint8]) -> str:
    """Return this user's signature of a pickled game."""
    return hmac.new(_key(key_file()), data.tobytes(), "sha256").hexdigest()


def check_signatures(tree: Any) -> None:
    """Raise ForeignGamesError unless this user has signed all pickled games of a checkpoint."""
    for game in pickled_games(tree):
        data = np.asarray(game["pickled"])
        if not hmac.compare_digest(signature(data), str(game.get("signature"))):
            raise ForeignGamesError(
                "its games are pickled and were not signed with this user's key, and unpickling a stranger's file runs "
                "code from it; pass trust_games=True if you know who wrote it (a run of your own on another machine, "
                f"for instance; the key is in {key_file()})"
            )


def pickled_games(tree: Any) -> Iterator[dict[str, Any]]:
    """Find the pickled games of a checkpoint."""
    if isinstance(tree, dict):
        if "pickled" in tree:
            yield tree
        tree = list(tree.values())
    if isinstance(tree, (list, tuple)):
        for part in tree:
            yield from pickled_games(part)


def sign_games(tree: Any) -> None:
    """Sign all pickled games of a checkpoint whose source the user trusts."""
    for game in pickled_games(tree):
        game["signature"] = signature(game["pickled"])


def common_settings(make_game: Callable[[], Any]) -> dict[str, Any]:
    """Return the settings of new games, see :func:`settings_of`, without those that differ from game to game."""
    with own_randomness(0):
        games = [make_game(), make_game()]
    one, other = map(settings_of, games)
    for game in games:
        with suppress(Exception):
            game.close()
    return {name: value for name, value in one.items() if name in other and repr(value) == repr(other[name])}


# --- trials -----------------------------------------------------------------------------------------------------------


def find_way(make_game: Callable[[], TeamMarkovVectorEnv]) -> Way:
    """
    Return a way of copying after which the copy continues like the original.

    A new game plays some steps and is copied; another plays and may change what games share; then both play the same
    actions and begin another episode.

    :raises CheckpointError: if there is no such way, with the difference found
    """
    reasons = []
    with own_randomness(0):
        for way in get_args(Way):
            reason = _trial(make_game, way)
            if reason is None:
                return way
            reasons.append(f"by {way}: {reason}")
    raise CheckpointError(
        f"SuperSuitVecEnv cannot give the state of its games ({', '.join(reasons)}), so a run on them cannot be "
        "resumed exactly; a game can that is pickled with all its state, or has get_state() and set_state(state). "
        "TeamCheckpointCallback(..., exact=False) begins new episodes on resuming instead"
    )


def _trial(make_game: Callable[[], TeamMarkovVectorEnv], way: Way) -> str | None:
    """Return why a way fails, or None."""
    original, copy, third = (make_game() for _ in range(3))
    try:
        reason = _difference(original, copy, third, way)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
    if reason is not None and way == "pickle":
        left_out = [name for _, name in _unpicklable(original.par_env).values()]
        reason += f" (it has to do without {', '.join(left_out)}, which cannot be pickled)" if left_out else ""
    for game in (original, copy, third):
        with suppress(Exception):
            game.close()
    return reason


def _difference(
    original: TeamMarkovVectorEnv, copy: TeamMarkovVectorEnv, third: TeamMarkovVectorEnv, way: Way
) -> str | None:
    """Return the first difference between a game and its copy, or None."""
    rows, _ = _play(original, original.reset(seed=0)[0], TRIAL_STEPS)
    copy.restore(decode(encode(original.snapshot(way))))
    began = generator_states()
    _play(third, third.reset(seed=1)[0], TRIAL_STEPS)
    set_generator_states(began)
    _, seen = _play(original, rows, TRIAL_STEPS)
    seen.append(_bytes_of(original.reset()[0]))
    if way == "pickle":  # includes the global generators
        set_generator_states(began)
    _, seen_by_copy = _play(copy, rows, len(seen) - 1, math.inf)
    seen_by_copy.append(_bytes_of(copy.reset()[0]))
    for step, (one, other) in enumerate(zip(seen, seen_by_copy, strict=True), 1):
        if one != other:
            return (
                f"{step} steps later a copy differs from the game, as where reset(seed=None) makes a new generator, or "
                "games share an object that changes"
            )
    return None


def _play(
    game: TeamMarkovVectorEnv, rows: Any, n_steps: int, seconds: float = TRIAL_SECONDS
) -> tuple[Any, list[bytes]]:
    """
    Play random legal actions, the same in each call, until the time limit in seconds.

    :return: the last observations, and the serialised result of each step
    """
    space = deepcopy(game.action_space)
    space.seed(0)
    seen: list[bytes] = []
    deadline = time.monotonic() + seconds
    while len(seen) < n_steps and time.monotonic() < deadline:
        rows, *outcome, _ = game.step(_actions(game, space, rows))
        seen.append(_bytes_of([rows, *outcome]))
    return rows, seen


def _actions(game: TeamMarkovVectorEnv, space: spaces.Space[Any], rows: Any) -> npt.NDArray[Any]:
    masks = rows.get(ACTION_MASK_KEY) if isinstance(rows, Mapping) else None, game.masks_of_method()
    given = [one for one in masks if one is not None]
    legal = np.logical_and.reduce(given) if given else [None] * game.num_envs
    return np.array([legal_sample(space, mask) for mask in legal], space.dtype)


def _bytes_of(data: Any) -> bytes:
    if isinstance(data, Mapping):
        data = list(data.values())
    if isinstance(data, (list, tuple)):
        return b"".join(map(_bytes_of, data))
    return np.asarray(data).tobytes()
