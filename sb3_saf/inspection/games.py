"""
Optional attributes of games that inspection reads through ``get_attr`` and ``env_method``.

================ ======================= ==============================================================================
attribute        form                    meaning
================ ======================= ==============================================================================
``agent_zones``  (N,) integers           present zone of each agent, from 0; -1 for none
``zone_colours`` Z times (r, g, b)       colour of each zone, 0 to 255
``return_unit``  str                     unit of the team return, such as ``"treasures"``
``best_return``  number                  the largest possible team return
``action_names`` A times str             name of each action
``render_mode``  ``"rgb_array"``         the method ``render`` then returns a picture, (height, width, 3) uint8
================ ======================= ==============================================================================

A game on a grid may have two methods for :func:`~sb3_saf.replay`: ``grid_scene()`` returns the data for a drawing (see
``HECOGridEnv``), ``replica()`` another game that plays the same episode from the same seed.

Letters: E games, N agents, B rows, A actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.teams.vec_env import require_n_agents

Ints = npt.NDArray[np.int64]
Picture = npt.NDArray[np.uint8]
#: Function from the environment to the zone of each row's agent, (B,) integers from 0, -1 for none.
ZoneFunction = Callable[[VecEnv], npt.ArrayLike]
#: None uses the environment's attribute; False disables zones.
Zones = ZoneFunction | Literal[False] | None

_NO_ZONE = -1


class ReturnScale(NamedTuple):
    """The unit of team returns, such as ``"treasures"``, and the largest possible one; None if unknown."""

    unit: str | None
    best: float | None


def check_zones(zones: object) -> None:
    """Check the argument ``zones``; ValueError if it is neither None, False nor a function."""
    if zones is not None and zones is not False and not callable(zones):
        raise ValueError(
            "zones must be a function from the environment to the zone of each row, None to ask the environment for "
            f"its attribute agent_zones, or False for no zones; got {zones!r}"
        )


def zone_function(env: VecEnv, zones: Zones) -> ZoneFunction | None:
    """Return the function for the zones of rows according to ``zones``; None if there are none."""
    check_zones(zones)
    if zones is False:
        return None
    if zones is not None:
        return zones
    return zones_by_attribute if env.has_attr("agent_zones") else None


def zones_by_attribute(env: VecEnv) -> Ints:
    """Return the games' attribute ``agent_zones``, (B,)."""
    return np.concatenate([np.asarray(zones, dtype=np.int64) for zones in _of_games(env, "agent_zones")])


def zones_now(zones: ZoneFunction, env: VecEnv) -> Ints:
    """Return the zone of each row, (B,); ValueError if they are not (B,) integers of at least -1."""
    found = np.asarray(zones(env))
    if found.shape != (env.num_envs,) or found.dtype.kind not in "iu" or (found < _NO_ZONE).any():
        raise ValueError(
            f"expected zones to give whole numbers from 0 (or -1 for no zone) of shape ({env.num_envs},), one for each "
            f"row, got shape {found.shape} and dtype {found.dtype}"
            + (f" with {found.min()}" if found.dtype.kind == "i" and found.size else "")
        )
    return found.astype(np.int64)


def zone_colours(env: VecEnv) -> list[tuple[float, float, float]] | None:
    """Return the colours of the zones, 0 to 1; None if the environment has none."""
    if not env.has_attr("zone_colours"):
        return None
    return [(red / 255, green / 255, blue / 255) for red, green, blue in env.get_attr("zone_colours", indices=[0])[0]]


def return_scale(env: VecEnv) -> ReturnScale:
    """Return the unit of team returns."""
    unit, best = (
        env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None for name in ("return_unit", "best_return")
    )
    return ReturnScale(None if unit is None else str(unit), None if best is None else float(best))


def draws_pictures(env: VecEnv) -> bool:
    """Return whether games can be drawn."""
    return env.render_mode == "rgb_array"


def picture(env: VecEnv) -> Picture | None:
    """Return a picture of the first game, (height, width, 3); None if ``render`` gives none."""
    frame = np.asarray(env.env_method("render", indices=[0])[0])
    return frame if frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3 else None


def _of_games(env: VecEnv, name: str) -> Sequence[Any]:
    """Return an attribute of each game, queried once per game."""
    return env.get_attr(name, indices=range(0, env.num_envs, require_n_agents(env)))
