"""
State of an SB3 algorithm between two rollouts.

SB3 has no public interface to set most of it: its ``load`` sets the attributes from an unpickled file, and ``save``
omits some. Only this module reads and sets them.
"""

from __future__ import annotations

from collections import deque
from inspect import signature
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.checkpoints.checks import (
    check_array,
    check_keys,
    check_like,
    check_list,
    check_observations,
    check_range,
    check_real,
    check_text,
    check_whole,
    refused,
)
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.environments import check_stateful
from sb3_saf.qplex.qplex import QPLEX
from sb3_saf.teams.errors import CheckpointError

_COUNTERS: Final = (
    *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"),
    *("_current_progress_remaining", "exploration_rate"),
)
_LAST: Final = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_INFO_BUFFERS: Final = ("ep_info_buffer", "ep_success_buffer")


def require_resumable(model: BaseAlgorithm) -> None:
    """Raise CheckpointError for algorithms whose complete state is not accessible, naming the supported ones."""
    if not isinstance(model, (OnPolicyAlgorithm, QPLEX)):
        raise CheckpointError(
            "exact resume is for PPO, A2C, TRPO, RecurrentPPO, MaskablePPO and QPLEX, got "
            f"{type(model).__name__}; train it with model.learn and SB3's CheckpointCallback, which begins new episodes"
        )


def is_off_policy(model: BaseAlgorithm) -> bool:
    """Return whether the algorithm is off-policy: its state has a replay buffer, too large to copy at every rollout."""
    return isinstance(model, QPLEX)


def model_state(model: BaseAlgorithm) -> dict[str, Tree]:
    """Return weights, optimiser, counters, last observations, memories, averages and replay at a rollout's start."""
    replay = getattr(model, "replay_buffer", None)
    return {
        "weights": dict(model.policy.state_dict()),
        "optimizer": model.policy.optimizer.state_dict(),
        "counters": _counters(model),
        "last": {name: getattr(model, name) for name in _LAST},
        "lstm": _lstm_states(model),
        "agent_state": getattr(model, "agent_state", None),
        "replay": None if replay is None else replay.checkpoint_state(),
        **{name: [dict(i) if isinstance(i, dict) else i for i in getattr(model, name) or ()] for name in _INFO_BUFFERS},
        "info_buffer_size": None if model.ep_info_buffer is None else model.ep_info_buffer.maxlen,
    }


def _counters(model: BaseAlgorithm) -> dict[str, Tree]:
    return {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}


def _lstm_states(model: BaseAlgorithm) -> Tree:
    """Return RecurrentPPO's hidden states: pairs for actor and critic."""
    states = getattr(model, "_last_lstm_states", None)
    return None if states is None else [list(pair) for pair in states]


def load_model_state(model: BaseAlgorithm, state: Tree) -> None:
    """Restore a state that passed :func:`check_model_state`."""
    model.policy.load_state_dict(state["weights"])
    model.policy.optimizer.load_state_dict(state["optimizer"])
    for name, value in (state["counters"] | state["last"]).items():
        setattr(model, name, value)
    for name in _INFO_BUFFERS:
        setattr(model, name, deque(state[name], maxlen=state["info_buffer_size"]))
    if isinstance(model, QPLEX):
        assert isinstance(model.replay_buffer, TeamReplayBuffer)
        model.replay_buffer.load_checkpoint_state(state["replay"])
        model.agent_state = state["agent_state"]
    if state["lstm"] is not None:
        own: Any = model._last_lstm_states  # type: ignore[attr-defined]
        pairs = (tuple(tensor.to(model.device) for tensor in pair) for pair in state["lstm"])
        model._last_lstm_states = type(own)(*pairs)  # type: ignore[attr-defined]


# --- checks -----------------------------------------------------------------------------------------------------------


def check_model_state(model: BaseAlgorithm, state: Tree) -> None:
    """Check that a state is valid for the model; a CheckpointError names the first mismatch."""
    names = ("weights", "optimizer", "counters", "last", "lstm", "agent_state", "replay", *_INFO_BUFFERS)
    check_keys(state, (*names, "info_buffer_size"), "model")
    check_like(state["weights"], dict(model.policy.state_dict()), "weights")
    _check_optimizer(model.policy.optimizer, state["optimizer"])
    _check_counters(model, state["counters"])
    _check_last(model, state["last"])
    check_like(state["lstm"], _lstm_states(model), "the LSTMs' states")
    _check_replay(model, state["replay"], state["agent_state"])
    if state["info_buffer_size"] is not None:
        check_whole(state["info_buffer_size"], "the size of the episodes' averages", 1)
    _check_infos(state)


