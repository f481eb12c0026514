"""Settings by name: the paper's numbers, all entries constructed, and refused ones."""

from __future__ import annotations

import inspect
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from hecogrid_envs.params import HECOGridParams
from sb3_saf import LightEncoder, TeamRolloutBuffer, game_seeds
from sb3_saf.suites.registry import suites
from sb3_saf.teams.checks import MAX_SEED, evaluation_seed
from sb3_saf.training.settings import ALGOS, load_settings, saved_settings
from sb3_saf.training.yaml_files import SIZES, Size, config_names, load_yaml, read_settings

ENV = "TeamTogether-v0"
ENV_IDS = suites()["hecogrid"].tasks


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("algo", ALGOS)
def test_every_entry_builds_and_smoke_learns_one_rollout(algo: str, size: Size) -> None:
    """Each with one of the tasks in turn: the entries are the same for all of them."""
    env_id = ENV_IDS[(list(ALGOS).index(algo) + SIZES.index(size)) % len(ENV_IDS)]
    settings = load_settings(algo, env_id, size)
    env = settings.make_env(0)
    model = settings.make_model(env, 0, device="cpu")
    assert (env.num_envs, env.n_agents) == (settings.n_envs * settings.n_agents, settings.n_agents)
    assert type(model) is ALGOS[algo].algorithm
    assert type(model.policy) is ALGOS[algo].policy_class
    if size == "smoke":
        before = [parameter.clone() for parameter in model.policy.parameters()]
        model.learn(getattr(model, "rollout_steps", 1) * env.num_envs)  # a rollout; off-policy one of one step
        assert any(not old.equal(new) for old, new in zip(before, model.policy.parameters(), strict=True))
    env.close()


@pytest.mark.parametrize(
    ("algo", "gae_lambda", "max_grad_norm"), [("saf", 1.0, 9.0), ("mappo", 0.95, 10.0), ("ippo", 0.95, 10.0)]
)
def test_paper_hyperparameters(algo: str, gae_lambda: float, max_grad_norm: float) -> None:
    settings = load_settings(algo, ENV, "paper")
    assert (settings.n_envs, settings.game_steps, settings.total_timesteps) == (128, 10_000_000, 100_000_000)
    assert asdict(HECOGridParams(observation="tiles")) == settings.env_kwargs
    assert settings.time_limit == "terminal"
    # The model's constructors get exactly these; the rest are their defaults, which are the paper's.
    arguments = {**_defaults(PPO), **settings.hyperparams}
    table: dict[str, Any] = {
        "learning_rate": 7e-4,
        "n_steps": 50,
        "n_epochs": 10,
        "batch_size": 128 * 50 * 10,
        "gamma": 0.99,
    }
    # The paper clips values by the larger of two losses, SB3 by one of them, with which values diverge.
    table |= {"gae_lambda": gae_lambda, "clip_range": 0.2, "clip_range_vf": None, "normalize_advantage": True}
    table |= {"ent_coef": 0.01, "vf_coef": 0.25, "max_grad_norm": max_grad_norm, "target_kl": None}
    assert {key: arguments[key] for key in table} == table
    assert arguments["rollout_buffer_class"] is TeamRolloutBuffer


def test_advantages_that_are_not_normalised_are_not_by_the_buffer_either(tmp_path: Path) -> None:
    config, ends = tmp_path / "own.yml", {"rollout_buffer_kwargs": {"ends": "team"}}
    kwargs = "{ends: team, normalize_advantage: agent}"
    config.write_text(f"base: mappo\ndefault: {{normalize_advantage: false, rollout_buffer_kwargs: {kwargs}}}")
    cases: list[tuple[Path | None, dict[str, Any], dict[str, Any] | None]] = [
        (None, {}, {"normalize_advantage": "agent"}),
        (None, {"normalize_advantage": False}, None),
        (None, {"normalize_advantage": False} | ends, {"ends": "team"}),
        (config, {}, {"ends": "team"}),
        (config, {"normalize_advantage": True}, {"ends": "team", "normalize_advantage": "agent"}),
    ]
    for file, given, expected in cases:
        settings = load_settings("mappo", ENV, "small", overrides=given, config=file)
        assert settings.hyperparams.get("rollout_buffer_kwargs") == expected


def test_paper_optimizer() -> None:
    settings = load_settings("saf", ENV, "paper", overrides={"n_envs": 1, "n_steps": 2})
    group = settings.make_model(settings.make_env(0), 0, device="cpu").policy.optimizer.param_groups[0]
    assert (group["lr"], group["eps"], group["weight_decay"]) == (7e-4, 1e-5, 0)


