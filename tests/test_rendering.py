"""Pictures: what differs must look different, what is equal must look equal, and sizes and colours are known."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from hecogrid_envs import rendering, window
from hecogrid_envs.constants import KEY_CARRIER_COLOUR, ZONE_COLOURS
from hecogrid_envs.fields_of_view import seen_cells
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.rendering import Scene, fit_tile_size, header_height, render_scene
from hecogrid_envs.task import TaskName
from hecogrid_envs.window import HumanWindow

pytest.importorskip("PIL")

TILE = 24
SIDE = 10


def make_params(n_agents: int = 1, heterogeneity: int = 1, grid_size: int = SIDE, **other: Any) -> HECOGridParams:
    return HECOGridParams(
        n_agents=n_agents, grid_size=grid_size, heterogeneity=heterogeneity, n_treasures=5, n_keys=2, **other
    )


def make_state(agents: list[tuple[int, int, int, bool]], side: int = SIDE) -> dict[str, npt.NDArray[Any]]:
    """An empty room with agents (x, y, direction, has key)."""
    walls = np.ones((side, side), dtype=bool)
    walls[1:-1, 1:-1] = False
    return {
        "walls": walls,
        "treasures": np.zeros((side, side), dtype=np.uint8),
        "keys": np.zeros((side, side), dtype=bool),
        "agent_pos": np.array([agent[:2] for agent in agents]),
        "agent_dir": np.array([agent[2] for agent in agents]),
        "agent_has_key": np.array([agent[3] for agent in agents]),
    }


def make_scene(
    agents: list[tuple[int, int, int, bool]] | None = None, task: TaskName = "TeamSupport", **params: Any
) -> Scene:
    agents = [(8, 8, 0, False)] if agents is None else agents
    world = make_params(n_agents=len(agents), **params)
    return Scene(task, world, make_state(agents, world.grid_size), step=3, collected=1)


def draw(scene: Scene, tile: int = TILE) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Header, and the map as (x, y, pixel row, pixel column, channel)."""
    picture = render_scene(scene, tile)
    top = header_height(scene.task, scene.params, tile)
    side = scene.params.grid_size
    return picture[:top], picture[top:].reshape(side, tile, side, tile, 3).transpose(2, 0, 1, 3, 4)


def cell_of(scene: Scene, x: int, y: int, tile: int = TILE) -> npt.NDArray[np.uint8]:
    return draw(scene, tile)[1][x, y]


def count(cell: npt.NDArray[np.uint8], colour: tuple[int, int, int]) -> int:
    return int((cell == colour).all(axis=-1).sum())


# --- size


@pytest.mark.parametrize("tile", [4, 12, 24])
@pytest.mark.parametrize("heterogeneity", [1, 3])
def test_picture_is_header_and_map(tile: int, heterogeneity: int) -> None:
    scene = make_scene(heterogeneity=heterogeneity)
    picture = render_scene(scene, tile)
    top = header_height(scene.task, scene.params, tile)
    assert picture.shape == (top + SIDE * tile, SIDE * tile, 3)
    assert picture.dtype == np.uint8
    assert top % 2 == 0


def test_size_stays_the_same_during_a_game() -> None:
    scene = make_scene()
    late = scene._replace(step=50, collected=5)
    assert render_scene(scene, 12).shape == render_scene(late, 12).shape


def test_usual_tile_size_is_24_and_smaller_for_large_maps() -> None:
    assert render_scene(make_scene()).shape[1] == SIDE * 24
    assert render_scene(make_scene(grid_size=120)).shape[1] == 120 * 12


@pytest.mark.parametrize(
    ("grid_size", "max_pixels", "tile"), [(30, 960, 32), (5, 960, 32), (40, 960, 24), (1000, 960, 4)]
)
def test_fit_tile_size(grid_size: int, max_pixels: int, tile: int) -> None:
    assert fit_tile_size(grid_size, max_pixels) == tile


@pytest.mark.parametrize("tile", [3, 129, 12.0])
def test_wrong_tile_size(tile: Any) -> None:
    with pytest.raises(ValueError, match=f"^tile_size must be an integer from 4 to 128, got {tile}$"):
        render_scene(make_scene(), tile)


