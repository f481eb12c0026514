"""Inspection's numbers, compared with numbers computed by hand."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from PIL import Image

from sb3_saf.inspection import figures
from sb3_saf.inspection.recording import EpisodeRecording, ReturnScale
from sb3_saf.inspection.scalars import (
    attention_of,
    calibrate,
    policy_distances,
    pool_scalars,
    team_scalars,
)
from sb3_saf.inspection.tensorboard import layout

Array = npt.NDArray[Any]


def recorded(**changes: Any) -> EpisodeRecording:
    """Two agents of one game, one episode of three steps."""
    usual = EpisodeRecording(
        n_agents=2,
        of_team=False,
        gamma=0.5,
        actions=np.zeros((3, 2), dtype=np.int64),
        counted=np.ones((3, 2), dtype=bool),
        rewards=np.array([[1, 0], [2, 0], [4, 8]], dtype=np.float32),
        team_rewards=np.array([[1.0], [2.0], [12.0]]),
        ends=np.array([[False] * 2, [False] * 2, [True] * 2]),
        last_values=np.zeros((3, 2), dtype=np.float32),
        values=np.zeros((3, 2), dtype=np.float32),
        values_without={},
        episode_returns=[15.0],
        episode_lengths=[3],
        pictures=[],
    )
    return usual._replace(**changes)


class TestReturns:
    LAST = np.array([[0, 0], [0, 0], [8, 16]], dtype=np.float32)
    VALUES = np.array([[100, 200], [10, 20], [30, 40]], dtype=np.float32)

    @pytest.mark.parametrize(
        ("changes", "lam", "expected"),
        [
            # 1 + 2 / 2 + 4 / 4 and 8 / 4; 2 + 4 / 2 and 8 / 2; 4 and 8.
            ({}, 1, [[3, 2], [4, 4], [4, 8]]),
            # The next episode does not contribute.
            ({"ends": np.array([[True] * 2, [False] * 2, [True] * 2])}, 1, [[1, 0], [4, 4], [4, 8]]),
            # A time limit that does not terminate is followed by a value.
            ({"last_values": LAST}, 1, [[4, 4], [6, 8], [8, 16]]),
            # The end of an agent ends only its own return.
            ({"ends": np.array([[False, True], [False, False], [True, True]])}, 1, [[3, 0], [4, 4], [4, 8]]),
            # One step, then the value.
            ({"values": VALUES}, 0, [[6, 10], [17, 20], [4, 8]]),
        ],
    )
    def test_targets_by_hand(self, changes: dict[str, Any], lam: float, expected: list[list[float]]) -> None:
        assert recorded(**changes).targets(lam).tolist() == expected

    def test_targets_in_between_are_gae_plus_values(self) -> None:
        rng = np.random.default_rng(0)
        values = rng.normal(size=(3, 2)).astype(np.float32)
        one = recorded(values=values, gamma=0.9)
        found = one.targets(0.7)
        advantage = np.zeros(2)
        for t in (2, 1, 0):
            following = values[t + 1] if t < 2 else np.zeros(2)
            advantage = one.rewards[t] + 0.9 * following - values[t] + 0.9 * 0.7 * advantage * (t < 2)
            np.testing.assert_allclose(found[t], advantage + values[t], rtol=1e-6)


class TestCalibration:
    def test_a_critic_that_exaggerates_and_promises_too_much(self) -> None:
        returns = np.array([1.0, 2.0, 3.0])
        found = calibrate(2 * returns + 1, returns)
        assert found.slope == pytest.approx(0.5)
        assert found.bias == pytest.approx(3)
        assert found.rmse == pytest.approx(math.sqrt((2**2 + 3**2 + 4**2) / 3))
        assert found.explained_variance == pytest.approx(0)

    def test_what_is_constant_has_no_slope_and_no_variance_to_explain(self) -> None:
        assert calibrate(np.ones(3), np.arange(3.0)).slope is None
        assert calibrate(np.arange(3.0), np.ones(3)).explained_variance is None


class TestSelection:
    def test_a_pool_with_known_choices_has_these_scalars(self) -> None:
        weights = np.array([[[0.75, 0.25], [0, 1]], [[0.25, 0.75], [0, 1]], [[1, 0], [1, 0]]])
        counted = np.array([[True] * 2, [True] * 2, [False] * 2])
        game = recorded(
            counted=counted,
            pool_weights=weights,
            zones=np.array([[0, 1], [0, 1], [1, 0]]),
            pool_actions=np.zeros((3, 2, 2, 3)),
        )
        scalars = pool_scalars(game, spaces.Discrete(3))
        expected = {
            "pool/chosen/policy_0": 0.25,
            "pool/chosen/policy_1": 0.75,
            "pool_by_zone/zone_0/policy_0": 0.5,
            "pool_by_zone/zone_0/policy_1": 0.5,
            "pool_by_zone/zone_1/policy_0": 0.0,
            "pool_by_zone/zone_1/policy_1": 1.0,
            "pool/difference": 0.0,
        }
        assert {tag: scalars[tag] for tag in expected} == pytest.approx(expected)
        bits = lambda p: -(p * math.log2(p) + (1 - p) * math.log2(1 - p))  # noqa: E731
        assert scalars["pool/entropy"] == pytest.approx(bits(0.25) / 2)
        assert scalars["pool/entropy_of_mean"] == pytest.approx(bits(0.25))
        assert scalars["pool/zone_dependence"] == pytest.approx(bits(0.25) - 0.5)


class TestDifferences:
    def test_discrete(self) -> None:
        logits = np.log(np.array([[[0.5, 0.5, 1e-30], [0.5, 0.5, 1e-30], [1e-30, 1e-30, 1]]]))
        table = policy_distances(spaces.Discrete(3), logits)
        np.testing.assert_allclose(table, [[0, 0, 1], [0, 0, 1], [1, 1, 0]], atol=1e-6)

    @pytest.mark.parametrize(
        ("space", "one", "other", "joint"),
        [
            (spaces.MultiDiscrete([2, 2]), [0, 0, 0, 0], [0, math.log(3), math.log(3), 0], (4, 4)),
            (spaces.MultiBinary(2), [0, 0], [math.log(3), -math.log(3)], (4, 4)),
        ],
    )
    def test_several_dimensions_are_those_of_joint_actions(
        self, space: spaces.Space[Any], one: list[float], other: list[float], joint: tuple[int, int]
    ) -> None:
        table = policy_distances(space, np.array([[one, other]], dtype=float))
        # Both spaces: (1/2, 1/2) twice against (1/4, 3/4) and (3/4, 1/4): four joint actions of probability 1/4.
        p, q = np.full(4, 0.25), np.array([3, 1, 9, 3]) / 16
        assert table[0, 1] == pytest.approx(math.sqrt(1 - np.sqrt(p * q).sum()))

    def test_gaussians_by_integration(self) -> None:
        x = np.linspace(-30, 30, 200_001)
        p = np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
        q = np.exp(-((x - 1) ** 2) / 8) / math.sqrt(8 * math.pi)
        overlap = np.sqrt(p * q).sum() * (x[1] - x[0])
        table = policy_distances(spaces.Box(-1, 1, (1,)), np.array([[[0, 0], [1, math.log(2)]]]))
        assert table[0, 1] == pytest.approx(math.sqrt(1 - overlap), rel=1e-6)


class TestAttention:
    def test_entropy_of_one_and_of_the_mean(self) -> None:
        # The slot attends to agent 0, then to agent 1: selective at each step, uniform on average.
        found = attention_of(np.array([[[1.0, 0.0]], [[0.0, 1.0]]]))
        assert found.mean.tolist() == [[0.5, 0.5]]
        assert found.entropy == pytest.approx(0)
        assert found.entropy_of_mean == pytest.approx(1)

    def test_queries_without_sources_are_left_out(self) -> None:
        found = attention_of(np.array([[[0.5, 0.5]], [[0.0, 0.0]]]))
        assert found.mean.tolist() == [[0.5, 0.5]]
        assert found.entropy == pytest.approx(1)
        found = attention_of(np.array([[[0.5, 0.5, 0.0]], [[1 / 3, 1 / 3, 1 / 3]]]))  # an agent is out, then in
        assert found.entropy == pytest.approx(1)

    def test_a_single_source_has_no_entropy(self) -> None:
        assert attention_of(np.ones((2, 3, 1)))[1:] == (None, None)


def test_team_scalars() -> None:
    game = recorded(episode_returns=[10.0, 20.0], episode_lengths=[3, 5])
    scalars = team_scalars(game, ReturnScale("treasures", 30))
    assert scalars["team/return"] == 15
    assert scalars["team/episode_length"] == 4
    assert scalars["team/share_of_treasures"] == 0.5
    # Student's t for one degree of freedom: 12.706 standard errors of 5.
    assert scalars["team/return_high"] == pytest.approx(15 + 12.7062 * 5, rel=1e-4)
    assert "team/share_of_best_return" not in team_scalars(game, ReturnScale(None, None))
    assert "team/return_low" not in team_scalars(recorded(), ReturnScale(None, None))


def test_films_keep_colours_of_few_pixels() -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(80, 120, (200, 200, 1), dtype=np.uint8).repeat(3, axis=2) for _ in range(9)]
    pictures[2][50:56, 50:56] = 220, 20, 30
    with Image.open(io.BytesIO(figures.gif(pictures, 1 / 60))) as film:
        assert film.info["duration"] == 20, "browsers show shorter ones for 100 ms"
        film.seek(2)
        shown = np.asarray(film.convert("RGB")).astype(int)[53, 53]
    assert np.abs(shown - [220, 20, 30]).max() < 40


def test_charts_of_the_critic_are_there_from_the_beginning() -> None:
    charts = layout(["team/return", "critic/bias"], value_based=False)["Critic"]  # all returns are 0 before training
    assert ["Multiline", ["^critic/explained_variance$"]] in charts.values()
