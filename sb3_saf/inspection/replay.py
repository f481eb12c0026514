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
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.evaluation import PlayedStep, play
from sb3_saf.export.actor import Actor
from sb3_saf.inspection.film import png
from sb3_saf.inspection.games import Picture, draws_pictures, picture
from sb3_saf.inspection.recording import EpisodeRecording, record_episodes
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.rows import ACTION_MASK_KEY, OBS_KEY, TeamSpaces
from sb3_saf.teams.vec_env import require_n_agents

#: Maximum game steps of an episode; longer ones are cut, with a note on the page.
MAX_STEPS: Final = 2000
#: Scale of fractions from 0 to 1 stored as 16-bit integers.
_SHARE: Final = 65535
_KINDS: Final = {"u1": np.uint8, "u2": np.uint16, "i2": np.int16, "f4": np.float32}

Player: TypeAlias = "BaseAlgorithm | BasePolicy | Actor"
Packed = dict[str, Any]


class _Episode(NamedTuple):
    """One episode of one game: actions (T, N), team rewards (T,), and further data of the page."""

    actions: npt.NDArray[Any]
    rewards: npt.NDArray[np.float64]
    #: Packed arrays by name.
    arrays: dict[str, Packed | None]
    #: Data URLs of pictures, if there is no grid.
    frames: list[str]
    #: Whether values are the team's.
    of_team: bool = False