def _defaults(algorithm: type) -> dict[str, Any]:
    parameters = inspect.signature(algorithm).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters}


@pytest.mark.parametrize("config", [name for name in config_names() if name != "levels"])
def test_files_have_only_what_differs(config: str) -> None:
    content = read_settings(config)
    assert {key for key in content if "/" not in key} <= {"default", "hecogrid", *ENV_IDS, *suites()}
    algorithm = next((spec.algorithm for spec in ALGOS.values() if spec.config == config), PPO)
    defaults = _defaults(algorithm)
    repeated = {key for key, value in content["default"].items() if key in defaults and value == defaults[key]}
    assert repeated == set()


def test_sizes_are_those_of_the_experiments() -> None:
    small, smoke = (load_settings("saf", ENV, size) for size in ("small", "smoke"))
    level = {key: small.env_kwargs[key] for key in ("n_agents", "grid_size", "n_treasures", "n_keys")}
    assert level == {"n_agents": 5, "grid_size": 15, "n_treasures": 25, "n_keys": 8}
    assert small.game_steps == 1_000_000
    assert small.hyperparams["policy_kwargs"]["features_extractor_class"] is LightEncoder
    assert smoke.game_steps <= 1000


@pytest.mark.parametrize("size", ["smoke", "small"])
def test_ablations_are_arguments_of_saf(size: Size) -> None:
    saf, no_pool, no_ks = (load_settings(algo, ENV, size) for algo in ("saf", "saf-no-pool", "saf-no-ks"))
    assert no_pool.hyperparams["policy_kwargs"] == {**saf.hyperparams["policy_kwargs"], "n_policies": 1}
    assert no_ks.hyperparams["policy_kwargs"] == {**saf.hyperparams["policy_kwargs"], "knowledge_source": False}
    without = [{**s.as_dict()["hyperparams"], "policy_kwargs": None} for s in (saf, no_pool, no_ks)]
    assert without[0] == without[1] == without[2]


def test_what_is_given_wins_and_policy_kwargs_are_merged() -> None:
    overrides = {"learning_rate": "lin_7e-4", "n_envs": 8, "n_epochs": "3", "policy_kwargs": {"n_slots": 8}}
    settings = load_settings("saf", ENV, "small", {"coordination": 2, "n_agents": 4}, overrides)
    assert settings.n_envs == 8
    assert settings.hyperparams["n_epochs"] == 3
    assert settings.hyperparams["batch_size"] == 8 * 4 * 10 // 2  # still halves of a rollout
    schedule = settings.hyperparams["learning_rate"]
    assert isinstance(schedule, LinearSchedule)
    assert schedule(0.5) == pytest.approx(3.5e-4)
    of_the_size = load_settings("saf", ENV, "small").hyperparams["policy_kwargs"]
    assert of_the_size["features_extractor_class"] is LightEncoder
    assert settings.hyperparams["policy_kwargs"] == {**of_the_size, "n_slots": 8}
    assert (settings.env_kwargs["coordination"], settings.env_kwargs["grid_size"]) == (2, 15)
    other = load_settings("saf", ENV, "smoke", overrides={"batch_size": 500, "time_limit": "bootstrap"})
    assert other.hyperparams["batch_size"] == 500 and other.make_env(0).time_limit == "bootstrap"


def test_numbers_with_exponents_are_no_text() -> None:
    assert load_yaml("[1e-3, -2.E4, .5e+1, lin_1e-3, '1e-3', 1e]", "x") == [0.001, -2e4, 5.0, "lin_1e-3", "1e-3", "1e"]


@pytest.mark.parametrize("algorithm", ["A2C", "TRPO"])
def test_another_algorithm_takes_the_settings_that_it_has(algorithm: str) -> None:
    settings = load_settings("saf", ENV, "small", overrides={"algorithm": algorithm, "n_envs": 2})
    with closing(settings.make_env(0)) as env:
        model = settings.make_model(env, 0, device="cpu")
        model.learn(model.n_envs)
    assert type(model).__name__ == algorithm
    assert (model.gamma, model.gae_lambda, model.n_steps) == (0.9, 0.9, 10)  # type: ignore[attr-defined]
    if algorithm == "A2C":  # its own settings, also when they are read again
        own = load_settings("saf", ENV, "small", overrides={"algorithm": algorithm, "use_rms_prop": False})
        assert saved_settings(own.as_dict()).hyperparams["use_rms_prop"] is False
    with pytest.raises(ValueError, match=f"unknown setting of {algorithm} 'clip_range'"):
        load_settings("saf", ENV, "small", overrides={"algorithm": algorithm, "clip_range": 0.1})


