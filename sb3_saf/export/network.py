"""
Network of one agent: the encoder, memory and actor of ``sb3_saf.networks``, from raw own observations to actions.

Letters: K rows, d features, N agents, U policies, P parameters of one policy's distribution, D action dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from safetensors import SafetensorError
from safetensors.torch import load
from torch import nn

from sb3_saf.export.manifest import (
    MANIFEST_FILE,
    WEIGHTS_FILE,
    Activation,
    ActorNet,
    EncoderNet,
    Manifest,
    MemoryNet,
)
from sb3_saf.networks import encoders
from sb3_saf.networks.actor import ActorNetwork, PolicyPool, PoolOutput, SinglePolicy, draw_policy
from sb3_saf.networks.distributions import (
    likeliest_action,
    mixture_log_probs,
    mixture_mode,
    mixture_sample,
    policy_parameters,
    sample_action,
)
from sb3_saf.networks.encoders import preprocess
from sb3_saf.networks.spaces import ObservationSpec, SpaceSpec
from sb3_saf.teams.errors import ExportError

Array = npt.NDArray[Any]
States = tuple[th.Tensor, ...]

#: Activations allowed in files.
ACTIVATIONS: Final[dict[str, type[nn.Module]]] = {name: getattr(nn, name) for name in get_args(Activation)}
#: Name of the pixels of tile codes in files.
ATLAS: Final = "encoder.pixels.atlas"


class RawEncoder(nn.Module):
    """Encoder of raw observations of a space; uint8 pictures may be scaled to [0, 1]."""

    def __init__(self, encoder: nn.Module, space: SpaceSpec, divide_by_255: bool):
        super().__init__()
        self.encoder, self.space, self.divide_by_255 = encoder, space, divide_by_255

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """Encode (K, *shape) as (K, d)."""
        return self.encoder(preprocess(observation, self.space, self.divide_by_255))


def make_encoder(net: EncoderNet, observation: ObservationSpec) -> nn.Module:
    """Make the encoder of a manifest, without loading weights."""
    if net.name == "PaperCNN":
        return encoders.PaperCNN(observation, net.features_dim)
    if net.name == "NatureEncoder":
        return encoders.NatureEncoder(observation, net.features_dim)
    if net.name == "MLPEncoder":
        return encoders.MLPEncoder(observation, net.features_dim, net.hidden)
    return encoders.LightEncoder(
        observation, net.features_dim, net.tile_size, net.embedding_dim, net.hidden, net.one_hot_codes
    )


def make_actor(
    net: ActorNet, features_dim: int, action: SpaceSpec, n_agents: int, activation_fn: type[nn.Module]
) -> ActorNetwork:
    """Make the actor of a manifest, without loading weights."""
    n_identities = n_agents if net.agent_identity else 0
    if net.name == "PolicyPool":
        return PolicyPool(
            features_dim,
            action,
            net.hidden,
            activation_fn,
            n_policies=net.n_policies,
            selection="mixture",
            latent_dim=net.latent_dim,
            projection_hidden=net.projection_hidden,
            n_identities=n_identities,
        )
    n_heads = n_agents if net.name == "AgentPolicies" else None
    return SinglePolicy(features_dim, action, net.hidden, activation_fn, n_agents=n_heads, n_identities=n_identities)


def make_memory(net: MemoryNet | None, features_dim: int) -> nn.LSTM | None:
    """Make the LSTM of a manifest, without loading weights; None without memory."""
    return None if net is None else nn.LSTM(features_dim, net.hidden_size, net.n_layers, bias=net.bias)


class AgentNetwork(nn.Module):
    """
    Complete network of an agent.

    :param encoder: (K, *shape) raw own observations to (K, d)
    :param memory: LSTM over the features of successive steps, (K, d) to (K, H); None without memory
    :param actor: (K, d), or (K, H), and agents to weights and parameters of policies
    """

    def __init__(self, encoder: nn.Module, memory: nn.LSTM | None, actor: ActorNetwork):
        super().__init__()
        self.encoder, self.memory, self.actor = encoder, memory, actor

    @classmethod
    def of(cls, manifest: Manifest, atlas: Array | None) -> AgentNetwork:
        """Make the network of a manifest, without loading weights; ``atlas`` has the pixels of tile codes."""
        encoder, actor, memory = manifest.encoder, manifest.actor, manifest.memory
        assert encoder is not None and actor is not None
        latent_dim = encoder.features_dim if memory is None else memory.hidden_size
        inner = make_encoder(encoder, ObservationSpec(manifest.observation, atlas))
        return cls(
            RawEncoder(inner, manifest.observation, encoder.divide_by_255),
            make_memory(memory, encoder.features_dim),
            make_actor(actor, latent_dim, manifest.action, manifest.n_agents, ACTIVATIONS[actor.activation]),
        )

    def forward(
        self, observation: th.Tensor, agent: th.Tensor | None = None, states: States = ()
    ) -> tuple[PoolOutput, States]:
        """
        Compute the selection weights and action parameters.

        :param observation: (K, *shape) raw own observations
        :param agent: (K,) indices of agents, if the actor depends on them
        :param states: hidden and cell state of the memory, (layers, K, H) each, if there is one
        :return: log weights (K, U) and parameters (K, U, P), and the next states
        """
        latent = self.encoder(observation)
        if self.memory is not None:
            hidden, cell = states
            outputs, states = self.memory(latent.unsqueeze(0), (hidden, cell))
            latent = outputs.squeeze(0)
        return self.actor.evaluate(latent, agent), states

    def tensors(self) -> dict[str, th.Tensor]:
        """Return the weights by their names in files."""
        return {_name_in_file(name): tensor for name, tensor in self.state_dict().items()}


def _name_in_file(name: str) -> str:
    """Return the name in files (format version 2), which is shorter than that of the module."""
    return name.replace("encoder.encoder.", "encoder.").replace("actor.head.heads.", "actor.heads.")


def decide(space: SpaceSpec, selection: str, output: PoolOutput, deterministic: bool) -> th.Tensor:
    """
    Choose actions as the trained model's ``predict``, with the same random numbers.

    :param space: the action space
    :param selection: ``"mixture"``, ``"gumbel"``, or ``"greedy"`` if parameters are action values
    :param output: output of the network, with illegal actions masked
    :param deterministic: whether to take the most likely action
    :return: (K, D)
    """
    log_weights, parameters = output
    is_pool = log_weights.shape[1] > 1
    favourite = policy_parameters(parameters, log_weights.argmax(dim=1)) if is_pool else parameters[:, 0]
    if selection == "greedy":
        # Values, not logits: no sampling.
        return favourite.argmax(dim=1, keepdim=True)
    if deterministic:
        mixed = is_pool and selection == "mixture"
        return mixture_mode(space, log_weights, parameters) if mixed else likeliest_action(space, favourite)
    if not is_pool:
        return sample_action(space, favourite)
    if selection == "gumbel":
        return sample_action(space, draw_policy(log_weights, parameters))
    if space.kind == "discrete":
        return sample_action(space, mixture_log_probs(log_weights, parameters))
    return mixture_sample(space, log_weights, parameters)


# --- reading ----------------------------------------------------------------------------------------------------------


def load_network(manifest: Manifest, weights: bytes) -> tuple[AgentNetwork, Array | None]:
    """
    Make the network of a manifest from the content of a safetensors file.

    Sizes are compared with the file's before memory is allocated.

    :return: the network, and the pixels of tile codes if observations are tile codes
    :raises ExportError: if manifest and weights do not match
    """
    try:
        tensors = load(weights)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError, OverflowError) as error:
        raise ExportError(f"{WEIGHTS_FILE} is not a valid safetensors file: {error}") from error
    _check_layers(manifest, len(tensors))
    atlas = _taken_atlas(manifest, tensors)
    with th.device("meta"):
        network = AgentNetwork.of(manifest, atlas)
    check_tensors(network.tensors(), tensors, WEIGHTS_FILE)
    network.load_state_dict({name: tensors[_name_in_file(name)] for name in network.state_dict()}, assign=True)
    return network.requires_grad_(False).eval(), atlas


def _taken_atlas(manifest: Manifest, tensors: dict[str, th.Tensor]) -> Array | None:
    shape = manifest.observation.atlas
    reads_pixels = manifest.encoder is not None and manifest.encoder.name != "MLPEncoder"
    if shape is None or (ATLAS not in tensors and not reads_pixels):
        return None
    check_tensors({ATLAS: th.empty(shape, dtype=th.uint8, device="meta")}, tensors, WEIGHTS_FILE, subset=True)
    return np.array(tensors.pop(ATLAS).numpy())


def _check_layers(manifest: Manifest, n_tensors: int) -> None:
    """Raise ExportError if the manifest has more layers than the file, before modules are made."""
    actor = manifest.actor
    assert actor is not None
    n_heads = manifest.n_agents if actor.name == "AgentPolicies" else actor.n_policies
    needed = 2 * (n_heads * (len(actor.hidden) + 1) + len(actor.projection_hidden))
    if manifest.memory is not None:
        needed += 2 * manifest.memory.n_layers
    if needed > n_tensors:
        raise ExportError(f"{MANIFEST_FILE} describes at least {needed} tensors, {WEIGHTS_FILE} has {n_tensors}")


def check_tensors(
    expected: Mapping[str, th.Tensor], found: Mapping[Any, Any], source: str, remedy: str = "", subset: bool = False
) -> None:
    """Compare tensors of a file, ``source``, with a network's; the ExportError has the difference and the remedy."""
    if missing := sorted(expected.keys() - found.keys()):
        raise ExportError(f"{source} lacks the tensor {missing[0]!r}{remedy}")
    if not subset and (unknown := sorted(map(str, found.keys() - expected.keys()))):
        raise ExportError(f"{source} has a tensor that the network does not have: {unknown[0][:80]!r}{remedy}")
    for name, wanted in expected.items():
        tensor = found[name]
        if not isinstance(tensor, th.Tensor) or tensor.layout != th.strided or tensor.is_quantized:
            raise ExportError(f"{source}: {name!r} is no plain tensor")
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise ExportError(
                f"{source}: expected {name!r} of shape {tuple(wanted.shape)} and {wanted.dtype}, got "
                f"{tuple(tensor.shape)} and {tensor.dtype}{remedy}"
            )
        if not bool(tensor.isfinite().all()):
            raise ExportError(f"{source}: {name!r} has NaN or infinity")
