"""
Pictures of a game for people: zones, walls, treasures, keys, agents with what they see, and a score bar.

Everything here works on a plain state mapping, so that a level can be drawn without running it. What does not change
within a game (floor, walls, zone names) is drawn once per level; a frame then costs a few milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import AGENT_PALETTE, KEY_CARRIER_INDEX, ZONE_COLOURS, Colour, TreasureState
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.task import TaskName

Picture = npt.NDArray[np.uint8]
#: A state mapping; see :class:`hecogrid_envs.state.StateMapping`.
State = Mapping[str, Any]

MIN_TILE: Final = 4
MAX_TILE: Final = 128
#: Pixels per cell, and the largest side of a map, where nobody asks for a size.
_USUAL_TILE: Final = 24
_LARGEST_SIDE: Final = 60 * _USUAL_TILE
#: A picture larger than this is a mistake: 64 million pixels are 192 MB.
MAX_PIXELS: Final = 2**26

_INK: Final[Colour] = (15, 17, 24)
_FLOOR: Final[Colour] = (44, 48, 61)
_WALL: Final[Colour] = (92, 98, 117)
_TEXT: Final[Colour] = (238, 240, 246)
_DIM: Final[Colour] = (141, 148, 168)
_GOLD: Final[Colour] = (255, 205, 60)
_EMERALD: Final[Colour] = (38, 222, 129)
_KEY: Final[Colour] = (255, 214, 64)
_PINK: Final[Colour] = AGENT_PALETTE[KEY_CARRIER_INDEX]

_ZONE_TINT: Final = 0.17
_WALL_TINT: Final = 0.06
_VIEW_FILL: Final = 0.10
_VIEW_EDGE: Final = 0.45
#: Shapes are drawn this many times larger and averaged down.
_SUPERSAMPLING: Final = 8


class Scene(NamedTuple):
    """
    What a picture shows.

    :param task: name of the task
    :param params: parameters of the world
    :param state: state mapping (``walls``, ``treasures``, ``keys``, ``agent_pos``, ``agent_dir``, ``agent_has_key``)
    :param step: game steps so far in this episode
    :param collected: treasures collected so far in this episode, the team's return
    :param visible: (N, W, H) bool, the cells that each agent sees, see :func:`seen_cells`; None draws no views
    :param selected: index of an agent to mark, the one a person plays
    """

    task: TaskName
    params: HECOGridParams
    state: State
    step: int
    collected: int
    visible: npt.NDArray[np.bool_] | None = None
    selected: int | None = None


class _Sprite(NamedTuple):
    """Pixels ready for blending: ``picture * keep + add``, both in units of 1/255."""

    add: npt.NDArray[np.uint16]
    keep: npt.NDArray[np.uint16]


def render_scene(scene: Scene, tile_size: int | None = None, show_views: bool = True) -> Picture:
    """
    Draw a scene.

    :param scene: what to draw
    :param tile_size: pixels per cell, from 4 to 128; by default 24, and less for maps of more than 60 cells
    :param show_views: lay a veil in the agent's colour over the cells that it sees (needs ``scene.visible``)
    :return: (height, width, 3); the size depends on the task, the parameters and ``tile_size`` only
    :raises ValueError: if the tile size is out of range or the picture would be enormous
    :raises ImportError: if Pillow is missing
    """
    if tile_size is None:
        tile_size = min(_USUAL_TILE, fit_tile_size(scene.params.grid_size, _LARGEST_SIDE))
    _check_size(scene.params, tile_size)
    walls = np.ascontiguousarray(scene.state["walls"], dtype=np.bool_)
    picture: Picture = _background(scene.task, scene.params, tile_size, walls.tobytes()).copy()
    top = header_height(scene.task, scene.params, tile_size)
    _draw_header(picture[:top], scene, tile_size)
    cells = _cells(picture[top:], tile_size)
    if show_views and scene.visible is not None:
        _draw_views(cells, scene)
    _draw_objects(cells, scene, tile_size)
    _draw_agents(cells, scene, tile_size)
    return picture


def header_height(task: TaskName, params: HECOGridParams, tile_size: int) -> int:
    """
    Height of the bar above the map.

    :return: pixels, an even number
    """
    return _header_layout(task, params, tile_size).height


def fit_tile_size(grid_size: int, max_pixels: int = 960) -> int:
    """
    Largest tile size, at most 32, whose map fits into a square window.

    :param grid_size: cells per side
    :param max_pixels: side of the window
    :return: pixels per cell, at least 4
    """
    return int(np.clip(max_pixels // grid_size, MIN_TILE, 32))


def _check_size(params: HECOGridParams, tile_size: int) -> None:
    if not isinstance(tile_size, (int, np.integer)) or not MIN_TILE <= tile_size <= MAX_TILE:
        raise ValueError(f"tile_size must be an integer from {MIN_TILE} to {MAX_TILE}, got {tile_size!r}")
    if (params.grid_size * tile_size) ** 2 > MAX_PIXELS:
        raise ValueError(
            f"a map of {params.grid_size} x {params.grid_size} cells at tile_size={tile_size} is more than "
            f"{MAX_PIXELS} pixels; use tile_size={fit_tile_size(params.grid_size)}"
        )


# --- colours, shapes and blending


def _pillow() -> tuple[ModuleType, ModuleType, ModuleType]:
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise ImportError("drawing games needs Pillow: pip install sb3-saf[render]") from error
    return Image, ImageDraw, ImageFont


def _mix(colour: Colour, other: Colour, share: float) -> Colour:
    """Move ``colour`` towards ``other`` by ``share``."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(colour, other, strict=True))
    return red, green, blue