def test_minibatches_are_whole_teams() -> None:
    settings = load_settings("saf", ENV, "smoke", {"n_agents": 3}, {"n_envs": 3, "n_minibatches": 4})
    assert settings.hyperparams["batch_size"] == 8 * 3  # 30 teams in 4 parts
    with pytest.warns(UserWarning, match="truncated mini-batch of size 18"):  # SB3 warns, and the buffer accepts it
        model = settings.make_model(settings.make_env(0), 0)
    model.learn(1)


def test_layers_of_a_file(tmp_path: Path) -> None:
    text = """
        default: {n_envs: 2, n_steps: 10, batch_size: 40, gamma: 0.9, ent_coef: 0.1, sizes: {smoke: {ent_coef: 0.2}}}
        TeamTogether-v0: {gamma: 0.8, ent_coef: 0.3}
        TeamSupport-v0: {sizes: {smoke: {ent_coef: 0.4}}}
    """
    (tmp_path / "own.yml").write_text(text, encoding="utf-8")

    def found(env_id: str, size: Size) -> tuple[float, float]:
        hyperparams = load_settings("ippo", env_id, size, config=tmp_path / "own.yml").hyperparams
        return hyperparams["gamma"], hyperparams["ent_coef"]

    assert found("TeamTogether-v0", "small") == (0.8, 0.3)
    assert found("TeamTogether-v0", "smoke") == (0.8, 0.2)  # sizes are the most specific
    assert found("TeamSupport-v0", "smoke") == (0.9, 0.4)
    assert found("KeyForTreasure-v0", "smoke") == (0.9, 0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algo": "sfa"}, "did you mean 'saf'"),
        ({"env_kwargs": {"coordinaton": 2}}, "did you mean 'coordination'"),
        ({"overrides": {"learning_rat": 1}}, "did you mean 'learning_rate'"),
        ({"overrides": {"seed": 1}}, "'seed'"),  # set per run
        ({"overrides": {"algo": "MaskablePPO"}}, "'algo'"),  # the method; its algorithm has another name
        ({"overrides": {"n_timesteps": 1, "game_steps": 1}}, "say the same thing"),
        ({"overrides": {"normalize": "yes"}}, "normalize='yes'"),
        ({"overrides": {"policy": "MlpPolicy"}}, "--algo"),
        ({"overrides": {"learning_rate": "fast"}}, "learning_rate='fast': .*lin_7e-4"),
        ({"overrides": {"gamma": 50}}, "gamma=50"),
        ({"overrides": {"n_envs": 0}}, "n_envs=0"),
        ({"overrides": {"time_limit": "end"}}, "time_limit='end'"),
        ({"overrides": {"policy_kwargs": "dict(n_slots=8)"}}, "policy_kwargs='dict"),
        ({"overrides": {"policy_kwargs": {"n_policys": 2}}}, "did you mean 'n_policies'"),
        ({"overrides": {"policy_kwargs": {"activation_fn": "nn.Tanh"}}}, "unknown activation_fn"),
        ({"overrides": {"rollout_buffer_class": "os.system"}}, "unknown rollout_buffer_class"),
        ({"algo": "saf-no-pool", "overrides": {"policy_kwargs": {"n_policies": 4}}}, "n_policies is fixed to 1"),
        ({"config": Path("nowhere.yml")}, "nowhere.yml"),
        (
            {"env_id": "tests.toy_envs:CounterEnv", "env_kwargs": {"active": False}},
            r"\['active'\] of env_kwargs are arg",
        ),
    ],
)
def test_mistakes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_settings(**{"algo": "saf", "env_id": ENV, "size": "paper", **change})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default: {n_envs: 2", "not valid YAML"),
        ("- 1", "must map 'default'"),
        ("default: {n_envs: 2, n_envs: 3}", "'n_envs' is there twice"),
        ("default: {sizes: {tiny: {}}}", "unknown size 'tiny'"),
        ("TeamTogeter-v0: {}", "did you mean 'TeamTogether-v0'"),
        ("hecogrid/TeamTogether-v0: {}", "did you mean 'TeamTogether-v0'"),
        ("base: sfa", "did you mean 'saf'"),
        ("default: {n_envs: !!bool many}", "not valid YAML"),
        ("default: {n_envs: !!python/object/apply:os.getcwd []}", "not valid YAML"),
    ],
)
def test_bad_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "bad.yml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as error:
        load_settings("saf", ENV, config=tmp_path / "bad.yml")
    assert "bad.yml" in str(error.value)


