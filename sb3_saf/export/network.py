"""
The networks of an actor in torch alone: encoder and policies, from raw own observations to action parameters.

The layers are those of ``sb3_saf.networks``, under the same names, without what training needs around them. Letters: K
rows, d features, N agents, U policies, P parameters of one policy's distribution, A actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod
from typing import Final

import torch as th
from torch import nn

from sb3_saf.export.manifest import (
    ACTIVATION_NAMES,
    ActorNet,
    EncoderNet,
    Manifest,
    MemoryNet,
    SpaceRecord,
    picture_shape,
)
from sb3_saf.networks.layers import mlp

#: Activations that a file may name.
ACTIVATIONS: Final[dict[str, type[nn.Module]]] = {name: getattr(nn, name) for name in ACTIVATION_NAMES}


class Pictures(nn.Module):
    """
    Raw pictures or tile codes as float pictures (K, C, H, W).

    :param space: of one own observation
    :param divide_by_255: whether pictures of bytes are scaled to [0, 1]
    """

    atlas: th.Tensor

    def __init__(self, space: SpaceRecord, divide_by_255: bool):
        super().__init__()
        self.divide_by_255 = divide_by_255
        self.shape = picture_shape(space)
        self.is_codes = space.atlas is not None
        self.channels_last = not self.is_codes and space.shape != self.shape
        if space.atlas is not None:
            self.register_buffer("atlas", th.zeros(space.atlas, dtype=th.uint8))

    def colours(self) -> th.Tensor:
        """(n_codes, t, t, C) pixels of every code in [0, 1]."""
        return self.atlas.float() / 255.0

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw observations to (K, C, H, W)."""
        if self.is_codes:
            tiles = self.colours()[observations.long()]
            channels, height, width = self.shape
            return tiles.transpose(2, 3).reshape(-1, height, width, channels).permute(0, 3, 1, 2)
        pictures = observations.float()
        if self.divide_by_255:
            pictures = pictures / 255.0
        if self.channels_last:
            pictures = pictures.permute(0, 3, 1, 2)
        return pictures.contiguous(memory_format=th.channels_last)