def _check_optimizer(optimizer: th.optim.Optimizer, state: Tree) -> None:
    """Check that settings except the learning rate are the model's, and statistics have their parameters' shapes."""
    own = optimizer.state_dict()
    check_keys(state, own, "optimizer")
    check_list(state["param_groups"], "the optimizer's groups", len(own["param_groups"]))
    for group, like in zip(state["param_groups"], own["param_groups"], strict=True):
        check_keys(group, like, "a group of the optimizer")
        check_real(group["lr"], "the learning rate")
        for name in like:
            if name != "lr" and repr(group[name]) != repr(like[name]):
                raise refused(f"the optimizer's {name}", repr(like[name]), repr(group[name]))
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    per_parameter = _statistics(optimizer)
    if not isinstance(state["state"], dict):
        raise refused("the optimizer's statistics", "a dict", type(state["state"]).__name__)
    for index, entries in state["state"].items():
        check_whole(index, "a parameter's number", 0, len(parameters) - 1)
        check_keys(entries, per_parameter, f"the optimizer's statistics of parameter {index}")
        for name, is_scalar in per_parameter.items():
            like = th.zeros(()) if is_scalar else parameters[index]
            check_like(entries[name], like.detach(), f"the optimizer's {name} of parameter {index}")


def _statistics(optimizer: th.optim.Optimizer) -> dict[str, bool]:
    """Return the statistics per parameter and whether each is a scalar, from a trial optimizer of the same class."""
    parameter = th.zeros(2, requires_grad=True)
    parameter.grad = th.zeros(2)
    known = signature(type(optimizer)).parameters
    probe = type(optimizer)([parameter], **{k: v for k, v in optimizer.defaults.items() if k in known})
    probe.step()
    return {name: value.dim() == 0 for name, value in probe.state[parameter].items() if isinstance(value, th.Tensor)}


def _check_counters(model: BaseAlgorithm, counters: Tree) -> None:
    own = _counters(model)
    check_keys(counters, own, "counters")
    for name, value in own.items():
        if isinstance(value, int) and name != "exploration_rate":
            check_whole(counters[name], name)
        else:
            check_real(counters[name], name)
    if "exploration_rate" in counters and not 0 <= counters["exploration_rate"] <= 1:
        raise refused("exploration_rate", "from 0 to 1", counters["exploration_rate"])
    if counters["num_timesteps"] % model.n_envs:
        raise refused("num_timesteps", f"a multiple of {model.n_envs} rows", counters["num_timesteps"])


def _check_last(model: BaseAlgorithm, last: Tree) -> None:
    check_keys(last, _LAST, "the last step")
    if last["_last_obs"] is not None:
        check_observations(last["_last_obs"], model.observation_space, model.n_envs, "the last observations")
        check_array(last["_last_episode_starts"], (model.n_envs,), np.bool_, "the starts of episodes")
    normalizer, original = model.get_vec_normalize_env(), last["_last_original_obs"]
    if normalizer is None and original is not None:
        raise refused("the last observations before VecNormalize", "None without it", type(original).__name__)
    if normalizer is not None and original is not None:
        space = normalizer.venv.observation_space
        check_observations(original, space, model.n_envs, "the last observations before VecNormalize")


def _check_replay(model: BaseAlgorithm, replay: Tree, agent_state: Tree) -> None:
    if not isinstance(model, QPLEX):
        if replay is not None or agent_state is not None:
            raise refused("replay and memory", f"None for {type(model).__name__}", "some")
        return
    assert isinstance(model.replay_buffer, TeamReplayBuffer)
    check_stateful(model.replay_buffer, replay, "the replay buffer")
    if agent_state is None:
        return
    memory = model.policy.memory
    if memory is None or not isinstance(agent_state, tuple) or len(agent_state) != 3:
        raise refused("what agents remember", "hidden state, cell state and last action of agents that do", "another")
    for part in agent_state[:2]:
        check_array(part, (model.n_envs, memory.hidden_size), np.float32, "what agents remember")
    check_array(agent_state[2], (model.n_envs,), np.int64, "the agents' last actions")
    check_range(agent_state[2], -1, int(model.action_space.n) - 1, "the agents' last actions")


def _check_infos(state: Tree) -> None:
    for name in _INFO_BUFFERS:
        check_list(state[name], name)
    for info in state["ep_info_buffer"]:
        if not isinstance(info, dict) or not {"r", "l"} <= info.keys():
            raise refused("an episode's entry", "a dict with 'r' and 'l'", repr(info)[:80])
        for key in info:
            check_text(key, "a name in an episode's entry")
        for key in ("r", "l"):
            check_real(info[key], f"{key!r} of an episode", finite=False)
    for success in state["ep_success_buffer"]:
        check_real(float(success) if isinstance(success, (bool, np.bool_)) else success, "a success")
