"""PPO hyperparameters for teams, for use in scripts."""

from __future__ import annotations

from typing import Any, Final

from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.networks.memory import MemoryName
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.teams.vec_env import require_n_agents, shares_reward

#: Settings of ``sb3_saf.train --size small`` that also apply to scripts.
_OF_BUFFER: Final = ("rollout_buffer_class", "rollout_buffer_kwargs")
_TAKEN: Final = ("learning_rate", "n_epochs", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", *_OF_BUFFER)
#: The same for HECOGrid's games only.
_TAKEN_OF_HECOGRID: Final = (*_TAKEN, "gamma")


def ppo_settings(
    env: VecEnv,
    algo: str = "mappo",
    algorithm: type[OnPolicyAlgorithm] = PPO,
    memory: MemoryName | None = None,
    **overrides: Any,
) -> dict[str, Any]:
    """
    Return PPO hyperparameters for an environment of teams::

        model = PPO("MAPPOPolicy", env, **sb3_saf.ppo_settings(env))
        model = PPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf"))
        model = MaskablePPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf", MaskablePPO))
        model = PPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf", memory="gru"))

    They are those of ``sb3_saf.train --size small``: ``TeamRolloutBuffer``, and a few minibatches per rollout with the
    same number of game steps for any number of games. HECOGrid with tile codes has its own settings: the light encoder,
    narrow heads, normalised values, its discount, and a learning rate that decreases to 0.

    Where agents have rewards of their own (``team_reward="given"``, unless the suite gives all the team's), advantages
    are normalised for each agent, and so are values if ``policy_kwargs`` has ``normalize_values``: agents that are paid
    less learn as fast as those that are paid more.

    :param env: from ``make_team_env``, with any number of games
    :param algo: the method, a name of ``sb3_saf.train --algo`` that PPO trains. The settings of ``"saf"`` include its
        widths, which other policies do not take
    :param algorithm: the class for which the settings are, those that it takes: PPO, MaskablePPO, TRPO, or A2C, which
        keeps its own short rollouts
    :param memory: ``"gru"`` or ``"lstm"`` for agents that remember their episode
    :param overrides: arguments of the algorithm that take precedence; ``policy_kwargs`` are merged
    :raises ValueError: if ``env`` has no teams, or the algorithm does not train ``algo``
    """
    from sb3_saf.networks.encoders import LightEncoder
    from sb3_saf.suites.registry import HOME
    from sb3_saf.teams.checks import unknown_name
    from sb3_saf.training.settings import ALGOS, algorithm_arguments, convert, find_algorithm
    from sb3_saf.training.yaml_files import entry_of, read_settings

    trained = [name for name, spec in ALGOS.items() if spec.algorithm is PPO]
    if algo not in trained:
        raise unknown_name("method of PPO", algo, trained)
    n_agents, spec = require_n_agents(env), find_algorithm(algo, algorithm.__name__)
    n_games, own = env.num_envs // n_agents, TeamSpaces.from_observation_space(env.observation_space).own
    encoder = LightEncoder if hasattr(own, "atlas") else None
    source = entry_of(read_settings(spec.config), ("default",) if encoder is None else ("default", HOME), "small")
    hints, taken = algorithm_arguments(algorithm), _TAKEN if encoder is None else _TAKEN_OF_HECOGRID
    policy: Any = algorithm.policy_aliases[spec.policy]
    found = {key: convert(key, source[key], hints[key]) for key in taken if key in source and key in hints}
    if not policy.takes_team_buffer:  # masks and sequences need buffers of their own
        found = {key: value for key, value in found.items() if key not in _OF_BUFFER}
    if "batch_size" in hints:
        rollout = source["n_steps"] * source["n_envs"]  # game steps, in all games
        n_minibatches = source["n_minibatches"]
        n_steps = max(source["n_steps"], -(-rollout // (n_games * n_minibatches)) * n_minibatches)
        teams = int(overrides.get("n_steps", n_steps)) * n_games
        found |= {"n_steps": n_steps, "batch_size": teams // (1 if teams % n_minibatches else n_minibatches) * n_agents}
    policy_kwargs = source.get("policy_kwargs", {}) | spec.policy_kwargs
    if memory is not None:
        policy_kwargs["memory"] = memory
    if encoder is not None:
        policy_kwargs["features_extractor_class"] = encoder
    if not policy.takes_team_buffer:
        policy_kwargs.pop("normalize_values", None)
    policy_kwargs |= overrides.get("policy_kwargs") or {}
    if shares_reward(env):
        found.pop("rollout_buffer_kwargs", None)
    elif policy_kwargs.get("normalize_values") is True:
        policy_kwargs["normalize_values"] = "agent"
    return {**found, **overrides, "policy_kwargs": policy_kwargs}
