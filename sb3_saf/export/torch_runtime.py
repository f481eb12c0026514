"""Run an exported actor in torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy.typing as npt
import torch as th
from safetensors import SafetensorError
from safetensors.torch import load

from sb3_saf.export.act import Outputs, States
from sb3_saf.export.errors import ExportError
from sb3_saf.export.files import read_checked
from sb3_saf.export.manifest import MANIFEST_FILE, WEIGHTS_FILE, ActorNet, Manifest
from sb3_saf.export.network import ActorNetwork, AgentPolicies

Array = npt.NDArray[Any]


class TorchRuntime:
    """
    The networks, on the CPU.

    :param folder: of the export
    :param manifest: what it says
    :param agent: index of the agent, where each has a policy of its own
    """

    def __init__(self, folder: Path, manifest: Manifest, agent: int | None):
        if WEIGHTS_FILE not in manifest.files:
            raise ExportError(
                f"{folder} has no {WEIGHTS_FILE}, because its encoder or activation is not one that a file can name; "
                'load it with runtime="onnx"'
            )
        self.network = load_network(manifest, read_checked(folder / WEIGHTS_FILE, manifest.files[WEIGHTS_FILE]))
        policies = self.network.actor
        if isinstance(policies, AgentPolicies):
            assert agent is not None
            self.network.actor = policies.of_agent(agent)

    def __call__(self, observations: Array, states: States = ()) -> tuple[Outputs, States]:
        """(K, *shape) own observations and what is remembered, to the network's outputs and what is remembered then."""
        with th.inference_mode():
            outputs = self.network(th.tensor(observations), None, *(th.tensor(state) for state in states))
        arrays = [output.numpy() for output in outputs]
        n_outputs = len(arrays) - len(states)
        return Outputs(*arrays[:n_outputs]), tuple(arrays[n_outputs:])

    def draws(self, seed: int | None) -> TorchDraws:
        """Torch's global generator, or a new one with a seed."""
        return TorchDraws(None if seed is None else th.Generator().manual_seed(seed))


def load_network(manifest: Manifest, weights: bytes) -> ActorNetwork:
    """
    Make the networks that a manifest describes.

    Sizes are compared with the file's before anything of these sizes is made.

    :param manifest: of the export
    :param weights: content of the safetensors file
    :raises ExportError: if they do not fit each other
    """
    try:
        tensors = load(weights)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError, OverflowError) as error:
        raise ExportError(f"{WEIGHTS_FILE} is not a valid safetensors file: {error}") from error
    _check_layers(manifest, len(tensors))
    with th.device("meta"):
        network = ActorNetwork.of(manifest)
    _check_tensors(network.state_dict(), tensors)
    network.load_state_dict(tensors, assign=True)
    return network.requires_grad_(False).eval()


def _check_layers(manifest: Manifest, n_tensors: int) -> None:
    """Refuse before millions of modules are made."""
    actor = manifest.actor
    assert isinstance(actor, ActorNet)
    n_heads = manifest.n_agents if actor.name == "AgentPolicies" else actor.n_policies
    needed = 2 * (n_heads * (len(actor.hidden) + 1) + len(actor.projection_hidden))
    if manifest.memory is not None:
        needed += 2 * manifest.memory.n_layers
    if needed > n_tensors:
        raise ExportError(f"{MANIFEST_FILE} describes at least {needed} tensors, {WEIGHTS_FILE} has {n_tensors}")


def _check_tensors(expected: dict[str, th.Tensor], found: dict[str, th.Tensor]) -> None:
    if missing := sorted(expected.keys() - found.keys()):
        raise ExportError(f"{WEIGHTS_FILE} lacks the tensor {missing[0]!r}")
    if unknown := sorted(found.keys() - expected.keys()):
        raise ExportError(f"{WEIGHTS_FILE} has a tensor that the actor does not have: {unknown[0][:80]!r}")
    for name, wanted in expected.items():
        tensor = found[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise ExportError(
                f"{WEIGHTS_FILE}: expected {name!r} of shape {tuple(wanted.shape)} and {wanted.dtype}, got "
                f"{tuple(tensor.shape)} and {tensor.dtype}"
            )
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise ExportError(f"{WEIGHTS_FILE}: {name!r} has NaN or infinity")


class TorchDraws:
    """
    Random numbers of torch, drawn in the order in which the trained model draws them.

    :param generator: where from; None for torch's global generator
    """

    def __init__(self, generator: th.Generator | None = None):
        self.generator = generator

    def categorical(self, probabilities: Array) -> Array:
        """(K,) indices: (K, n)."""
        drawn = th.multinomial(th.from_numpy(probabilities), 1, True, generator=self.generator)
        return drawn.squeeze(1).numpy()

    def bernoulli(self, probabilities: Array) -> Array:
        """(K, D) zeros and ones: (K, D)."""
        return th.bernoulli(th.from_numpy(probabilities), generator=self.generator).numpy()

    def normal(self, shape: tuple[int, ...]) -> Array:
        """Standard normal numbers."""
        return th.normal(th.zeros(shape), th.ones(shape), generator=self.generator).numpy()

    def uniform(self, shape: tuple[int, ...]) -> Array:
        """Numbers in [0, 1)."""
        return th.rand(shape, generator=self.generator).numpy()
