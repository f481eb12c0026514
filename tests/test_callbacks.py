"""Training is watched: NaN and infinity, training games in evaluation, the schedule of the entropy bonus."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

import sb3_saf
from sb3_saf import (
    QPLEX,
    CentralizedValueWrapper,
    EntropySchedule,
    FiniteCallback,
    NonFiniteError,
    TeamEvalCallback,
    TeamReplayBuffer,
    resumable_learn,
)
from tests.team_venv import TeamVenv
from tests.toy_envs import CounterEnv
from tests.weights import weights_of

N_AGENTS, N_GAMES, N_STEPS = 2, 3, 4
ROLLOUT = N_AGENTS * N_GAMES * N_STEPS
TASK: dict[str, Any] = {"n_agents": N_AGENTS, "grid_size": 7, "n_treasures": 3, "coordination": 1, "max_cycles": 10}
LIGHT: dict[str, Any] = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [8]}


def games(seed: int = 0) -> CentralizedValueWrapper:
    return sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=seed, **TASK)


def spoiled(what: str, value: float, step: int) -> CentralizedValueWrapper:
    """Games in which agent 1 of game 1 sees, or is paid, an invalid value from a step on."""

    def is_bad(which: str, game: int, agent: int, now: int) -> bool:
        return which == what and (game, agent) == (1, 1) and now >= step

    def see(game: int, agent: int, episode: int, now: int) -> np.ndarray:
        return np.full(4, value if is_bad("observations", game, agent, now) else agent, dtype=np.float32)

    def pay(game: int, agent: int, now: int) -> float:
        return value if is_bad("rewards", game, agent, now) else 1.0

    return CentralizedValueWrapper(TeamVenv((10,) * N_GAMES, N_AGENTS, see=see, reward=pay))


def ppo(env: VecEnv | None = None, **settings: Any) -> PPO:
    policy = LIGHT if env is None else {"net_arch": [8]}
    defaults = {"n_steps": N_STEPS, "batch_size": ROLLOUT // 2, "n_epochs": 1, "seed": 0, "policy_kwargs": policy}
    buffer = sb3_saf.TeamRolloutBuffer
    return PPO("SAFPolicy", env or games(), rollout_buffer_class=buffer, **{**defaults, **settings})


def undiscounted(model: QPLEX) -> QPLEX:
    """Return the model with a discount that makes its targets NaN."""
    model.gamma = float("nan")
    return model


CAUSES: dict[str, tuple[Any, str]] = {
    "loss": (lambda: ppo(ent_coef=float("nan")), r"the gradient of \S+ must be finite, got nan at game step 12, .*"),
    "reward": (
        lambda: ppo(spoiled("rewards", float("nan"), 6)),
        "rewards must be finite, got nan at step 6 for agent 1 of game 1.*",
    ),
    "observation": (
        lambda: ppo(spoiled("observations", float("-inf"), 7)),
        "observations must be finite, got -inf at step 7 for agent 1 of game 1.*",
    ),
    "returns": (
        lambda: ppo(spoiled("rewards", 3e38, 2)),
        "returns of the rollout must be finite, got inf at game step 12, after 0 steps of the optimizer.*",
    ),
    "values of QPLEX": (
        lambda: undiscounted(QPLEX("QPLEXPolicy", games(), learning_starts=6, batch_size=4, train_freq=6, seed=0)),
        r"the gradient of \S+ must be finite, got nan at game step 12.*",
    ),
}


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize("name", CAUSES)
def test_training_stops_with_step_name_and_last_good_checkpoint_and_good_weights(name: str, tmp_path: Path) -> None:
    make, words = CAUSES[name]
    model = make()
    with pytest.raises(NonFiniteError, match=rf"{words}last good checkpoint is .*checkpoint-\d+\.ckpt"):
        resumable_learn(model, 10 * ROLLOUT, tmp_path, every_game_steps=1)
    assert all(bool(tensor.isfinite().all()) for tensor in model.policy.state_dict().values())


def test_nothing_is_learned_from_bad_losses_and_those_of_before_are_named() -> None:
    model = ppo().learn(ROLLOUT)
    before = weights_of(model)
    model.ent_coef = float("nan")
    with pytest.raises(NonFiniteError, match=r"the gradient of \S+ must be finite, got nan at game step \d+, after 0"):
        model.learn(ROLLOUT, FiniteCallback())
    assert weights_of(model) == before
    with pytest.raises(NonFiniteError, match=r"\(the update before had .*train/value_loss \d.*train/loss -?\d.*\)"):
        ppo().learn(3 * ROLLOUT, [FiniteCallback(), SpoiledLater()])
    bad, fine = spoiled("rewards", float("nan"), 6), spoiled("nothing", 0.0, 0)
    with pytest.raises(NonFiniteError, match=r"^in the evaluation, rewards must be finite, got nan at step 6"):
        ppo(fine).learn(ROLLOUT, TeamEvalCallback(bad, eval_freq=1, n_eval_episodes=3, warn=False))


class SpoiledLater(BaseCallback):
    """Makes the loss NaN after the first update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps > ROLLOUT:
            vars(self.model)["ent_coef"] = float("nan")


