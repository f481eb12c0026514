"""
Pictures of a game for people: zones, walls, treasures, keys, agents with their fields of view, and a score bar.

All functions take a plain state mapping, so that a level can be drawn without running it. Colours are distinguishable
by colour-blind people (Okabe and Ito, 2008); agents also show their numbers. Observations are drawn by
:mod:`hecogrid_envs.tiles`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import OKABE_ITO, Colour, TreasureState, zone_colour
from hecogrid_envs.params import HECOGridParams, whole_number
from hecogrid_envs.task import DECLARED, TaskName

Picture = npt.NDArray[np.uint8]
#: A state mapping; see :class:`hecogrid_envs.state.StateMapping`.
State = Mapping[str, Any]

MIN_TILE: Final = 4
MAX_TILE: Final = 128
#: Default pixels per cell, and the largest map side drawn at this size.
_USUAL_TILE: Final = 24
_LARGEST_SIDE: Final = 60 * _USUAL_TILE
#: Largest allowed picture: 64 million pixels are 192 MB.
MAX_PIXELS: Final = 2**26

#: Colours of agents by index, repeating beyond the last; the gems' green is left out.
AGENT_COLOURS: Final = tuple(
    OKABE_ITO[name] for name in ("orange", "sky", "purple", "white", "vermillion", "blue", "yellow")
)

_INK: Final[Colour] = (15, 17, 24)
_FLOOR: Final[Colour] = (44, 48, 61)
_WALL: Final[Colour] = (104, 110, 128)
_TEXT: Final[Colour] = (238, 240, 246)
_DIM: Final[Colour] = (141, 148, 168)
_KEY: Final[Colour] = (255, 214, 64)

_ZONE_TINT: Final = 0.25
#: Opacity, from 0 to 255, of the veil over seen cells and of the outline of each agent's field of view.
_VEIL: Final = 14
_OUTLINE: Final = 110
#: Shapes are drawn this many times larger and averaged down.
_SUPERSAMPLING: Final = 8
#: Sprites smaller than this show no number.
_LEGIBLE: Final = 15


class Scene(NamedTuple):
    """
    Content of a picture.

    :param state: state mapping (``walls``, ``treasures``, ``keys``, ``agent_pos``, ``agent_dir``, ``agent_has_key``)
    :param step: game steps so far in this episode
    :param collected: treasures collected so far in this episode, the team's return
    :param visible: (N, W, H) bool, the cells that each agent sees (``GameBatch.fields_of_view``); None for no views
    :param selected: index of the agent to mark as the one the person controls
    """

    task: TaskName
    params: HECOGridParams
    state: State
    step: int
    collected: int
    visible: npt.NDArray[np.bool_] | None = None
    selected: int | None = None


def render_scene(scene: Scene, tile_size: int | None = None) -> Picture:
    """
    Draw a scene.

    :param tile_size: pixels per cell, from 4 to 128; by default 24, and less for maps of more than 60 cells
    :return: (height, width, 3); the size depends on the task, the parameters and ``tile_size`` only
    :raises ValueError: if the tile size is out of range or the picture exceeds :data:`MAX_PIXELS`
    :raises ImportError: if Pillow is missing
    """
    if tile_size is None:
        tile_size = min(_USUAL_TILE, fit_tile_size(scene.params.grid_size, _LARGEST_SIDE))
    side = scene.params.grid_size
    tile_size = whole_number("tile_size", tile_size, MIN_TILE, MAX_TILE)
    if (side * tile_size) ** 2 > MAX_PIXELS:
        raise ValueError(
            f"a map of {side} x {side} cells at tile_size={tile_size} is more than {MAX_PIXELS} pixels; use "
            f"tile_size={fit_tile_size(side)}"
        )
    walls = np.ascontiguousarray(scene.state["walls"], dtype=np.bool_)
    image = _background(scene.task, scene.params, tile_size, walls.tobytes()).copy()
    _draw_header(image, scene, tile_size)
    top = header_height(scene.task, scene.params, tile_size)
    if scene.visible is not None:
        _draw_views(image, scene, tile_size, top)
    _draw_objects(image, scene, tile_size, top)
    _draw_agents(image, scene, tile_size, top)
    return np.array(image)


def header_height(task: TaskName, params: HECOGridParams, tile_size: int) -> int:
    """Return the height of the bar above the map in pixels, an even number."""
    return _header_layout(task, params, tile_size)[1]


def fit_tile_size(grid_size: int, max_pixels: int = 960) -> int:
    """
    Return the largest tile size, at most 32, whose map fits into a square window.

    :return: pixels per cell, at least 4
    """
    return int(np.clip(max_pixels // grid_size, MIN_TILE, 32))


def _pillow() -> tuple[ModuleType, ModuleType, ModuleType]:
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise ImportError("drawing games needs Pillow: pip install 'sb3-saf[render]'") from error
    return Image, ImageDraw, ImageFont


def _brush(image: Any) -> Any:
    """Return a drawing context that lays translucent colours over an image."""
    return _pillow()[1].Draw(image, "RGBA")


@lru_cache(maxsize=64)
def _font(size: int) -> Any:
    return _pillow()[2].load_default(size)


def _mix(colour: Colour, other: Colour, share: float) -> Colour:
    """Move ``colour`` towards ``other`` by ``share``."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(colour, other, strict=True))
    return red, green, blue


