"""Arguments with which PPO learns well on teams, for scripts."""

from __future__ import annotations

from typing import Any, Final

from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.envs.teams import TeamSpaces, require_n_agents

#: Whose numbers these are: zoo_configs/saf.yml at size small. The task only decides the level, which is not read.
_SOURCE: Final = ("saf", "TeamSupport-v0", "small")
#: What of it holds for any environment.
_TAKEN: Final = (
    *("learning_rate", "n_epochs", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm"),
    "rollout_buffer_class",
)


def ppo_settings(env: VecEnv, **overrides: Any) -> dict[str, Any]:
    """
    Return arguments with which PPO learns well on an environment of teams::

        model = PPO("SAFPolicy", env, **sb3_saf.ppo_settings(env))

    They are those of ``sb3_saf.train --size small``: whole teams in ``TeamRolloutBuffer``, as many game steps in a
    rollout however few games there are, two minibatches; for HECOGrid, whose observations are tile codes, the light
    encoder and its discount.

    :param env: from ``make_team_env``, with any number of games
    :param overrides: arguments of PPO that win; ``policy_kwargs`` are merged
    :raises ValueError: if ``env`` is not made of teams
    """
    from sb3_saf.training.settings import load_settings

    n_agents = require_n_agents(env)
    n_games, source = env.num_envs // n_agents, load_settings(*_SOURCE)
    found = {key: source.hyperparams[key] for key in _TAKEN}
    rollout = source.hyperparams["n_steps"] * source.n_envs  # game steps, in all games
    n_minibatches = rollout * source.n_agents // source.hyperparams["batch_size"]
    n_steps = max(source.hyperparams["n_steps"], -(-rollout // (n_games * n_minibatches)) * n_minibatches)
    teams = int(overrides.get("n_steps", n_steps)) * n_games
    found |= {"n_steps": n_steps, "batch_size": teams // (1 if teams % n_minibatches else n_minibatches) * n_agents}
    encoder = _encoder_of(env)
    policy_kwargs = {}
    if encoder is not None:
        policy_kwargs, found["gamma"] = {"features_extractor_class": encoder}, source.hyperparams["gamma"]
    policy_kwargs |= overrides.get("policy_kwargs") or {}
    return {**found, **overrides, "policy_kwargs": policy_kwargs}


def _encoder_of(env: VecEnv) -> type[Any] | None:
    from sb3_saf.policies.extractors import LightEncoder

    own: spaces.Space[Any] = TeamSpaces.from_observation_space(env.observation_space).own
    return LightEncoder if hasattr(own, "atlas") else None
