"""From a trained model to the files of an actor."""

from __future__ import annotations

import copy
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from safetensors.torch import save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from torch import nn

from sb3_saf.export.comparison import ExportablePolicy, compare, some_inputs
from sb3_saf.export.errors import ExportError
from sb3_saf.export.files import write_folder
from sb3_saf.export.manifest import (
    MANIFEST_FILE,
    ONNX_FILE,
    SCRIPT_FILE,
    WEIGHTS_FILE,
    ActorNet,
    Bound,
    DataFile,
    EncoderNet,
    Manifest,
    MemoryNet,
    SpaceRecord,
)
from sb3_saf.export.network import ACTIVATIONS, ENCODERS, ActorNetwork, make_actor, make_memory
from sb3_saf.networks.actor import ActionHead, SinglePolicy
from sb3_saf.networks.layers import AgentHeads
from sb3_saf.networks.policy_pool import PolicyPool
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.extractors import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
from sb3_saf.policies.maskable import TeamMaskablePolicy
from sb3_saf.policies.recurrent import TeamRecurrentPolicy
from sb3_saf.qplex.policies import QPLEXPolicy


def export_actors(
    model: BaseAlgorithm | ExportablePolicy,
    folder: str | PathLike[str],
    onnx: bool = True,
    overwrite: bool = False,
) -> Path:
    """
    Write what one agent needs to act on its own observation: encoder, policies and the choice among them.

    ===================== ============================================================================
    file                  content
    ===================== ============================================================================
    ``actor.json``        spaces, networks, versions and checksums, in plain words and numbers
    ``actor.safetensors`` the weights, and the pictures of tile codes
    ``actor.onnx``        the same network as a graph, from raw observations to action parameters
    ``act.py``            an example that needs NumPy and onnxruntime alone
    ===================== ============================================================================

    Nothing of the critic is written. ``sb3_saf.Actor.load`` reads the folder. Actors of models with masks of actions
    are told the mask with each observation, those of models with memory carry one (see :class:`~sb3_saf.Actor`). With
    an encoder or activation of your own, which no file can name, there is no ``actor.safetensors``: the ONNX graph is
    all. The folder appears whole or not at all; an earlier export in it is replaced.

    :param model: an algorithm with a SAF, MAPPO or IPPO policy, also recurrent or maskable; QPLEX without memory; or
        the policy itself
    :param folder: where to
    :param onnx: whether to write ``actor.onnx`` and ``act.py``, which needs ``pip install "sb3-saf[export]"``
    :param overwrite: whether to replace a folder that is not an export, with everything in it
    :return: the folder
    :raises ExportError: if the model has no such actor, the folder must not be replaced, or the exported network does
        not give the model's numbers
    """
    policy = _checked_policy(model)
    described = _Described.of(policy)
    network = described.network(policy)
    inputs = some_inputs(policy, described.memory)
    expected = compare(policy, network, inputs)
    data: dict[str, bytes] = {}
    if described.encoder is not None and described.actor_name_is_known:
        data[WEIGHTS_FILE] = save({name: tensor.contiguous() for name, tensor in network.state_dict().items()})
    elif not onnx:
        raise ExportError(
            f"{type(policy.features_extractor).__name__} with {policy.activation_fn.__name__} can be exported as ONNX "
            "only: leave onnx=True, or use an encoder of sb3_saf and an activation of torch.nn"
        )
    if onnx:
        from sb3_saf.export.onnx_writer import onnx_bytes

        data[ONNX_FILE] = onnx_bytes(network, inputs, expected)
    manifest = described.manifest(policy, {name: DataFile.of(content) for name, content in data.items()})
    data[MANIFEST_FILE] = manifest.to_json().encode("utf-8")
    if onnx:
        data[SCRIPT_FILE] = files("sb3_saf.export").joinpath(SCRIPT_FILE).read_bytes()
    Manifest.from_json(data[MANIFEST_FILE])  # what cannot be read again is not written
    path = Path(folder)
    write_folder(path, data, overwrite)
    return path


def _checked_policy(model: object) -> ExportablePolicy:
    policy = getattr(model, "policy", model)
    if not isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        raise ExportError(
            f"expected a model with SAFPolicy, MAPPOPolicy or IPPOPolicy, or of QPLEX, got "
            f"{type(policy).__name__}; policies of "
            "Stable-Baselines3 itself read whole rows and have no actor of one agent"
        )
    if getattr(policy, "memory", None) is not None:
        raise ExportError(
            f"{type(policy).__name__} cannot be exported: its memory reads the agent's last action, too; act with "
            "model.predict, which carries the state, or train RecurrentPPO's policies, whose memory can be exported"
        )
    if type(policy.actor) not in (SinglePolicy, PolicyPool):
        raise ExportError(f"expected the actor SinglePolicy or PolicyPool, got {type(policy.actor).__name__}")
    wrong = [name for name, tensor in policy.state_dict().items() if not bool(tensor.isfinite().all())]
    if wrong:
        raise ExportError(f"the model's {wrong[0]} has NaN or infinity: training went wrong before it was exported")
    return policy