def _readable_on(colour: Colour) -> Colour:
    """Return black or white, the one with more contrast."""
    red, green, blue = colour
    return _INK if 0.30 * red + 0.59 * green + 0.11 * blue > 105 else (255, 255, 255)


# --- the level: floor, walls, zones; drawn once


@lru_cache(maxsize=8)
def _background(task: TaskName, params: HECOGridParams, tile: int, walls_bytes: bytes) -> Any:
    """Draw the static part of a game."""
    side, top = params.grid_size, header_height(task, params, tile)
    walls = np.frombuffer(walls_bytes, dtype=np.bool_).reshape(side, side)
    image = _pillow()[0].new("RGB", (side * tile, top + side * tile), _INK)
    draw, zones = _brush(image), params.zone_of_column()
    for x, y in np.ndindex(side, side):
        # A map with one zone needs no tint.
        tint = _mix(_FLOOR, zone_colour(int(zones[x])), _ZONE_TINT if zones[-1] > 0 else 0.0)
        box = (x * tile, top + y * tile, (x + 1) * tile - 1, top + (y + 1) * tile - 1)
        draw.rectangle(box, fill=_WALL if walls[x, y] else tint, outline=None if walls[x, y] else _mix(tint, _INK, 0.2))
    band = _band_height(zones, tile)
    font = _font(max(band - 4, 7))
    for zone in np.unique(zones).tolist() if band else ():
        # A band in the zones' full colours right above the map.
        columns = np.flatnonzero(zones == zone) * tile
        left, right = int(columns[0]), int(columns[-1]) + tile
        draw.rectangle((left, top - band, right - 1, top - 1), fill=zone_colour(zone))
        for name in (f"zone {zone}", f"{zone}"):
            if font.getlength(name) + 6 <= right - left:
                place = ((left + right) / 2, top - band / 2)
                draw.text(place, name, font=font, fill=_readable_on(zone_colour(zone)), anchor="mm")
                break
    return image


def _band_height(zones: npt.NDArray[np.int64], tile: int) -> int:
    return 2 * max(round(tile * 0.29), 2) if zones[-1] > 0 else 0


# --- the bar above the map


def _words(scene: Scene) -> list[tuple[str, str]]:
    """Return labels and values of the bar."""
    treasures, params = scene.state["treasures"], scene.params
    found, total = (int(np.count_nonzero(treasures >= kind)) for kind in (TreasureState.COLLECTED, 1))
    return [
        ("", scene.task),
        ("c", f"{params.coordination}"),
        ("h", f"{params.heterogeneity}"),
        ("step", f"{scene.step}/{params.max_cycles}"),
        ("treasures", f"{found}/{total}"),
        ("return", f"{scene.collected}"),
    ]


