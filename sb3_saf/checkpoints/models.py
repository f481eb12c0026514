"""State of an algorithm of SB3 between two rollouts, and how it was made."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.qplex.qplex import QPLEX

#: Arguments that have to be those of the checkpoint. Schedules are compared by their values, see :func:`description`.
_ARGUMENTS: Final = (
    *("n_envs", "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "normalize_advantage", "ent_coef"),
    *("vf_coef", "max_grad_norm", "target_kl", "use_sde", "sde_sample_freq"),
    # TRPO's
    *("cg_max_steps", "cg_damping", "line_search_shrinking_factor", "line_search_max_iter", "n_critic_updates"),
    "sub_sampling_factor",
    # QPLEX's
    *("buffer_size", "learning_starts", "tau", "update_interval", "gradient_steps", "target_update_interval"),
    *("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
)
_SCHEDULES: Final = ("lr_schedule", "clip_range", "clip_range_vf")
_COUNTERS: Final = (
    *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"),
    *("_current_progress_remaining", "exploration_rate"),
)
_LAST: Final = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_INFO_BUFFERS: Final = ("ep_info_buffer", "ep_success_buffer")


def require_resumable(model: BaseAlgorithm) -> None:
    """
    Check that an algorithm's state can be given completely.

    :raises CheckpointError: if it cannot, naming those that can
    """
    if not isinstance(model, (OnPolicyAlgorithm, QPLEX)):
        raise CheckpointError(
            "exact resume is for PPO, A2C, TRPO, RecurrentPPO, MaskablePPO and QPLEX, got "
            f"{type(model).__name__}; train it with model.learn and SB3's CheckpointCallback, which begins new episodes"
        )


def is_off_policy(model: BaseAlgorithm) -> bool:
    """Whether a rollout is one step and the state holds a replay buffer, which is dear to copy."""
    return isinstance(model, QPLEX)


def description(model: BaseAlgorithm) -> dict[str, Tree]:
    """
    How the model was made, as far as that can be compared.

    Schedules are functions; they are described by their values at five points of training.
    """
    policy = model.policy
    values = {name: getattr(model, name, None) for name in _ARGUMENTS}
    for name in _SCHEDULES:
        schedule = getattr(model, name, None)
        values[name] = [float(schedule(i / 4)) for i in range(5)] if callable(schedule) else None
    return {
        "algorithm": type(model).__name__,
        "policy": type(policy).__name__,
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
        **{f"{name}_class": _class_name(getattr(model, name, None)) for name in ("rollout_buffer", "replay_buffer")},
        **values,
        **{f"policy's {name}": _plain(value) for name, value in _policy_arguments(model).items()},
        **{f"parameter {name}": [str(p.dtype), *p.shape] for name, p in policy.state_dict().items()},
    }


def _class_name(value: object) -> str | None:
    return None if value is None else type(value).__name__


def _policy_arguments(model: BaseAlgorithm) -> dict[str, Any]:
    arguments = model.policy._get_constructor_parameters()
    return {
        name: arguments[name] for name in arguments if name not in ("observation_space", "action_space", "lr_schedule")
    }


def _plain(value: object) -> Tree:
    """Data as JSON gives it back; classes and functions by their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def check_description(model: BaseAlgorithm, saved: dict[str, Tree]) -> None:
    """
    Compare a model with the one that the checkpoint is of.

    :raises CheckpointError: naming the first difference
    """
    own = description(model)
    for name in dict.fromkeys([*saved, *own]):
        if own.get(name) != saved.get(name):
            raise CheckpointError(
                f"the checkpoint is of a model made in another way: {name} is {saved.get(name)!r} there and "
                f"{own.get(name)!r} in the model; make the model as for the first start"
            )


def model_state(model: BaseAlgorithm) -> Tree:
    """Weights, optimiser, counters, last observations, memories, averages, replay; at the start of a rollout."""
    replay = getattr(model, "replay_buffer", None)
    return {
        "weights": dict(model.policy.state_dict()),
        "optimizer": model.policy.optimizer.state_dict(),
        "counters": {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)},
        "last": {name: getattr(model, name) for name in _LAST},
        "lstm": _tensors(getattr(model, "_last_lstm_states", None)),
        "agent_state": getattr(model, "_agent_state", None),
        "replay": None if replay is None else replay.checkpoint_state(),
        **{name: [dict(i) if isinstance(i, dict) else i for i in getattr(model, name) or ()] for name in _INFO_BUFFERS},
    }


def _tensors(states: Any) -> Tree:
    """RecurrentPPO's hidden states: pairs for actor and critic."""
    return None if states is None else [list(pair) for pair in states]


def load_model_state(model: BaseAlgorithm, state: Tree) -> None:
    """Go on from there; the model must have passed :func:`check_description`."""
    model.policy.load_state_dict(state["weights"])
    model.policy.optimizer.load_state_dict(state["optimizer"])
    for name, value in (state["counters"] | state["last"]).items():
        setattr(model, name, value)
    for name in _INFO_BUFFERS:
        setattr(model, name, deque(state[name], maxlen=model._stats_window_size))
    if isinstance(model, QPLEX):
        assert isinstance(model.replay_buffer, TeamReplayBuffer)
        model.replay_buffer.load_checkpoint_state(state["replay"])
        model._agent_state = state["agent_state"]
    if state["lstm"] is not None:
        own: Any = model._last_lstm_states  # type: ignore[attr-defined]
        model._last_lstm_states = type(own)(*(_on(pair, model.device) for pair in state["lstm"]))  # type: ignore[attr-defined]


def _on(pair: list[th.Tensor], device: th.device) -> tuple[th.Tensor, ...]:
    return tuple(tensor.to(device) for tensor in pair)