def test_a_file_refines_another(tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text("base: mappo\ndefault: {sizes: {small: {n_epochs: 7}}}", encoding="utf-8")
    base, own = (load_settings("mappo", ENV, config=config).as_dict() for config in (None, tmp_path / "own.yml"))
    assert own["hyperparams"].pop("n_epochs") == 7 and base["hyperparams"].pop("n_epochs") == 4
    assert own == base


def test_the_later_of_batch_size_and_n_minibatches_counts(tmp_path: Path) -> None:
    config = tmp_path / "own.yml"
    config.write_text("base: mappo\ndefault: {sizes: {small: {batch_size: 500}}}", encoding="utf-8")
    for given, expected in (({}, 500), ({"n_minibatches": 4}, 1000), ({"batch_size": 250}, 250)):
        assert load_settings("mappo", ENV, overrides=given, config=config).hyperparams["batch_size"] == expected
    config.write_text("default: {n_envs: 4, n_steps: 10, batch_size: 20, n_minibatches: 2}", encoding="utf-8")
    both = "batch_size and n_minibatches say the same thing"
    with pytest.raises(ValueError, match=rf"own\.yml: the entry 'default': {both}"):
        load_settings("mappo", ENV, config=config)
    with pytest.raises(ValueError, match=both):
        load_settings("mappo", ENV, overrides={"batch_size": 500, "n_minibatches": 2})
    with pytest.raises(ValueError, match="n_minibatches divides rollouts of n_steps; A2C has no parts of them"):
        load_settings("mappo", ENV, overrides={"algorithm": "A2C", "n_minibatches": 2})


def test_maskable_ppo_takes_no_normalised_values_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text("base: mappo\ndefault: {policy_kwargs: {normalize_values: true}}")
    settings = load_settings("mappo", ENV, overrides={"algorithm": "MaskablePPO"}, config=tmp_path / "own.yml")
    assert "normalize_values" not in settings.hyperparams["policy_kwargs"]


def test_names_of_rl_zoo3_in_files(tmp_path: Path) -> None:
    text = "default: {n_timesteps: 1e5, policy: SAFPolicy, n_envs: 2, n_steps: 10, batch_size: 20}"
    (tmp_path / "own.yml").write_text(text, encoding="utf-8")
    assert load_settings("saf", ENV, config=tmp_path / "own.yml").game_steps == 100_000
    with pytest.raises(ValueError, match="policy='SAFPolicy' is not a setting"):
        load_settings("mappo", ENV, config=tmp_path / "own.yml")


def test_settings_survive_a_file() -> None:
    overrides = {"learning_rate": "lin_7e-4", "policy_kwargs": {"n_slots": 8, "activation_fn": "relu"}}
    settings = load_settings("saf", ENV, "small", {"coordination": 2}, overrides)
    again = saved_settings(yaml.safe_load(yaml.safe_dump(settings.as_dict())))
    assert again.as_dict() == settings.as_dict()
    assert again.hyperparams["policy_kwargs"] == settings.hyperparams["policy_kwargs"]
    assert saved_settings(settings.as_dict(), {"coordination": 3}).env_kwargs["coordination"] == 3
    with pytest.raises(ValueError, match="hyperparams is missing"):
        saved_settings({key: value for key, value in settings.as_dict().items() if key != "hyperparams"})


def test_no_run_has_the_seed_of_an_evaluation() -> None:
    seeds = [0, 1, 12345, MAX_SEED]
    training = {game for seed in seeds for game in game_seeds(seed, 64)}
    assert all(training.isdisjoint(game_seeds(evaluation_seed(seed), 64)) for seed in seeds)
    assert len({evaluation_seed(seed) for seed in range(100)}) == 100
    for bad in (-1, MAX_SEED + 1, True, 0.5):
        with pytest.raises(ValueError, match="seed must be a whole number"):
            evaluation_seed(bad)  # type: ignore[arg-type]


def test_normalize_without_arguments_normalises() -> None:
    values: tuple[Any, ...] = (True, {})
    for value in values:
        settings = load_settings("saf", "TeamTogether-v0", "smoke", overrides={"normalize": value})
        assert unwrap_vec_normalize(settings.make_env(0)) is not None
    with pytest.raises(ValueError, match="normalize is for"):
        load_settings("qplex", "TeamTogether-v0", "smoke", overrides={"normalize": {}})