def test_enormous_picture_is_refused_with_advice() -> None:
    message = r"^a map of 100 x 100 cells at tile_size=128 is more than 67108864 pixels; use tile_size=9$"
    with pytest.raises(ValueError, match=message):
        render_scene(make_scene(grid_size=100), 128)


# --- floor, walls, zones


def test_one_zone_has_a_neutral_floor_and_no_names() -> None:
    scene = make_scene(heterogeneity=1)
    assert (cell_of(scene, 2, 2)[:-1, :-1] == rendering._FLOOR).all()
    two = make_params(heterogeneity=2)
    assert header_height("TeamSupport", scene.params, TILE) < header_height("TeamSupport", two, TILE)


def test_floor_shows_the_zone_and_only_the_zone() -> None:
    scene = make_scene(heterogeneity=3)
    zones = scene.params.zone_of_column()
    cells = draw(scene)[1]
    tints: dict[int, tuple[int, ...]] = {}
    for x in range(1, SIDE - 1):
        tint = tuple(cells[x, 4, 10, 10].tolist())
        assert tints.setdefault(int(zones[x]), tint) == tint
    assert len(set(tints.values())) == 3
    red, green, blue = tints[0]
    assert red > green
    assert red > blue


def test_tints_are_gentle() -> None:
    scene = make_scene(heterogeneity=3)
    tint = cell_of(scene, 1, 4)[10, 10].astype(int)
    assert np.abs(tint - rendering._FLOOR).max() < 64


@pytest.mark.parametrize(("rules", "n_zones"), [("paper", 3), ("released", 4)])
def test_zone_names_stand_over_their_columns(rules: str, n_zones: int) -> None:
    scene = make_scene(heterogeneity=3, rules=rules)
    band = draw(scene)[0][-1]
    colours = [tuple(band[x * TILE].tolist()) for x in range(SIDE)]
    assert len(set(colours)) == n_zones
    expected = [ZONE_COLOURS[zone] for zone in scene.params.zone_of_column()]
    for colour, zone_colour in zip(colours, expected, strict=True):
        assert np.abs(np.array(colour) - zone_colour).max() < 45


def test_walls_are_solid_and_differ_from_floor() -> None:
    scene = make_scene()
    scene.state["walls"][4, 4] = True
    wall = cell_of(scene, 4, 4)
    assert (wall[8:16] == rendering._WALL).all()
    assert not (cell_of(scene, 4, 6) == rendering._WALL).all(axis=-1).any()
    assert (wall[0] > rendering._WALL).all()
    assert (wall[-1] < rendering._WALL).all()


def test_new_walls_are_not_taken_from_the_cache() -> None:
    scene = make_scene()
    before = render_scene(scene, TILE)
    scene.state["walls"][4, 4] = True
    assert not np.array_equal(before, render_scene(scene, TILE))


def test_level_is_drawn_once() -> None:
    scene = make_scene()
    render_scene(scene, TILE)
    misses = rendering._background.cache_info().misses
    scene.state["treasures"][2, 2] = 1
    first = render_scene(scene, TILE)
    first[:] = 0
    assert render_scene(scene, TILE).any()
    assert rendering._background.cache_info().misses == misses


# --- treasures and keys


@pytest.mark.parametrize("tile", [12, 24])
def test_available_and_collected_treasures_and_floor_all_differ(tile: int) -> None:
    scene = make_scene()
    scene.state["treasures"][2, 2] = 1
    scene.state["treasures"][4, 2] = 2
    cells = draw(scene, tile)[1].astype(int)
    available, collected, floor = cells[2, 2], cells[4, 2], cells[6, 2]
    assert np.abs(available - collected).mean() > 20
    assert np.abs(collected - floor).mean() > 3
    # Only what can be had shines.
    assert np.ptp(available, axis=-1).max() > 100
    assert np.ptp(collected, axis=-1).max() < 40


@pytest.mark.parametrize(("task", "brightest"), [("TeamTogether", 0), ("TeamSupport", 1), ("KeyForTreasure", 1)])
def test_gems_have_the_colour_of_the_task(task: TaskName, brightest: int) -> None:
    scene = make_scene(task=task)
    scene.state["treasures"][2, 2] = 1
    body = cell_of(scene, 2, 2)[12, 12]
    assert body.argmax() == brightest