def replay(
    model: Player | Mapping[str, Player],
    env: VecEnv,
    path: str | Path = "replay.html",
    episodes: int = 1,
    seed: int = 20_000,
    deterministic: bool = False,
    gamma: float | None = None,
) -> Path:
    """
    Play episodes and write a page that shows them agent by agent, offline and without a server.

    Models of SAF, MAPPO, IPPO and QPLEX are shown with action probabilities, pool, knowledge source and values, as far
    as they have them. Exported actors are shown with own observations and actions. HECOGrid is drawn from its state,
    other games from rendered pictures.

    :param model: a trained model, its policy, an exported :class:`~sb3_saf.Actor`, or several by name, shown side by
        side
    :param env: from ``make_team_env``, with at least ``episodes`` games; HECOGrid needs no render mode, others
        ``render_mode="rgb_array"``
    :param path: path of the page
    :param episodes: games to show from their start; a page shows at most 2,000 game steps
    :param seed: seed of games and actions; all models play the same games
    :param deterministic: whether to take the most likely actions
    :param gamma: discount factor of the returns; None for the model's
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
    if not has_grid and not draws_pictures(env):
        raise ValueError(
            "expected an environment that can be shown, got one with neither a grid nor render_mode='rgb_array'; make "
            "it with make_team_env(..., render_mode='rgb_array')"
        )
    if not has_grid and episodes > 1:
        raise ValueError("expected episodes=1: pictures are recorded of the first game only, as HECOGrid's are not")
    players = model if isinstance(model, Mapping) else {"team": model}
    runs: list[Packed] = []
    grid: Packed | None = None
    for name, player in players.items():
        _check_spaces(name, player, env)
        for game, episode in enumerate(_play(player, env, episodes, seed, deterministic, gamma)):
            title = name if episodes == 1 else f"{name}, game {game + 1}"
            run, grid = _run(title, episode, env, game, seed) if has_grid else (_run_of_frames(title, episode), None)
            run["of_team"] = episode.of_team
            runs.append({**run, **{key: value for key, value in episode.arrays.items() if value is not None}})
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(_page(_title(env, players), _data(env, runs, grid)), encoding="utf-8")
    return target


def _check_spaces(name: str, player: Player, env: VecEnv) -> None:
    if isinstance(player, Actor):
        return  # it checks every observation
    expected, found = (TeamSpaces.from_observation_space(one.observation_space) for one in (env, player))
    if (found.own.shape, found.n_agents) != (expected.own.shape, expected.n_agents) or (
        player.action_space != env.action_space
    ):
        raise ValueError(
            f"expected {name} to be trained on observations of shape {expected.own.shape} and {env.action_space} with "
            f"{expected.n_agents} agents, got shape {found.own.shape} and {player.action_space} with {found.n_agents}; "
            "replay it on the environment that it was trained on"
        )


# --- playing ----------------------------------------------------------------------------------------------------------


def _play(
    player: Player, env: VecEnv, episodes: int, seed: int, deterministic: bool, gamma: float | None
) -> list[_Episode]:
    """Return one episode of each of the first games."""
    if isinstance(player, Actor):
        return _play_actor(player, env, episodes, seed, deterministic)
    policy = player.policy if isinstance(player, BaseAlgorithm) else player
    discount = float(getattr(player, "gamma", 1.0)) if gamma is None else gamma
    n_games = env.num_envs // require_n_agents(env)
    recording = record_episodes(policy, env, n_games, seed, deterministic, gamma=discount)
    return [_episode_of(recording, game, _atlas(env) is not None) for game in range(episodes)]


def _episode_of(recording: EpisodeRecording, game: int, has_codes: bool) -> _Episode:
    """Return the first episode of a game, at most ``MAX_STEPS`` long."""
    n = recording.n_agents
    rows = slice(game * n, (game + 1) * n)
    ended = recording.ends[:, rows].all(axis=1)
    steps = slice(0, min(int(np.flatnonzero(ended)[0]) + 1, MAX_STEPS))
    zero = recording.values_without.get("zero")
    rewards = recording.rewards[steps, rows]
    arrays: dict[str, Packed | None] = {
        "actions": _packed(recording.actions[steps, rows], "u1") if recording.actions.ndim == 2 else None,
        "probabilities": _share(recording.action_probabilities, steps, rows),
        "weights": _share(recording.pool_weights, steps, rows),
        "read": _share(recording.read_attention, steps, game),
        "write": _share(recording.write_attention, steps, game),
        "values": _packed(recording.values[steps, rows], "f4"),
        "returns": _packed(recording.returns[steps, rows], "f4"),
        "message": None if zero is None else _packed((zero - recording.values)[steps, rows], "f4"),
    }
    if has_codes and recording.observations is not None:
        arrays["views"] = _packed(recording.observations[steps, rows], "u1")
    team = rewards[:, 0] if recording.of_team else rewards.sum(axis=1)
    frames = [_data_url(frame) for frame in recording.pictures[steps]] if game == 0 else []
    return _Episode(recording.actions[steps, rows], team.astype(np.float64), arrays, frames, recording.of_team)


def _share(shares: npt.NDArray[Any] | None, steps: slice, rows: slice | int) -> Packed | None:
    return None if shares is None else _packed(shares[steps, rows] * _SHARE, "u2", 1 / _SHARE)


def _play_actor(actor: Actor, env: VecEnv, episodes: int, seed: int, deterministic: bool) -> list[_Episode]:
    """Play one episode of each game with an exported actor, on own observations and masks."""
    if actor.has_memory or actor.manifest.reads_agent:
        raise ValueError(
            "expected an exported actor without memory and heads per agent to replay; replay the model that it "
            "was exported from"
        )
    n_agents, frames = require_n_agents(env), []

    def act(obs: Any, starts: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        if draws_pictures(env) and (frame := picture(env)) is not None:
            frames.append(frame)
        return np.asarray(actor.act(obs[OBS_KEY], deterministic, action_mask=obs.get(ACTION_MASK_KEY)))

    with own_randomness(seed, th.device("cpu")):
        env.seed(seed)
        steps = list(play(env, act, env.num_envs // n_agents))
    return [_episode_of_actor(steps, game, n_agents, frames, _atlas(env) is not None) for game in range(episodes)]


def _episode_of_actor(
    steps: list[PlayedStep], game: int, n_agents: int, frames: list[Picture], has_codes: bool
) -> _Episode:
    rows = slice(game * n_agents, (game + 1) * n_agents)
    length = next(number for number, step in enumerate(steps, 1) if step.ended[game])
    played = steps[: min(length, MAX_STEPS)]
    actions = np.stack([step.actions[rows] for step in played])
    arrays: dict[str, Packed | None] = {"actions": _packed(actions, "u1")}
    if has_codes:
        arrays["views"] = _packed(np.stack([step.observations[OBS_KEY][rows] for step in played]), "u1")
    rewards = np.array([float(step.rewards[rows].sum()) for step in played])
    pictures = [_data_url(frame) for frame in frames[: len(played)]] if game == 0 else []
    return _Episode(actions, rewards, arrays, pictures)


# --- the data of the page ---------------------------------------------------------------------------------------------


def _run(name: str, episode: _Episode, env: VecEnv, game: int, seed: int) -> tuple[Packed, Packed]:
    """Return the page's data of a game with a grid, played again from its seed, and the grid itself."""
    env.seed(seed)
    replica: Any = env.env_method("replica", indices=[game * require_n_agents(env)])[0]
    replica.reset(seed=_seeds(env)[game])
    agents = list(replica.possible_agents)
    scenes = [replica.grid_scene()]
    for actions in episode.actions:
        replica.step(dict(zip(agents, actions.tolist(), strict=True)))
        scenes.append(replica.grid_scene())
    taken = np.array([[treasure[2] for treasure in scene["treasures"]] for scene in scenes], dtype=bool)
    first = np.where(taken.any(axis=0), taken.argmax(axis=0), -1) if taken.size else np.empty(0, dtype=int)
    run = {
        **_run_of_frames(name, episode),
        "frames": None,
        "pose": _packed(np.array([scene["agents"] for scene in scenes]), "i2"),
        "treasures": [treasure[:2] for treasure in scenes[0]["treasures"]],
        "collected": first.tolist(),
        "keys": [scene["keys"] for scene in scenes] if any(scene["keys"] for scene in scenes) else None,
    }
    return run, {key: scenes[0][key] for key in ("width", "height", "walls", "zones")}


