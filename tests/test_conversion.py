"""Models act on what a game itself gives, as they act on its rows: unequal and nested spaces, pictures, masks."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from sb3_saf import QPLEX, make_team_env, ppo_settings
from sb3_saf.teams.conversion import AgentConversion
from sb3_saf.teams.rows import n_mask_entries
from tests.contrib_teams import random_masks

# One of the agents of "pictures" has none.
pytestmark = pytest.mark.filterwarnings("ignore:the pictures in the agents' observations are read as plain numbers")

VECTOR: Final = spaces.Box(-1, 1, (5,), np.float64)
SHORT: Final = spaces.Box(-1, 1, (3,), np.float32)
PICTURE: Final = spaces.Box(0, 255, (12, 12, 3), np.uint8)
NESTED: Final = spaces.Dict(
    z=spaces.Discrete(3, start=4), a=spaces.Tuple([SHORT, spaces.MultiDiscrete([2, 3], start=[1, 0])])
)
MULTI: Final = spaces.MultiDiscrete([4, 3], start=[0, 2])
FOUR, THREE = spaces.Discrete(4, start=2), spaces.Discrete(3)
LONG, WIDE = spaces.Box(-2, 2, (3,), np.float32), spaces.Box(0, 1, (1,), np.float32)
WHOLE: Final = spaces.Box(-9, 9, (2,), np.int32)

#: Observation and action spaces of three agents.
KINDS: Final[dict[str, list[tuple[spaces.Space[Any], spaces.Space[Any]]]]] = {
    "equal": [(VECTOR, THREE)] * 3,
    "equal, start": [(spaces.Discrete(4, start=3), FOUR)] * 3,
    "equal, nested": [(NESTED, THREE)] * 3,
    "equal, pictures": [(PICTURE, THREE)] * 3,
    "vectors": [(VECTOR, FOUR), (SHORT, THREE), (SHORT, THREE)],
    "nested": [(NESTED, FOUR), (VECTOR, THREE), (spaces.Discrete(3, start=1), THREE)],
    "pictures": [
        (spaces.Dict(camera=PICTURE, state=VECTOR), THREE),
        (spaces.Dict(camera=PICTURE), FOUR),
        (SHORT, FOUR),
    ],
    "ambiguous": [(SHORT, THREE), (SHORT, FOUR), (VECTOR, THREE)],
    "multi": [(VECTOR, MULTI), (SHORT, spaces.MultiDiscrete([2, 5])), (VECTOR, MULTI)],
    "mixed": [(VECTOR, MULTI), (SHORT, FOUR), (VECTOR, MULTI)],
    "boxes": [(VECTOR, LONG), (SHORT, WIDE), (VECTOR, LONG)],
    "equal, boxes": [(VECTOR, WHOLE)] * 3,
}


class Kinds(ParallelEnv[str, Any, Any]):
    """
    Three agents, five steps, observations drawn from their spaces; the first agent ends in step 2.

    :param kind: of ``KINDS``
    :param masks: None, or where masks are: "info" or "observation"
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "kinds"}
    possible_agents: ClassVar[list[str]] = ["agent", "b", "c"]

    def __init__(self, kind: str, masks: str | None = None) -> None:
        self.own = dict(zip(self.possible_agents, KINDS[kind], strict=True))
        self.masks = masks
        self.steps_of_games: list[dict[str, Any]] = []

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        observed, acted = self.own[agent]
        if self.masks != "observation":
            return observed
        n_entries = n_mask_entries(acted)
        assert n_entries is not None
        return spaces.Dict(observation=observed, action_mask=spaces.MultiBinary(n_entries))

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self.own[agent][1]

    def _seen(self) -> tuple[dict[str, Any], dict[str, Any]]:
        observations: dict[str, Any] = {}
        infos: dict[str, Any] = {agent: {} for agent in self.agents}
        for agent in self.agents:
            space, acted = self.own[agent]
            space.seed(int(self.rng.integers(1 << 30)))
            observations[agent] = space.sample()
            if self.masks is not None:
                mask = random_masks(acted, 1, self.rng)[0].astype(np.int8)
                if self.masks == "info":
                    infos[agent] = {"avail_actions" if agent == "b" else "action_mask": mask}
                else:
                    observations[agent] = {"observation": observations[agent], "action_mask": mask}
        return observations, infos

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.rng = np.random.default_rng(seed)
        self.agents, self.steps = list(self.possible_agents), 0
        return self._seen()

    def step(self, actions: dict[str, Any]) -> Any:
        for agent, action in actions.items():
            assert self.action_space(agent).contains(action), (agent, action)
        self.steps_of_games.append(actions)
        self.steps += 1
        team = list(self.agents)
        observations, infos = self._seen()
        ends = {agent: self.steps == 5 or (self.steps == 2 and agent == "agent") for agent in team}
        self.agents = [agent for agent in team if not ends[agent]]
        return observations, dict.fromkeys(team, 1.0), ends, dict.fromkeys(team, False), infos


