"""
Play a game with the keyboard: ``python -m hecogrid_envs.play TeamSupport``.

You walk one agent at a time; the others wait, or wander with ``--others random``.
"""

from __future__ import annotations

import argparse
import os
import re
import select
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import fields
from importlib.util import find_spec
from typing import Any, Final, Literal, TextIO, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from hecogrid_envs.batch import seen_cells
from hecogrid_envs.constants import N_ACTIONS, Command, Direction
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.rendering import Picture, Scene, fit_tile_size, render_scene
from hecogrid_envs.tasks import parallel_env
from hecogrid_envs.text import render_text
from hecogrid_envs.tiles import INVISIBLE
from hecogrid_envs.window import HumanWindow

Others = Literal["wait", "random"]

#: What each key commands the selected agent.
COMMANDS: Final[dict[str, Command]] = {
    "left": Command.LEFT,
    "right": Command.RIGHT,
    "up": Command.FORWARD,
    "p": Command.PICKUP,
    "d": Command.DROP,
    "space": Command.DONE,
}
RAW_ACTIONS: Final = tuple(str(action) for action in range(N_ACTIONS))
QUIT: Final = ("q", "escape", "quit")

KEYS_HELP: Final = """\
keys:
  left, right   turn the selected agent        TAB      select the next agent
  up            walk forward                   r        new game
  p             pick up a key or a treasure    q, Esc   quit
  d             drop the key                   h, ?     these keys
  space         wait                           0-6      send that action integer as it is

In heterogeneous maps (--heterogeneity 2 or more) every zone permutes the action integers. Your keys are translated,
so that "up" walks everywhere; with --raw they are not: each sends the integer that it means in zone 0, and you feel
what an agent has to learn. The number keys are never translated.
"""

#: Parameters that affect observations only, not the displayed game.
_NOT_FOR_PEOPLE: Final = ("observation", "view_tile_size")
_WINDOW_FPS: Final = 30


class Session:
    """
    One person's game: turns keys into joint actions and says what happened.

    :param env: the game, with tile codes as observations
    :param seed: seed of the first game; later games continue its randomness
    :param raw: send each key's zone 0 integer instead of translating it for the agent's zone
    :param others: behaviour of the agents that are not selected
    """

    def __init__(self, env: HECOGridEnv, seed: int | None = None, raw: bool = False, others: Others = "wait") -> None:
        self.env = env
        self.raw = raw
        self.others = others
        self.selected = 0
        self.over = False
        self.message = ""
        self._rng = np.random.default_rng(seed)
        self._zones = env.params.zone_of_column()
        self._command_of = env.params.command_of()
        self._views: npt.NDArray[np.bool_]
        self.new_game(seed)

    def new_game(self, seed: int | None = None) -> None:
        """Start over on a new level."""
        observations, _ = self.env.reset(seed=seed)
        self._look(observations)
        self.over = False
        self.message = "new game; h lists the keys"

    def press(self, key: str) -> bool:
        """
        Handle a key.

        :param key: a name such as ``"up"``, ``"p"``, ``"3"``
        :return: False if the person wants to leave
        """
        if key in QUIT:
            return False
        if key == "tab":
            self.selected = (self.selected + 1) % len(self.env.possible_agents)
            self.message = "selected"
        elif key == "r":
            self.new_game()
        elif key in ("h", "?"):
            self.message = KEYS_HELP
        elif key in COMMANDS or key in RAW_ACTIONS:
            self._play(key)
        else:
            self.message = f"key {key!r} does nothing; h lists the keys"
        return True

    def _play(self, key: str) -> None:
        if self.over:
            self.message = "the game is over; r starts a new one, q quits"
            return
        actions = [self._other_action(agent) for agent in range(len(self.env.possible_agents))]
        action = self.action_for(key)
        actions[self.selected] = action
        command = Command(int(self._command_of[self._zone(self.selected), action]))
        observations, rewards, terminations, truncations, _ = self.env.step(
            dict(zip(self.env.possible_agents, actions, strict=True))
        )
        self._look(observations)
        self.over = any(terminations.values()) or any(truncations.values())
        gain = round(sum(rewards.values()))
        self.message = f"{key}: action {action} = {command.name.lower()}"
        self.message += f"; {gain} collected!" if gain else ""
        self.message += f"; game over, {self.env.collected} collected, r starts a new one" if self.over else ""

    def action_for(self, key: str) -> int:
        """Return the action integer that a key sends for the selected agent."""
        if key in RAW_ACTIONS:
            return int(key)
        return int(COMMANDS[key]) if self.raw else self._action(self.selected, COMMANDS[key])

    def _other_action(self, agent: int) -> int:
        if self.others == "random":
            return int(self._rng.integers(N_ACTIONS))
        return self._action(agent, Command.DONE)

    def _action(self, agent: int, command: Command) -> int:
        """Return the action integer that triggers ``command`` where the agent stands."""
        return int(np.flatnonzero(self._command_of[self._zone(agent)] == command)[0])

    def _zone(self, agent: int) -> int:
        return int(self._zones[self.env.get_state()["agent_pos"][agent][0]])

    def _look(self, observations: Mapping[str, Any]) -> None:
        views = [np.asarray(observations[agent]) for agent in self.env.possible_agents]
        self._views = np.stack(views) != INVISIBLE

    @property
    def status(self) -> str:
        """Selected agent and outcome of the last action."""
        agent, state = self.selected, self.env.get_state()
        facing = Direction(int(state["agent_dir"][agent])).name.lower()
        key = ", has a key" if state["agent_has_key"][agent] else ""
        return f"agent {agent} (zone {self._zone(agent)}, facing {facing}{key}): {self.message}"

    def text(self, colour: bool) -> str:
        """Write the game as text, then the status."""
        env = self.env
        several = int(self._zones[-1]) > 0
        page = render_text(
            env.get_state(),
            zones=self._zones if several else None,
            step=env.n_steps,
            collected=env.collected,
            colour=colour,
        )
        return f"{page}\n{self.status}"

    def picture(self, tile_size: int) -> Picture:
        """Draw the game as a picture, the selected agent marked."""
        env, state = self.env, self.env.get_state()
        visible = seen_cells(
            self._views, state["agent_pos"], state["agent_dir"], env.params.view_offset, env.params.grid_size
        )
        scene = Scene(env.task, env.params, state, env.n_steps, env.collected, visible, self.selected)
        return render_scene(scene, tile_size)


