"""Text output: golden pages."""

from __future__ import annotations

from textwrap import dedent
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from hecogrid_envs import state as text
from hecogrid_envs.state import LEGEND, render_text

State = dict[str, npt.NDArray[Any]]


def make_state() -> State:
    walls = np.zeros((7, 4), dtype=bool)
    walls[[0, -1]] = walls[:, [0, -1]] = True
    treasures = np.zeros((7, 4), dtype=np.uint8)
    treasures[1, 1], treasures[2, 1], treasures[4, 2] = 1, 2, 1
    keys = np.zeros((7, 4), dtype=bool)
    keys[3, 1] = True
    return {
        "walls": walls,
        "treasures": treasures,
        "keys": keys,
        "agent_pos": np.array([(4, 2), (2, 2), (1, 2), (2, 2), (5, 1)]),
        "agent_dir": np.array([3, 0, 1, 2, 2]),
        "agent_has_key": np.array([False, False, False, True, True]),
    }


PAGE = f"""\
step 3  collected 1
0000111
#######
#$_k.W#
#v2.^.#
#######
agents 0^4,2$ 1>2,2 2v1,2 3W2,2 4W5,1
{LEGEND}"""


def test_page() -> None:
    assert render_text(make_state(), zones=[0, 0, 0, 0, 1, 1, 1], step=3, collected=1) == PAGE


def test_what_is_not_known_is_left_out() -> None:
    lines = PAGE.splitlines()
    assert render_text(make_state(), legend=False).splitlines() == lines[2:-1]
    assert render_text(make_state(), step=0, legend=False).splitlines() == ["step 0", *lines[2:-1]]


def test_every_direction_with_and_without_key() -> None:
    state = make_state()
    state["agent_pos"] = np.array([(x, y) for y in (1, 2) for x in (1, 2, 3, 4)])
    state["agent_dir"] = np.array([0, 1, 2, 3] * 2)
    state["agent_has_key"] = np.array([False] * 4 + [True] * 4)
    rows = render_text(state).splitlines()
    assert rows[1:3] == ["#>v<^.#", "#ESWN.#"]


@pytest.mark.parametrize(("number", "character"), [(1, "v"), (2, "2"), (9, "9"), (10, "+"), (40, "+")])
def test_crowds_are_counted(number: int, character: str) -> None:
    state = make_state()
    state["agent_pos"] = np.array([(5, 2)] * number)
    state["agent_dir"] = np.ones(number, dtype=int)
    state["agent_has_key"] = np.zeros(number, dtype=bool)
    assert render_text(state).splitlines()[2] == f"#...${character}#"


def test_zones_beyond_nine_are_letters() -> None:
    assert render_text(make_state(), zones=[9, 10, 35, 36, 0, 0, 0]).splitlines()[0] == "9az0000"


def test_the_page_in_the_documentation_is_real() -> None:
    state = make_state()
    state["walls"] = np.ones((12, 4), dtype=bool)
    state["walls"][1:-1, 1:-1] = False
    state["walls"][2, 2] = True
    state["treasures"] = np.zeros((12, 4), dtype=np.uint8)
    state["treasures"][[4, 5], [1, 2]], state["treasures"][4, 2] = 1, 2
    state["keys"] = np.zeros((12, 4), dtype=bool)
    state["keys"][7, 1] = True
    state["agent_pos"] = np.array([(2, 1), (9, 1), (5, 2), (5, 2)])
    state["agent_dir"], state["agent_has_key"] = np.array([0, 2, 3, 2]), np.array([False, True, False, False])
    doc = text.__doc__
    assert doc is not None
    page = dedent(doc.split("::\n\n")[1]).rstrip()
    assert render_text(state, zones=[0] * 6 + [1] * 6, step=3, collected=1) == page


def test_agents_wrap_and_may_be_missing() -> None:
    state = make_state()
    for name in ("agent_pos", "agent_dir", "agent_has_key"):
        state[name] = np.concatenate([state[name]] * 5)
    lines = [line for line in render_text(state).splitlines() if line.startswith("agents ")]
    assert len(lines) == 2 and all(len(line) <= 100 for line in lines)
    assert [word for line in lines for word in line.split()[1:]][24] == "24W5,1"
    for name in ("agent_pos", "agent_dir", "agent_has_key"):
        state[name] = state[name][:0]
    assert render_text(state).splitlines()[-2] == "#######"