def test_keys_are_golden() -> None:
    scene = make_scene()
    scene.state["keys"][2, 2] = True
    assert count(cell_of(scene, 2, 2), rendering._KEY) > 20
    assert count(cell_of(scene, 3, 2), rendering._KEY) == 0


# --- agents


@pytest.mark.parametrize(("x", "zone"), [(1, 0), (5, 1), (8, 2)])
def test_agent_has_the_colour_of_the_zone_where_it_stands(x: int, zone: int) -> None:
    cell = cell_of(make_scene([(x, 5, 0, False)], heterogeneity=3), x, 5)
    for index, colour in enumerate(ZONE_COLOURS[:3]):
        assert (count(cell, colour) > 40) == (index == zone)


@pytest.mark.parametrize("tile", [12, 24])
@pytest.mark.parametrize("direction", range(4))
def test_agent_points_where_it_faces(direction: int, tile: int) -> None:
    cell = cell_of(make_scene([(5, 5, direction, False)]), 5, 5, tile)
    east_up = np.rot90(cell, direction)
    body = (east_up[..., 0] > 200) & (east_up[..., 1] < 60)
    half = tile // 2
    assert body[:, :half].sum() > 1.5 * body[:, half:].sum() > 0


def test_agents_carry_their_numbers() -> None:
    cells = draw(make_scene([(2, 2, 0, False), (4, 2, 0, False)]))[1]
    assert not np.array_equal(cells[2, 2], cells[4, 2])
    assert count(cells[2, 2], (255, 255, 255)) + (cells[2, 2][8:16, 5:12, 1] > 120).sum() > 5


