"""Check that an exported network reproduces the model's outputs."""

from __future__ import annotations

import copy
from typing import Final, TypeAlias

import numpy as np
import torch as th

from sb3_saf.export.manifest import MemoryNet
from sb3_saf.export.network import AgentNetwork, States
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.recurrent import TeamRecurrentPolicy
from sb3_saf.qplex.policies import QPLEXPolicy
from sb3_saf.teams.errors import ExportError

#: Policies whose actors read only one agent's own observation, index, mask and memory.
ExportablePolicy: TypeAlias = TeamPolicy | QPLEXPolicy

#: Maximum relative difference between the model's and the exported network's outputs.
_TOLERANCE: Final = 1e-4
_N_CHECKED: Final = 16


def some_inputs(policy: ExportablePolicy, memory: MemoryNet | None) -> dict[str, th.Tensor]:
    """Make random inputs of the network, by name, without using the space's generator or torch's."""
    space = copy.deepcopy(policy.team_spaces.own)
    space.seed(0)
    inputs = {"observation": th.as_tensor(np.stack([np.asarray(space.sample()) for _ in range(_N_CHECKED)]))}
    if policy.actor.reads_agent:
        inputs["agent"] = th.arange(_N_CHECKED) % policy.team_spaces.n_agents
    if memory is not None:
        generator = th.Generator().manual_seed(0)
        for name in ("hidden", "cell"):
            inputs[name] = th.randn(memory.n_layers, _N_CHECKED, memory.hidden_size, generator=generator)
    return inputs


def check_network(policy: ExportablePolicy, network: AgentNetwork, inputs: dict[str, th.Tensor]) -> None:
    """Compare the exported network with the model; ExportError if they differ by more than rounding."""
    was_training = policy.training
    policy.set_training_mode(False)
    with th.no_grad():
        expected = _of_model(policy, {name: value.to(policy.device) for name, value in inputs.items()})
        states = (inputs["hidden"], inputs["cell"]) if "hidden" in inputs else ()
        output, states = network(inputs["observation"], inputs.get("agent"), states)
    policy.set_training_mode(was_training)
    for found, wanted in zip((*output, *states), expected, strict=True):
        check_close(found, wanted.cpu(), f"{type(policy).__name__} does more than its encoder and actor show")


def _of_model(policy: ExportablePolicy, inputs: dict[str, th.Tensor]) -> States:
    """Return the outputs of the model's actor, and its next memory."""
    latent = policy.extract_features(inputs["observation"])
    states: States = ()
    if isinstance(policy, TeamRecurrentPolicy):
        latent, states = policy.remember(latent, (inputs["hidden"], inputs["cell"]))
    return *policy.actor.evaluate(latent, inputs.get("agent")), *states


def check_close(found: th.Tensor, expected: th.Tensor, otherwise: str) -> None:
    """Compare outputs; ExportError if they differ by more than rounding."""
    if found.shape != expected.shape or not th.allclose(found, expected, rtol=_TOLERANCE, atol=_TOLERANCE):
        raise ExportError(f"the exported network does not give the model's numbers: {otherwise}")
