"""
Melting Pot's substrates: ``meltingpot/clean_up``, ``meltingpot/collaborative_cooking__cramped``.

Agents observe ``RGB`` (88 x 88 pixels; ``pixels_per_sprite=1`` averages each sprite of 8 x 8 to one pixel, as for most
published agents) and the substrate's other observations, such as ``READY_TO_SHOOT`` or ``INVENTORY``. ``WORLD.RGB`` and
``COLLECTIVE_REWARD``, which are not for acting, are removed from observations; with ``state=True`` the critic reads
``WORLD.RGB``. The engine draws its own random numbers: seeds do not determine episodes. Episodes ended by the substrate
are terminated, those that reach ``max_cycles`` truncated.

dm-meltingpot downloads its assets when it is built. If that fails, put the folder ``meltingpot`` of its public source
on ``PYTHONPATH``, and run ``pip install dmlab2d dm-env chex immutabledict ml-collections networkx
pygame-ce reactivex shimmy tensorflow-cpu``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from sb3_saf.suites.registry import Suite

#: Side of the engine's sprites in pixels.
_SPRITE: Final = 8
_PICTURE: Final = "RGB"
_WORLD: Final = "WORLD.RGB"
#: Observation not for acting, besides all that begin with ``WORLD.``.
_HIDDEN: Final = "COLLECTIVE_REWARD"


class MeltingPotTeam(BaseParallelWrapper[str, Any, Any]):
    """
    A substrate without the observations not for acting, and with the picture of the world as ``state()``.

    :param env: the substrate as shimmy's ParallelEnv
    :param substrate: Melting Pot's own object of it
    :param pixels_per_sprite: side of a sprite in observations: 1, 2, 4 or 8
    :raises ValueError: for another number of pixels
    """

    def __init__(self, env: ParallelEnv[str, Any, Any], substrate: Any, pixels_per_sprite: int = _SPRITE) -> None:
        if pixels_per_sprite not in (1, 2, 4, 8):
            raise ValueError(f"pixels_per_sprite must be 1, 2, 4 or 8, got {pixels_per_sprite!r}")
        super().__init__(env)
        self._substrate = substrate
        self._block = _SPRITE // pixels_per_sprite
        seen = env.observation_space(env.possible_agents[0])
        assert isinstance(seen, spaces.Dict)
        own = {key: space for key, space in seen.spaces.items() if key != _HIDDEN}
        height, width, channels = own[_PICTURE].shape or (0, 0, 0)
        own[_PICTURE] = spaces.Box(0, 255, (height // self._block, width // self._block, channels), np.uint8)
        self._observation_space = spaces.Dict(own)
        self.state_space = spaces.Box(0, 255, substrate.observation_spec()[0][_WORLD].shape, np.uint8)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's observation."""
        return self._observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode; the engine takes no seed."""
        observations, _ = self.env.reset(seed=seed, options=options)
        return self._shown(observations), {agent: {} for agent in observations}

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Play one step (see PettingZoo)."""
        observations, *others = self.env.step(dict(actions))
        return (self._shown(observations), *others)

    def state(self) -> Any:
        """Return the picture of the world."""
        return self._substrate.observation()[0][_WORLD]

    def _shown(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return {
            agent: {key: self._smaller(seen[key]) if key == _PICTURE else seen[key] for key in self._observation_space}
            for agent, seen in observations.items()
        }

    def _smaller(self, picture: Any) -> Any:
        """Return the picture (H, W, C) uint8 with blocks of pixels averaged."""
        if self._block == 1:
            return picture
        height, width, channels = picture.shape
        # Two sums of integers take a quarter of the time of one mean over both axes, and give the same pixels.
        rows = picture.reshape(height // self._block, self._block, width * channels).sum(axis=1, dtype=np.uint16)
        sums = rows.reshape(len(rows), width // self._block, self._block, channels).sum(axis=2, dtype=np.uint16)
        return (sums // self._block**2).astype(np.uint8)


def _tasks() -> list[str]:
    return sorted(_substrates().SUBSTRATES)


def _substrates() -> Any:
    # By name, because the package has a different name.
    return importlib.import_module("meltingpot.substrate")


def _game(
    task: str, *, render_mode: str | None = None, max_cycles: int = 1000, pixels_per_sprite: int = _SPRITE
) -> Any:
    from shimmy import MeltingPotCompatibilityV0

    substrate = _substrates().build(task, roles=_substrates().get_config(task).default_player_roles)
    game = MeltingPotCompatibilityV0(env=substrate, max_cycles=max_cycles, render_mode=render_mode)
    return MeltingPotTeam(game, substrate, pixels_per_sprite)


SUITE: Final = Suite(
    name="meltingpot",
    title="Melting Pot: social dilemmas, clean-up, cooking together",
    requires=("dm-meltingpot>=2.2", "dmlab2d>=1.0.2", "pygame-ce>=2.4,<3", "shimmy>=2,<3"),
    extra="meltingpot",
    page="https://github.com/google-deepmind/meltingpot",
    list_tasks=_tasks,
    examples=("collaborative_cooking__cramped", "clean_up"),
    game=_game,
    module="meltingpot",
)
