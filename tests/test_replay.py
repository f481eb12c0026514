"""The replay page: its numbers equal the recording's, its controls work, and invalid input is refused."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

import sb3_saf
from sb3_saf.inspection import replay as replay_module
from sb3_saf.inspection.recording import EpisodeRecording, record_episodes
from sb3_saf.inspection.replay import replay
from sb3_saf.training import replay as command
from sb3_saf.training.train import train
from tests.test_training_commands import failed
from tests.toy_envs import CounterEnv, Game

LEVEL: dict[str, Any] = {"n_agents": 3, "grid_size": 9, "n_treasures": 12, "max_cycles": 12, "heterogeneity": 2}
SEED = 7
KINDS = {"u1": np.uint8, "u2": np.uint16, "i2": np.int16, "f4": np.float32}


def make_env(task: str = "TeamSupport", n_envs: int = 2, **params: Any) -> Any:
    return sb3_saf.make_team_env(task, n_envs=n_envs, seed=0, **{**LEVEL, **params})


@pytest.fixture(scope="module")
def model() -> PPO:
    env = make_env()
    return PPO("SAFPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env, n_steps=100, n_epochs=2)).learn(600)


def data_of(page: Path) -> Any:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found
    return json.loads(found[1])


def unpacked(packed: Any) -> Any:
    numbers = np.frombuffer(base64.b64decode(packed["data"]), dtype=KINDS[packed["type"]])
    return numbers.reshape(packed["shape"]) * packed["scale"]


def test_numbers_are_those_of_the_recording(model: PPO, tmp_path: Path) -> None:
    data = data_of(replay(model, make_env(), tmp_path / "page.html", seed=SEED))
    recording = record_episodes(model.policy, make_env(), 2, SEED, gamma=model.gamma)
    (run,) = data["runs"]
    assert run["steps"] == LEVEL["max_cycles"] and data["n_agents"] == 3
    rows = slice(0, 3)
    for name, expected in (
        ("actions", recording.actions[:, rows]),
        ("views", of(recording.observations)[:, rows]),
        ("probabilities", of(recording.action_probabilities)[:, rows]),
        ("weights", of(recording.pool_weights)[:, rows]),
        ("read", of(recording.read_attention)[:, 0]),
        ("write", of(recording.write_attention)[:, 0]),
        ("values", recording.values[:, rows]),
        ("returns", recording.returns[:, rows]),
        ("message", (recording.values_without["zero"] - recording.values)[:, rows]),
        ("rewards", recording.team_rewards[:, 0]),
    ):
        np.testing.assert_allclose(unpacked(run[name]), expected, atol=1e-5, err_msg=name)
    assert sum(step >= 0 for step in run["collected"]) == pytest.approx(recording.episode_returns[0])


@pytest.mark.parametrize("team_reward", ["sum", "mean"])
def test_shared_rewards_count_once(model: PPO, team_reward: Any, tmp_path: Path) -> None:
    """The return of a team is what the game paid, whatever its agents learn from."""
    env = make_env(team_reward=team_reward)
    recording = record_episodes(model.policy, env, 2, SEED)
    assert recording.episode_returns == pytest.approx(
        record_episodes(model.policy, make_env(), 2, SEED).episode_returns
    )
    assert recording.episode_returns[0] > 0
    (run,) = data_of(replay(model, env, tmp_path / "page.html", seed=SEED))["runs"]
    assert unpacked(run["rewards"]).sum() == pytest.approx(sum(step >= 0 for step in run["collected"]))


def test_each_model_has_its_own_discount(model: PPO, tmp_path: Path) -> None:
    discounts = {"short": 0.5, "long": 1.0}
    page = replay(
        dict.fromkeys(discounts, model.policy), make_env(), tmp_path / "page.html", seed=SEED, gamma=discounts
    )
    for run, discount in zip(data_of(page)["runs"], discounts.values(), strict=True):
        recording = record_episodes(model.policy, make_env(), 2, SEED, gamma=discount)
        np.testing.assert_allclose(unpacked(run["returns"]), recording.returns[:, :3], atol=1e-5)


def of(array: Any) -> Any:
    assert array is not None
    return array


def test_the_grid_is_that_of_the_game(model: PPO, tmp_path: Path) -> None:
    data = data_of(replay(model, make_env("KeyForTreasure", n_keys=3), tmp_path / "page.html", seed=SEED))
    env = make_env("KeyForTreasure", n_keys=3)
    env.seed(SEED)
    obs = env.reset()
    run, pose = data["runs"][0], unpacked(data["runs"][0]["pose"])
    for step, actions in enumerate(unpacked(run["actions"])):
        state = env.env_method("get_state", indices=[0])[0]
        assert pose[step, :, :2].tolist() == state["agent_pos"].tolist()
        assert len(run["keys"][step]) == state["keys"].sum()
        obs, *_ = env.step(np.concatenate([actions, np.zeros(3, dtype=int)]).astype(int))
    assert obs is not None and len(pose) == run["steps"] + 1
    assert data["grid"]["zones"] == [0, 0, 0, 0, 0, 1, 1, 1, 1]


def test_each_game_has_its_walls(model: PPO, tmp_path: Path) -> None:
    runs = data_of(replay(model, make_env(), tmp_path / "page.html", seed=SEED, episodes=2))["runs"]
    env = make_env()
    env.seed(SEED)
    env.reset()
    walls = [np.argwhere(state["walls"]).tolist() for state in env.env_method("get_state", indices=[0, 3])]
    assert [sorted(run["walls"]) for run in runs] == walls and walls[0] != walls[1]


class Lane(Game):
    """Agents move on a line; actions count from 1, and the second agent has ended after two steps."""

    action_names = ("left", "stay", "right")

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return spaces.Discrete(3, start=1)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.x = {"a": 4, "b": 5}
        return super().reset(seed, options)

    def change(self, out: list[Any]) -> None:
        for agent, action in self.actions.items():
            self.x[agent] += action - 2
        if self.t >= 2:
            out[2]["b"], self.agents = True, ["a"]

    def replica(self) -> Lane:
        return Lane()

    def grid_scene(self) -> dict[str, Any]:
        poses = [[self.x[agent], 0, 0, 0] for agent in self.possible_agents]
        return {"width": 9, "height": 1, "zones": [0] * 9, "walls": [], "keys": [], "treasures": [], "agents": poses}


def test_a_grid_of_ones_own_is_played_again_with_the_games_actions(tmp_path: Path) -> None:
    env = sb3_saf.make_team_env(Lane, 1, seed=0)
    model = PPO("IPPOPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env))
    (run,) = data_of(replay(model, env, tmp_path / "page.html", seed=SEED))["runs"]
    moves = unpacked(run["actions"]).astype(int) - 1
    moves[2:, 1] = 0
    assert np.diff(unpacked(run["pose"])[:, :, 0], axis=0).tolist() == moves.tolist() != np.zeros((4, 2)).tolist()


@pytest.mark.parametrize("policy", ["MAPPOPolicy", "QPLEXPoolPolicy"])
def test_methods_without_parts(policy: str, tmp_path: Path) -> None:
    env = make_env()
    algorithm: Any = sb3_saf.QPLEX if policy.startswith("QPLEX") else PPO
    other = algorithm(policy, env, seed=0, device="cpu")
    (run,) = data_of(replay(other, make_env(), tmp_path / "page.html"))["runs"]
    assert ("weights" in run) == ("Pool" in policy) and "read" not in run
    assert run["of_team"] == policy.startswith("QPLEX") and "values" in run


def test_names_are_text(model: PPO, tmp_path: Path) -> None:
    page = replay({"model": model, "<b>other</b>": model}, make_env(), tmp_path / "page.html")
    first, second = data_of(page)["runs"]
    assert (first["name"], second["name"]) == ("model", "<b>other</b>") and second["actions"] == first["actions"]
    assert "<b>other" not in page.read_text()


def test_other_games_are_shown_by_their_pictures_and_names(tmp_path: Path) -> None:
    env = sb3_saf.make_team_env(CounterEnv, n_envs=1, seed=0, render_mode="rgb_array")
    other = PPO("MAPPOPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env))
    data = data_of(replay(other, env, tmp_path / "page.html"))
    (run,) = data["runs"]
    assert data["agents"] == CounterEnv().possible_agents
    assert len(run["frames"]) == run["steps"] and run["frames"][0].startswith("data:image/png;base64,")


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([np.zeros((4, 4), np.uint8)] * 99, r"\(height, width, 3\), .* got uint8 of shape \(4, 4\)"),
        ([None] * 99, r"\(height, width, 3\), .* got None"),
        ([None], "before each of 3 steps, got 2"),
    ],
)
def test_games_that_draw_no_pictures_are_refused(frames: list[Any], message: str, tmp_path: Path) -> None:
    given = iter(frames)

    class Drawn(CounterEnv):
        def render(self) -> Any:
            return next(given, np.zeros((4, 4, 4), np.uint8))  # transparent, too

    env = sb3_saf.make_team_env(Drawn, n_envs=1, seed=0, render_mode="rgb_array")
    other = PPO("MAPPOPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env))
    with pytest.raises(ValueError, match=f"expected .*{message}"):
        replay(other, env, tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


def test_all_of_many_actions_are_shown(tmp_path: Path) -> None:
    class Many(CounterEnv):
        def action_space(self, agent: str) -> Any:
            return spaces.Discrete(400)

    env = sb3_saf.make_team_env(Many, n_envs=1, seed=0, render_mode="rgb_array")
    other = PPO("MAPPOPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env))
    (run,) = data_of(replay(other, env, tmp_path / "page.html", deterministic=False, seed=1))["runs"]
    expected = record_episodes(other.policy, env, 1, deterministic=False, seed=1).actions
    assert unpacked(run["actions"]).tolist() == expected[: run["steps"]].tolist() and expected.max() > 255


def test_long_episodes_are_cut(model: PPO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_module, "MAX_STEPS", 5)
    data = data_of(replay(model, make_env(), tmp_path / "page.html"))
    assert data["runs"][0]["steps"] == 5 and data["note"] == "Cut after 5 game steps."


def test_bad_input(model: PPO, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"at least episodes=3 games, got 2; make it with make_team_env"):
        replay(model, make_env(), tmp_path / "page.html", episodes=3)
    with pytest.raises(ValueError, match=r"on which team was trained, .*shape \(7, 7\).*got .*shape \(5, 5\)"):
        replay(model, make_env(view_size=5), tmp_path / "page.html")
    with pytest.raises(ValueError, match=r"and 3 agents, got .* and 2 agents"):
        replay(model, make_env(n_agents=2), tmp_path / "page.html")
    env = sb3_saf.make_team_env(CounterEnv, n_envs=1)
    other = PPO("MAPPOPolicy", env, **sb3_saf.ppo_settings(env))
    with pytest.raises(ValueError, match="neither a grid nor render_mode='rgb_array'"):
        replay(other, env, tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium drives the browser")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("chromium and chromedriver are not installed (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1200,900"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield started
    started.quit()


def numbers_in(browser: Any, table: str) -> list[float]:
    cells = browser.find_elements("css selector", f"#{table} td[data-number]")
    return [float(cell.get_attribute("data-number")) for cell in cells]


def test_the_page_in_a_browser(browser: Any, model: PPO, tmp_path: Path) -> None:
    recording: EpisodeRecording = record_episodes(model.policy, make_env(), 2, SEED, gamma=model.gamma)
    browser.get(replay({"a": model, "b": model}, make_env(), tmp_path / "page.html", seed=SEED).as_uri())
    body = browser.find_element("tag name", "body")
    for _ in range(4):
        body.send_keys("\ue014")  # right arrow
    browser.find_element("css selector", "button[data-agent='2']").click()
    assert browser.find_element("id", "clock").text == f"step 4 of {LEVEL['max_cycles']}"
    row = 2
    for table, expected in (
        ("actions", of(recording.action_probabilities)[4, row]),
        ("weights", of(recording.pool_weights)[4, row]),
        ("slots", of(recording.read_attention)[4, 0, row]),
    ):
        np.testing.assert_allclose(numbers_in(browser, table), expected, atol=1e-4, err_msg=table)
    shown = {name: browser.find_element("id", name) for name in ("value-number", "return-number", "strength")}
    value, zeroed = recording.values[4, row], recording.values_without["zero"][4, row]
    for name, number in (
        ("value-number", value),
        ("return-number", recording.returns[4, row]),
        ("strength", zeroed - value),
    ):
        assert float(shown[name].get_attribute("data-number")) == pytest.approx(number, abs=1e-5)
    change = (recording.values_without["zero"] - recording.values)[4, :3].mean()
    assert f"without messages the mean value changes by {change:.3f}" in browser.find_element("id", "team-value").text
    score = recording.rewards[:4, :3].sum()
    assert browser.find_element("id", "score-1").text.startswith(f"b: return {score:.2f}, {round(score)} of 12")
    browser.find_element("id", "play").click()
    assert browser.find_element("id", "play").text == "Pause"
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_means_are_of_the_agents_that_are_in_the_game(browser: Any, tmp_path: Path) -> None:
    env = sb3_saf.make_team_env(CounterEnv, n_envs=1, seed=0, render_mode="rgb_array", deaths={1: 1})
    other = PPO("IPPOPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env))
    page = replay(other, env, tmp_path / "page.html", seed=SEED)
    recording = record_episodes(other.policy, env, 1, SEED)
    assert unpacked(data_of(page)["runs"][0]["counted"]).tolist() == [[1, 1], [1, 0], [1, 0]]
    browser.get(page.as_uri())
    browser.find_element("tag name", "body").send_keys("\ue014")
    assert recording.values[1, 0] != recording.values[1, 1]
    assert f"Mean value {recording.values[1, 0]:.2f}," in browser.find_element("id", "team-value").text
    browser.find_element("tag name", "body").send_keys("\ue014\ue014")
    assert browser.find_element("id", "clock").text == "step 3 of 3", "the last reward is shown, with the last picture"


def test_returns_have_the_scale_of_values_that_were_learned_with_normalize(tmp_path: Path) -> None:
    words = "--algo mappo --env TeamSupport-v0 --size smoke --seed 0 --eval-freq -1 --verbose 0 -params normalize:true"
    train(["-f", str(tmp_path), *words.split()])
    model = tmp_path / "mappo" / "TeamSupport-v0_1" / "TeamSupport-v0.zip"
    command.main(["--model", str(model), "-o", str(tmp_path / "page.html")])
    data, expected = data_of(tmp_path / "page.html"), 0.0
    (run,) = data["runs"]
    for reward in unpacked(run["rewards"])[::-1] / data["n_agents"]:  # an agent's share
        expected = reward + 0.99 * expected
    assert expected > 0
    with np.load(model.with_suffix(".vecnormalize.npz")) as statistics:
        expected /= float(statistics["returns var"]) ** 0.5
    assert unpacked(run["returns"])[0, 0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--model", "nowhere.zip"], "--model nowhere.zip is not there"),
        (["--model", __file__, "--size", "huge"], "unknown size 'huge'"),
        (["--model", __file__], "does not hold the tensors of a saved model"),
    ],
)
def test_wrong_commands(given: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in failed(given, capsys, command.main)