def make(algorithm: Any, policy: str, env: Any, **kwargs: Any) -> Any:
    if algorithm is QPLEX:
        return QPLEX(policy, env, buffer_size=100, seed=0, **kwargs)
    settings = ppo_settings(env, n_steps=8, **kwargs) if algorithm is PPO else {"n_steps": 8, "batch_size": 24}
    return algorithm(policy, env, **settings, seed=0)


@pytest.mark.parametrize("kind", KINDS)
def test_actions_of_the_game_become_those_of_rows_and_back(kind: str) -> None:
    env = make_team_env(partial(Kinds, kind), seed=0)
    agents: Any = env.observation_space["agent"]  # type: ignore[index]
    for conversion, (_, space) in zip(agents.conversions, KINDS[kind], strict=True):
        space.seed(0)
        for action in (space.sample() for _ in range(20)):
            row = conversion.row_action_of(action)
            assert row.shape == env.action_space.shape
            np.testing.assert_array_equal(conversion.game_action(row), action)


@pytest.mark.parametrize("masks", [None, "info", "observation"])
@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_those_of_the_rows(kind: str, masks: str | None, tmp_path: Path) -> None:
    if "boxes" in kind and masks is not None:
        pytest.skip("Boxes have no masks")
    game = Kinds(kind, masks)
    env = make_team_env(partial(Kinds, kind, masks), seed=0)
    model: Any = make(PPO, "SAFPolicy", env)
    if kind == "equal, boxes":
        with th.no_grad():  # actions that are not near 0
            model.policy.actor.query_net[-1].bias.add_(1.0)
            for parameter in model.policy.actor.parameters():
                parameter.add_(th.randn_like(parameter))
    model.save(tmp_path / "model")
    model = PPO.load(tmp_path / "model", device="cpu")
    (copy,) = env.get_attr("steps_of_games", indices=[0])
    rows: Any = env.reset()
    observations, infos = game.reset(seed=int(env.venv.seeded_with[0]))  # type: ignore[attr-defined]
    while game.agents:
        row_actions, _ = model.predict(rows, deterministic=True)
        # As in training, infos are read where observations have no masks.
        told: Any = infos if masks == "info" else {agent: {"action_mask": np.zeros(2)} for agent in observations}
        given = observations if masks is None else (observations, told)
        actions, _ = model.predict(given, deterministic=True)
        rows, *_ = env.step(row_actions)
        for agent, action in actions.items():
            np.testing.assert_allclose(action, copy[-1][agent], atol=1e-6)
            assert game.action_space(agent).contains(action)
            if masks != "info":
                alone, _ = model.predict({agent: observations[agent]}, deterministic=True)
                np.testing.assert_allclose(alone[agent], action, atol=1e-6)
                if kind == "ambiguous" and agent != "c" and masks is None:  # masks have the lengths of the actions
                    with pytest.raises(ValueError, match=r"name the agent: \{'agent': observation\}"):
                        model.predict(observations[agent])
                    continue
                nameless, _ = model.predict(observations[agent], deterministic=True)
                np.testing.assert_allclose(nameless, action, atol=1e-6)
        observations, _, _, _, infos = game.step(actions)
        observations = {agent: observations[agent] for agent in game.agents}


