"""
Self-contained web page that plays episodes with each agent's observation and policy outputs.

Letters: T game steps, N agents, A actions, U policies, L slots.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_saf.evaluation import check_trained_on
from sb3_saf.inspection.figures import png
from sb3_saf.inspection.recording import EpisodeRecording, picture, record_episodes
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.files import write_text
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.teams.vec_env import agent_names, layers, require_n_agents

#: Maximum game steps of an episode; longer ones are cut, with a note on the page.
MAX_STEPS: Final = 2000
#: Scale of fractions from 0 to 1 stored as 16-bit integers.
_SHARE: Final = 65535

Player: TypeAlias = "BaseAlgorithm | BasePolicy"
Packed = dict[str, Any]


def replay(
    model: Player | Mapping[str, Player],
    env: VecEnv,
    path: str | Path = "replay.html",
    episodes: int = 1,
    seed: int = 20_000,
    deterministic: bool = False,
    gamma: float | Mapping[str, float] | None = None,
    normalizer: VecNormalize | None = None,
) -> Path:
    """
    Play episodes and write a page that shows them agent by agent, offline and without a server.

    Models of SAF, MAPPO, IPPO and QPLEX are shown with action probabilities, pool, knowledge source and values, as far
    as they have them. HECOGrid is drawn from its state, other games from pictures, one before each step: the last state
    has none, since games begin again at once.

    :param model: a trained model, its policy, or several by name, shown side by side
    :param env: from ``make_team_env``, with at least ``episodes`` games; HECOGrid needs no render mode, others
        ``render_mode="rgb_array"``
    :param path: path of the page
    :param episodes: games to show from their start; a page shows at most 2,000 game steps
    :param seed: seed of games and actions; all models play the same games
    :param deterministic: whether to take the most likely actions
    :param gamma: discount factor of the returns, for all models or by their names; None for the models' own
    :param normalizer: normaliser of the returns beside the values of policies; models have their own
    :return: the path
    :raises ValueError: if a model was trained on other spaces, there are too few games, or they cannot be shown
    """
    n_agents = require_n_agents(env)
    check_count("episodes", episodes)
    if episodes > env.num_envs // n_agents:
        raise ValueError(
            f"expected an environment of at least episodes={episodes} games, got {env.num_envs // n_agents}; make it "
            f"with make_team_env(..., n_envs={episodes})"
        )
    has_grid = env.has_attr("grid_scene") and env.has_attr("replica")
    if not has_grid and env.render_mode != "rgb_array":
        raise ValueError(
            "expected an environment that can be shown, got one with neither a grid nor render_mode='rgb_array'; make "
            "it with make_team_env(..., render_mode='rgb_array')"
        )
    if not has_grid and episodes > 1:
        raise ValueError("expected episodes=1: pictures are recorded of the first game only, as HECOGrid's are not")
    players = model if isinstance(model, Mapping) else {"team": model}
    runs: list[Packed] = []
    grid: Packed | None = None
    atlas = getattr(TeamSpaces.from_observation_space(env.observation_space).own, "atlas", None)
    for name, player in players.items():
        check_trained_on(player, env, name, same_size=True)
        policy = player.policy if isinstance(player, BaseAlgorithm) else player
        given = gamma[name] if isinstance(gamma, Mapping) else gamma
        discount = float(getattr(player, "gamma", 1.0)) if given is None else given
        recording = record_episodes(
            *(policy, env, env.num_envs // n_agents, seed, deterministic),
            gamma=discount,
            normalizer=player.get_vec_normalize_env() if isinstance(player, BaseAlgorithm) else normalizer,
        )
        for game in range(episodes):
            rows = slice(game * n_agents, (game + 1) * n_agents)
            ended = recording.ends[:, rows].all(axis=1)
            steps = slice(0, min(int(np.flatnonzero(ended)[0]) + 1, MAX_STEPS))
            if not has_grid and len(recording.pictures) < steps.stop:
                picture(env.env_method("render", indices=[0])[0])
                raise ValueError(f"expected a picture before each of {steps.stop} steps, got {len(recording.pictures)}")
            frames = [] if has_grid else [base64.b64encode(png(one)).decode() for one in recording.pictures[steps]]
            run: Packed = {
                "name": name if episodes == 1 else f"{name}, game {game + 1}",
                "steps": steps.stop,
                "rewards": _packed(recording.team_rewards[steps, game], "f4"),
                "frames": None if has_grid else [f"data:image/png;base64,{frame}" for frame in frames],
            }
            if has_grid:
                scenes, grid = _played_again(recording.actions[steps, rows], env, game, seed)
                run |= scenes
            run["of_team"] = recording.of_team
            if atlas is not None:
                assert recording.observations is not None
                run["views"] = _packed(recording.observations[steps, rows], "u1")
            runs.append(run | _outputs(recording, game, rows, steps))
    n_actions = int(env.action_space.n) if isinstance(env.action_space, spaces.Discrete) else 0
    names = env.get_attr("action_names", indices=[0])[0] if env.has_attr("action_names") else range(n_actions)
    cut = any(run["steps"] == MAX_STEPS for run in runs)
    note = "Point at an agent, or choose its number." if has_grid else "Choose an agent by button or number key."
    data = {
        "n_agents": n_agents,
        "agents": [str(agent) for agent in range(n_agents)] if has_grid else agent_names(env),
        "grid": grid,
        "tiles": None if atlas is None else _packed(atlas, "u1"),
        "actions": [str(name) for name in names],
        "runs": runs,
        "note": f"Cut after {MAX_STEPS:,} game steps." if cut else note,
    }
    kinds = {type(getattr(player, "policy", player)).__name__.removesuffix("Policy") for player in players.values()}
    folder = files("sb3_saf.inspection")
    page = folder.joinpath("replay.html").read_text(encoding="utf-8")
    for mark, content in (
        ("{{title}}", escape(f"Replay: {', '.join(sorted(kinds))}, {n_agents} agents")),
        ("{{script}}", folder.joinpath("replay.js").read_text(encoding="utf-8")),
        # "<" occurs in strings only: no name can close the element with the data.
        ("{{data}}", json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")),
    ):
        page = page.replace(mark, content)
    write_text(Path(path), page)
    return Path(path)


def _outputs(recording: EpisodeRecording, game: int, rows: slice, steps: slice) -> Packed:
    """Return actions and what the policy computed, as far as it has it."""

    def share(values: npt.NDArray[Any] | None, columns: slice | int) -> Packed | None:
        return None if values is None else _packed(values[steps, columns] * _SHARE, "u2", 1 / _SHARE)

    zero = recording.values_without.get("zero")
    arrays = {
        "actions": _packed(recording.actions[steps, rows], "u2") if recording.actions.ndim == 2 else None,
        "probabilities": share(recording.action_probabilities, rows),
        "weights": share(recording.pool_weights, rows),
        "read": share(recording.read_attention, game),
        "write": share(recording.write_attention, game),
        "counted": _packed(recording.counted[steps, rows], "u1"),
        "values": _packed(recording.values[steps, rows], "f4"),
        "returns": _packed(recording.returns[steps, rows], "f4"),
        "message": None if zero is None else _packed((zero - recording.values)[steps, rows], "f4"),
    }
    return {name: array for name, array in arrays.items() if array is not None}


def _played_again(actions: npt.NDArray[Any], env: VecEnv, game: int, seed: int) -> tuple[Packed, Packed]:
    """
    Play a game with a grid again from its seed.

    :param actions: (T, N)
    :return: what changes from step to step, and the grid
    """
    env.seed(seed)
    replica: Any = env.env_method("replica", indices=[game * require_n_agents(env)])[0]
    seeds: Any = next(layer.seeded_with for layer in layers(env) if hasattr(layer, "seeded_with"))
    replica.reset(seed=int(seeds[game]))
    scenes = [replica.grid_scene()]
    conversions = TeamSpaces.from_observation_space(env.observation_space).conversions
    for of_agents in actions:
        given = of_agents.tolist()
        if conversions is not None:
            given = [one.game_action(action) for one, action in zip(conversions, of_agents, strict=True)]
        taken = dict(zip(replica.possible_agents, given, strict=True))
        replica.step({agent: taken[agent] for agent in replica.agents})
        scenes.append(replica.grid_scene())
    is_collected = np.array([[treasure[2] for treasure in scene["treasures"]] for scene in scenes], dtype=bool)
    first = (
        np.where(is_collected.any(axis=0), is_collected.argmax(axis=0), -1) if is_collected.size else np.empty(0, int)
    )
    run = {
        "pose": _packed(np.array([scene["agents"] for scene in scenes]), "i2"),
        "walls": scenes[0]["walls"],
        "treasures": [treasure[:2] for treasure in scenes[0]["treasures"]],
        "collected": first.tolist(),
        "keys": [scene["keys"] for scene in scenes] if any(scene["keys"] for scene in scenes) else None,
    }
    return run, {key: scenes[0][key] for key in ("width", "height", "zones")}


def _packed(array: npt.ArrayLike, kind: str, scale: float = 1) -> Packed:
    """Return an array as base64 of little-endian numbers, multiplied by ``scale`` on the page."""
    numbers = np.asarray(array)
    if kind != "f4":
        numbers = np.rint(numbers)
    data = numbers.astype(f"<{kind}").tobytes()
    return {"type": kind, "shape": list(numbers.shape), "scale": scale, "data": base64.b64encode(data).decode()}
