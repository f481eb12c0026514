"""Rendered images: different things look different, equal things look equal, sizes and colours are known."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from hecogrid_envs import rendering
from hecogrid_envs.constants import zone_colour
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.play import HumanWindow
from hecogrid_envs.rendering import Scene, header_height, render_scene
from hecogrid_envs.task import TaskName
from tests.levels import level

pytest.importorskip("PIL")

TILE = 24
SIDE = 10


def make_params(n_agents: int = 1, heterogeneity: int = 1, grid_size: int = SIDE, **other: Any) -> HECOGridParams:
    return HECOGridParams(
        n_agents=n_agents, grid_size=grid_size, heterogeneity=heterogeneity, n_treasures=5, n_keys=2, **other
    )


def make_scene(
    agents: list[tuple[int, int, int, bool]] | None = None, task: TaskName = "TeamSupport", **params: Any
) -> Scene:
    agents = [(8, 8, 0, False)] if agents is None else agents
    world = make_params(n_agents=len(agents), **params)
    side = world.grid_size
    room = "#" * side + ("\n#" + "." * (side - 2) + "#") * (side - 2) + "\n" + "#" * side
    return Scene(task, world, level(room, agents), step=3, collected=1)


def draw(scene: Scene, tile: int = TILE) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Draw the header, and the map as (x, y, pixel row, pixel column, channel)."""
    picture = render_scene(scene, tile)
    top = header_height(scene.task, scene.params, tile)
    side = scene.params.grid_size
    return picture[:top], picture[top:].reshape(side, tile, side, tile, 3).transpose(2, 0, 1, 3, 4)


def cell_of(scene: Scene, x: int, y: int, tile: int = TILE) -> npt.NDArray[np.uint8]:
    return draw(scene, tile)[1][x, y]


def count(cell: npt.NDArray[np.uint8], colour: tuple[int, ...]) -> int:
    return int((cell == colour).all(axis=-1).sum())


def golden(cell: npt.NDArray[np.uint8]) -> int:
    return count(cell, (255, 214, 64))


# --- size


@pytest.mark.parametrize(("tile", "heterogeneity"), [(4, 1), (24, 3)])
def test_picture_is_header_and_map(tile: int, heterogeneity: int) -> None:
    scene = make_scene(heterogeneity=heterogeneity)
    picture = render_scene(scene, tile)
    top = header_height(scene.task, scene.params, tile)
    assert picture.shape == (top + SIDE * tile, SIDE * tile, 3)
    assert picture.dtype == np.uint8
    assert top % 2 == 0


def test_usual_tile_size_is_24_and_smaller_for_large_maps() -> None:
    assert render_scene(make_scene()).shape[1] == SIDE * 24
    assert render_scene(make_scene(grid_size=120)).shape[1] == 120 * 12


@pytest.mark.parametrize("tile", [3, 129, 12.0])
def test_wrong_tile_size(tile: Any) -> None:
    with pytest.raises(ValueError, match=f"tile_size .*got {tile}"):
        render_scene(make_scene(), tile)


def test_enormous_picture_is_refused_with_advice() -> None:
    with pytest.raises(ValueError, match=r"100 x 100 .*tile_size=128 .*tile_size=9"):
        render_scene(make_scene(grid_size=100), 128)


# --- floor, walls, zones


def test_floor_shows_the_zone_and_walls_do_not() -> None:
    scene = make_scene(heterogeneity=3)
    scene.state["walls"][4, 6] = True
    zones, cells = scene.params.zone_of_column(), draw(scene)[1].astype(int)
    one_zone = make_scene(heterogeneity=1)
    neutral = cell_of(one_zone, 2, 2)[10, 10].astype(int)
    for x in range(1, SIDE - 1):
        expected = 0.75 * neutral + 0.25 * np.array(zone_colour(int(zones[x])))
        assert np.abs(cells[x, 4, 10, 10] - expected).max() <= 1
    assert (cells[4, 6] == cells[0, 0]).all() and (cells[4, 6] != cells[4, 5]).any()
    assert len(draw(one_zone)[0]) < len(draw(scene)[0])


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
    # Only treasures that can be collected are bright.
    assert np.ptp(available, axis=-1).max() > 100
    assert np.ptp(collected, axis=-1).max() < 40


# --- agents


def test_agents_have_colours_of_their_own_and_numbers() -> None:
    """Also the eighth agent, which has the first one's colour."""
    scene = make_scene([(1 + agent, 5, 0, False) for agent in range(8)], heterogeneity=3)
    cells = draw(scene)[1]
    for agent, colour in enumerate((*rendering.AGENT_COLOURS, rendering.AGENT_COLOURS[0])):
        assert count(cells[1 + agent, 5], colour) > 40
    one_zone = draw(make_scene([(1 + agent, 5, 0, False) for agent in range(8)]))[1]
    assert not np.array_equal(one_zone[1, 5], one_zone[8, 5])


@pytest.mark.parametrize("tile", [12, 24])
@pytest.mark.parametrize("direction", range(4))
def test_agent_points_where_it_faces(direction: int, tile: int) -> None:
    cell = cell_of(make_scene([(5, 5, direction, False)]), 5, 5, tile)
    body = (np.rot90(cell, direction) == rendering.AGENT_COLOURS[0]).all(axis=-1)
    half = tile // 2
    assert body[:, :half].sum() > 1.2 * body[:, half:].sum() > 0


def test_key_carriers_show_their_key() -> None:
    cells = draw(make_scene([(2, 2, 0, True), (4, 2, 0, False)]))[1]
    assert golden(cells[2, 2][: TILE // 2, TILE // 2 :]) > 10
    assert golden(cells[4, 2]) == 0


# --- fields of view


def test_views_are_outlined_and_change_nothing_else() -> None:
    scene = make_scene([(1, 1, 0, False)])
    visible = np.zeros((1, SIDE, SIDE), dtype=bool)
    visible[0, 3:6, 4:8] = True
    seen = scene._replace(visible=visible)
    plain, drawn = draw(scene)[1].astype(int), draw(seen)[1].astype(int)
    np.testing.assert_array_equal((plain != drawn).any(axis=(2, 3, 4)), visible[0])
    # A faint veil, and a line in the agent's colour along the border.
    assert 0 < (drawn - plain)[4, 5, 10, 10].max() < 16
    assert (drawn - plain)[3, 5, 10, 0, 0] > 60
    assert (drawn - plain)[4, 5, 10, 0, 0] < 16


# --- missing packages


def test_missing_libraries_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match=r"Pillow: .*\[render\]"):
        render_scene(make_scene([(1, 1, 0, True)], grid_size=7), 31)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pygame: .*\[render\]"):
        HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))


# --- the window


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    module = pytest.importorskip("pygame")
    yield module
    module.display.quit()


def test_closed_window_stays_closed(pygame: Any) -> None:
    with closing(HumanWindow()) as window:
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        assert window.poll() == ["quit"]
        assert window.closed_by_user
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
        assert not window.is_open


def test_no_display_is_an_error_and_not_an_invisible_window(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER")
    # On a machine without a display, SDL silently falls back to this driver.
    monkeypatch.setattr(pygame.display, "init", lambda: None)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(RuntimeError, match=r'no display\); draw pictures with render_mode="rgb_array"'):
        HumanWindow().show(np.zeros((4, 4, 3), dtype=np.uint8))