@pytest.mark.parametrize("tile", [12, 24])
def test_key_carriers_have_a_pink_rim_and_a_golden_badge(tile: int) -> None:
    cells = draw(make_scene([(2, 2, 0, True), (4, 2, 0, False)]), tile)[1]
    carrier, other = cells[2, 2].astype(int), cells[4, 2].astype(int)

    def close(cell: npt.NDArray[Any], colour: tuple[int, int, int]) -> int:
        return int((np.abs(cell - colour).max(axis=-1) < 60).sum())

    assert close(carrier, KEY_CARRIER_COLOUR) >= 8
    assert close(other, KEY_CARRIER_COLOUR) == 0
    assert close(carrier[: tile // 2, tile // 2 :], rendering._KEY) >= 3
    assert close(other, rendering._KEY) == 0


def test_selected_agent_is_marked() -> None:
    scene = make_scene([(2, 2, 0, False), (4, 2, 0, False)])
    plain, marked = draw(scene)[1], draw(scene._replace(selected=0))[1]
    changed = (plain != marked).any(axis=(2, 3, 4))
    assert np.argwhere(changed).tolist() == [[2, 2]]


def test_two_agents_in_a_cell_stand_on_its_diagonal() -> None:
    cell = cell_of(make_scene([(5, 5, 0, False), (5, 5, 2, False)]), 5, 5)
    red = (cell[..., 0] > 200) & (cell[..., 1] < 60)
    assert red[:12, :12].sum() > 15
    assert red[12:, 12:].sum() > 15
    assert red[:8, 16:].sum() == 0
    assert red[16:, :8].sum() == 0


@pytest.mark.parametrize("number", [2, 3, 4, 9, 10, 11])
def test_one_agent_more_in_a_cell_is_seen(number: int) -> None:
    fewer = cell_of(make_scene([(5, 5, 0, False)] * (number - 1)), 5, 5)
    more = cell_of(make_scene([(5, 5, 0, False)] * number), 5, 5)
    assert not np.array_equal(fewer, more)


@pytest.mark.parametrize("number", [2, 3, 4, 9])
def test_everyone_in_a_cell_has_a_place_in_it(number: int) -> None:
    scale, centres = rendering._FANS[number]
    assert len(set(centres)) == number
    assert min(min(centre) for centre in centres) - scale / 2 > -0.01
    assert max(max(centre) for centre in centres) + scale / 2 < 1.01


def test_agents_draw_only_in_their_cells() -> None:
    alone = (8, 8, 0, False)
    one, all_ = make_scene([alone]), make_scene([alone] + [(5, 5, 0, True)] * 12)
    changed = (draw(one)[1] != draw(all_)[1]).any(axis=(2, 3, 4))
    assert np.argwhere(changed).tolist() == [[5, 5]]


def test_treasure_shows_behind_an_agent() -> None:
    scene = make_scene([(5, 5, 0, False)])
    bare = cell_of(scene, 5, 5)
    scene.state["treasures"][5, 5] = 1
    available = cell_of(scene, 5, 5)
    scene.state["treasures"][5, 5] = 2
    collected = cell_of(scene, 5, 5)
    green = [int(((cell[..., 1] > 150) & (cell[..., 0] < 120)).sum()) for cell in (bare, available, collected)]
    assert green[0] == green[2] == 0
    assert green[1] > 10
    # The agent lies on top.
    red = [count(cell, (255, 0, 0)) for cell in (available, collected)]
    assert red[0] == red[1] > 20


# --- fields of view


def test_views_veil_exactly_the_seen_cells() -> None:
    scene = make_scene([(1, 1, 0, False)])
    visible = np.zeros((1, SIDE, SIDE), dtype=bool)
    visible[0, 3:6, 4:8] = True
    veiled = draw(scene._replace(visible=visible))[1]
    changed = (draw(scene)[1] != veiled).any(axis=(2, 3, 4))
    np.testing.assert_array_equal(changed, visible[0])
    # A tenth of the agent's red on the floor.
    expected = np.round(0.9 * np.array(rendering._FLOOR) + 0.1 * np.array(ZONE_COLOURS[0]))
    assert np.abs(veiled[4, 5, 10, 10] - expected).max() <= 1
    # The border is a line, stronger than the veil.
    assert veiled[3, 5, 10, 0, 0] > veiled[3, 5, 10, 10, 0] + 40


def test_more_viewers_make_a_denser_veil() -> None:
    scene = make_scene([(1, 1, 0, False), (2, 1, 0, False)])
    visible = np.zeros((2, SIDE, SIDE), dtype=bool)
    visible[0, 3:8, 5] = visible[1, 6, 5] = True
    cells = draw(scene._replace(visible=visible))[1]
    assert cells[6, 5, 10, 10, 0] > cells[4, 5, 10, 10, 0] > draw(scene)[1][4, 5, 10, 10, 0]


def test_views_can_be_left_out() -> None:
    scene = make_scene()
    seen = scene._replace(visible=np.ones((1, SIDE, SIDE), dtype=bool))
    np.testing.assert_array_equal(render_scene(seen, TILE, show_views=False), render_scene(scene, TILE))


@pytest.mark.parametrize(
    ("direction", "ahead", "right"),
    [(0, (6, 5), (5, 6)), (1, (5, 6), (4, 5)), (2, (4, 5), (5, 4)), (3, (5, 4), (6, 5))],
)
def test_seen_cells_turn_with_the_agent(direction: int, ahead: tuple[int, int], right: tuple[int, int]) -> None:
    views = np.zeros((3, 7, 7), dtype=bool)
    views[0, 5, 3] = True  # the agent's own cell, with one row behind it
    views[1, 4, 3] = True  # one ahead
    views[2, 5, 4] = True  # one to the right
    seen = seen_cells(views, np.array([(5, 5)] * 3), np.full(3, direction), 1, SIDE)
    assert [np.argwhere(plane).tolist() for plane in seen] == [[[5, 5]], [list(ahead)], [list(right)]]


def test_seen_cells_beyond_the_map_are_left_out() -> None:
    seen = seen_cells(np.ones((1, 3, 3), dtype=bool), np.array([(0, 0)]), np.array([3]), 1, 4)
    assert np.argwhere(seen[0]).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


# --- the bar above the map


@pytest.mark.parametrize(("step", "collected"), [(4, 1), (3, 2)])
def test_score_and_step_are_in_the_header_alone(step: int, collected: int) -> None:
    scene = make_scene()
    header, cells = draw(scene)
    other_header, other_cells = draw(scene._replace(step=step, collected=collected))
    # The words themselves, not just the time bar below them.
    assert not np.array_equal(header[:-4], other_header[:-4])
    np.testing.assert_array_equal(cells, other_cells)


def test_header_counts_treasures_of_the_map() -> None:
    scene = make_scene()
    scene.state["treasures"][2, 2:5] = 1
    before = draw(scene)[0]
    scene.state["treasures"][2, 2] = 2
    assert not np.array_equal(before, draw(scene)[0])


@pytest.mark.parametrize(("step", "share"), [(0, 0.0), (25, 0.5), (50, 1.0)])
def test_time_bar_grows_with_the_steps(step: int, share: float) -> None:
    bar = draw(make_scene()._replace(step=step))[0][-1]
    assert count(bar, rendering._DIM) == share * SIDE * TILE


@pytest.mark.parametrize("grid_size", [4, 6, 8, 15, 30])
@pytest.mark.parametrize("tile", [8, 12, 24])
def test_words_stay_inside_the_header(grid_size: int, tile: int) -> None:
    """Nothing is cut off on the right, and lines do not overlap."""
    params = HECOGridParams(
        n_agents=2, grid_size=grid_size, n_treasures=min(100, (grid_size - 2) ** 2), n_keys=0, max_cycles=500
    )
    layout = rendering._header_layout("KeyForTreasure", params, tile)
    items = rendering._header_items("KeyForTreasure", params, 500, params.n_treasures, params.n_treasures, 100)
    boxes = [
        (slot.y, slot.x, slot.x + rendering._item_width(item, layout.font))
        for item, slot in zip(items, layout.slots, strict=True)
    ]
    assert max(end for _, _, end in boxes) <= grid_size * tile or layout.font == 6
    for (row, _, end), (next_row, start, _) in pairwise(boxes):
        assert next_row > row or start > end


# --- what is not installed


def test_importing_loads_neither_pillow_nor_pygame() -> None:
    code = (
        "import sys; import hecogrid_envs.rendering, hecogrid_envs.text, hecogrid_envs.play; "
        "print([name for name in ('PIL', 'pygame', 'torch') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_missing_pillow_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match=r"^drawing games needs Pillow: pip install sb3-saf\[render\]$"):
        rendering._pillow()


def test_missing_pygame_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"^a window needs pygame: pip install sb3-saf\[render\]$"):
        HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))


