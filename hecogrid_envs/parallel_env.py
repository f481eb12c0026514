"""One HECOGrid game as a PettingZoo ParallelEnv."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from inspect import cleandoc
from typing import Any, ClassVar, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from hecogrid_envs.batch import GameBatch
from hecogrid_envs.constants import N_ACTIONS, Colour, Command, RenderMode, TreasureState, zone_colour
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.state import STATE_PLANES, StateMapping, central_view, state_option
from hecogrid_envs.task import COMMON_PAGE, DECLARED, Task, TaskName
from hecogrid_envs.tiles import observation_space

Observations = dict[str, npt.NDArray[np.uint8]]
Infos = dict[str, dict[str, Any]]


class StepResult(NamedTuple):
    """Results of a step, one entry per agent in each dict."""

    observations: Observations
    rewards: dict[str, float]
    terminations: dict[str, bool]
    truncations: dict[str, bool]
    infos: Infos


class HECOGridEnv(ParallelEnv[str, npt.NDArray[np.uint8], int]):
    """
    Base class of all tasks; the classes in :mod:`hecogrid_envs.tasks` document the games.

    :param render_mode: ``"rgb_array"``, ``"human"`` (a window), ``"ansi"`` (text) or None
    :param params: the fields of :class:`~hecogrid_envs.params.HECOGridParams`
    :raises ValueError: for an unknown parameter, a value out of range, or objects that do not fit on the map
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "hecogrid_v0",
        "render_modes": list(get_args(RenderMode)),
        "render_fps": 8,
        "is_parallelizable": True,
    }
    #: Declaration of the task; each class that sets it declares a new task.
    declaration: ClassVar[Task]
    task: ClassVar[TaskName]
    #: Unit of the team's return.
    return_unit: ClassVar[str] = "treasures"

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "declaration" not in cls.__dict__:
            return
        cls.task = cls.declaration.name
        DECLARED[cls.task] = cls.declaration
        # Each task's docstring is its documentation page; the shared part is appended.
        cls.__doc__ = f"{cleandoc(cls.__doc__ or '')}\n\n{COMMON_PAGE}"

    def __init__(self, render_mode: RenderMode | None = None, **params: Any):
        self._setup(GameBatch(self.task, HECOGridParams.from_kwargs(params)), 0, render_mode)

    @classmethod
    def turn_based(cls, render_mode: RenderMode | None = None, **params: Any) -> Any:
        """Make the game in PettingZoo's turn-based (AEC) form."""
        return parallel_to_aec(cls(render_mode=render_mode, **params))

    @classmethod
    def of_batch(cls, batch: GameBatch, game: int, render_mode: RenderMode | None = None) -> HECOGridEnv:
        """Wrap one game of a batch as an environment; both share the state."""
        env = cls.__new__(cls)
        env._setup(batch, game, render_mode)
        return env

    def _setup(self, batch: GameBatch, game: int, render_mode: RenderMode | None) -> None:
        if render_mode is not None and render_mode not in get_args(RenderMode):
            raise ValueError(f"render_mode must be one of {get_args(RenderMode)} or None, got {render_mode!r}")
        self.params = batch.params
        self.render_mode = render_mode
        self._batch = batch
        self._game = game
        self._window: Any = None
        self.possible_agents = [f"agent_{i}" for i in range(self.params.n_agents)]
        self.agents: list[str] = []
        own_space = observation_space(self.task, self.params)
        size = self.params.grid_size
        # The same object in every call: seeding a space must affect later calls.
        self.observation_spaces = dict.fromkeys(self.possible_agents, own_space)
        self.action_spaces = {agent: spaces.Discrete(N_ACTIONS) for agent in self.possible_agents}
        # Floats with a bound that no count reaches: up to 1 or 255 libraries take them for a picture.
        self.state_space = spaces.Box(0, 2**16, (size, size, len(STATE_PLANES)), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the space of an agent's observation."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the space of seven action integers; what they do depends on the agent's zone."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observations, Infos]:
        """
        Start an episode.

        :param seed: seeds the game's random generator; None continues it
        :param options: ``{"state": mapping}`` starts from a given state instead of a random level
        :return: observations and empty infos, per agent
        :raises ValueError: for a negative seed or an inconsistent state
        """
        # Checked first: an invalid state leaves the game unchanged.
        state = state_option(options, self.params)
        which = np.zeros(self._batch.n_games, dtype=bool)
        which[self._game] = True
        seeds: list[int | None] = [None] * self._batch.n_games
        seeds[self._game] = seed
        self._batch.reset(which, seeds)
        if state is not None:
            self._batch.set_state(state, self._game)
        self.agents = list(self.possible_agents)
        if self.render_mode == "human":
            self.render()
        return self.observations(), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, int]) -> StepResult:
        """
        Play one game step.

        :param actions: an integer from 0 to 6 for every agent
        :return: observations, rewards (treasures collected in this step / N), terminations (never), truncations
            (after ``max_cycles`` steps) and infos, per agent
        :raises ValueError: for a missing or unknown agent, an action outside the space, or a step without a reset
        """
        self._batch._step_checked(self._checked(actions))
        agents, reward = self.agents, float(self._batch.rewards[self._game])
        over = bool(self._batch.truncated[self._game])
        result = StepResult(
            observations=self.observations(),
            rewards=dict.fromkeys(agents, reward),
            terminations=dict.fromkeys(agents, False),
            truncations=dict.fromkeys(agents, over),
            infos={agent: {} for agent in agents},
        )
        if over:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return result

    def _checked(self, actions: Mapping[str, int]) -> npt.NDArray[np.uint8]:
        if self._batch.n_games > 1:
            raise ValueError("this game is one of a batch and steps with it: call step on the vector environment")
        if not self.agents:
            raise ValueError("the episode has not begun or is over: call reset() before step()")
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions must be a dict from agent to action, got {type(actions).__name__}")
        if actions.keys() != set(self.agents):
            for agent in self.agents:
                if agent not in actions:
                    raise ValueError(f"no action for {agent!r}; every agent needs one: {', '.join(self.agents)}")
            unknown = next(agent for agent in actions if agent not in self.agents)
            raise ValueError(f"unknown agent {unknown!r}; the agents are {', '.join(self.agents)}")
        row = np.empty((1, len(self.agents)), dtype=np.uint8)
        for i, agent in enumerate(self.agents):
            action: Any = actions[agent]
            if isinstance(action, np.ndarray) and action.shape == () and action.dtype.kind in "iu":
                action = int(action)
            if isinstance(action, bool) or not isinstance(action, (int, np.integer)) or not 0 <= action < N_ACTIONS:
                raise ValueError(f"action of {agent!r} must be an integer from 0 to {N_ACTIONS - 1}, got {action!r}")
            row[0, i] = action
        return row

    def observations(self) -> Observations:
        """Return the present views of all agents, also after :meth:`set_state`."""
        return dict(zip(self.possible_agents, self._batch.observe_game(self._game), strict=True))

    def state(self) -> npt.NDArray[np.float32]:
        """Return the central view: (W, H, 10), planes as in :data:`hecogrid_envs.state.STATE_PLANES`."""
        return central_view(self.get_state(), self.params.zone_of_column())

    def get_state(self) -> StateMapping:
        """Return the whole game as plain arrays (see :class:`hecogrid_envs.state.StateMapping`)."""
        return self._batch.get_state(self._game)

    def set_state(self, state: object) -> None:
        """
        Start an episode from a given state; :meth:`observations` gives its views.

        :param state: see :class:`hecogrid_envs.state.StateMapping`
        :raises ValueError: naming the first fault of an inconsistent mapping
        """
        self.reset(options={"state": state})

    @property
    def agent_zones(self) -> npt.NDArray[np.int64]:
        """(N,) the zone of each agent, which determines the effect of its actions."""
        return self.params.zone_of_column()[self._batch.columns[self._game]]

    @property
    def zone_colours(self) -> tuple[Colour, ...]:
        """Colour of each zone in pictures, from 0 to 255."""
        n_zones = int(self.params.zone_of_column()[-1]) + 1
        return tuple(zone_colour(zone) for zone in range(n_zones))

    @property
    def action_names(self) -> list[str]:
        """Name of each action integer; the integers themselves if zones permute the actions."""
        if self.params.heterogeneity > 1:
            return [str(action) for action in range(N_ACTIONS)]
        return [command.name.lower() for command in Command]

    def replica(self) -> HECOGridEnv:
        """Return an independent game with the same parameters; the same seed gives the same episode."""
        return type(self)(**asdict(self.params))

    def grid_scene(self) -> dict[str, Any]:
        """
        Return the data for drawing the game, as plain lists.

        :return: ``width``, ``height``, ``walls`` and ``keys`` [x, y], ``zones`` by column, ``treasures``
            [x, y, whether it is collected], ``agents`` [x, y, direction, whether it has a key]
        """
        state, size = self.get_state(), self.params.grid_size
        treasures = np.argwhere(state["treasures"] != TreasureState.NONE)
        agents = [state["agent_pos"], state["agent_dir"], state["agent_has_key"]]
        return {
            "width": size,
            "height": size,
            "walls": np.argwhere(state["walls"]).tolist(),
            "keys": np.argwhere(state["keys"]).tolist(),
            "zones": self.params.zone_of_column().tolist(),
            "treasures": [
                [x, y, bool(state["treasures"][x, y] == TreasureState.COLLECTED)] for x, y in treasures.tolist()
            ],
            "agents": np.column_stack(agents).tolist(),
        }

    @property
    def best_return(self) -> int:
        """The team's return if it collects every treasure."""
        return self.params.n_treasures

    @property
    def n_steps(self) -> int:
        """Game steps since the reset."""
        return int(self._batch.steps[self._game])

    @property
    def collected(self) -> int:
        """Treasures collected since the reset: the team's return so far."""
        return int(self._batch.collected[self._game])

    def render(self) -> npt.NDArray[np.uint8] | str | None:
        """
        Show the game.

        :return: (height, width, 3) uint8 for ``"rgb_array"``, text for ``"ansi"``, None for ``"human"``
        """
        if self.render_mode is None:
            first = self.metadata["render_modes"][0]
            raise ValueError(f"no render_mode was given; create the environment with render_mode={first!r}")
        if self.render_mode == "ansi":
            from hecogrid_envs.text import render_text

            zones = self.params.zone_of_column() if self.params.heterogeneity > 1 else None
            return render_text(self.get_state(), self.n_steps, self.collected, zones)
        if self.render_mode == "rgb_array":
            return self.picture()
        from hecogrid_envs.play import HumanWindow
        from hecogrid_envs.rendering import fit_tile_size

        if self._window is None:
            self._window = HumanWindow(f"HECOGrid: {self.task}", fps=self.metadata["render_fps"])
        self._window.show(self.picture(fit_tile_size(self.params.grid_size)))
        return None

    def picture(self, tile_size: int | None = None, selected: int | None = None) -> npt.NDArray[np.uint8]:
        """
        Draw the game.

        :param tile_size: pixels per cell, see :func:`hecogrid_envs.rendering.render_scene`
        :param selected: index of an agent to mark
        :return: (height, width, 3)
        """
        from hecogrid_envs.rendering import Scene, render_scene

        scene = Scene(
            task=self.task,
            params=self.params,
            state=self.get_state(),
            step=self.n_steps,
            collected=self.collected,
            visible=self._batch.fields_of_view(self._game),
            selected=selected,
        )
        return render_scene(scene, tile_size)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __str__(self) -> str:
        return f"hecogrid/{self.task}-v0"
