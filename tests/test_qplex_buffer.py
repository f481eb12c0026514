"""The replay buffer of teams, compared with a list of all transitions."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_saf.buffers.replay import TeamReplayBuffer, TeamReplaySamples
from sb3_saf.teams.files import read_tree, write_tree
from sb3_saf.teams.rows import TeamSpaces

N_AGENTS, N_GAMES, N_ACTIONS = 2, 3, 4
OWN = spaces.Box(0, 255, (3,), np.uint8)


def make_buffer(game_steps: int = 30, **kwargs: Any) -> TeamReplayBuffer:
    space = TeamSpaces(OWN, N_AGENTS, **kwargs).to_dict_space()
    return TeamReplayBuffer(
        game_steps,
        space,
        spaces.Discrete(N_ACTIONS),
        device="cpu",
        n_envs=N_AGENTS * N_GAMES,
        optimize_memory_usage=False,
    )


class Story:
    """Random games whose transitions are recorded."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.now = self._views()
        self.starts = np.ones(N_GAMES, dtype=bool)
        self.told: list[list[dict[str, Any]]] = [[] for _ in range(N_GAMES)]
        self.last = np.full((N_GAMES, N_AGENTS), -1)

    def _views(self) -> np.ndarray:
        return self.rng.integers(0, 256, (N_GAMES, N_AGENTS, 3), dtype=np.uint8)

    def rows(self, views: np.ndarray) -> dict[str, np.ndarray]:
        agents = np.tile(np.arange(N_AGENTS), N_GAMES)
        state = np.repeat(views[:, 0, :1], N_AGENTS, axis=0).astype(np.float32)
        masks = np.repeat(views.reshape(-1, 3)[:, :1] > 99, N_ACTIONS, axis=1).astype(np.int8)
        active = np.repeat((views[:, :, 1] > 50).astype(np.int8), N_AGENTS, axis=0)
        obs = views.reshape(-1, 3)
        return {"obs": obs, "agent": agents, "state": state, "action_mask": masks, "active": active}

    def step(self, buffer: TeamReplayBuffer, cut: bool = False) -> None:
        """Take one step; ``cut`` starts new episodes afterwards although none ended."""
        actions = self.rng.integers(N_ACTIONS, size=(N_GAMES, N_AGENTS))
        rewards = self.rng.random((N_GAMES, N_AGENTS)).astype(np.float32)
        after, ended = self._views(), self.rng.random(N_GAMES) < 0.3
        truncated = ended & (self.rng.random(N_GAMES) < 0.5)
        # Not of the first agent, which may have ended before the time limit of its team.
        flags = [bool(truncated[row // N_AGENTS] and row % N_AGENTS) for row in range(N_GAMES * N_AGENTS)]
        infos = [{"TimeLimit.truncated": flag} for flag in flags]
        rows = np.repeat(ended, N_AGENTS)
        starts = np.repeat(self.starts, N_AGENTS)
        buffer.add(self.rows(self.now), self.rows(after), actions.reshape(-1), rewards.reshape(-1), rows, infos, starts)
        for game in range(N_GAMES):
            self.told[game].append(
                {
                    "now": self.now[game],
                    "after": after[game],
                    "actions": actions[game],
                    "reward": rewards[game].sum(),
                    "done": float(ended[game] and not truncated[game]),
                    "start": self.starts[game],
                    "last": np.full(N_AGENTS, -1) if self.starts[game] else self.last[game],
                }
            )
        self.last = actions
        self.starts = ended | cut
        self.now = np.where(self.starts[:, None, None], self._views(), after)


def check(story: Story, samples: TeamReplaySamples, oldest: int, terminal: bool = False) -> set[tuple[int, int]]:
    """Find every sampled step in the story; what follows a termination does not matter."""
    found = set()
    for i in range(len(samples.rewards)):
        own = samples.now.own[i].numpy()
        where = [
            (game, t)
            for game, told in enumerate(story.told)
            for t, step in enumerate(told)
            if t >= oldest and np.array_equal(step["now"], own)
        ]
        assert len(where) == 1
        (game, t) = where[0]
        step = story.told[game][t]
        assert np.array_equal(step["actions"], samples.actions[i])
        assert step["reward"] == pytest.approx(float(samples.rewards[i]))
        assert step["done"] == float(samples.dones[i])
        after = samples.after
        if not step["done"]:
            assert np.array_equal(step["after"], after.own[i])
            if after.states is not None and after.masks is not None and after.active is not None:
                assert float(after.states[i]) == step["after"][0, 0]
                assert np.array_equal(after.masks[i, :, 0], step["after"][:, 0] > 99)
                assert np.array_equal(after.active[i], step["after"][:, 1] > 50)
        found.add(where[0])
    return found


@pytest.mark.parametrize("kwargs", [{}, {"has_active": True, "n_masked_actions": 4, "state": spaces.Box(0, 255, (1,))}])
def test_samples_are_what_happened(kwargs: dict[str, Any]) -> None:
    """Also after the ring was overwritten, with time limits and resets in between."""
    buffer, story = make_buffer(30, **kwargs), Story()
    for t in range(47):
        story.step(buffer, cut=t in (5, 17, 31, 44))
        n_kept = min(t + 1, 10)
        assert buffer.n_stored == N_GAMES * n_kept
        if t in (0, 3, 11, 46):
            found = check(story, buffer.sample(200), oldest=t + 1 - n_kept)
            assert len(found) == N_GAMES * n_kept  # all of them, and no others


def test_observations_are_stored_once() -> None:
    buffer, story = make_buffer(3_000), Story()
    for _ in range(1_500):
        story.step(buffer)
    n_slots = 1_001 * N_GAMES
    assert buffer.seen["obs"].nbytes == n_slots * N_AGENTS * 3
    # Stored separately: last observations of time limits among the kept steps; they do not accumulate.
    assert len(buffer.aside["obs"]) < n_slots / 3
    per_step = buffer.nbytes / n_slots
    assert per_step < 25


def test_sequences_are_consecutive_and_know_where_episodes_start() -> None:
    buffer, story = make_buffer(36), Story()
    for t in range(31):
        story.step(buffer, cut=t == 25)
    samples = buffer.sample_sequences(40, length=4, burn_in=3)
    info = samples.sequences
    assert info is not None and (info.n, info.length) == (40, 7)
    check(story, samples, oldest=31 - 12)
    keys = {step["now"].tobytes(): (game, t) for game, told in enumerate(story.told) for t, step in enumerate(told)}
    places = np.array([keys[own.tobytes()] for own in samples.now.own.numpy()]).reshape(40, 7, 2)
    counted, resets = info.counted.view(40, 7).numpy(), info.resets.view(40, 7).numpy()
    assert (counted == (np.arange(7) >= 3)).all()
    moves = np.diff(places[:, :, 1], axis=1)
    assert ((moves == 1) | (resets[:, :-1] & (moves == 0))).all() and (moves[:, 3:] == 1).all()
    for (game, t), last, reset in zip(
        places.reshape(-1, 2), info.last_actions.numpy(), resets.reshape(-1), strict=True
    ):
        step = story.told[game][t]
        assert np.array_equal(last, step["last"])
        assert reset == (step["start"] or t == 31 - 12)


def test_rows_that_are_no_teams_are_refused() -> None:
    buffer, story = make_buffer(), Story()
    with pytest.raises(ValueError, match="at least one step"):
        buffer.sample(3)
    rows = story.rows(story.now)
    rest: Any = (np.zeros(6), np.zeros(6), np.zeros(6), [{}] * 6)
    with pytest.raises(ValueError, match="game-major, then agent"):
        buffer.add({**rows, "agent": rows["agent"][::-1]}, rows, *rest)
    with pytest.raises(ValueError, match="of shape"):
        buffer.add({**rows, "obs": rows["obs"][:, :2]}, rows, *rest)
    with pytest.raises(ValueError, match="whole teams"):
        TeamReplayBuffer(10, TeamSpaces(OWN, 2).to_dict_space(), spaces.Discrete(2), n_envs=3)


def test_teams_that_never_take_part_are_refused() -> None:
    buffer, story = make_buffer(has_active=True), Story()
    rest: Any = (np.zeros(6, dtype=int), np.zeros(6), np.zeros(6), [{}] * 6)
    rows = story.rows(story.now)
    dead = {**rows, "active": np.zeros((6, N_AGENTS), dtype=np.int8)}
    buffer.add(dead, dead, *rest)
    with pytest.raises(ValueError, match=r"expected agents that take part, got none in 1 steps of 3 games"):
        buffer.sample(3)
    copy = make_buffer(has_active=True)
    copy.load_checkpoint_state(buffer.checkpoint_state())
    with pytest.raises(ValueError, match="expected agents that take part"):
        copy.sample(3)
    buffer.add({**dead, "active": np.ones((6, N_AGENTS), dtype=np.int8)}, dead, *rest)
    assert len(buffer.sample(3).rewards) == 3


def test_a_checkpoint_is_written_without_a_second_buffer_in_memory(tmp_path: Path) -> None:
    space = TeamSpaces(spaces.Box(0, 255, (3_000,), np.uint8), N_AGENTS).to_dict_space()
    buffer = TeamReplayBuffer(6_000, space, spaces.Discrete(4), n_envs=N_AGENTS * N_GAMES)
    buffer._n_steps, buffer.pos, buffer._has_played, buffer.full = buffer.buffer_size, 0, True, True
    assert buffer.nbytes > 30e6
    tracemalloc.start()
    try:
        with (tmp_path / "file").open("wb") as file:
            write_tree(file, buffer.checkpoint_state())
        written = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        with (tmp_path / "file").open("rb") as file:
            read_tree(file)
        read = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert written < 0.6 * buffer.nbytes and read < 1.5 * buffer.nbytes


def test_memory_that_does_not_fit_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=100))
    with pytest.warns(UserWarning, match="replay buffer of 30 game steps takes"):
        make_buffer()
