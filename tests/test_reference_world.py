"""The reference world, compared with results worked out by hand from the rule book."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.levels import State, level, params_for
from tests.reference_world import ReferenceWorld

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = range(7)
EAST, SOUTH, WEST, NORTH = range(4)
RED, ORANGE, YELLOW, GREEN, BLUE = (255, 0, 0), (255, 165, 0), (255, 255, 0), (0, 255, 0), (0, 0, 255)
PINK, GREY, BLACK, HIDDEN = (255, 0, 189), (100, 100, 100), (0, 0, 0), (35, 25, 30)
RULES = ("paper", "released")
both_rules = pytest.mark.parametrize("rules", RULES)


def world_of(state: State, task: str = "TeamTogether", **params: Any) -> ReferenceWorld:
    world = ReferenceWorld(task, **{**params_for(state), **params})
    world.set_state(state)
    return world


def tile_at(world: ReferenceWorld, viewer: int, ahead: int, aside: int = 0) -> npt.NDArray[np.uint8]:
    """Return the tile at a position ahead of a viewer and to its right."""
    t = world.tile
    row, column = world.view - 1 - world.offset - ahead, world.view // 2 + aside
    return world.observe(viewer)[row * t : (row + 1) * t, column * t : (column + 1) * t]


def colour_at(world: ReferenceWorld, viewer: int, ahead: int, aside: int = 0) -> tuple[int, ...]:
    """Return the colour in the middle of a tile: the agent's if drawn, else the cell's. Needs tiles of 12 pixels."""
    assert world.tile == 12, "in small tiles no pixel lies wholly inside the triangle"
    return tuple(tile_at(world, viewer, ahead, aside)[6, 6].tolist())


# ------------------------------------------------------------------------------------------------- Zones and commands


@pytest.mark.parametrize(
    ("rules", "heterogeneity", "zones"),
    [
        ("paper", 1, [0] * 12),
        ("released", 1, [0] * 12),
        ("paper", 4, [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]),
        ("released", 4, [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]),
        ("paper", 5, [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4, 4]),
        ("released", 5, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]),
        ("paper", 7, [0, 0, 1, 1, 2, 2, 3, 4, 4, 5, 5, 6]),
        ("released", 7, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
    ],
)
def test_zone_of_column(rules: str, heterogeneity: int, zones: list[int]) -> None:
    world = ReferenceWorld("TeamTogether", grid_size=12, heterogeneity=heterogeneity, rules=rules)
    assert [world.zone_of_column(x) for x in range(12)] == zones


@pytest.mark.parametrize(
    ("heterogeneity", "zone", "actions_of_commands"),
    [
        (1, 0, (0, 1, 2, 3, 4, 5, 6)),
        (2, 1, (0, 5, 1, 6, 3, 2, 4)),  # 500 = 0*720 + 4*120 + 0*24 + 3*6 + 1*2 + 0*1
        (11, 2, (1, 3, 2, 5, 6, 0, 4)),  # 1000 = 1*720 + 2*120 + 1*24 + 2*6 + 2*2 + 0*1
        (11, 11, (0, 4, 6, 1, 5, 2, 3)),  # 5500 is beyond the last: 460 = 0*720 + 3*120 + 4*24 + 0*6 + 2*2 + 0*1
        (12, 1, (0, 4, 3, 5, 1, 2, 6)),  # stride 5040 // 12: 420 = 0*720 + 3*120 + 2*24 + 2*6 + 0*2 + 0*1
    ],
)
def test_commands_are_permuted(heterogeneity: int, zone: int, actions_of_commands: tuple[int, ...]) -> None:
    world = ReferenceWorld("TeamTogether", heterogeneity=heterogeneity)
    for command, action in enumerate(actions_of_commands):
        assert world.command(zone, action) == command


@both_rules
def test_agent_obeys_the_zone_that_it_starts_the_step_in(rules: str) -> None:
    world = world_of(level("######\n#.>..#\n#....#\n#....#\n#....#\n######"), heterogeneity=2, rules=rules)
    world.step([FORWARD])  # zone 0: from column 2 into column 3
    assert world.pos == [(3, 1)]
    world.step([FORWARD])  # zone 1: what 2 triggers there is toggle
    assert world.pos == [(3, 1)]
    assert world.dir == [EAST]
    world.step([1])  # zone 1: forward
    assert world.pos == [(4, 1)]
    world.step([5])  # zone 1: right
    assert world.dir == [SOUTH]


# ----------------------------------------------------------------------------------------------------------- Movement


@pytest.mark.parametrize(("ahead", "enters"), [("#", False), ("k", False), (".", True), ("$", True), ("o", True)])
@both_rules
def test_what_blocks_the_way(ahead: str, enters: bool, rules: str) -> None:
    world = world_of(level(f"####\n#>{ahead}#\n#..#\n####"), "KeyForTreasure", rules=rules)
    world.step([FORWARD])
    assert world.pos == [(2, 1) if enters else (1, 1)]


def test_agents_act_in_the_given_order() -> None:
    state = level("#####\n#>k<#\n#...#\n#...#\n#####")
    for order, winner in [([0, 1], 0), ([1, 0], 1)]:
        world = world_of(state, "KeyForTreasure")
        world.step([PICKUP, PICKUP], order)
        assert world.has_key == [winner == 0, winner == 1]


# --------------------------------------------------------------------------------------------------- Order of arrival


def test_agents_keep_their_order_of_arrival() -> None:
    world = world_of(level("#####\n#>.<#\n#.^.#\n#...#\n#####"))
    world.step([FORWARD] * 3, order=[2, 0, 1])
    assert world.agents_in((2, 1)) == [2, 0, 1]
    assert world_of(world.get_state()).agents_in((2, 1)) == [0, 1, 2]  # a state has no arrivals: index order
    world.step([TOGGLE, TOGGLE, RIGHT])  # turning is not leaving the cell
    assert world.agents_in((2, 1)) == [2, 0, 1]
    world.step([TOGGLE, TOGGLE, FORWARD])  # the first leaves
    assert world.agents_in((2, 1)) == [0, 1]
    world.step([RIGHT, RIGHT, RIGHT])
    world.step([TOGGLE, TOGGLE, RIGHT])
    world.step([TOGGLE, TOGGLE, FORWARD])  # and returns as the last
    assert world.agents_in((2, 1)) == [0, 1, 2]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("cell", [".", "$", "o"])
@both_rules
def test_first_arrival_is_drawn_unless_the_viewer_is_there(first: int, cell: str, rules: str) -> None:
    # Agent 0 enters from the west, 1 from the east, 2 watches from the south; the treasure needs three on the cell.
    world = world_of(level(f"#####\n#>{cell}<#\n#...#\n#.^.#\n#####"), coordination=3, rules=rules)
    world.step([FORWARD, FORWARD, TOGGLE], [first, 1 - first, 2])
    for there, facing in [(0, EAST), (1, WEST)]:
        state = level(f"#####\n#.{cell}.#\n#...#\n#.^.#\n#####", agents=[(2, 1, facing, False)])
        alone = world_of(state, coordination=2, rules=rules)
        alone.step([TOGGLE, TOGGLE])  # released rules: colours show after the first step
        np.testing.assert_array_equal(tile_at(world, there, ahead=0), tile_at(alone, 1, ahead=0))
        if there == first:
            np.testing.assert_array_equal(tile_at(world, 2, ahead=2), tile_at(alone, 0, ahead=2))


# --------------------------------------------------------------------------------------------------------- Collecting


@both_rules
def test_treasure_pays_once_and_everyone(rules: str) -> None:
    world = world_of(level("#####\n#>$.#\n#.^.#\n#..^#\n#####"), rules=rules)
    assert world.step([FORWARD, TOGGLE, TOGGLE]) == [1 / 3] * 3
    assert world.get_state()["treasures"][2, 1] == 2
    assert world.step([PICKUP, FORWARD, TOGGLE]) == [0] * 3
    assert world.pos == [(2, 1), (2, 1), (3, 3)]


@both_rules
def test_team_together_counts_the_treasure_cell(rules: str) -> None:
    world = world_of(level("#####\n#>$<#\n#.^.#\n#...#\n#####"), coordination=3, rules=rules)
    assert world.step([FORWARD, FORWARD, TOGGLE]) == [0] * 3
    assert world.step([PICKUP, PICKUP, TOGGLE]) == [0] * 3
    assert world.step([TOGGLE, TOGGLE, FORWARD]) == [1 / 3] * 3


@both_rules
def test_pickup_collects_underfoot(rules: str) -> None:
    state = level("####\n#$.#\n#..#\n####", agents=[(1, 1, EAST, False), (1, 1, EAST, False)])
    world = world_of(state, coordination=2, rules=rules)
    assert world.step([FORWARD, PICKUP]) == [0, 0]  # the first has left before the second acts
    world = world_of(state, coordination=2, rules=rules)
    assert world.step([PICKUP, FORWARD]) == [0.5, 0.5]  # in the reverse order both are on the cell


SUPPORT = [
    # agents: the collector (facing the treasure) and its helper; collected under the paper's and the released rules
    pytest.param("...>$.^..", True, False, id="two-from-treasure"),
    pytest.param(".^.>$....", False, True, id="two-from-agent"),
    pytest.param("..^>$....", True, True, id="near-both"),
    pytest.param("...>$..^.", False, False, id="far-from-both"),
]


@pytest.mark.parametrize(("row", "paper", "released"), SUPPORT)
@both_rules
def test_where_support_is_counted(row: str, paper: bool, released: bool, rules: str) -> None:
    empty = "#.........#\n"
    state = level("###########\n" + empty * 3 + f"#{row}#\n" + empty * 5 + "###########")
    world = world_of(state, "TeamSupport", coordination=2, rules=rules)
    actions = [FORWARD if direction == EAST else TOGGLE for direction in world.dir]
    expected = {"paper": paper, "released": released}[rules]
    assert world.step(actions) == [0.5 * expected] * 2
    # If the agent has a key, the released rules count KeyForTreasure the same way; the paper's need both on the cell.
    state["agent_has_key"][:] = True
    world = world_of(state, "KeyForTreasure", coordination=2, rules=rules)
    assert world.step(actions) == [0.5 * (rules == "released" and released)] * 2


@pytest.mark.parametrize(
    ("helper", "radius", "supports"),
    [
        ((5, 5), 2, True),  # the corner of the square counts (Chebyshev distance)
        ((5, 6), 2, False),
        ((1, 1), 2, True),
        ((3, 3), 0, True),
        ((3, 4), 0, False),
        ((6, 0), 3, True),
    ],
)
@both_rules
def test_support_radius_is_a_square(helper: tuple[int, int], radius: int, supports: bool, rules: str) -> None:
    text = "\n".join(["." * 8] * 3 + ["...$...."] + ["." * 8] * 4)
    state = level(text, agents=[(3, 3, EAST, False), (*helper, EAST, False)])
    world = world_of(state, "TeamSupport", coordination=2, support_radius=radius, rules=rules)
    assert world.step([PICKUP, TOGGLE]) == [0.5 * supports] * 2


@pytest.mark.parametrize(("order", "supported"), [([0, 1], True), ([1, 0], False)])
@both_rules
def test_support_sees_those_who_acted_before(order: list[int], supported: bool, rules: str) -> None:
    # The helper walks from distance 3 to distance 2, before or after the collector acts.
    state = level("######\n#$..<#\n#....#\n#....#\n#....#\n######", agents=[(1, 1, EAST, False)])
    world = world_of(state, "TeamSupport", coordination=2, rules=rules)
    assert world.step([FORWARD, PICKUP], order) == [0.5 * supported] * 2


@both_rules
def test_one_agent_supports_itself(rules: str) -> None:
    for task in ("TeamTogether", "TeamSupport"):
        world = world_of(level("####\n#>$#\n#..#\n####"), task, support_radius=0, rules=rules)
        assert world.step([FORWARD]) == [1]


# --------------------------------------------------------------------------------------------------------------- Keys


@both_rules
def test_a_treasure_needs_a_key_which_is_not_used_up(rules: str) -> None:
    state = level("#####\n#>$$#\n#...#\n#...#\n#####")
    world = world_of(state, "KeyForTreasure", rules=rules)
    assert world.step([FORWARD]) + world.step([PICKUP]) == [0, 0]
    state["agent_has_key"][0] = True
    world = world_of(state, "KeyForTreasure", rules=rules)
    assert world.step([FORWARD]) + world.step([FORWARD]) == [1, 1]
    assert world.has_key == [True]


@both_rules
def test_key_for_treasure_together_on_the_cell(rules: str) -> None:
    state = level("#####\n#>$<#\n#...#\n#...#\n#####", carrying=[1])
    world = world_of(state, "KeyForTreasure", coordination=2, rules=rules)
    assert world.step([FORWARD, FORWARD], [0, 1]) == [0.5, 0.5]
    world = world_of(state, "KeyForTreasure", coordination=2, rules=rules)
    # The agent with the key comes first: alone on the cell (paper), but not alone nearby (released).
    assert world.step([FORWARD, FORWARD], [1, 0]) == [0.5 * (rules == "released")] * 2


@both_rules
def test_pickup_collects_first_and_takes_the_key_second(rules: str) -> None:
    world = world_of(level("####\n#$k#\n#..#\n####", agents=[(1, 1, EAST, False)]), "KeyForTreasure", rules=rules)
    assert world.step([PICKUP]) == [0]
    assert world.has_key == [True]
    assert not world.keys
    assert world.step([PICKUP]) == [1]


def test_nobody_carries_two_keys() -> None:
    world = world_of(level("####\n#>k#\n#..#\n####", carrying=[0]), "KeyForTreasure")
    world.step([PICKUP])
    assert world.keys == {(2, 1)}
    assert world.has_key == [True]


@pytest.mark.parametrize("ahead", [".", "#", "$", "o", "k", "<"])
@both_rules
def test_keys_are_dropped_on_empty_cells_only(ahead: str, rules: str) -> None:
    world = world_of(level(f"####\n#>{ahead}#\n#..#\n####", carrying=[0]), "KeyForTreasure", rules=rules)
    world.step([DROP] + [TOGGLE] * (ahead == "<"))
    dropped = ahead == "."
    assert world.has_key[0] is not dropped
    assert world.keys == ({(2, 1)} if ahead in ".k" else set())
    if dropped:
        world.step([DROP])
        assert world.keys == {(2, 1)}
        assert world.has_key == [False]


# --------------------------------------------------------------------------------------------------------- Visibility


def seen_rows(world: ReferenceWorld, viewer: int = 0) -> list[str]:
    """Format the mask: '+' seen, '.' not, farthest row first."""
    return ["".join("+" if seen else "." for seen in row) for row in world.visible(viewer).T]


def test_a_wall_ahead_hides_the_far_left_only() -> None:
    """The scan is not symmetric: to the left it stops at column 1, so column 0 lights nothing."""
    world = world_of(level("...\n.#.\n.^."), view_size=3, view_offset=0)
    assert seen_rows(world) == [".++", "+++", "+++"]


def test_shadows_turn_with_the_viewer() -> None:
    drawn = {EAST: "...\n>#.\n...", SOUTH: ".v.\n.#.\n...", WEST: "...\n.#<\n...", NORTH: "...\n.#.\n.^."}
    for facing, text in drawn.items():
        world = world_of(level(text), view_size=3, view_offset=0)
        assert world.dir == [facing]
        assert seen_rows(world) == [".++", "+++", "+++"]


def test_a_wall_behind_hides_the_left_only() -> None:
    """Two rows are seen behind the agent. Column 4 lights the cell below itself, column 0 never does."""
    world = world_of(level(".....\n.....\n..^..\n.###.\n....."), view_size=5, view_offset=2)
    assert seen_rows(world) == ["+++++", "+++++", "+++++", "+++++", "....+"]
    world = world_of(level(".....\n.....\n..^..\n..#..\n....."), view_size=5, view_offset=2)
    assert seen_rows(world) == ["+++++"] * 5


@pytest.mark.parametrize("thing", ["k", "$", "o", "v"])
def test_only_walls_are_opaque(thing: str) -> None:
    empty = "." * 9 + "\n"
    row = "." + thing * 7 + ".\n"
    world = world_of(level(empty * 3 + row + empty * 5, agents=[(4, 4, NORTH, False)]))
    assert seen_rows(world, viewer=world.n_agents - 1) == ["+++++++"] * 7


def test_the_smallest_view() -> None:
    world = world_of(level("####\n#^.#\n#..#\n####"), view_size=1, view_offset=0, view_tile_size=12)
    assert seen_rows(world) == ["+"]
    assert world.observe(0).shape == (12, 12, 3)
    assert colour_at(world, 0, ahead=0) == RED


# ------------------------------------------------------------------------------------------------------------- Pixels


def test_what_is_seen_where() -> None:
    state = level("#####\n#$.k#\n#...#\n#o^.#\n#####")
    for rules, collected in [("paper", GREY), ("released", BLACK)]:
        world = world_of(state, rules=rules, view_size=5, view_tile_size=12)
        assert colour_at(world, 0, ahead=3) == (74, 65, 42)
        assert colour_at(world, 0, ahead=2, aside=-1) == YELLOW
        assert colour_at(world, 0, ahead=0, aside=-1) == collected
        assert colour_at(world, 0, ahead=1) == BLACK
        for task in ("TeamSupport", "KeyForTreasure"):
            world = world_of(state, task, rules=rules, view_size=5, view_tile_size=12)
            assert colour_at(world, 0, ahead=2, aside=-1) == GREEN
            assert colour_at(world, 0, ahead=0, aside=-1) == GREY


@pytest.mark.parametrize("facing", range(4))
def test_key_turns_with_the_map(facing: int) -> None:
    """Upright for an agent facing north, on its side for one facing east; n of 9 yellow points: 255 * n // 9."""
    upright = np.array([[0, 2, 5, 0], [0, 3, 7, 0], [0, 1, 6, 0], [0, 1, 4, 0]])
    on_its_side = np.array([[0, 0, 0, 0], [5, 7, 6, 4], [2, 3, 1, 1], [0, 0, 0, 0]])
    turned = {NORTH: upright, EAST: on_its_side, SOUTH: upright[::-1, ::-1], WEST: on_its_side[::-1, ::-1]}
    world = world_of(level("#####\n#.k.#\n#k.k#\n#.k.#\n#####", agents=[(2, 2, facing, False)]))
    tile = tile_at(world, 0, ahead=1)
    assert tile[:, :, 0].tolist() == tile[:, :, 1].tolist() == (255 * turned[facing] // 9).tolist()
    assert not tile[:, :, 2].any()


def test_triangle_points_up_for_the_viewer() -> None:
    """
    The triangle (0.19, 0.88), (0.50, 0.13), (0.81, 0.88) counted on a grid of 12 x 12 points.

    Row k has y = (k + 0.5) / 12 and reaches 0.31 * (y - 0.13) / 0.75 to both sides; the points lie 0.5 / 12, 1.5 / 12,
    ... from the middle. Row 7, say, reaches 0.2046: past 1.5 / 12 = 0.125, not to 2.5 / 12 = 0.208.
    """
    points = {3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 6, 9: 6, 10: 8}  # row: points inside
    expected = np.zeros((4, 4), dtype=int)
    for row, width in points.items():
        for column in range(6 - width // 2, 6 + width // 2):
            expected[row // 3, column // 3] += 1
    for facing in range(4):
        world = world_of(level("#####\n#...#\n#...#\n#...#\n#####", agents=[(2, 2, facing, False)]))
        tile = tile_at(world, 0, ahead=0)
        assert tile[:, :, 0].tolist() == (255 * expected // 9).tolist()
        assert not tile[:, :, 1:].any()


def test_agent_on_a_collected_treasure() -> None:
    """Paper: grey shows around the agent. Released TeamTogether: blended into black, so darker at its edges."""
    state = level("####\n#o.#\n#..#\n####", agents=[(1, 1, NORTH, False)])
    alone = level("####\n#^.#\n#..#\n####")
    tiles = {}
    for rules in RULES:
        world, other = world_of(state, rules=rules), world_of(alone, rules=rules)
        tiles[rules] = (tile_at(world, 0, ahead=0).astype(int), tile_at(other, 0, ahead=0).astype(int))
    on_grey, agent = tiles["paper"]
    a = agent.sum(axis=2, keepdims=True)
    assert (on_grey == (100 * (a.max() - a) + agent * a) // a.max()).all()
    assert (on_grey[0, 0] == 100).all()
    on_black, agent = tiles["released"]
    a = agent.sum(axis=2, keepdims=True)
    assert (on_black == agent * a // a.max()).all()
    assert (on_black != agent).any()


@pytest.mark.parametrize(("t", "grey"), [(10, 0), (11, 1), (12, 2), (30, 20), (40, 20)])
@pytest.mark.parametrize("facing", range(4))
def test_grid_lines_of_large_tiles_turn_with_the_map(t: int, grey: int, facing: int) -> None:
    """The north and the east side of a map cell have the line."""
    world = world_of(level("#####\n#...#\n#...#\n#...#\n#####", agents=[(2, 2, facing, False)]), view_tile_size=t)
    expected = np.zeros((t, t, 3), dtype=int)
    # An agent that faces east sees the map's north on the left and its east at the top, and so on.
    row, column = {NORTH: (0, -1), EAST: (0, 0), SOUTH: (-1, 0), WEST: (-1, -1)}[facing]
    expected[row, :] = expected[:, column] = grey
    np.testing.assert_array_equal(tile_at(world, 0, ahead=1), expected)
    own = tile_at(world, 0, ahead=0)
    assert (own[row, :] == grey).all()
    assert (own[:, column] == grey).all()


def test_which_tiles_carry_grid_lines() -> None:
    state = level("#####\n#$k##\n#o^.#\n#...#\n#####", agents=[(1, 1, NORTH, False), (1, 2, NORTH, False)])

    def lined(world: ReferenceWorld, ahead: int, aside: int) -> bool:
        tile = tile_at(world, 0, ahead, aside).astype(int)
        return bool((tile[0, :] - tile[-1, 0] == 2).all() and (tile[:, -1] - tile[-1, 0] == 2).all())

    for rules in RULES:
        world = world_of(state, rules=rules, view_tile_size=12)
        assert lined(world, 0, 0), "an agent"
        assert lined(world, 1, 0), "a key"
        assert lined(world, 0, 1), "nothing"
        assert not lined(world, 1, 1), "a wall"
        assert not lined(world, 1, -1), "an agent on a treasure"
        assert lined(world, 0, -1) == (rules == "released"), "an agent on a collected treasure, black if released"
    world = world_of(level("####\n#$o#\n#^.#\n####"), rules="released", view_tile_size=12)
    assert not lined(world, 1, 0), "a treasure"
    assert lined(world, 1, 1), "a collected treasure"


# ------------------------------------------------------------------------------------------------------------ Colours


def test_paper_colours_show_the_present() -> None:
    world = world_of(
        level("######\n#.>..#\n#.k..#\n#....#\n#....#\n######"), "KeyForTreasure", heterogeneity=2, view_tile_size=12
    )
    assert colour_at(world, 0, ahead=0) == RED
    world.step([RIGHT])
    world.step([PICKUP])
    assert colour_at(world, 0, ahead=0) == PINK
    world.step([DROP])
    assert colour_at(world, 0, ahead=0) == RED
    world.step([LEFT])
    world.step([FORWARD])
    assert colour_at(world, 0, ahead=0) == ORANGE


def test_released_colours_are_stale_by_one_step() -> None:
    world = world_of(
        level("######\n#.>..#\n#.k..#\n#....#\n#....#\n######"),
        "KeyForTreasure",
        heterogeneity=2,
        view_tile_size=12,
        rules="released",
    )
    shown = [colour_at(world, 0, ahead=0)]
    for action in (RIGHT, PICKUP, TOGGLE, DROP, TOGGLE, LEFT, FORWARD, TOGGLE):
        world.step([action])
        shown.append(colour_at(world, 0, ahead=0))
    #                reset right pickup toggle drop toggle left forward toggle
    assert shown == [BLUE, RED, RED, BLUE, BLUE, RED, RED, RED, ORANGE]
    world.set_state(world.get_state())
    assert colour_at(world, 0, ahead=0) == BLUE


def test_key_carrier_is_drawn_only_if_it_came_first() -> None:
    for carrier in (0, 1):
        world = world_of(
            level("#####\n#...#\n#...#\n#.^.#\n#####", agents=[(2, 1, EAST, carrier == 0), (2, 1, EAST, carrier == 1)]),
            "KeyForTreasure",
            view_tile_size=12,
        )
        assert colour_at(world, 0, ahead=2) == (PINK if carrier == 0 else RED)
        assert colour_at(world, 1, ahead=0) == (PINK if carrier == 0 else RED)  # each sees itself
        assert colour_at(world, 2, ahead=0) == (PINK if carrier == 1 else RED)


def test_colours_repeat_after_the_last() -> None:
    text = "\n".join(["." * 18] * 18)
    world = world_of(
        level(text, agents=[(x, 1, NORTH, False) for x in range(18)]), grid_size=18, heterogeneity=16, view_tile_size=12
    )
    zones = [world.zone_of_column(x) for x in range(18)]
    assert max(zones) == 15
    colours = {zone: colour_at(world, x, ahead=0) for x, zone in enumerate(zones)}
    assert colours[14] == colours[0] == RED
    assert colours[15] == colours[1] == ORANGE
    assert len(set(colours.values())) == 14
    assert PINK not in colours.values()