def _zone_colour(zone: int) -> Colour:
    return ZONE_COLOURS[zone % len(ZONE_COLOURS)]


def _gem_colour(task: TaskName) -> Colour:
    return _GOLD if task == "TeamTogether" else _EMERALD


def _cells(area: Picture, tile_size: int) -> Picture:
    """View the map's pixels as (row y, pixel row, column x, pixel column, channel)."""
    height, width, _ = area.shape
    return area.reshape(height // tile_size, tile_size, width // tile_size, tile_size, 3)


def _over(below: Picture, sprite: _Sprite) -> Picture:
    """Blend with integers only: exact to rounding, and several times faster than floats."""
    mixed = below.astype(np.uint16)
    mixed *= sprite.keep
    mixed += sprite.add
    mixed += 128
    mixed += mixed >> 8
    mixed >>= 8
    return mixed.astype(np.uint8)


def _veil(colours: npt.NDArray[Any], alpha: float) -> _Sprite:
    """Translucent colour of any leading shape."""
    opacity = round(alpha * 255)
    return _Sprite((np.asarray(colours) * opacity).astype(np.uint16), np.array(255 - opacity, dtype=np.uint16))


def _sprite(image: Any, size: int) -> _Sprite:
    """Average a large RGBA drawing down to ``size`` pixels."""
    pixels = np.asarray(image.reduce(image.width // size)).astype(np.uint16)
    alpha = pixels[..., 3:]
    return _Sprite(pixels[..., :3] * alpha, 255 - alpha)


class _Canvas:
    """A large transparent drawing in unit coordinates, averaged down to a sprite at the end."""

    def __init__(self, size: int) -> None:
        image, draw, _ = _pillow()
        self.size = size
        self.side = size * _SUPERSAMPLING
        self.image = image.new("RGBA", (self.side, self.side), (0, 0, 0, 0))
        self.draw = draw.Draw(self.image)

    def points(self, unit: npt.ArrayLike) -> list[tuple[float, float]]:
        return [(float(x) * self.side, float(y) * self.side) for x, y in np.asarray(unit, dtype=float)]

    def polygon(self, unit: npt.ArrayLike, colour: Colour, alpha: int = 255) -> None:
        self.draw.polygon(self.points(unit), fill=(*colour, alpha))

    def outline(self, unit: npt.ArrayLike, colour: Colour, width: float) -> None:
        points = self.points(unit)
        stroke = max(round(width * self.side), 1)
        self.draw.line([*points, points[0], points[1]], fill=(*colour, 255), width=stroke, joint="curve")

    def disc(self, x: float, y: float, radius: float, colour: Colour) -> None:
        box = self.points([(x - radius, y - radius), (x + radius, y + radius)])
        self.draw.ellipse(box, fill=(*colour, 255))

    def box(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        self.draw.rectangle(self.points([(left, top), (right, bottom)]), fill=(*colour, 255))

    def text(self, x: float, y: float, text: str, height: float, colour: Colour) -> None:
        font = _font(round(height * self.side))
        self.draw.text((x * self.side, y * self.side), text, font=font, fill=(*colour, 255), anchor="mm")

    def sprite(self) -> _Sprite:
        return _sprite(self.image, self.size)


@lru_cache(maxsize=64)
def _font(size: int) -> Any:
    return _pillow()[2].load_default(size)


# --- the level: floor, walls, zones; drawn once


@lru_cache(maxsize=8)
def _background(task: TaskName, params: HECOGridParams, tile_size: int, walls_bytes: bytes) -> Picture:
    """Everything that stays put in a game, header bar (without its words) and zone names included."""
    side = params.grid_size
    walls = np.frombuffer(walls_bytes, dtype=np.bool_).reshape(side, side)
    top = header_height(task, params, tile_size)
    picture = np.empty((top + side * tile_size, side * tile_size, 3), dtype=np.uint8)
    picture[:top] = _INK
    _draw_zone_names(picture[:top], params, tile_size)
    cells = _cells(picture[top:], tile_size)
    _draw_floor(cells, params)
    _draw_walls(cells, walls.T, params)
    picture.flags.writeable = False
    return picture


def _zone_tints(base: Colour, params: HECOGridParams, share: float) -> list[Colour]:
    """
    Colour of each column, its zone's shining through.

    A map with one zone stays neutral: there is nothing to tell apart.
    """
    zones = params.zone_of_column()
    share = share if zones[-1] > 0 else 0.0
    return [_mix(base, _zone_colour(int(zone)), share) for zone in zones]


def _draw_floor(cells: Picture, params: HECOGridParams) -> None:
    for x, tint in enumerate(_zone_tints(_FLOOR, params, _ZONE_TINT)):
        cells[:, :, x] = tint
        line = _mix(tint, _INK, 0.35)
        cells[:, -1, x] = line
        cells[:, :, x, -1] = line


def _draw_walls(cells: Picture, walls: npt.NDArray[np.bool_], params: HECOGridParams) -> None:
    """Blocks lit from above: a bright upper rim, a dark front, and a shadow on the floor below."""
    tile = cells.shape[1]
    rim, front, shadow = max(tile // 12, 1), max(tile // 5, 1), max(tile // 6, 1)
    blocks = _zone_tints(_WALL, params, _WALL_TINT)
    for y, x in np.argwhere(walls):
        block = blocks[x]
        cells[y, :, x] = block
        if y > 0 and not walls[y - 1, x]:
            cells[y, :rim, x] = _mix(block, (255, 255, 255), 0.35)
        if y + 1 < len(walls) and not walls[y + 1, x]:
            cells[y, tile - front :, x] = _mix(block, _INK, 0.45)
            cells[y + 1, :shadow, x] = _over(cells[y + 1, :shadow, x], _veil(np.array(_INK), 0.4))


def _draw_zone_names(header: Picture, params: HECOGridParams, tile_size: int) -> None:
    """A band in the zones' full colours right above the map, only where there is more than one zone."""
    band = _band_height(params, tile_size)
    if band == 0:
        return
    zones = params.zone_of_column()
    for zone in np.unique(zones):
        columns = np.flatnonzero(zones == zone) * tile_size
        left, right = int(columns[0]), int(columns[-1]) + tile_size
        colour = _mix(_zone_colour(int(zone)), _INK, 0.15)
        strip = header[-band:, left:right]
        strip[:] = colour
        for text in (f"zone {zone}", f"{zone}"):
            mask = _text_mask(text, max(band - 4, 7))
            if mask.shape[0] <= band and mask.shape[1] + 6 <= right - left:
                y, x = (band - mask.shape[0]) // 2, (right - left - mask.shape[1]) // 2
                _stamp(strip, mask, x, y, _readable_on(colour))
                break


def _band_height(params: HECOGridParams, tile_size: int) -> int:
    several = int(params.zone_of_column()[-1]) > 0
    return 2 * max(round(tile_size * 0.29), 2) if several else 0


def _readable_on(colour: Colour) -> Colour:
    """Black or white, whichever stands out."""
    red, green, blue = colour
    return _INK if 0.30 * red + 0.59 * green + 0.11 * blue > 105 else (255, 255, 255)


# --- the bar above the map


class _Item(NamedTuple):
    """A label and a value of the bar; ``widest`` is the value that needs most room, so that numbers do not jump."""

    label: str
    value: str
    widest: str
    gem: bool = False


#: Where the second half of the bar begins: step, treasures, return.
_FIRST_SCORE_ITEM: Final = 3


class _Slot(NamedTuple):
    x: int
    y: int


class _HeaderLayout(NamedTuple):
    font: int
    height: int
    slots: tuple[_Slot, ...]


def _header_items(task: TaskName, params: HECOGridParams, step: int, found: int, total: int, score: int) -> list[_Item]:
    cycles = params.max_cycles
    return [
        _Item("", task, task),
        _Item("c", f"{params.coordination}", f"{params.coordination}"),
        _Item("h", f"{params.heterogeneity}", f"{params.heterogeneity}"),
        _Item("step", f"{step}/{cycles}", f"{cycles}/{cycles}"),
        _Item("", f"{found}/{total}", f"{total}/{total}", gem=True),
        _Item("return", f"{score}", f"{total}"),
    ]


@lru_cache(maxsize=64)
def _header_layout(task: TaskName, params: HECOGridParams, tile_size: int) -> _HeaderLayout:
    """Place the words: on one line if they fit, else in two or more, smaller in tiny pictures."""
    width = params.grid_size * tile_size
    items = _header_items(task, params, 0, 0, params.n_treasures, 0)
    wanted = int(np.clip(round(tile_size * 0.62), 11, 22))
    font, rows = _choose_rows(items, wanted, width)
    gap, margin, line = font, font // 2, font + font // 2
    places: dict[int, _Slot] = {}
    for number, row in enumerate(rows):
        # On a single line the score stands on the right, above the map's corner.
        spare = width - 2 * margin - _row_width(items, row, font) if len(rows) == 1 else 0
        x = margin
        for index in row:
            x += spare if index == _FIRST_SCORE_ITEM else 0
            places[index] = _Slot(x, margin // 2 + number * line)
            x += _item_width(items[index], font) + gap
    height = len(rows) * line + 2 * (margin // 2) + _bar_height(tile_size) + _band_height(params, tile_size)
    return _HeaderLayout(font, height + height % 2, tuple(places[index] for index in range(len(items))))


def _choose_rows(items: list[_Item], wanted: int, width: int) -> tuple[int, list[list[int]]]:
    """Font size and the items of each line."""
    everything = list(range(len(items)))
    halves = [everything[:_FIRST_SCORE_ITEM], everything[_FIRST_SCORE_ITEM:]]
    for font in range(wanted, round(wanted * 0.8), -1):
        if _row_width(items, everything, font) <= width - font:
            return font, [everything]
    for font in range(wanted, 7, -1):
        if max(_row_width(items, half, font) for half in halves) <= width - font:
            return font, halves
    for font in range(min(wanted, 9), 5, -1):
        if max(_item_width(item, font) for item in items) <= width - font:
            break
    return font, _wrap([_item_width(item, font) for item in items], font, width - font)


def _row_width(items: list[_Item], row: list[int], font: int) -> int:
    return sum(_item_width(items[index], font) for index in row) + font * (len(row) - 1)


def _wrap(widths: list[int], gap: int, room: int) -> list[list[int]]:
    """Fill lines from the left."""
    rows: list[list[int]] = [[]]
    used = 0
    for index, width in enumerate(widths):
        if rows[-1] and used + gap + width > room:
            rows.append([])
            used = 0
        used += width + (gap if rows[-1] else 0)
        rows[-1].append(index)
    return rows


def _bar_height(tile_size: int) -> int:
    return 2 if tile_size < 16 else 3


def _item_width(item: _Item, font: int) -> int:
    before = font if item.gem else _text_width(item.label, font)
    return before + (font // 3 if before else 0) + _text_width(item.widest, font)


def _draw_header(header: Picture, scene: Scene, tile_size: int) -> None:
    treasures = scene.state["treasures"]
    total = int(np.count_nonzero(treasures))
    found = int(np.count_nonzero(treasures == TreasureState.COLLECTED))
    items = _header_items(scene.task, scene.params, scene.step, found, total, scene.collected)
    layout = _header_layout(scene.task, scene.params, tile_size)
    for item, slot in zip(items, layout.slots, strict=True):
        _draw_item(header, item, slot, layout.font, scene.task)
    bottom = len(header) - _band_height(scene.params, tile_size)
    bar = header[bottom - _bar_height(tile_size) : bottom]
    bar[:] = _mix(_INK, _DIM, 0.25)
    bar[:, : round(bar.shape[1] * min(scene.step / scene.params.max_cycles, 1))] = _DIM


def _draw_item(header: Picture, item: _Item, slot: _Slot, font: int, task: TaskName) -> None:
    x = slot.x
    if item.gem:
        area = header[slot.y + font // 8 : slot.y + font // 8 + font, x : x + font]
        sprite = _treasure_sprite(font, _gem_colour(task), False)
        area[:] = _over(area, _Sprite(*(part[: area.shape[0], : area.shape[1]] for part in sprite)))
        x += font + font // 3
    elif item.label:
        _stamp(header, _text_mask(item.label, font), x, slot.y, _DIM)
        x += _text_width(item.label, font) + font // 3
    _stamp(header, _text_mask(item.value, font), x, slot.y, _TEXT)


def _stamp(area: Picture, mask: npt.NDArray[np.uint8], x: int, y: int, colour: Colour) -> None:
    """Print a text mask, cut off at the area's edges."""
    part = area[y : y + mask.shape[0], x : x + mask.shape[1]]
    alpha = mask[: part.shape[0], : part.shape[1], None].astype(np.uint16)
    part[:] = _over(part, _Sprite(alpha * np.array(colour, dtype=np.uint16), 255 - alpha))


@lru_cache(maxsize=1024)
def _text_mask(text: str, size: int) -> npt.NDArray[np.uint8]:
    """Coverage of each pixel by the text, its lines as high as the font's tallest letters."""
    image, draw, _ = _pillow()
    font = _font(size)
    ascent, descent = font.getmetrics()
    picture = image.new("L", (max(_text_width(text, size), 1), ascent + descent), 0)
    draw.Draw(picture).text((0, 0), text, font=font, fill=255)
    return np.asarray(picture)


@lru_cache(maxsize=1024)
def _text_width(text: str, size: int) -> int:
    return int(np.ceil(_font(size).getlength(text))) if text else 0


# --- what agents see


def _draw_views(cells: Picture, scene: Scene) -> None:
    """Veil the seen cells in their viewers' colours, walls less, and line each view's border on the floor."""
    visible = np.asarray(scene.visible, dtype=np.bool_).transpose(0, 2, 1)
    walls = np.asarray(scene.state["walls"], dtype=np.bool_).T
    colours = _agent_colours(scene)
    count = visible.sum(axis=0)
    y, x = np.nonzero(count)
    # The mean colour of the viewers; the more of them, the denser, but never opaque.
    mean = np.einsum("nk,nc->kc", visible[:, y, x], colours) / count[y, x, None]
    opacity = 1 - (1 - _VIEW_FILL) ** np.minimum(count[y, x], 3)
    alpha = np.round(255 * opacity * np.where(walls[y, x], 0.25, 1.0))[:, None, None, None]
    veil = _Sprite((mean[:, None, None] * alpha).astype(np.uint16), (255 - alpha).astype(np.uint16))
    cells[y, :, x] = _over(cells[y, :, x], veil)
    _draw_view_edges(cells, visible, walls, colours)


def _draw_view_edges(
    cells: Picture,
    visible: npt.NDArray[np.bool_],
    walls: npt.NDArray[np.bool_],
    colours: npt.NDArray[np.uint16],
) -> None:
    around = np.pad(visible | walls, ((0, 0), (1, 1), (1, 1)))
    whole = slice(None)
    sides: list[tuple[Any, Any, npt.NDArray[np.bool_]]] = [
        (0, whole, around[:, :-2, 1:-1]),
        (-1, whole, around[:, 2:, 1:-1]),
        (whole, 0, around[:, 1:-1, :-2]),
        (whole, -1, around[:, 1:-1, 2:]),
    ]
    for row, column, neighbour in sides:
        agent, y, x = np.nonzero(visible & ~walls & ~neighbour)
        veil = _veil(colours[agent][:, None, :], _VIEW_EDGE)
        cells[y, row, x, column] = _over(cells[y, row, x, column], veil)


def _agent_colours(scene: Scene) -> npt.NDArray[np.uint16]:
    """Colour of each agent by the zone it stands in now: (N, 3)."""
    zones = scene.params.zone_of_column()[np.asarray(scene.state["agent_pos"])[:, 0]]
    colours: npt.NDArray[np.uint16] = np.array(ZONE_COLOURS, dtype=np.uint16)[zones % len(ZONE_COLOURS)]
    return colours


# --- treasures and keys


def _draw_objects(cells: Picture, scene: Scene, tile_size: int) -> None:
    treasures, gem = scene.state["treasures"], _gem_colour(scene.task)
    _paste(cells, treasures == TreasureState.COLLECTED, _treasure_sprite(tile_size, gem, True))
    _paste(cells, treasures == TreasureState.AVAILABLE, _treasure_sprite(tile_size, gem, False))
    _paste(cells, scene.state["keys"], _key_sprite(tile_size))


def _paste(cells: Picture, where: npt.NDArray[np.bool_], sprite: _Sprite) -> None:
    x, y = np.nonzero(where)
    cells[y, :, x] = _over(cells[y, :, x], sprite)


@lru_cache(maxsize=64)
def _treasure_sprite(size: int, colour: Colour, collected: bool) -> _Sprite:
    """A cut gem; where it was collected only its empty setting remains."""
    canvas = _Canvas(size)
    girdle, table, tip = 0.40, 0.20, 0.86
    outline = [(0.30, table), (0.70, table), (0.90, girdle), (0.50, tip), (0.10, girdle)]
    if collected:
        canvas.polygon(outline, _INK, 90)
        canvas.outline(outline, _mix(_DIM, _INK, 0.25), 0.06)
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
def _key_sprite(size: int) -> _Sprite:
    canvas = _Canvas(size)
    _draw_key(canvas, 0.5, 0.5, 1.0, 0.05)
    return canvas.sprite()


def _draw_key(canvas: _Canvas, x: float, y: float, scale: float, rim: float) -> None:
    """A golden key, upright, its middle at (x, y)."""

    def box(left: float, top: float, right: float, bottom: float, grow: float, colour: Colour) -> None:
        canvas.box(
            x + left * scale - grow, y + top * scale - grow, x + right * scale + grow, y + bottom * scale + grow, colour
        )

    for grow, colour in ((rim, _INK), (0.0, _KEY)):
        canvas.disc(x, y - 0.21 * scale, 0.19 * scale + grow, colour)
        box(-0.07, -0.10, 0.07, 0.40, grow, colour)
        box(0.00, 0.10, 0.24, 0.20, grow, colour)
        box(0.00, 0.28, 0.20, 0.38, grow, colour)
    canvas.disc(x, y - 0.21 * scale, 0.08 * scale, _INK)


# --- agents


class _Look(NamedTuple):
    """Everything that decides how one agent's sprite looks."""

    size: int
    colour: Colour
    direction: int
    label: str
    has_key: bool
    selected: bool


#: Where the members of a crowd stand in their cell (centres), and how large; more than nine share the last grid.
_FANS: Final[dict[int, tuple[float, list[tuple[float, float]]]]] = {
    1: (1.0, [(0.5, 0.5)]),
    2: (0.66, [(0.33, 0.33), (0.67, 0.67)]),
    3: (0.60, [(0.30, 0.30), (0.70, 0.30), (0.50, 0.70)]),
    4: (0.54, [(0.27, 0.27), (0.73, 0.27), (0.27, 0.73), (0.73, 0.73)]),
    9: (0.36, [(x, y) for y in (0.18, 0.5, 0.82) for x in (0.18, 0.5, 0.82)]),
}
_MOST_SHOWN: Final = 9
#: An agent alone on a treasure is drawn smaller, so that the treasure shows.
_ON_TREASURE: Final = (0.70, [(0.5, 0.56)])
#: Sprites smaller than this carry no number and no picture of a key.
_LEGIBLE: Final = 15


def _draw_agents(cells: Picture, scene: Scene, tile_size: int) -> None:
    positions = np.asarray(scene.state["agent_pos"])
    crowds: dict[tuple[int, int], list[int]] = {}
    for index, (x, y) in enumerate(positions.tolist()):
        crowds.setdefault((x, y), []).append(index)
    colours = _agent_colours(scene)
    for (x, y), members in crowds.items():
        _draw_crowd(cells[y, :, x], scene, members, colours, tile_size)


def _draw_crowd(
    cell: Picture, scene: Scene, members: list[int], colours: npt.NDArray[np.uint16], tile_size: int
) -> None:
    """Draw all agents of one cell side by side; when too many, the last place shows how many are left."""
    scale, centres = next(fan for most, fan in _FANS.items() if most >= min(len(members), _MOST_SHOWN))
    x, y = scene.state["agent_pos"][members[0]]
    if len(members) == 1 and scene.state["treasures"][x, y] != TreasureState.NONE:
        scale, centres = _ON_TREASURE
    size = max(round(scale * tile_size), 1)
    shown = members if len(members) <= _MOST_SHOWN else members[: _MOST_SHOWN - 1]
    for index, centre in zip(shown, centres, strict=False):
        red, green, blue = colours[index].tolist()
        look = _Look(
            size,
            (red, green, blue),
            int(scene.state["agent_dir"][index]),
            f"{index}",
            bool(scene.state["agent_has_key"][index]),
            index == scene.selected,
        )
        _put(cell, _agent_sprite(look), centre)
    if len(shown) < len(members):
        _put(cell, _more_sprite(size, len(members) - len(shown)), centres[-1])


def _put(cell: Picture, sprite: _Sprite, centre: tuple[float, float]) -> None:
    size, tile = len(sprite.add), len(cell)
    left, top = (int(np.clip(round(at * tile - size / 2), 0, tile - size)) for at in centre)
    part = cell[top : top + size, left : left + size]
    part[:] = _over(part, sprite)


@lru_cache(maxsize=4096)
def _agent_sprite(look: _Look) -> _Sprite:
    """A triangle that points where the agent faces, its index inside, pink rim and a key if it carries one."""
    canvas = _Canvas(look.size)
    shape = _turned([(0.12, 0.12), (0.92, 0.50), (0.12, 0.88)], look.direction)
    if look.selected:
        canvas.outline(shape, (255, 255, 255), 0.24)
    canvas.outline(shape, _INK, 0.13)
    canvas.polygon(shape, look.colour)
    if look.has_key:
        canvas.outline(shape, _PINK, 0.11)
    else:
        canvas.outline(shape, _mix(look.colour, (255, 255, 255), 0.65), 0.06)
    if look.size >= _LEGIBLE and len(look.label) <= 2:
        x, y = _turned([(0.37, 0.5)], look.direction)[0]
        canvas.text(x, y, look.label, 0.42 if len(look.label) == 1 else 0.36, _readable_on(look.colour))
    if look.has_key:
        if look.size >= _LEGIBLE:
            _draw_key(canvas, 0.84, 0.27, 0.56, 0.045)
        else:
            canvas.disc(0.80, 0.20, 0.20, _INK)
            canvas.disc(0.80, 0.20, 0.15, _KEY)
    return canvas.sprite()


def _turned(points: list[tuple[float, float]], direction: int) -> list[tuple[float, float]]:
    """Turn an eastward shape about the middle of the unit square, clockwise as seen on the screen."""
    for _ in range(direction):
        points = [(1 - y, x) for x, y in points]
    return points


@lru_cache(maxsize=256)
def _more_sprite(size: int, number: int) -> _Sprite:
    canvas = _Canvas(size)
    canvas.disc(0.5, 0.5, 0.5, _INK)
    canvas.text(0.5, 0.5, f"+{number}", 0.6 if number < 10 else 0.45, _TEXT)
    return canvas.sprite()
