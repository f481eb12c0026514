"""
A window for pictures, and playing in it with the keyboard: ``python -m hecogrid_envs.play TeamSupport``.

You walk one agent at a time; the others wait, or wander with ``--others random``.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import fields
from typing import Any, Final, Literal, get_args, get_type_hints

import numpy as np

from hecogrid_envs.constants import N_ACTIONS, Command, Direction
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.rendering import Picture, fit_tile_size
from hecogrid_envs.tasks import parallel_env

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
_OTHER_WAYS: Final = (
    'draw pictures with render_mode="rgb_array", text with "ansi", or set SDL_VIDEODRIVER=dummy to test'
)


class Session:
    """
    One person's game: turns keys into joint actions and says what happened.

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
        self._command_of = env.params.command_of()
        self.new_game(seed)

    def new_game(self, seed: int | None = None) -> None:
        """Start over on a new level."""
        self.env.reset(seed=seed)
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
        agents = range(len(self.env.possible_agents))
        if self.others == "random":
            actions = [int(self._rng.integers(N_ACTIONS)) for _ in agents]
        else:
            actions = [self._action(agent, Command.DONE) for agent in agents]
        action = self.action_for(key)
        actions[self.selected] = action
        command = Command(int(self._command_of[self._zone(self.selected), action]))
        _, rewards, _, truncations, _ = self.env.step(dict(zip(self.env.possible_agents, actions, strict=True)))
        self.over = any(truncations.values())
        gain = round(sum(rewards.values()))
        self.message = f"{key}: action {action} = {command.name.lower()}"
        self.message += f"; {gain} collected!" if gain else ""
        self.message += f"; game over, {self.env.collected} collected, r starts a new one" if self.over else ""

    def action_for(self, key: str) -> int:
        """Return the action integer that a key sends for the selected agent."""
        if key in RAW_ACTIONS:
            return int(key)
        return int(COMMANDS[key]) if self.raw else self._action(self.selected, COMMANDS[key])

    def _action(self, agent: int, command: Command) -> int:
        """Return the action integer that triggers ``command`` where the agent stands."""
        return int(np.flatnonzero(self._command_of[self._zone(agent)] == command)[0])

    def _zone(self, agent: int) -> int:
        return int(self.env.agent_zones[agent])

    @property
    def status(self) -> str:
        """Selected agent and outcome of the last action."""
        agent, state = self.selected, self.env.get_state()
        facing = Direction(int(state["agent_dir"][agent])).name.lower()
        key = ", has a key" if state["agent_has_key"][agent] else ""
        return f"agent {agent} (zone {self._zone(agent)}, facing {facing}{key}): {self.message}"


class HumanWindow:
    """
    Window that shows pictures and collects keys; it opens with the first picture.

    After the person has closed it, pictures are dropped silently, so that the program continues.

    :param fps: maximum pictures per second, :meth:`show` waits if necessary; None never waits
    """

    def __init__(self, title: str = "HECOGrid", fps: float | None = None) -> None:
        self.title = title
        self.fps = fps
        self.closed_by_user = False
        self._pygame: Any = None
        self._screen: Any = None
        self._clock: Any = None
        self._keys: list[str] = []

    @property
    def is_open(self) -> bool:
        """Whether there is a window now."""
        return self._screen is not None

    def show(self, picture: Picture) -> None:
        """
        Show a picture; the window takes its size.

        :param picture: (height, width, 3)
        :raises ImportError: if pygame is missing
        :raises RuntimeError: if there is no display
        """
        if self.closed_by_user:
            return
        pygame = self._open(picture.shape[1], picture.shape[0])
        pygame.surfarray.blit_array(self._screen, picture.transpose(1, 0, 2))
        pygame.display.flip()
        self._collect_events()
        if self.fps is not None:
            self._clock.tick(self.fps)

    def poll(self) -> list[str]:
        """
        Return the keys pressed since the last call.

        :return: names such as ``"left"``, ``"space"``, ``"p"``, ``"3"``; ``"quit"`` if the window was closed
        """
        self._collect_events()
        keys, self._keys = self._keys, []
        return keys

    def close(self) -> None:
        """Close the window; a later picture opens a new one unless the person closed this one."""
        if self.is_open:
            self._pygame.display.quit()
        self._screen = None

    def _open(self, width: int, height: int) -> Any:
        if self._pygame is None:
            os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
            try:
                with warnings.catch_warnings():  # some versions warn about setuptools, on which users cannot act
                    warnings.simplefilter("ignore")
                    import pygame as imported
            except ImportError as error:
                raise ImportError("a window needs pygame: pip install 'sb3-saf[render]'") from error
            self._pygame = imported
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
            except pygame.error as error:
                raise RuntimeError(f"no window can be opened ({error}); {_OTHER_WAYS}") from error
            # Without a screen, SDL silently selects a driver that shows nothing; accepted only if asked for.
            if pygame.display.get_driver() in ("offscreen", "dummy") and "SDL_VIDEODRIVER" not in os.environ:
                pygame.display.quit()
                raise RuntimeError(f"no window can be opened (there is no display); {_OTHER_WAYS}")
            pygame.display.set_caption(self.title)
            self._clock = pygame.time.Clock()
        if self._screen is None or self._screen.get_size() != (width, height):
            self._screen = pygame.display.set_mode((width, height))
            pygame.key.set_repeat(300, 90)
        return pygame

    def _collect_events(self) -> None:
        if not self.is_open:
            return
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._keys.append("quit")
                self.closed_by_user = True
                self.close()
                return
            if event.type == pygame.KEYDOWN:
                # Keys of the number pad have names such as "[4]".
                self._keys.append(pygame.key.name(event.key).strip("[]"))