# --- in a window


def play_window(session: Session, tile_size: int | None = None, echo: Callable[[str], object] = print) -> None:
    """
    Play in a window until the person leaves.

    :param session: the game
    :param tile_size: pixels per cell; by default as many as fit the screen of a laptop
    :param echo: called with the status after every key
    """
    tile = tile_size or fit_tile_size(session.env.params.grid_size, 840)
    echo(KEYS_HELP)
    with closing(HumanWindow(f"HECOGrid: {session.env.task}", fps=_WINDOW_FPS)) as window:
        picture = session.picture(tile)
        while True:
            window.show(picture)
            for key in window.poll():
                if not session.press(key):
                    return
                echo(session.status)
                picture = session.picture(tile)


# --- in a terminal


def play_text(session: Session, stdin: TextIO, stdout: TextIO) -> None:
    """
    Play in a terminal, key by key, or from lines of key names if the input is no terminal.

    :param session: the game
    :param stdin: keys
    :param stdout: where the game is written
    """
    terminal = stdin.isatty() and find_spec("termios") is not None  # not on Windows
    colour = stdout.isatty() and "NO_COLOR" not in os.environ
    clear = "\x1b[2J\x1b[H" if terminal and stdout.isatty() else ""
    mode: AbstractContextManager[object] = _single_keys(stdin) if terminal else nullcontext()
    with mode:
        print(clear + session.text(colour), file=stdout, flush=True)
        for key in terminal_keys(stdin.fileno()) if terminal else line_keys(stdin):
            if not session.press(key):
                return
            print(clear + session.text(colour), file=stdout, flush=True)


def line_keys(stdin: TextIO) -> Iterator[str]:
    """Read keys from lines such as ``up up left p``: their words, in lower case."""
    for line in stdin:
        yield from line.lower().split()


_ESCAPES: Final = {"[A": "up", "[B": "down", "[C": "right", "[D": "left", "OA": "up", "OC": "right", "OD": "left"}


