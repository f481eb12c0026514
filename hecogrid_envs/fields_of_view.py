"""From agents' own views to cells of the map."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import STEP


def seen_cells(
    views: npt.NDArray[np.bool_], agent_pos: npt.NDArray[Any], agent_dir: npt.NDArray[Any], offset: int, width: int
) -> npt.NDArray[np.bool_]:
    """
    Turn the agents' own views into cells of the map.

    :param views: (N, V, V) bool, what each agent sees in its view, row by row, the agent looking up
    :param agent_pos: (N, 2) x, y
    :param agent_dir: (N,)
    :param offset: rows visible behind the agent
    :param width: W, side of the map
    :return: (N, W, W) bool, indexed ``[agent, x, y]``; seen cells beyond the map are left out
    """
    side = views.shape[1]
    agent, row, column = np.nonzero(views)
    ahead, aside = side - 1 - offset - row, column - side // 2
    direction = np.asarray(agent_dir)[agent]
    cell = np.asarray(agent_pos)[agent] + ahead[:, None] * STEP[direction] + aside[:, None] * STEP[(direction + 1) % 4]
    on_map = ((cell >= 0) & (cell < width)).all(axis=1)
    seen = np.zeros((len(views), width, width), dtype=np.bool_)
    seen[agent[on_map], cell[on_map, 0], cell[on_map, 1]] = True
    return seen