def play_window(session: Session, tile_size: int | None = None) -> None:
    """
    Play in a window until the person leaves; the status is printed after every key.

    :param tile_size: pixels per cell; by default as many as fit the screen of a laptop
    """
    env, tile = session.env, tile_size or fit_tile_size(session.env.params.grid_size, 840)
    with closing(HumanWindow(f"HECOGrid: {env.task}", fps=_WINDOW_FPS)) as window:
        picture = env.picture(tile, session.selected)
        window.show(picture)
        # Only now: Ctrl-C while libraries are imported may be lost.
        print(KEYS_HELP)
        while True:
            window.show(picture)
            for key in window.poll():
                if not session.press(key):
                    return
                print(session.status)
                picture = env.picture(tile, session.selected)


# --- the command line


def make_session(arguments: Sequence[str] | None = None) -> tuple[Session, argparse.Namespace]:
    """
    Build the game of a command line; invalid arguments end the program with a message.

    :param arguments: command line arguments, ``sys.argv[1:]`` by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m hecogrid_envs.play",
        description="Play a HECOGrid game with the keyboard.",
        epilog=KEYS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("task", nargs="?", default="TeamSupport", help="its name (default: TeamSupport)")
    parser.add_argument("--seed", type=int, help="seed of the first game (default: a new one every time)")
    parser.add_argument("--raw", action="store_true", help="do not translate keys into the dynamics of the zone")
    parser.add_argument("--others", choices=get_args(Others), default="wait", help="other agents (default: wait)")
    parser.add_argument("--tile-size", type=int, help="pixels per cell (default: fit the screen)")
    group = parser.add_argument_group("world", "parameters of the game")
    # With the names, defaults and descriptions of HECOGridParams.
    entries = re.findall(r":param (\w+): (.+?)(?=\n\s*:|$)", HECOGridParams.__doc__ or "", re.DOTALL)
    notes = {name: " ".join(text.replace("`", "").split()) for name, text in entries}
    types, names = get_type_hints(HECOGridParams), []
    for field in fields(HECOGridParams):
        if field.name in _NOT_FOR_PEOPLE:
            continue
        names.append(field.name)
        choices = get_args(types[field.name]) or None
        group.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=str if choices else types[field.name],
            choices=choices,
            default=argparse.SUPPRESS,
            metavar=None if choices else types[field.name].__name__.upper(),
            help=f"{notes.get(field.name, '')} (default: {field.default})".replace("%", "%%"),
        )
    options = parser.parse_args(arguments)
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
        play_window(session, options.tile_size)
    except KeyboardInterrupt:
        pass
    except (ImportError, RuntimeError) as error:
        sys.exit(str(error))
    finally:
        session.env.close()


if __name__ == "__main__":
    main()