class _Described(NamedTuple):
    """What the parts of a policy are in the words of a manifest."""

    encoder: EncoderNet | None
    memory: MemoryNet | None
    actor: ActorNet
    features_dim: int
    selection: str
    observation: SpaceRecord
    action: SpaceRecord

    @property
    def reads_agent(self) -> bool:
        return self.actor.name == "AgentPolicies"

    @property
    def actor_name_is_known(self) -> bool:
        return self.actor.activation in ACTIVATIONS

    @classmethod
    def of(cls, policy: ExportablePolicy) -> _Described:
        own = policy.team_spaces.own
        return cls(
            encoder=_describe_encoder(policy),
            memory=_describe_memory(policy),
            actor=_describe_actor(policy),
            features_dim=policy.features_dim,
            selection=_selection(policy),
            observation=describe_space(own, "observation"),
            action=describe_space(policy.action_space, "action"),
        )

    def network(self, policy: ExportablePolicy) -> ActorNetwork:
        """The network with the policy's weights, on the CPU."""
        encoder: nn.Module
        if self.encoder is None:
            encoder = _OwnExtractor(policy)
        else:
            encoder = ENCODERS[self.encoder.name](self.observation, self.encoder)
            encoder.load_state_dict(_encoder_tensors(policy), strict=True)
        n_agents = policy.team_spaces.n_agents
        memory = make_memory(self.memory, self.features_dim)
        if memory is not None:
            assert isinstance(policy, TeamRecurrentPolicy)
            memory.load_state_dict(policy.lstm_actor.state_dict(), strict=True)
        latent_dim = self.features_dim if self.memory is None else self.memory.hidden_size
        actor = make_actor(self.actor, latent_dim, self.action, n_agents, policy.activation_fn)
        prefix = "head." if self.reads_agent else ""
        actor.load_state_dict(
            {name.removeprefix(prefix): tensor for name, tensor in policy.actor.state_dict().items()}, strict=True
        )
        gives_log_probs = self.action.kind == "discrete" and self.selection != "greedy"
        return ActorNetwork(encoder, memory, actor, gives_log_probs).requires_grad_(False).eval()

    def manifest(self, policy: ExportablePolicy, data: dict[str, DataFile]) -> Manifest:
        """The manifest beside some files."""
        from sb3_saf import __version__

        complete = WEIGHTS_FILE in data
        return Manifest(
            sb3_saf_version=__version__,
            policy=type(policy).__name__,
            n_agents=policy.team_spaces.n_agents,
            reads_agent=self.reads_agent,
            action_mask=_action_mask(policy),
            selection=self.selection,
            observation=self.observation,
            action=self.action,
            encoder=self.encoder if complete else None,
            actor=self.actor if complete else None,
            memory=self.memory,
            files=data,
        )


