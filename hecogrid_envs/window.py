"""Window on the screen, for watching and playing."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from types import ModuleType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]

#: Time limit for a display to answer.
_DISPLAY_SECONDS: Final = 15.0
_OTHER_WAYS: Final = (
    'draw pictures with render_mode="rgb_array", text with "ansi", or set SDL_VIDEODRIVER=dummy to test'
)


class HumanWindow:
    """
    Window that shows pictures and collects keys; it opens with the first picture.

    After the person has closed it, pictures are dropped silently, so that the program continues.

    :param title: text of the title bar
    :param fps: maximum pictures per second, :meth:`show` waits if necessary; None never waits
    """

    def __init__(self, title: str = "HECOGrid", fps: float | None = None) -> None:
        self.title = title
        self.fps = fps
        self.closed_by_user = False
        self._pygame: ModuleType | None = None
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
        :raises RuntimeError: if there is no display, or it does not answer
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
        if self._pygame is not None and self.is_open:
            self._pygame.display.quit()
        self._screen = None

    def _open(self, width: int, height: int) -> ModuleType:
        if self._pygame is None:
            self._pygame = _import_pygame()
        pygame = self._pygame
        if self._screen is None:
            _start_display(pygame)
            pygame.display.set_caption(self.title)
            self._clock = pygame.time.Clock()
        if self._screen is None or self._screen.get_size() != (width, height):
            self._screen = pygame.display.set_mode((width, height))
            pygame.key.set_repeat(300, 90)
        return pygame

    def _collect_events(self) -> None:
        pygame = self._pygame
        if pygame is None or not self.is_open:
            return
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._keys.append("quit")
                self.closed_by_user = True
                self.close()
                return
            if event.type == pygame.KEYDOWN:
                # Keys of the number pad have names such as "[4]".
                self._keys.append(pygame.key.name(event.key).strip("[]"))


def _import_pygame() -> ModuleType:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        # Some versions of pygame warn about setuptools when imported; users cannot act on that.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import pygame
    except ImportError as error:
        raise ImportError("a window needs pygame: pip install -e '.[render]'") from error
    return pygame


def _start_display(pygame: ModuleType) -> None:
    """
    Start the display, or raise RuntimeError without one.

    Without a screen, SDL silently selects a driver that shows nothing; it is accepted only if requested explicitly.
    """
    _wait_for_display()
    try:
        pygame.display.init()
    except pygame.error as error:
        raise RuntimeError(f"no window can be opened ({error}); {_OTHER_WAYS}") from error
    driver = pygame.display.get_driver()
    if driver in ("offscreen", "dummy") and "SDL_VIDEODRIVER" not in os.environ:
        pygame.display.quit()
        raise RuntimeError(f"no window can be opened (there is no display); {_OTHER_WAYS}")


def _wait_for_display() -> None:
    """
    Open the display in another process first: a display that hangs, for example after a broken connection, would block
    this process, even for Ctrl-C.
    """
    name = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
    if not name or not sys.platform.startswith("linux") or "SDL_VIDEODRIVER" in os.environ:
        return
    program = "import pygame; pygame.display.init()"
    try:
        # Other errors occur again in this process, with their own message.
        subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=_DISPLAY_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(
            f"no window can be opened (the display {name!r} has not answered for {_DISPLAY_SECONDS:.0f} s; is the "
            f"connection to it broken?); {_OTHER_WAYS}"
        ) from error
