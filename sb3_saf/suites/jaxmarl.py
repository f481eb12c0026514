"""
All other environments of JaxMARL: ``jaxmarl/MPE_simple_spread_v3``, ``jaxmarl/overcooked_v2``, ``jaxmarl/hanabi``.

Parameters are those of the environment. Observations are flattened, and shorter ones padded with zeros; actions that an
agent lacks are masked. Environments with missing packages are not listed.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.registry import Suite

#: Requirements of all suites of JaxMARL.
JAXMARL: Final = ('jaxmarl>=0.2,<0.3; python_version >= "3.11"', 'jax>=0.4.25; python_version >= "3.11"')
#: Shaped rewards are for training only.
TRAINING_PARAMS: Final = ("reward_shaping", "reward_shaping_steps")


def _tasks() -> list[str]:
    from sb3_saf.suites.engines.jaxmarl import registered

    return registered()


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.jaxmarl import vec_env

    return vec_env(task, n_envs, seed, **params)


SUITE: Final = Suite(
    name="jaxmarl",
    title="environments by the names that JaxMARL registers",
    requires=JAXMARL,
    extra="jaxmarl",
    page="https://jaxmarl.foersterlab.com",
    list_tasks=_tasks,
    examples=("MPE_simple_spread_v3",),
    vec_env=_games,
    competitive=(
        "SMAX", "MPE_simple_adversary_*", "MPE_simple_crypto_*", "MPE_simple_push_*", "MPE_simple_tag_*",
        "MPE_simple_world_comm_*", "MPE_simple_facmac_*", "coin_game",
    ),
    training_params=TRAINING_PARAMS,
)  # fmt: skip