def terminal_keys(descriptor: int) -> Iterator[str]:
    """
    Read keys from a terminal in single key mode; arrow keys arrive as escape sequences, Esc as a lone escape.

    :param descriptor: file descriptor to read bytes from
    :return: names as :class:`~hecogrid_envs.window.HumanWindow` gives them, until the input ends
    """
    names = {"\t": "tab", " ": "space", "\x04": "quit"}
    while True:
        key = os.read(descriptor, 1).decode(errors="replace")
        if not key:
            return
        if key == "\x1b":
            # The rest of an escape sequence follows immediately.
            sequence = ""
            while len(sequence) < 2 and select.select([descriptor], [], [], 0.05)[0]:
                sequence += os.read(descriptor, 1).decode(errors="replace")
            yield _ESCAPES.get(sequence, "escape" if not sequence else f"escape {sequence}")
        else:
            yield names.get(key, key.lower())


@contextmanager
def _single_keys(stdin: TextIO) -> Iterator[None]:
    """Put a terminal into single key mode without echo, and restore it at the end."""
    import termios
    import tty

    before = termios.tcgetattr(stdin.fileno())
    tty.setcbreak(stdin.fileno())
    try:
        yield
    finally:
        termios.tcsetattr(stdin.fileno(), termios.TCSADRAIN, before)


# --- the command line


def build_parser() -> argparse.ArgumentParser:
    """Build the command line parser: one option per parameter of the world, and the player's options."""
    parser = argparse.ArgumentParser(
        prog="python -m hecogrid_envs.play",
        description="Play a HECOGrid game with the keyboard.",
        epilog=KEYS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "task", nargs="?", default="TeamSupport", help="TeamTogether, TeamSupport (default) or KeyForTreasure"
    )
    parser.add_argument("--seed", type=int, help="seed of the first game (default: a new one every time)")
    parser.add_argument(
        "--raw", action="store_true", help="do not translate keys into the dynamics of the agent's zone"
    )
    parser.add_argument(
        "--others", choices=get_args(Others), default="wait", help="what the other agents do (default: wait)"
    )
    parser.add_argument(
        "--text", action="store_true", help="play in the terminal; reads lines of key names from a pipe"
    )
    parser.add_argument("--tile-size", type=int, help="pixels per cell in the window (default: fit the screen)")
    _add_world_options(parser.add_argument_group("world", "parameters of the game"))
    return parser


def _add_world_options(group: argparse._ArgumentGroup) -> None:
    """Add options with the names, defaults and descriptions of :class:`HECOGridParams`."""
    entries = re.findall(r":param (\w+): (.+?)(?=\n\s*:|$)", HECOGridParams.__doc__ or "", re.DOTALL)
    notes = {name: " ".join(text.replace("`", "").split()) for name, text in entries}
    types = get_type_hints(HECOGridParams)
    for field in fields(HECOGridParams):
        if field.name in _NOT_FOR_PEOPLE:
            continue
        choices = get_args(types[field.name]) or None
        group.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=str if choices else types[field.name],
            choices=choices,
            default=argparse.SUPPRESS,
            metavar=None if choices else types[field.name].__name__.upper(),
            help=f"{notes.get(field.name, '')} (default: {field.default})".replace("%", "%%"),
        )


def make_session(arguments: Sequence[str] | None = None) -> tuple[Session, argparse.Namespace]:
    """
    Build the game of a command line; invalid arguments end the program with a message.

    :param arguments: command line arguments, ``sys.argv[1:]`` by default
    """
    parser = build_parser()
    options = parser.parse_args(arguments)
    names = {field.name for field in fields(HECOGridParams)}
    world = {name: value for name, value in vars(options).items() if name in names}
    try:
        env = parallel_env(options.task, observation="tiles", **world)
        return Session(env, options.seed, options.raw, options.others), options
    except ValueError as error:
        parser.error(str(error))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    session, options = make_session(arguments)
    try:
        if options.text:
            play_text(session, sys.stdin, sys.stdout)
        else:
            play_window(session, options.tile_size)
    except KeyboardInterrupt:
        pass
    except (ImportError, RuntimeError) as error:
        sys.exit(f"{error}\n(or play in the terminal: add --text)")
    finally:
        session.env.close()


if __name__ == "__main__":
    main()