def test_one_bad_gradient_is_named_before_clipping_spreads_it() -> None:
    model = ppo()
    assert isinstance(model.policy, sb3_saf.SAFPolicy)
    names = [name for name, _ in model.policy.named_parameters()]
    spoiled = names[len(names) // 2]
    dict(model.policy.named_parameters())[spoiled].register_hook(lambda grad: grad * float("inf"))
    with pytest.raises(NonFiniteError, match=rf"the gradient of {spoiled} must be finite"):
        model.learn(ROLLOUT, FiniteCallback())


def test_weights_and_losses_are_looked_at_after_updates() -> None:
    with pytest.raises(NonFiniteError, match="must be finite"):
        ppo(learning_rate=1e38, max_grad_norm=1e30, policy_kwargs={**LIGHT, "optimizer_class": th.optim.SGD}).learn(
            2 * ROLLOUT, FiniteCallback()
        )
    model = ppo()
    callback = FiniteCallback()
    model.learn(ROLLOUT)
    callback.init_callback(model)
    model.logger.record("train/value_loss", float("inf"))
    with pytest.raises(NonFiniteError, match=r"train/value_loss must be finite, got inf at game step 12"):
        callback.on_rollout_start()


def test_looking_changes_nothing_and_leaves_nothing() -> None:
    model, plain = ppo().learn(3 * ROLLOUT, FiniteCallback()), ppo().learn(3 * ROLLOUT)
    assert weights_of(model) == weights_of(plain)
    assert not model.policy.optimizer._optimizer_step_pre_hooks
    assert not any(parameter._post_accumulate_grad_hooks for parameter in model.policy.parameters())


# --- seeds ------------------------------------------------------------------------------------------------------------


def normalised(seed: int, is_training: bool) -> CentralizedValueWrapper:
    """Games of vectors with one VecNormalize below the joint observation."""
    rows = sb3_saf.make_team_env(CounterEnv, N_GAMES, seed=seed).venv
    return CentralizedValueWrapper(VecNormalize(rows, training=is_training, norm_reward=False, norm_obs_keys=["obs"]))


def test_every_evaluation_has_the_statistics_of_training(tmp_path: Path) -> None:
    games, evaluated, inspected = normalised(0, True), normalised(1, False), normalised(2, False)
    evaluation = sb3_saf.TeamEvalCallback(evaluated, eval_freq=1, n_eval_episodes=2, verbose=0)
    inspection = sb3_saf.InspectionCallback(inspected, 1, 2, pictures=False)
    ppo(games, tensorboard_log=str(tmp_path)).learn(ROLLOUT, [evaluation, inspection])
    means = []
    for env in (games, evaluated, inspected):
        layer: Any = unwrap_vec_normalize(env)
        assert layer.obs_rms["obs"].count > 10
        means.append(layer.obs_rms["obs"].mean.tolist())
    assert means[2] == means[0] != means[1]  # inspected at the end of the training, evaluated before its last steps
    plain = sb3_saf.TeamEvalCallback(sb3_saf.make_team_env(CounterEnv, 2, seed=1), eval_freq=1, verbose=0)
    with pytest.raises(
        ValueError, match="as many VecNormalize in the games of evaluation as in those of training, 1, got 0"
    ):
        ppo(normalised(0, True)).learn(ROLLOUT, plain)
    for other, got in ((plain.eval_env, 0), (normalised(1, False), 1)):  # without, and without its statistics
        with pytest.raises(ValueError, match=rf"by 1 VecNormalize \(1 with statistics\), got {got} \(0\); .*sync"):
            sb3_saf.evaluate_team(ppo(games), other)
    assert len(sb3_saf.evaluate_team(ppo(normalised(3, True)), evaluated, 2).returns) == 2  # a loaded one may have more


class SometimesWon(CounterEnv):
    """Says only of every second episode that it was won; agent 0 is stopped one step before the others."""

    def __init__(self, only_won: bool) -> None:
        super().__init__(n_agents=2, cuts={0: 2})
        self.only_won = only_won

    def step(self, actions: dict[str, Any]) -> Any:
        *results, infos = super().step(actions)
        if self.steps == 3 and (self.episode % 2 or not self.only_won):
            infos["agent_1"]["is_success"] = bool(self.episode % 2)
        if self.steps == 2 and not self.only_won:
            infos["agent_0"]["is_success"] = True
        return (*results, infos)


def test_games_that_tell_only_won_episodes(tmp_path: Path) -> None:
    env, other = (sb3_saf.make_team_env(SometimesWon, 1, seed=seed, only_won=True) for seed in (0, 1))
    evaluation = sb3_saf.TeamEvalCallback(other, eval_freq=12, n_eval_episodes=3, log_path=str(tmp_path), verbose=0)
    with pytest.warns(UserWarning, match="some episodes end with 'is_success' in their infos, others do not"):
        ppo(env, n_steps=12).learn(48, evaluation)
    with np.load(tmp_path / "evaluations.npz") as arrays:
        assert arrays["successes"].shape == arrays["results"].shape
        assert 0 < np.isnan(arrays["successes"]).sum() < arrays["successes"].size


def test_successes_are_those_of_teams_also_where_agents_end_alone() -> None:
    env = sb3_saf.make_team_env(SometimesWon, 1, seed=0, only_won=False, time_limit="bootstrap")
    model = ppo(env, n_steps=12).learn(24)
    assert model.ep_success_buffer is not None and model.ep_info_buffer is not None
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer) == 4
    assert list(model.ep_success_buffer) == [True, False, True, False]