# --- the window


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    try:
        module = window._import_pygame()
    except ImportError:
        pytest.skip("pygame is not installed")
    yield module
    module.display.quit()


def test_window_shows_the_picture(pygame: Any) -> None:
    picture = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    with HumanWindow("title") as window:
        assert not window.is_open
        window.show(picture)
        assert window.is_open
        assert pygame.display.get_caption()[0] == "title"
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
        np.testing.assert_array_equal(shown, picture)
        window.show(np.zeros((8, 10, 3), dtype=np.uint8))
        assert pygame.display.get_surface().get_size() == (10, 8)
    assert not window.is_open
    assert not pygame.display.get_init()


def test_window_hands_over_keys_once(pygame: Any) -> None:
    with HumanWindow() as window:
        assert window.poll() == []
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
        for key in (pygame.K_LEFT, pygame.K_SPACE, pygame.K_p, pygame.K_3, pygame.K_KP4, pygame.K_TAB, pygame.K_ESCAPE):
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
        assert window.poll() == ["left", "space", "p", "3", "4", "tab", "escape"]
        assert window.poll() == []


def test_closed_window_stays_closed(pygame: Any) -> None:
    with HumanWindow() as window:
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        assert window.poll() == ["quit"]
        assert window.closed_by_user
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
        assert not window.is_open


def test_no_display_is_an_error_and_not_an_invisible_window(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER")
    # On a machine without a screen SDL falls back to this driver without a word.
    monkeypatch.setattr(pygame.display, "init", lambda: None)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(RuntimeError, match=r'no display\); draw pictures with render_mode="rgb_array"'):
        HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))


@pytest.mark.skipif("DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ, reason="there is a display")
@pytest.mark.skipif(sys.platform != "linux", reason="how to have no display")
def test_no_display_for_real(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER")
    with pytest.raises(RuntimeError, match="no window can be opened"):
        HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))


@pytest.mark.skipif(sys.platform != "linux", reason="displays of other systems are not servers")
def test_a_display_that_hangs(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An X server that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        name = f"127.0.0.1:{server.getsockname()[1] - 6000}"
        monkeypatch.delenv("SDL_VIDEODRIVER")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        monkeypatch.setenv("DISPLAY", name)
        monkeypatch.setattr("hecogrid_envs.window._DISPLAY_SECONDS", 2.0)
        message = rf"the display '{name}' has not answered for 2 s; is the connection to it broken\?\); draw pictures"
        with pytest.raises(RuntimeError, match=message):
            HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))