class PaperCNN(nn.Module):
    """See ``sb3_saf.PaperCNN``."""

    def __init__(self, space: SpaceRecord, net: EncoderNet):
        super().__init__()
        self.pixels = Pictures(space, net.divide_by_255)
        channels, height, width = self.pixels.shape
        out = [((size - 4) // 2 + 1 - 3) // 2 + 1 for size in (height, width)]
        self.net = nn.Sequential(
            nn.Conv2d(channels, 32, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(32, 64, kernel_size=3, stride=2),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(64 * prod(out), 512),
            nn.ReLU(),
            nn.Linear(512, net.features_dim),
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw observations to (K, d)."""
        features: th.Tensor = self.net(self.pixels(observations))
        return features


class NatureEncoder(nn.Module):
    """See ``sb3_saf.NatureEncoder``."""

    def __init__(self, space: SpaceRecord, net: EncoderNet):
        super().__init__()
        self.pixels = Pictures(space, net.divide_by_255)
        self.nature = _NatureCNN(self.pixels.shape, net.features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw observations to (K, d)."""
        features: th.Tensor = self.nature(self.pixels(observations))
        return features


class _NatureCNN(nn.Module):
    """Stable-Baselines3's, without Stable-Baselines3."""

    def __init__(self, shape: tuple[int, int, int], features_dim: int):
        super().__init__()
        channels, height, width = shape
        out = [(((size - 8) // 4 + 1 - 4) // 2 + 1 - 3) + 1 for size in (height, width)]
        self.cnn = nn.Sequential(
            nn.Conv2d(channels, 32, kernel_size=8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, kernel_size=3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.linear = nn.Sequential(nn.Linear(64 * prod(out), features_dim), nn.ReLU())

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """(K, C, H, W) to (K, d)."""
        features: th.Tensor = self.linear(self.cnn(pictures))
        return features


class LightEncoder(nn.Module):
    """See ``sb3_saf.LightEncoder``."""

    def __init__(self, space: SpaceRecord, net: EncoderNet):
        super().__init__()
        self.pixels = Pictures(space, net.divide_by_255)
        self.tile = net.tile_size
        channels, height, width = self.pixels.shape
        self.n_tiles = (height // self.tile) * (width // self.tile)
        self.embed = nn.Linear(self.tile**2 * channels, net.embedding_dim)
        self.net = mlp([self.n_tiles * net.embedding_dim, net.hidden, net.features_dim], nn.ReLU)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw observations to (K, d)."""
        if self.pixels.is_codes:
            by_code = self.embed(self.pixels.colours().flatten(1))
            tiles = nn.functional.embedding(observations.long().flatten(1), by_code)
        else:
            tiles = self.embed(self._cut(self.pixels(observations)))
        features: th.Tensor = self.net(tiles.flatten(1))
        return features

    def _cut(self, pictures: th.Tensor) -> th.Tensor:
        """(K, tiles, t * t * C): (K, C, H, W)."""
        channels, height, width = self.pixels.shape
        t = self.tile
        tiles = pictures.reshape(-1, channels, height // t, t, width // t, t).permute(0, 2, 4, 3, 5, 1)
        return tiles.reshape(-1, self.n_tiles, t * t * channels)


class MLPEncoder(nn.Module):
    """See ``sb3_saf.MLPEncoder``."""

    def __init__(self, space: SpaceRecord, net: EncoderNet):
        super().__init__()
        self.choices = space.choices if space.is_one_hot else ()
        self.divide_by_255 = net.divide_by_255
        n_inputs = sum(self.choices) or prod(space.shape)
        self.net = mlp([n_inputs, net.hidden, net.features_dim], nn.Tanh)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw observations to (K, d)."""
        features: th.Tensor = self.net(self._one_hot(observations) if self.choices else self._floats(observations))
        return features

    def _floats(self, observations: th.Tensor) -> th.Tensor:
        numbers = observations.float()
        return (numbers / 255.0 if self.divide_by_255 else numbers).flatten(1)

    def _one_hot(self, observations: th.Tensor) -> th.Tensor:
        columns = observations.reshape(-1, len(self.choices)).long()
        hot = [columns[:, i : i + 1] == th.arange(n) for i, n in enumerate(self.choices)]
        return th.cat(hot, dim=1).float()


#: Encoders that a file may name.
ENCODERS: Final[dict[str, Callable[[SpaceRecord, EncoderNet], nn.Module]]] = {
    "LightEncoder": LightEncoder,
    "MLPEncoder": MLPEncoder,
    "NatureEncoder": NatureEncoder,
    "PaperCNN": PaperCNN,
}


class Head(nn.Module):
    """
    One policy: an MLP, and for Box actions a standard deviation that does not depend on the observation.

    :param sizes: d, hidden layers, outputs
    :param activation_fn: activation of the hidden layers
    :param has_std: whether actions are a Box
    """

    log_std: nn.Parameter | None

    def __init__(self, sizes: Sequence[int], activation_fn: type[nn.Module], has_std: bool):
        super().__init__()
        self.register_parameter("log_std", nn.Parameter(th.zeros(sizes[-1])) if has_std else None)
        self.net = mlp(sizes, activation_fn)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """(K, d) to (K, P)."""
        outputs: th.Tensor = self.net(features)
        return outputs if self.log_std is None else th.cat([outputs, self.log_std.expand_as(outputs)], dim=1)


class SinglePolicy(nn.Module):
    """
    One policy for all agents.

    :param head: the policy
    """

    def __init__(self, head: nn.Module):
        super().__init__()
        self.head = head

    def forward(self, features: th.Tensor, agent: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """(K, d) to (K, 1) log weights and (K, 1, P) parameters."""
        return _certain(features), self.head(features).unsqueeze(1)


class AgentPolicies(nn.Module):
    """
    One policy for each agent; rows may belong to different agents.

    :param heads: N policies
    """

    def __init__(self, heads: Sequence[Head]):
        super().__init__()
        self.heads = nn.ModuleList(heads)

    def forward(self, features: th.Tensor, agent: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """(K, d) and (K,) agents to (K, 1) log weights and (K, 1, P) parameters."""
        assert agent is not None
        every = th.stack([head(features) for head in self.heads], dim=1)
        return _certain(features), every.gather(1, agent.reshape(-1, 1, 1).expand(-1, 1, every.shape[2]))

    def of_agent(self, agent: int) -> SinglePolicy:
        """The policy of one agent."""
        return SinglePolicy(self.heads[agent])


class PolicyPool(nn.Module):
    """
    U policies and the choice among them: see ``sb3_saf.networks.policy_pool.PolicyPool``.

    :param query_net: (K, d) features to (K, latent) queries
    :param latent_dim: size of queries and signature keys
    :param policies: U policies
    """

    def __init__(self, query_net: nn.Module, latent_dim: int, policies: Sequence[Head]):
        super().__init__()
        self.query_net = query_net
        self.signature_keys = nn.Parameter(th.zeros(len(policies), latent_dim))
        self.policies = nn.ModuleList(policies)

    def forward(self, features: th.Tensor, agent: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """(K, d) to (K, U) log weights and (K, U, P) parameters."""
        logits = self.query_net(features) @ self.signature_keys.t() * self.signature_keys.shape[1] ** -0.5
        return logits.log_softmax(dim=1), th.stack([policy(features) for policy in self.policies], dim=1)


def _certain(features: th.Tensor) -> th.Tensor:
    """(K, 1) log weights of the only policy."""
    return th.zeros_like(features[:, :1])


def make_actor(
    net: ActorNet, features_dim: int, action: SpaceRecord, n_agents: int, activation_fn: type[nn.Module]
) -> SinglePolicy | AgentPolicies | PolicyPool:
    """
    The policies, with weights yet to be loaded.

    :param net: which, and their sizes
    :param features_dim: d
    :param action: the action space
    :param n_agents: N
    :param activation_fn: activation of hidden layers
    """
    sizes = [features_dim, *net.hidden, action.n_outputs]

    def heads(count: int) -> list[Head]:
        return [Head(sizes, activation_fn, has_std=action.kind == "box") for _ in range(count)]

    if net.name == "SinglePolicy":
        return SinglePolicy(heads(1)[0])
    if net.name == "AgentPolicies":
        return AgentPolicies(heads(n_agents))
    query_net = mlp([features_dim, *net.projection_hidden, net.latent_dim], activation_fn)
    return PolicyPool(query_net, net.latent_dim, heads(net.n_policies))


def make_memory(net: MemoryNet | None, features_dim: int) -> nn.LSTM | None:
    """
    The LSTM, with weights yet to be loaded.

    :param net: its sizes; None without memory
    :param features_dim: d
    """
    return None if net is None else nn.LSTM(features_dim, net.hidden_size, net.n_layers, bias=net.bias)


class ActorNetwork(nn.Module):
    """
    All that an agent needs to act.

    :param encoder: (K, *shape) raw own observations to (K, d)
    :param memory: LSTM over the features of one step after the other, (K, d) to (K, H); None without memory
    :param actor: (K, d), or (K, H), and agents to log weights and parameters
    :param gives_log_probs: whether actions are discrete, so that each has a probability
    """

    def __init__(
        self,
        encoder: nn.Module,
        memory: nn.LSTM | None,
        actor: SinglePolicy | AgentPolicies | PolicyPool,
        gives_log_probs: bool,
    ) -> None:
        super().__init__()
        self.encoder, self.memory, self.actor, self.gives_log_probs = encoder, memory, actor, gives_log_probs

    @classmethod
    def of(cls, manifest: Manifest) -> ActorNetwork:
        """The networks that a manifest describes, with weights yet to be loaded."""
        encoder, actor, memory = manifest.encoder, manifest.actor, manifest.memory
        assert encoder is not None and actor is not None
        latent_dim = encoder.features_dim if memory is None else memory.hidden_size
        return cls(
            ENCODERS[encoder.name](manifest.observation, encoder),
            make_memory(memory, encoder.features_dim),
            make_actor(actor, latent_dim, manifest.action, manifest.n_agents, ACTIVATIONS[actor.activation]),
            manifest.gives_log_probs,
        )

    def forward(
        self,
        observation: th.Tensor,
        agent: th.Tensor | None = None,
        hidden: th.Tensor | None = None,
        cell: th.Tensor | None = None,
    ) -> tuple[th.Tensor, ...]:
        """
        Everything that the action depends on.

        :param observation: (K, *shape) raw own observations
        :param agent: (K,) indices of agents, where each has a policy of its own
        :param hidden: (layers, K, H) what is remembered, where there is a memory
        :param cell: the same of the LSTM's cells
        :return: log weights (K, U), parameters (K, U, P), for discrete actions log-probabilities (K, A), and with a
            memory the next hidden and cell states
        """
        latent, states = self.encoder(observation), ()
        if self.memory is not None:
            assert hidden is not None and cell is not None
            outputs, states = self.memory(latent.unsqueeze(0), (hidden, cell))
            latent = outputs.squeeze(0)
        log_weights, parameters = self.actor(latent, agent)
        if not self.gives_log_probs:
            return log_weights, parameters, *states
        log_probs = (log_weights.unsqueeze(2) + parameters.log_softmax(dim=2)).logsumexp(dim=1)
        return log_weights, parameters, log_probs, *states