def test_masks_are_passed_by_agent() -> None:
    env = make_team_env(partial(Kinds, "equal"), seed=0, action_masks=False)
    model = make(MaskablePPO, "MAPPOMaskablePolicy", env)
    observations, _ = Kinds("equal").reset(seed=0)
    for action in range(3):
        masks = dict.fromkeys(observations, np.eye(3)[action])
        assert model.predict(observations, action_masks=masks)[0] == dict.fromkeys(observations, action)
        assert model.predict(observations["b"], action_masks=masks["b"])[0] == action
        assert model.predict(observations, action_masks=masks["b"])[0] == dict.fromkeys(observations, action)
    seen = spaces.Box(0, 1, (1,))
    conversion = AgentConversion.of(seen, spaces.Discrete(2), seen, spaces.Discrete(3))
    assert conversion.mask([0, 1, 1]).tolist() == [0, 1, 0], "a mask of rows allows no action that the agent lacks"
    for _ in range(5):  # whoever has no mask may do everything
        partly = {**dict.fromkeys(observations), "b": np.eye(3)[2]}
        assert model.predict(observations, action_masks=partly, deterministic=False)[0]["b"] == 2
        infos: Any = {agent: {} if mask is None else {"action_mask": mask} for agent, mask in partly.items()}
        assert model.predict((observations, infos), deterministic=False)[0]["b"] == 2
        both = {"b": 1 - np.eye(3)[0]}  # with a mask in the info: all masks must allow an action
        infos["b"] = {"action_mask": 1 - np.eye(3)[1]}
        assert model.predict((observations, infos), action_masks=partly | both, deterministic=False)[0]["b"] == 2
    with pytest.raises(ValueError, match=r"expected a mask of each observed agent, .* got none of \['agent', 'c'"):
        model.predict(observations, action_masks={"b": np.eye(3)[2]})


@pytest.mark.parametrize(
    ("kind", "observation", "message"),
    [
        ("vectors", {"b": np.zeros(5, np.float32)}, r"observation of b: .* of shape \(3,\), got .* \(5,\)"),
        ("vectors", {"b": {"place": np.zeros(3)}}, r"observation of b: .* of shape \(3,\)"),
        ("vectors", {"d": np.zeros(3, np.float32)}, r"'agent', 'b', 'c', .* got 'd'"),
        ("equal, start", {"b": 2}, "observation of b: expected values from 3 to 6 .* got 2"),
        ("equal, pictures", {"b": np.full((12, 12, 3), 300, np.uint16)}, "expected values from 0 to 255 .* got 300"),
        ("nested", {"agent": {"z": 4}}, r"observation of agent: .* the parts \['z', 'a'\], got \['z'\]"),
    ],
)
def test_observations_of_another_form(kind: str, observation: Any, message: str) -> None:
    model = make(PPO, "IPPOPolicy", make_team_env(partial(Kinds, kind), seed=0))
    with pytest.raises(ValueError, match=message):
        model.predict(observation)


def test_masks_that_the_game_gives_are_required() -> None:
    model = make(PPO, "IPPOPolicy", make_team_env(partial(Kinds, "equal", "info"), seed=0))
    observations, infos = Kinds("equal", "info").reset(seed=0)
    with pytest.raises(ValueError, match=r"observation of agent: expected an action mask .* got None"):
        model.predict(observations)
    with pytest.raises(ValueError, match="observation of b: expected an action mask of 3 zeros and ones"):
        model.predict((observations, {**infos, "b": {"action_mask": np.ones(4)}}))