@lru_cache(maxsize=64)
def _header_layout(task: TaskName, params: HECOGridParams, tile: int) -> tuple[int, int, tuple[tuple[int, int], ...]]:
    """
    Place as many words to a line as fit, at their largest possible width so that they do not move.

    :return: font size of the bar's words, its height, and (x, y) of each word
    """
    width, wanted = params.grid_size * tile, int(np.clip(round(tile * 0.62), 11, 22))
    most = np.ones(params.n_treasures)
    words = _words(Scene(task, params, {"treasures": 2 * most}, params.max_cycles, len(most)))
    for font in range(wanted, 5, -1):
        widths = [int(np.ceil(_font(font).getlength(" ".join(word).strip()))) for word in words]
        if max(widths) <= width - font:
            break
    places: list[tuple[int, int]] = []
    x, y = font // 2, font // 4
    for word_width in widths:
        if places and x + word_width > width - font // 2:
            x, y = font // 2, y + font + font // 2
        places.append((x, y))
        x += word_width + font
    height = y + font + font // 2 + font // 4 + _bar_height(tile) + _band_height(params.zone_of_column(), tile)
    return font, height + height % 2, tuple(places)


def _bar_height(tile: int) -> int:
    return 2 if tile < 16 else 3


def _draw_header(image: Any, scene: Scene, tile: int) -> None:
    (size, height, places), draw = _header_layout(scene.task, scene.params, tile), _brush(image)
    font = _font(size)
    for (label, value), place in zip(_words(scene), places, strict=True):
        indent = font.getlength(f"{label} ") if label else 0
        draw.text(place, label, font=font, fill=_DIM)
        draw.text((place[0] + indent, place[1]), value, font=font, fill=_TEXT)
    bottom = height - _band_height(scene.params.zone_of_column(), tile) - 1
    top, share = bottom - _bar_height(tile) + 1, min(scene.step / scene.params.max_cycles, 1)
    draw.rectangle((0, top, image.width, bottom), fill=_mix(_INK, _DIM, 0.25))
    if share > 0:
        draw.rectangle((0, top, round(image.width * share) - 1, bottom), fill=_DIM)


# --- fields of view


def _draw_views(image: Any, scene: Scene, tile: int, top: int) -> None:
    """Lighten seen floor a little, and outline each agent's field of view in its colour."""
    floor = ~np.asarray(scene.state["walls"], dtype=np.bool_)
    visible = np.asarray(scene.visible, dtype=np.bool_) & floor
    draw = _brush(image)
    for x, y in np.argwhere(visible.any(axis=0)).tolist():
        draw.rectangle(_box(x, y, tile, top), fill=(255, 255, 255, _VEIL))
    for agent, seen in enumerate(visible):
        around = np.pad(seen | ~floor, 1)
        ink = (*_agent_colour(agent), _OUTLINE)
        for x, y in np.argwhere(seen).tolist():
            left, upper, right, lower = _box(x, y, tile, top)
            for dx, dy, edge in (
                (-1, 0, (left, upper, left, lower)),
                (1, 0, (right, upper, right, lower)),
                (0, -1, (left, upper, right, upper)),
                (0, 1, (left, lower, right, lower)),
            ):
                if not around[x + 1 + dx, y + 1 + dy]:
                    draw.line(edge, fill=ink)


def _box(x: int, y: int, tile: int, top: int) -> tuple[int, int, int, int]:
    """Return the first and last pixels of a cell: left, upper, right, lower."""
    return x * tile, top + y * tile, (x + 1) * tile - 1, top + (y + 1) * tile - 1


def _agent_colour(agent: int) -> Colour:
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


# --- sprites


