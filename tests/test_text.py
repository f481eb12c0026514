"""Text output: golden pages, and output that can be read back."""

from __future__ import annotations

from textwrap import dedent
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hecogrid_envs import text
from hecogrid_envs.text import LEGEND, parse_level, render_text

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


def assert_equal_states(got: Any, expected: Any) -> None:
    assert set(got) == set(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(got[name], array, err_msg=name)
        assert got[name].dtype == array.dtype, name


# --- writing


def test_page() -> None:
    assert render_text(make_state(), zones=[0, 0, 0, 0, 1, 1, 1], step=3, collected=1) == PAGE


def test_what_is_not_known_is_left_out() -> None:
    lines = PAGE.splitlines()
    assert render_text(make_state(), legend=False).splitlines() == lines[2:-1]
    assert render_text(make_state(), step=0, legend=False).splitlines() == ["step 0", *lines[2:-1]]


@pytest.mark.parametrize(("number", "character"), [(1, "v"), (2, "2"), (9, "9"), (10, "+"), (40, "+")])
def test_crowds_are_counted(number: int, character: str) -> None:
    state = make_state()
    state["agent_pos"] = np.array([(5, 2)] * number)
    state["agent_dir"] = np.ones(number, dtype=int)
    state["agent_has_key"] = np.zeros(number, dtype=bool)
    assert render_text(state).splitlines()[2] == f"#...${character}#"


# --- reading


@st.composite
def states(draw: st.DrawFn) -> State:
    width, height = draw(st.integers(3, 9)), draw(st.integers(3, 9))
    inner = width * height
    # 0 floor, 1 treasure, 2 collected, 3 key, 4 wall
    cells = np.array(draw(st.lists(st.integers(0, 4), min_size=inner, max_size=inner))).reshape(width, height)
    cells[[0, -1]] = cells[:, [0, -1]] = 4
    cells[1, 1] = draw(st.integers(0, 2))
    free = np.argwhere(cells <= 2).tolist()
    n = draw(st.integers(0, 12))
    return {
        "walls": cells == 4,
        "treasures": np.where(cells <= 2, cells, 0).astype(np.uint8),
        "keys": cells == 3,
        "agent_pos": np.array([draw(st.sampled_from(free)) for _ in range(n)], dtype=np.int64).reshape(-1, 2),
        "agent_dir": np.array([draw(st.integers(0, 3)) for _ in range(n)], dtype=np.int64),
        "agent_has_key": np.array([draw(st.booleans()) for _ in range(n)], dtype=bool),
    }


@given(states(), st.booleans())
def test_every_state_is_read_back(state: State, heading: bool) -> None:
    zones = np.arange(len(state["walls"])) if heading else None
    page = render_text(state, zones=zones, step=7 if heading else None, collected=2 if heading else None)
    assert_equal_states(parse_level(page), state)


def test_agents_line_may_stand_alone() -> None:
    state = parse_level("####\n#$.#\n#..#\n####\nagents 1<2,2\nagents 0N1,1")
    assert state["agent_pos"].tolist() == [[1, 1], [2, 2]]
    assert state["agent_dir"].tolist() == [3, 2]
    assert state["agent_has_key"].tolist() == [True, False]
    assert state["treasures"][1, 1] == 1


ROOM = "####\n#>.#\n#..#\n####\n"
#: Levels, and what the message names.
WRONG = [
    ("", "no map"),
    ("####\n#.#\n####", "4 long .*row 1 is 3"),
    ("####\n#?.#\n####", r"cell \(1, 1\) .*'\?'"),
    ("####\n#.2#\n####", r"cell \(2, 1\); .*'agents 0>2,1'"),
    (ROOM + "hello", "'hello'"),
    (ROOM + "agents 0x1,1", "'0x1,1' .*3N4,5"),
    (ROOM + "agents 0>1,1 0>1,1", "agent 0 .*twice"),
    (ROOM + "agents 0>1,1 2>1,1", r"0 to 1, got \[0, 2\]"),
    (ROOM + "agents 0>1,4", r"agent 0 .*\(1, 4\), .*4 x 4"),
    (ROOM + "agents 0>2,2", r"agent at \(1, 1\)"),
]


@pytest.mark.parametrize(("level", "named"), WRONG)
def test_wrong_levels(level: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        parse_level(level)


def test_the_page_in_the_documentation_is_real() -> None:
    doc = text.__doc__
    assert doc is not None
    page = dedent(doc.split("::\n\n")[1]).rstrip()
    zones = [int(digit) for digit in page.splitlines()[1]]
    assert render_text(parse_level(page), zones=zones, step=3, collected=1) == page
