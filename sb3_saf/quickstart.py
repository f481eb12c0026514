"""
``make train``: SAF on a HECOGrid task, from nothing to a model, a learning curve and a GIF in minutes on a laptop.

Everything here is what a user would write: ``make_team_env``, stock ``PPO("SAFPolicy", ...)``, ``evaluate_team``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3 import PPO

import hecogrid_envs
from hecogrid_envs import TASK_NAMES
from hecogrid_envs.task import check_task
from sb3_saf import EvaluationResult, LightEncoder, RandomPolicy, TeamRolloutBuffer, evaluate_team, make_team_env

#: The ``small`` size of the experiments: 5 agents, grid 15, 25 treasures.
SMALL: dict[str, Any] = {"n_agents": 5, "grid_size": 15, "n_treasures": 25, "n_keys": 8}

#: What differs from the constructors of PPO and SAFPolicy. One rollout is one episode of every game.
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 50,
    "batch_size": 2_000,
    "n_epochs": 4,
    "learning_rate": 7e-4,
    "gae_lambda": 0.9,
    "ent_coef": 0.01,
    "max_grad_norm": 9.0,
    "rollout_buffer_class": TeamRolloutBuffer,
    "policy_kwargs": {"features_extractor_class": LightEncoder},
}
N_GAMES = 16
#: Evaluation games are seeded apart from training's.
EVALUATION_SEED = 10_000
N_EPISODES = 64


class Options(NamedTuple):
    """What the command line chooses."""

    task: str
    coordination: int
    heterogeneity: int
    game_steps: int
    seed: int
    output: Path
    progress_bar: bool

    @property
    def level(self) -> dict[str, Any]:
        """Parameters of the task."""
        return {**SMALL, "coordination": self.coordination, "heterogeneity": self.heterogeneity}


def parse(arguments: list[str] | None = None) -> Options:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m sb3_saf.quickstart", description=__doc__.strip().splitlines()[0])
    parser.add_argument("--task", choices=TASK_NAMES, default="TeamSupport")
    parser.add_argument("--coordination", type=int, default=2, help="agents that one treasure needs")
    parser.add_argument("--heterogeneity", type=int, default=1, help="zones with different dynamics")
    parser.add_argument("--game-steps", type=int, default=100_000, help="steps of the game, not of its agents")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/quickstart"))
    parser.add_argument("--no-progress-bar", dest="progress_bar", action="store_false")
    options = Options(**vars(parser.parse_args(arguments)))
    try:
        hecogrid_envs.HECOGridParams(**options.level).check_fits(check_task(options.task))
    except ValueError as error:
        parser.error(str(error))
    return options


def train(options: Options) -> PPO:
    """Train, leaving TensorBoard logs, ``monitor.csv`` and the model in the output folder."""
    env = make_team_env(
        options.task, n_envs=N_GAMES, seed=options.seed, monitor_dir=str(options.output), **options.level
    )
    model = PPO("SAFPolicy", env, seed=options.seed, tensorboard_log=str(options.output / "tb"), **PPO_SETTINGS)
    # SB3 counts every agent's step.
    model.learn(options.game_steps * env.n_agents, tb_log_name="saf", progress_bar=options.progress_bar)
    model.save(options.output / "model.zip")
    env.close()
    return model


def evaluate(options: Options, model: Any) -> EvaluationResult:
    """Team returns over games that were not trained on, the same for every model."""
    env = make_team_env(options.task, n_envs=N_EPISODES, seed=EVALUATION_SEED + options.seed, **options.level)
    result = evaluate_team(model, env, n_eval_episodes=N_EPISODES, deterministic=False)
    env.close()
    return result


def draw_curve(options: Options, random: EvaluationResult) -> Path:
    """Plot the team return of the training episodes against game steps."""
    from matplotlib.figure import Figure

    episodes = np.genfromtxt(options.output / "monitor.csv", delimiter=",", skip_header=1, names=True)
    game_steps, returns = np.cumsum(episodes["l"]), episodes["r"]
    figure = Figure(figsize=(7, 4), dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.plot(game_steps, returns, color="tab:blue", alpha=0.12, linewidth=0.5)
    window = max(1, min(N_GAMES * 5, len(returns) // 10))
    smooth = np.convolve(returns, np.ones(window) / window, mode="valid")
    axes.plot(game_steps[window - 1 :], smooth, color="tab:blue", label=f"SAF (mean of {window} episodes)")
    axes.axhline(random.mean, color="tab:grey", linestyle="--", label="random team")
    axes.set(
        xlabel="game steps",
        ylabel="team return (treasures)",
        title=f"{options.task}, coordination {options.coordination}, heterogeneity {options.heterogeneity}",
    )
    axes.legend(loc="upper left")
    path = options.output / "learning_curve.png"
    figure.savefig(path)
    return path


def record_episode(options: Options, model: PPO) -> Path:
    """Play one game, each agent seeing its own observation only, and keep it as a GIF."""
    import imageio.v3 as imageio

    env = hecogrid_envs.parallel_env(options.task, render_mode="rgb_array", observation="tiles", **options.level)
    observations, _ = env.reset(seed=EVALUATION_SEED + options.seed)
    frames = [env.render()]
    while env.agents:
        actions, _ = model.predict(np.stack(list(observations.values())), deterministic=False)
        observations, *_ = env.step(dict(zip(env.agents, actions.tolist(), strict=True)))
        frames.append(env.render())
    path = options.output / "episode.gif"
    imageio.imwrite(path, np.stack(frames), duration=125, loop=0)  # type: ignore[arg-type]
    return path


def main(arguments: list[str] | None = None) -> None:
    """Train, compare with a random team, and say where everything is."""
    options = parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    print(f"Training SAF on {options.task} {options.level} for {options.game_steps:,} game steps")
    model = train(options)
    trained = evaluate(options, model)
    random = evaluate(options, RandomPolicy(model.action_space, seed=options.seed))
    curve, gif = draw_curve(options, random), record_episode(options, model)
    print(f"\nTeam return (treasures collected), {N_EPISODES} fresh games, mean and 95 % interval")
    print(f"  SAF     {trained}")
    print(f"  random  {random}")
    print(f"\nmodel           {options.output / 'model.zip'}")
    print(f"learning curve  {curve}")
    print(f"episode         {gif}")
    print(f"TensorBoard     tensorboard --logdir {options.output / 'tb'}")


if __name__ == "__main__":
    main()