@pytest.mark.parametrize("name", ["TeamEvalCallback", "TeamCheckpointCallback", "EntropySchedule"])
def test_callbacks_that_would_hear_of_steps_only_are_refused(name: str, tmp_path: Path) -> None:
    callback = {
        "TeamEvalCallback": lambda: sb3_saf.TeamEvalCallback(games(1), eval_freq=1, verbose=0),
        "TeamCheckpointCallback": lambda: sb3_saf.TeamCheckpointCallback(tmp_path, every_game_steps=1),
        "EntropySchedule": lambda: sb3_saf.EntropySchedule(0.001),
    }[name]()
    with pytest.raises(ValueError, match=f"{name} must hear of rollouts, which EveryNTimesteps does not pass on"):
        ppo().learn(1, EveryNTimesteps(1, callback))
    ppo().learn(1, callback)


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_evaluation_on_the_games_of_training_is_refused(backend: Any) -> None:
    evaluations = [
        TeamEvalCallback(sb3_saf.make_team_env("TeamTogether", 2, 5, backend, **TASK), warn=False) for _ in range(2)
    ]
    with pytest.raises(ValueError, match=r"got 2 with seeds of training games.*another one"):
        ppo(games(seed=7), seed=5).learn(ROLLOUT, evaluations[0])
    ppo(games(seed=5), seed=7).learn(ROLLOUT, evaluations[1])


