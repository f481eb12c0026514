"""
The figures of the documentation, drawn by the games' own renderer: ``python -m docs.tools.figures``.

Everything is seeded, so that the same command gives the same pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from hecogrid_envs import TASK_NAMES, parallel_env
from hecogrid_envs.constants import Command
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.rendering import Scene, render_scene
from hecogrid_envs.task import TaskName

Picture = npt.NDArray[np.uint8]

FOLDER: Final = Path(__file__).resolve().parents[1] / "images"
#: Background between panels, which light and dark pages bear.
_GAP: Final = 128
_LEVEL: Final[dict[str, Any]] = {"n_agents": 5, "grid_size": 15, "n_treasures": 25, "n_keys": 8}


def _task(task: TaskName) -> Picture:
    """A level of a task, with what each agent sees."""
    env = parallel_env(task, render_mode="rgb_array", coordination=2, heterogeneity=2, **_LEVEL)
    env.reset(seed=3)
    return _drawn(env)


def _heterogeneity() -> Picture:
    """One level under h = 1, 3, 5: the same walls, treasures and agents, in more and more zones."""
    start = parallel_env("TeamTogether", **_LEVEL)
    start.reset(seed=3)
    state = start.get_state()
    return _in_a_row([_scene("TeamTogether", state, {**_LEVEL, "heterogeneity": h}) for h in (1, 3, 5)])


def _coordination() -> Picture:
    """One agent steps onto a treasure in TeamSupport under c = 2: alone, then with a teammate two cells away."""
    return _in_a_row([_after_a_step(teammate) for teammate in ((8, 3), (6, 3))])


def _after_a_step(teammate: tuple[int, int]) -> Picture:
    """Agent 0 has just entered the treasure's cell (4, 3); the other one stands where it is told."""
    params: dict[str, Any] = {"n_agents": 2, "grid_size": 10, "n_treasures": 1, "coordination": 2}
    env = parallel_env("TeamSupport", render_mode="rgb_array", clutter_density=0.0, **params)
    env.reset(seed=0)
    state = {name: np.array(value) for name, value in env.get_state().items()}
    state["treasures"][:] = 0
    state["treasures"][4, 3] = 1
    state["agent_pos"][:] = [(3, 3), teammate]
    state["agent_dir"][:] = [0, 2]
    env.reset(options={"state": state})
    env.step({"agent_0": Command.FORWARD, "agent_1": Command.DONE})
    return _drawn(env)


def _view() -> Picture:
    """What an agent sees, 28 x 28 pixels, eight times enlarged, for four agents of one game."""
    env = parallel_env("KeyForTreasure", heterogeneity=3, **_LEVEL)
    observations, _ = env.reset(seed=3)
    return _in_a_row([observations[agent].repeat(8, axis=0).repeat(8, axis=1) for agent in env.agents[:4]])


def _scene(task: TaskName, state: Any, params: dict[str, Any]) -> Picture:
    env = parallel_env(task, **params)
    return render_scene(Scene(task, env.params, state, step=0, collected=0), tile_size=24)


def _drawn(env: HECOGridEnv) -> Picture:
    picture = env.render()
    if not isinstance(picture, np.ndarray):
        raise TypeError(f"expected a picture, got {type(picture).__name__}; pass render_mode='rgb_array'")
    return picture


def _in_a_row(panels: list[Picture], gap: int = 12) -> Picture:
    """Panels beside each other; lower ones are continued in the colour of their last corner."""
    height = max(len(panel) for panel in panels)
    space = np.full((height, gap, 3), _GAP, dtype=np.uint8)
    parts = [part for panel in panels for part in (_stretched(panel, height), space)]
    return np.concatenate(parts[:-1], axis=1)


def _stretched(panel: Picture, height: int) -> Picture:
    below = np.full((height - len(panel), *panel.shape[1:]), panel[-1, -1], dtype=np.uint8)
    return np.concatenate([panel, below])


def _of_task(task: TaskName) -> Callable[[], Picture]:
    return lambda: _task(task)


#: File names and what makes their pixels.
FIGURES: Final[dict[str, Callable[[], Picture]]] = {
    **{f"{task}.png": _of_task(task) for task in TASK_NAMES},
    "heterogeneity.png": _heterogeneity,
    "coordination.png": _coordination,
    "views.png": _view,
}


def main() -> None:
    """Write all figures."""
    parser = argparse.ArgumentParser(prog="python -m docs.tools.figures", description="Draw the figures of the pages.")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where to (default: %(default)s)")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in FIGURES.items():
        Image.fromarray(draw()).save(folder / name, optimize=True)
        print(folder / name)


if __name__ == "__main__":
    main()