class _OwnExtractor(nn.Module):
    """A user's own features extractor on raw observations; only an ONNX graph can hold it."""

    def __init__(self, policy: ExportablePolicy):
        super().__init__()
        self.space = policy.team_spaces.own
        self.normalize_images = policy.normalize_images
        self.extractor = copy.deepcopy(policy.features_extractor).cpu()

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) raw own observations to (K, d)."""
        features: th.Tensor = self.extractor(preprocess_obs(observations, self.space, self.normalize_images))
        return features


# --- describing -------------------------------------------------------------------------------------------------------


def _selection(policy: ExportablePolicy) -> str:
    if isinstance(policy, QPLEXPolicy):
        return "greedy"
    return policy.actor.selection if isinstance(policy.actor, PolicyPool) else "mixture"


def _action_mask(policy: ExportablePolicy) -> str:
    """Whether the policy asks for masks: with each observation, or only if somebody has one."""
    if policy.team_spaces.action_mask is not None:
        return "required"
    return "optional" if isinstance(policy, TeamMaskablePolicy) else "none"


def _describe_memory(policy: ExportablePolicy) -> MemoryNet | None:
    if not isinstance(policy, TeamRecurrentPolicy):
        return None
    lstm = policy.lstm_actor
    if lstm.bidirectional or lstm.proj_size or lstm.batch_first:
        raise ExportError(
            f"expected an LSTM that goes forward, lstm_kwargs of bias and dropout at most, got {policy.lstm_kwargs}"
        )
    return MemoryNet(lstm.hidden_size, lstm.num_layers, lstm.bias)


def _inner_encoder(policy: ExportablePolicy) -> nn.Module:
    extractor = policy.features_extractor
    return extractor.encoder if type(extractor) is ObservationEncoder else extractor


def _describe_encoder(policy: ExportablePolicy) -> EncoderNet | None:
    """None for an encoder that is not exactly one of ours: a subclass may do anything."""
    own, encoder = policy.team_spaces.own, _inner_encoder(policy)
    divide = bool(policy.normalize_images and isinstance(own, spaces.Box) and is_image_space(own))
    features_dim = policy.features_dim
    if type(encoder) in (PaperCNN, NatureEncoder):
        return EncoderNet(type(encoder).__name__, features_dim, divide)
    if type(encoder) is MLPEncoder:
        return EncoderNet("MLPEncoder", features_dim, divide, hidden=_hidden(encoder.net)[0])
    if type(encoder) is LightEncoder:
        return EncoderNet(
            "LightEncoder",
            features_dim,
            divide,
            tile_size=int(encoder.tile_size),
            embedding_dim=encoder.embed.out_features,
            hidden=_hidden(encoder.net)[0],
        )
    return None


def _encoder_tensors(policy: ExportablePolicy) -> dict[str, th.Tensor]:
    tensors = dict(_inner_encoder(policy).state_dict())
    own: Any = policy.team_spaces.own
    if hasattr(own, "atlas") and type(_inner_encoder(policy)) is not MLPEncoder:
        # What codes look like belongs to the space, not to the weights, and an actor has no space but this.
        tensors["pixels.atlas"] = th.tensor(np.asarray(own.atlas))
    return tensors


def _describe_actor(policy: ExportablePolicy) -> ActorNet:
    actor, activation = policy.actor, policy.activation_fn.__name__
    if ACTIVATIONS.get(activation) is not policy.activation_fn:
        activation = "one that no file can name"
    head = next(module for module in actor.modules() if isinstance(module, ActionHead))
    hidden = _hidden(head.net)
    if isinstance(actor, PolicyPool):
        latent_dim, projection = actor.signature_keys.shape[1], _hidden(actor.query_net)
        return ActorNet("PolicyPool", hidden, activation, actor.n_policies, latent_dim, projection)
    assert isinstance(actor, SinglePolicy)
    return ActorNet("AgentPolicies" if isinstance(actor.head, AgentHeads) else "SinglePolicy", hidden, activation)


def _hidden(net: nn.Sequential) -> tuple[int, ...]:
    """Sizes of the hidden layers of an MLP."""
    return tuple(layer.out_features for layer in net if isinstance(layer, nn.Linear))[:-1]


def describe_space(space: spaces.Space[Any], what: str) -> SpaceRecord:
    """
    A space in plain words and numbers.

    :param space: Box, Discrete, MultiDiscrete or MultiBinary; choices must count from 0
    :param what: its name, for messages
    :raises ExportError: for any other space
    """
    shape, dtype = tuple(int(size) for size in space.shape or ()), str(space.dtype)
    if isinstance(space, spaces.Box):
        atlas = np.shape(space.atlas) if hasattr(space, "atlas") else None
        return SpaceRecord(
            "box",
            shape,
            dtype,
            low=_bound(space.low),
            high=_bound(space.high),
            picture=atlas is None and is_image_space(space),
            atlas=None if atlas is None else (atlas[0], atlas[1], atlas[2], atlas[3]),
        )
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return SpaceRecord("discrete", shape, dtype, (int(space.n),))
    if isinstance(space, spaces.MultiDiscrete) and len(shape) == 1 and not np.any(space.start):
        return SpaceRecord("multi_discrete", shape, dtype, tuple(int(n) for n in space.nvec))
    if isinstance(space, spaces.MultiBinary):
        return SpaceRecord("multi_binary", shape, dtype, (2,) * int(np.prod(shape)))
    raise ExportError(
        f"expected the {what} space Box, Discrete, MultiDiscrete (of one axis) or MultiBinary, counting from 0, got "
        f"{space}"
    )


def _bound(values: npt.NDArray[Any]) -> Bound:
    """One number if all are equal, else nested lists."""
    if values.size and (values == values.flat[0]).all():
        values = values.flat[0]
    words = np.where(np.isinf(values), np.where(values > 0, "inf", "-inf"), "")
    numbers = np.where(words == "", values, 0).astype(values.dtype)
    return _merged(numbers.tolist(), words.tolist())


def _merged(number: Any, word: Any) -> Bound:
    if isinstance(number, list):
        return [_merged(*pair) for pair in zip(number, word, strict=True)]
    result: Bound = word or number
    return result