class _Canvas:
    """A large transparent drawing in unit coordinates, averaged down to a sprite at the end."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.side = size * _SUPERSAMPLING
        self.image = _pillow()[0].new("RGBA", (self.side, self.side), (0, 0, 0, 0))
        self.draw = _pillow()[1].Draw(self.image)

    def points(self, unit: npt.ArrayLike) -> list[tuple[float, float]]:
        return [(float(x) * self.side, float(y) * self.side) for x, y in np.asarray(unit, dtype=float)]

    def polygon(self, unit: npt.ArrayLike, colour: Colour, alpha: int = 255) -> None:
        self.draw.polygon(self.points(unit), fill=(*colour, alpha))

    def outline(self, unit: npt.ArrayLike, colour: Colour, width: float) -> None:
        points = self.points(unit)
        self.draw.line(
            [*points, *points[:2]], fill=(*colour, 255), width=max(round(width * self.side), 1), joint="curve"
        )

    def disc(self, x: float, y: float, radius: float, colour: Colour) -> None:
        box = self.points([(x - radius, y - radius), (x + radius, y + radius)])
        self.draw.ellipse(box, fill=(*colour, 255))

    def box(self, box: npt.NDArray[np.float64], colour: Colour) -> None:
        self.draw.rectangle(self.points(box.reshape(2, 2)), fill=(*colour, 255))

    def text(self, x: float, y: float, text: str, height: float, colour: Colour) -> None:
        font = _font(round(height * self.side))
        stroke = self.side // 60
        place = (x * self.side, y * self.side)
        self.draw.text(place, text, font=font, fill=(*colour, 255), anchor="mm", stroke_width=stroke)

    def sprite(self) -> Any:
        return self.image.reduce(_SUPERSAMPLING)


def _paste(image: Any, sprite: Any, x: int, y: int, tile: int, top: int, centre: tuple[float, float]) -> None:
    """Lay a sprite over a cell, around a point of the cell, inside it."""
    left, upper = (int(np.clip(round(at * tile - sprite.width / 2), 0, tile - sprite.width)) for at in centre)
    image.paste(sprite, (x * tile + left, top + y * tile + upper), sprite)


# --- treasures and keys

_MIDDLE: Final = (0.5, 0.5)


def _draw_objects(image: Any, scene: Scene, tile: int, top: int) -> None:
    treasures, gem = np.asarray(scene.state["treasures"]), DECLARED[scene.task].gem
    for where, sprite in (
        (treasures == TreasureState.COLLECTED, _treasure_sprite(tile, gem, True)),
        (treasures == TreasureState.AVAILABLE, _treasure_sprite(tile, gem, False)),
        (scene.state["keys"], _key_sprite(tile)),
    ):
        for x, y in np.argwhere(where).tolist():
            _paste(image, sprite, x, y, tile, top, _MIDDLE)


@lru_cache(maxsize=64)
def _treasure_sprite(size: int, colour: Colour, collected: bool) -> Any:
    """Draw a cut gem, or an empty setting and a tick if it was collected."""
    canvas = _Canvas(size)
    girdle, table, tip = 0.40, 0.20, 0.86
    outline = [(0.30, table), (0.70, table), (0.90, girdle), (0.50, tip), (0.10, girdle)]
    if collected:
        canvas.polygon(outline, _INK, 110)
        canvas.outline(outline, _mix(_DIM, _INK, 0.25), 0.06)
        canvas.draw.line(canvas.points([(0.36, 0.46), (0.48, 0.60), (0.68, 0.34)]), (*_DIM, 255), canvas.side // 12)
        return canvas.sprite()
    white = (255, 255, 255)
    canvas.outline(outline, _INK, 0.14)
    canvas.polygon(outline, colour)
    canvas.polygon([(0.10, girdle), (0.34, girdle), (0.50, tip)], _mix(colour, _INK, 0.12))
    canvas.polygon([(0.66, girdle), (0.90, girdle), (0.50, tip)], _mix(colour, _INK, 0.42))
    canvas.polygon([(0.30, table), (0.34, girdle), (0.10, girdle)], _mix(colour, white, 0.45))
    canvas.polygon([(0.70, table), (0.90, girdle), (0.66, girdle)], _mix(colour, _INK, 0.18))
    canvas.polygon([(0.30, table), (0.70, table), (0.66, girdle), (0.34, girdle)], _mix(colour, white, 0.70))
    return canvas.sprite()


@lru_cache(maxsize=32)
def _key_sprite(size: int) -> Any:
    canvas = _Canvas(size)
    _draw_key(canvas, 0.5, 0.5, 1.0, 0.05)
    return canvas.sprite()


def _draw_key(canvas: _Canvas, x: float, y: float, scale: float, rim: float) -> None:
    """Draw a golden key, upright, its middle at (x, y)."""
    boxes = np.array([(-0.07, -0.10, 0.07, 0.40), (0.00, 0.10, 0.24, 0.20), (0.00, 0.28, 0.20, 0.38)])
    for grow, colour in ((rim, _INK), (0.0, _KEY)):
        canvas.disc(x, y - 0.21 * scale, 0.19 * scale + grow, colour)
        for box in boxes * scale + (x, y, x, y) + np.multiply((-1, -1, 1, 1), grow):
            canvas.box(box, colour)
    canvas.disc(x, y - 0.21 * scale, 0.08 * scale, _INK)


# --- agents


#: Size and centres of the sprites of a crowd in its cell; more than nine agents use the last grid.
_CROWDS: Final[dict[int, tuple[float, list[tuple[float, float]]]]] = {
    1: (1.0, [_MIDDLE]),
    2: (0.66, [(0.33, 0.33), (0.67, 0.67)]),
    3: (0.60, [(0.30, 0.30), (0.70, 0.30), (0.50, 0.70)]),
    4: (0.54, [(0.27, 0.27), (0.73, 0.27), (0.27, 0.73), (0.73, 0.73)]),
    9: (0.36, [(x, y) for y in (0.18, 0.5, 0.82) for x in (0.18, 0.5, 0.82)]),
}
_MOST_SHOWN: Final = 9
#: An agent alone on a treasure is drawn smaller, so that the treasure shows.
_ON_TREASURE: Final = (0.75, [(0.5, 0.60)])


def _draw_agents(image: Any, scene: Scene, tile: int, top: int) -> None:
    crowds: dict[tuple[int, int], list[int]] = {}
    for agent, (x, y) in enumerate(np.asarray(scene.state["agent_pos"]).tolist()):
        crowds.setdefault((x, y), []).append(agent)
    for (x, y), members in crowds.items():
        scale, centres = next(crowd for most, crowd in _CROWDS.items() if most >= min(len(members), _MOST_SHOWN))
        if len(members) == 1 and scene.state["treasures"][x, y] != TreasureState.NONE:
            scale, centres = _ON_TREASURE
        size = max(round(scale * tile), 1)
        shown = members if len(members) <= _MOST_SHOWN else members[: _MOST_SHOWN - 1]
        for agent, centre in zip(shown, centres, strict=False):
            direction, has_key = (int(scene.state[name][agent]) for name in ("agent_dir", "agent_has_key"))
            sprite = _agent_sprite(size, agent, direction, bool(has_key), agent == scene.selected)
            _paste(image, sprite, x, y, tile, top, centre)
        if len(shown) < len(members):
            # The last place shows the number of agents not drawn.
            _paste(image, _more_sprite(size, len(members) - len(shown)), x, y, tile, top, centres[-1])


@lru_cache(maxsize=4096)
def _agent_sprite(size: int, agent: int, direction: int, has_key: bool, selected: bool) -> Any:
    """Draw a triangle in the agent's direction with its number, and a key if it carries one."""
    canvas, colour, label = _Canvas(size), _agent_colour(agent), f"{agent}"
    shape = _turned([(0.10, 0.06), (0.97, 0.50), (0.10, 0.94)], direction)
    if selected:
        canvas.outline(shape, (255, 255, 255), 0.24)
    canvas.outline(shape, _INK, 0.13)
    canvas.polygon(shape, colour)
    if size >= _LEGIBLE and len(label) <= 2:
        x, y = _turned([(0.36, 0.5)], direction)[0]
        canvas.text(x, y, label, 0.5 if len(label) == 1 else 0.40, _readable_on(colour))
    if has_key:
        _draw_key(canvas, 0.82, 0.27, 0.60, 0.05)
    return canvas.sprite()


def _turned(points: list[tuple[float, float]], direction: int) -> list[tuple[float, float]]:
    """Turn an eastward shape about the middle of the unit square, clockwise as seen on the screen."""
    for _ in range(direction):
        points = [(1 - y, x) for x, y in points]
    return points


@lru_cache(maxsize=256)
def _more_sprite(size: int, number: int) -> Any:
    canvas = _Canvas(size)
    canvas.disc(0.5, 0.5, 0.5, _INK)
    canvas.text(0.5, 0.5, f"+{number}", 0.6 if number < 10 else 0.45, _TEXT)
    return canvas.sprite()
