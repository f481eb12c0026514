"""Text, and playing: golden pages, keys that become the right actions, a window."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from textwrap import dedent
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from hecogrid_envs import TeamSupportEnv, play, text
from hecogrid_envs.parallel_env import StepResult
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.play import HumanWindow, Others, Session, make_session, play_window
from hecogrid_envs.text import LEGEND, render_text
from tests.levels import level

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
    assert render_text(make_state(), 3, 1, zones=[0, 0, 0, 0, 1, 1, 1]) == PAGE
    first, _, *others = PAGE.splitlines()
    assert render_text(make_state(), 3, 1).splitlines() == [first, *others]


@pytest.mark.parametrize(("number", "character"), [(1, "v"), (2, "2"), (9, "9"), (10, "+"), (40, "+")])
def test_crowds_are_counted(number: int, character: str) -> None:
    state = make_state()
    state["agent_pos"] = np.array([(5, 2)] * number)
    state["agent_dir"] = np.ones(number, dtype=int)
    state["agent_has_key"] = np.zeros(number, dtype=bool)
    assert render_text(state, 3, 1).splitlines()[3] == f"#...${character}#"


def test_the_page_in_the_documentation_is_real() -> None:
    assert dedent((text.__doc__ or "").split("::\n\n")[1]).rstrip() == PAGE


# --- playing ----------------------------------------------------------------------------------------------------------


#: Zone 0 is columns 0 to 4, zone 1 columns 5 to 9.
LEVEL = """
    ##########
    #>.$.v...#
    #........#
    #..^.....#
    #........#
    #........#
    #........#
    #........#
    #........#
    ##########
"""
ZONE_1 = list(permutations(range(7)))[500]


class NotedGame(TeamSupportEnv):
    """Records its calls."""

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self.actions: list[list[int]] = []
        self.seeds: list[int | None] = []

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> Any:
        self.seeds.append(seed)
        return super().reset(seed, options)

    def step(self, actions: Mapping[str, int]) -> StepResult:
        self.actions.append([actions[agent] for agent in self.possible_agents])
        return super().step(actions)


def noted_session(
    seed: int | None = 0, raw: bool = False, others: Others = "wait", **params: Any
) -> tuple[Session, NotedGame]:
    """Create a session on the level above, and its game."""
    world = {"n_agents": 3, "grid_size": 10, "n_treasures": 1, "n_keys": 0, "clutter_density": 0.0} | params
    game = NotedGame(observation="tiles", agent_order="index", **world)
    session = Session(game, seed, raw, others)
    game.set_state(level(LEVEL))
    return session, game


def real_session(**params: Any) -> Session:
    return noted_session(**params)[0]


# --- keys and actions


@pytest.mark.parametrize(("key", "command"), [("left", 0), ("right", 1), ("up", 2), ("p", 3), ("d", 4), ("space", 6)])
def test_keys_are_translated_for_the_zone(key: str, command: int) -> None:
    session, game = noted_session(heterogeneity=2)
    session.press(key)
    assert game.actions[-1][0] == command
    # The second agent (reading order) stands in zone 1.
    session.press("tab")
    session.press(key)
    assert game.actions[-1][1] == ZONE_1[command]


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("action", range(7))
def test_numbers_are_never_translated(action: int, raw: bool) -> None:
    session, game = noted_session(raw=raw, heterogeneity=2)
    session.press("tab")
    session.press(str(action))
    assert game.actions[-1][1] == action


def test_the_others_can_wander() -> None:
    session, game = noted_session(others="random", max_cycles=100)
    for _ in range(100):
        session.press("up")
    actions = np.array(game.actions)
    assert (actions[:, 0] == 2).all()
    assert set(actions[:, 1]) == set(actions[:, 2]) == set(range(7))


def test_tab_selects_round_and_round() -> None:
    session, game = noted_session()
    selected = []
    for _ in range(4):
        session.press("tab")
        selected.append(session.selected)
    assert selected == [1, 2, 0, 1]
    assert game.actions == []


@pytest.mark.parametrize("key", ["q", "escape", "quit"])
def test_leaving(key: str) -> None:
    assert real_session().press(key) is False
    assert real_session().press("tab") is True


def test_help_and_unknown_keys_are_answered() -> None:
    session = real_session()
    session.press("x")
    assert "key 'x' does nothing" in session.status
    session.press("h")
    assert session.status.endswith(play.KEYS_HELP)


def test_new_games_continue_the_seed() -> None:
    session, game = noted_session(seed=5)
    session.press("r")
    assert game.seeds == [5, None, None]  # the second one is the level's


def test_an_ended_game_waits_for_a_new_one() -> None:
    session, game = noted_session(max_cycles=3)
    for _ in range(5):
        session.press("up")
    assert len(game.actions) == 3
    assert session.over
    assert session.status.endswith("the game is over; r starts a new one, q quits")
    session.press("r")
    session.press("up")
    assert len(game.actions) == 4


# --- in a window


def test_playing_in_a_window(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("PIL")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    session = real_session()
    shown = []
    keys = iter([pygame.K_UP, pygame.K_UP, pygame.K_q])

    def press_next(window: Any, picture: Any, show: Any = HumanWindow.show) -> None:
        show(window, picture)
        shown.append(picture)
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=next(keys)))

    monkeypatch.setattr(HumanWindow, "show", press_next)
    play_window(session, tile_size=12)
    assert session.env.collected == 1
    assert len(shown) == 3
    assert not np.array_equal(shown[0], shown[2])
    printed = capsys.readouterr().out
    assert printed.startswith(play.KEYS_HELP) and printed.endswith("1 collected!\n")
    assert not pygame.display.get_init()


# --- the command line


def test_every_parameter_is_an_option() -> None:
    params: dict[str, Any] = {"n_agents": 4, "grid_size": 12, "coordination": 2, "heterogeneity": 3, "n_treasures": 9}
    params |= {"n_keys": 1, "clutter_density": 0.2, "view_size": 5, "view_offset": 2, "support_radius": 3}
    params |= {"max_cycles": 20, "rules": "released", "agent_order": "index"}
    words = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in params.items())
    session, options = make_session(f"TeamTogether {words} --seed 3 --raw --others random --tile-size 9".split())
    assert session.env.task == "TeamTogether"
    assert session.env.params == HECOGridParams(**params, observation="tiles")
    assert (session.raw, session.others, options.tile_size) == (True, "random", 9)


def test_defaults_are_those_of_the_world() -> None:
    session, _ = make_session([])
    assert session.env.params == HECOGridParams(observation="tiles")
    assert (session.env.task, session.raw, session.others) == ("TeamSupport", False, "wait")


WRONG_WORDS = [
    (["TeamSuport"], "did you mean 'TeamSupport'"),
    (["--coordination", "11"], "coordination"),
    (["--grid-size", "big"], "--grid-size"),
    (["--rules", "mine"], "--rules"),
    (["--grid-size", "8"], "n_treasures"),
    (["--seed", "-1"], "seed"),
]


@pytest.mark.parametrize(("words", "message"), WRONG_WORDS)
def test_mistakes_end_with_a_message(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        make_session(words)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_without_a_window_the_program_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(play, "play_window", refuse)
    with pytest.raises(SystemExit, match="no display"):
        play.main(["--n-agents", "2"])