# --- the schedule of the entropy bonus --------------------------------------------------------------------------------


class Seen(BaseCallback):
    """Record the coefficients of updates, and those between them, with which a model would be saved."""

    def __init__(self) -> None:
        super().__init__()
        self.coefficients: list[float] = []
        self.saved: set[float] = set()

    def _on_step(self) -> bool:
        self.saved.add(vars(self.model)["ent_coef"])
        return True

    def _on_rollout_end(self) -> None:
        self.coefficients.append(vars(self.model)["ent_coef"])


def learner(algorithm: Any, **settings: Any) -> Any:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 2)))
    return algorithm("IPPOPolicy", env, n_steps=4, device="cpu", seed=0, **settings)


@pytest.mark.parametrize(("algorithm", "settings"), [(PPO, {"batch_size": ROLLOUT, "n_epochs": 1}), (A2C, {})])
def test_updates_use_a_coefficient_that_changes_linearly(
    algorithm: Any, settings: dict[str, Any], tmp_path: Path
) -> None:
    model, seen = learner(algorithm, ent_coef=0.08, **settings), Seen()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * ROLLOUT, [EntropySchedule(end=0.04), seen], log_interval=1)
    assert seen.coefficients == pytest.approx([0.07, 0.06, 0.05, 0.04])
    assert model.ent_coef == 0.08
    assert seen.saved == {0.08}  # a model that is saved during a rollout has its own value
    model.logger.close()
    with (tmp_path / "progress.csv").open() as file:
        logged = [float(row["train/ent_coef"]) for row in csv.DictReader(file)]
    assert logged == pytest.approx([0.08, 0.07, 0.06, 0.05])  # beside the losses of the update before


def test_the_bonus_is_gone_at_the_end_also_of_a_training_that_goes_on() -> None:
    model, seen = learner(PPO, ent_coef=0.01, batch_size=ROLLOUT, n_epochs=1), Seen()
    model.learn(ROLLOUT, [EntropySchedule(), seen])
    model.learn(ROLLOUT, [EntropySchedule(), seen], reset_num_timesteps=False)
    assert seen.coefficients == pytest.approx([0.0, 0.0])
    model.learn(2 * ROLLOUT, [EntropySchedule(), seen])
    assert seen.coefficients[2:] == pytest.approx([0.005, 0.0])


def test_the_coefficient_that_is_logged_first_is_that_of_the_steps_before(tmp_path: Path) -> None:
    """As after a resume, where the model has its first coefficient again."""
    model = learner(PPO, ent_coef=0.09, batch_size=ROLLOUT, n_epochs=1)
    model.learn(2 * ROLLOUT)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(ROLLOUT, EntropySchedule(), log_interval=1, reset_num_timesteps=False)
    model.logger.close()
    with (tmp_path / "progress.csv").open() as file:
        assert [float(row["train/ent_coef"]) for row in csv.DictReader(file)] == pytest.approx([0.03])


def test_what_has_no_entropy_coefficient_is_refused() -> None:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 2)))
    model = QPLEX("QPLEXPolicy", env, replay_buffer_class=TeamReplayBuffer, buffer_size=100, device="cpu")
    with pytest.raises(ValueError, match="of PPO and A2C; QPLEX has none; leave the callback out"):
        model.learn(ROLLOUT, EntropySchedule())
    with pytest.raises(ValueError, match=r"ent_coef is 0\.0 from the start, as end; give the algorithm another"):
        learner(PPO, ent_coef=0.0, batch_size=ROLLOUT).learn(ROLLOUT, EntropySchedule())


@pytest.mark.parametrize("end", [-1, float("nan"), float("inf"), "x", None, True])
def test_the_end_is_a_number(end: Any) -> None:
    with pytest.raises(ValueError, match=f"end must be a number of at least 0, got {end!r}"):
        EntropySchedule(end=end)