def _run_of_frames(name: str, episode: _Episode) -> Packed:
    return {
        "name": name,
        "steps": len(episode.actions),
        "rewards": _packed(episode.rewards, "f4"),
        "frames": episode.frames,
    }


def _seeds(env: VecEnv) -> list[int]:
    """Return the seeds of the games."""
    layer: Any = env
    while not hasattr(layer, "seeded_with"):
        layer = layer.venv
    return [int(seed) for seed in layer.seeded_with]


def _atlas(env: VecEnv) -> npt.NDArray[np.uint8] | None:
    """Return the pixels of tile codes, (codes, t, t, 3); None if observations are not tile codes."""
    own = TeamSpaces.from_observation_space(env.observation_space).own
    atlas = getattr(own, "atlas", None)
    return None if atlas is None else np.asarray(atlas)


def _data(env: VecEnv, runs: list[Packed], grid: Packed | None) -> Packed:
    atlas, space = _atlas(env), env.action_space
    n_actions = int(space.n) if isinstance(space, spaces.Discrete) else 0
    names = env.get_attr("action_names", indices=[0])[0] if env.has_attr("action_names") else range(n_actions)
    cut = any(run["steps"] == MAX_STEPS for run in runs)
    return {
        "n_agents": require_n_agents(env),
        "grid": grid,
        "tiles": None if atlas is None else _packed(atlas, "u1"),
        "actions": [str(name) for name in names],
        "runs": runs,
        "note": f"Cut after {MAX_STEPS:,} game steps." if cut else "Point at an agent, or choose its number.",
    }


def _packed(array: npt.ArrayLike, kind: str, scale: float = 1) -> Packed:
    """Return an array as base64 of little-endian numbers, multiplied by ``scale`` on the page."""
    numbers = np.asarray(array)
    if kind != "f4":
        numbers = np.rint(numbers)
    data = np.ascontiguousarray(numbers.astype(np.dtype(_KINDS[kind]).newbyteorder("<"))).tobytes()
    return {"type": kind, "shape": list(numbers.shape), "scale": scale, "data": base64.b64encode(data).decode()}


def _data_url(frame: npt.NDArray[np.uint8]) -> str:
    return f"data:image/png;base64,{base64.b64encode(png(frame)).decode()}"


def _title(env: VecEnv, players: Mapping[str, Player]) -> str:
    kinds = {
        "exported actor"
        if isinstance(player, Actor)
        else type(getattr(player, "policy", player)).__name__.removesuffix("Policy")
        for player in players.values()
    }
    return f"Replay: {', '.join(sorted(kinds))}, {require_n_agents(env)} agents"


def _page(title: str, data: Packed) -> str:
    folder = files("sb3_saf.inspection")
    template = folder.joinpath("replay.html").read_text(encoding="utf-8")
    script = folder.joinpath("replay.js").read_text(encoding="utf-8")
    # "<" occurs in strings only: no name can close the element with the data.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    for mark, content in (("{{title}}", escape(title)), ("{{script}}", script), ("{{data}}", text)):
        template = template.replace(mark, content)
    return template
