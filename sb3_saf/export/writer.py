"""Export of a trained model to the files of an actor."""

from __future__ import annotations

import copy
import warnings
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from msgspec.structs import replace
from safetensors.torch import save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import nn

from sb3_saf.export.comparison import ExportablePolicy, check_network, some_inputs
from sb3_saf.export.files import write_folder
from sb3_saf.export.manifest import (
    MANIFEST_FILE,
    ONNX_FILE,
    SCRIPT_FILE,
    WEIGHTS_FILE,
    Activation,
    ActorNet,
    DataFile,
    EncoderName,
    EncoderNet,
    Manifest,
    MemoryNet,
)
from sb3_saf.export.network import ACTIVATIONS, ATLAS, AgentNetwork, RawEncoder, make_actor, make_encoder, make_memory
from sb3_saf.networks.actor import ActionHead, PolicyPool, Selection, SinglePolicy
from sb3_saf.networks.layers import AgentHeads
from sb3_saf.networks.spaces import AnySpace, ObservationSpec, SpaceSpec, observation_spec, spec_of
from sb3_saf.policies.base import TeamMaskablePolicy, TeamPolicy
from sb3_saf.policies.extractors import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
from sb3_saf.policies.recurrent import TeamRecurrentPolicy
from sb3_saf.qplex.policies import QPLEXPolicy
from sb3_saf.teams import package_version
from sb3_saf.teams.errors import ExportError


def export_actors(
    model: BaseAlgorithm | ExportablePolicy,
    folder: str | PathLike[str],
    onnx: bool = True,
    overwrite: bool = False,
) -> Path:
    """
    Write the actor of one agent: encoder, policies and their selection.

    ===================== ============================================================================
    file                  content
    ===================== ============================================================================
    ``actor.json``        spaces, networks, versions and checksums
    ``actor.safetensors`` the weights, and the pictures of tile codes
    ``actor.onnx``        the same network as a graph, from raw observations to actions
    ``act.py``            an example that needs only NumPy and onnxruntime
    ===================== ============================================================================

    The critic is not exported, nor are VecNormalize's statistics, of which a warning tells. ``sb3_saf.Actor.load``
    reads the folder. Actors of models with action masks need a mask with each observation, those of models with memory
    a memory (see :class:`~sb3_saf.Actor`). With a custom encoder or activation only the ONNX graph is written, without
    ``actor.safetensors``. The folder is written atomically; an earlier export is replaced.

    :param model: an algorithm with a SAF, MAPPO or IPPO policy, also recurrent or maskable; QPLEX without memory; or
        the policy itself
    :param folder: output folder
    :param onnx: whether to write ``actor.onnx`` and ``act.py``, which needs ``pip install -e '.[export]'``
    :param overwrite: whether to replace a folder that is not an export, with all its content
    :return: the folder
    :raises ExportError: if the model has no such actor, the folder must not be replaced, or the exported network's
        outputs differ from the model's
    """
    policy = _checked_policy(model)
    layer = model.get_vec_normalize_env() if isinstance(model, BaseAlgorithm) else None
    if layer is not None and layer.norm_obs:
        warnings.warn(
            "the model was trained on observations normalised by VecNormalize, whose statistics are not exported; "
            "normalise what the actors observe, as env.normalize_obs does",
            UserWarning,
            stacklevel=2,
        )
    described = _Described.of(policy)
    network = described.network(policy)
    inputs = some_inputs(policy, described.memory)
    check_network(policy, network, inputs)
    atlas = described.observation.atlas
    data: dict[str, bytes] = {}
    if described.encoder is not None and described.activation_is_known:
        data[WEIGHTS_FILE] = save(_tensors(network, described.observation))
    elif not onnx:
        raise ExportError(
            f"{type(policy.features_extractor).__name__} with {policy.activation_fn.__name__} can be exported as ONNX "
            "only: leave onnx=True, or use an encoder of sb3_saf and an activation of torch.nn"
        )
    if onnx:
        from sb3_saf.export.onnx_writer import onnx_bytes

        has_masks = _action_mask(policy) != "none"
        data[ONNX_FILE] = onnx_bytes(network, described.action, described.selection, inputs, has_masks, atlas)
    manifest = described.manifest(policy, {name: DataFile.of(content) for name, content in data.items()})
    data[MANIFEST_FILE] = manifest.to_json().encode("utf-8")
    if onnx:
        data[SCRIPT_FILE] = files("sb3_saf.export").joinpath(SCRIPT_FILE).read_bytes()
    Manifest.from_json(data[MANIFEST_FILE])  # checks that it can be read again
    path = Path(folder)
    write_folder(path, data, overwrite)
    return path


def _tensors(network: AgentNetwork, observation: ObservationSpec) -> dict[str, th.Tensor]:
    """Return the weights, and the pixels of tile codes."""
    tensors = {name: tensor.contiguous() for name, tensor in network.tensors().items()}
    return tensors if observation.atlas is None else tensors | {ATLAS: th.tensor(observation.atlas)}


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
    """Parts of a policy as entries of a manifest."""

    encoder: EncoderNet | None
    memory: MemoryNet | None
    actor: ActorNet
    activation_is_known: bool
    features_dim: int
    selection: Selection | Literal["greedy"]
    observation: ObservationSpec
    action: SpaceSpec

    @classmethod
    def of(cls, policy: ExportablePolicy) -> _Described:
        _check_counts_from_zero(policy.team_spaces.own, "observation")
        _check_counts_from_zero(policy.action_space, "action")
        return cls(
            encoder=_describe_encoder(policy),
            memory=_describe_memory(policy),
            actor=_describe_actor(policy),
            activation_is_known=ACTIVATIONS.get(policy.activation_fn.__name__) is policy.activation_fn,
            features_dim=policy.features_dim,
            selection=_selection(policy),
            observation=observation_spec(policy.team_spaces.own),
            action=spec_of(policy.action_space),
        )

    def network(self, policy: ExportablePolicy) -> AgentNetwork:
        """Make the network with the policy's weights, on the CPU."""
        encoder: nn.Module = _OwnExtractor(policy)
        if self.encoder is not None:
            inner = make_encoder(self.encoder, self.observation)
            inner.load_state_dict(_inner_encoder(policy).state_dict(), strict=True)
            encoder = RawEncoder(inner, self.observation.space, self.encoder.divide_by_255)
        memory = make_memory(self.memory, self.features_dim)
        if memory is not None:
            assert isinstance(policy, TeamRecurrentPolicy)
            memory.load_state_dict(policy.lstm_actor.state_dict(), strict=True)
        latent_dim = self.features_dim if self.memory is None else self.memory.hidden_size
        n_agents = policy.team_spaces.n_agents
        actor = make_actor(self.actor, latent_dim, self.action, n_agents, policy.activation_fn)
        actor.load_state_dict(policy.actor.state_dict(), strict=True)
        return AgentNetwork(encoder, memory, actor).requires_grad_(False).eval()

    def manifest(self, policy: ExportablePolicy, data: dict[str, DataFile]) -> Manifest:
        """Make the manifest of some files."""
        complete = WEIGHTS_FILE in data
        return Manifest(
            sb3_saf_version=package_version(),
            policy=type(policy).__name__,
            n_agents=policy.team_spaces.n_agents,
            reads_agent=self.actor.reads_agent,
            action_mask=_action_mask(policy),
            selection=self.selection,
            observation=self.observation.space,
            action=self.action,
            encoder=self.encoder if complete else None,
            actor=self.actor if complete else None,
            memory=self.memory,
            files=cast("dict[Literal['actor.safetensors', 'actor.onnx'], DataFile]", data),
        )


class _OwnExtractor(nn.Module):
    """A user's features extractor on raw observations, for ONNX graphs only."""

    def __init__(self, policy: ExportablePolicy):
        super().__init__()
        self.space: spaces.Space[Any] = policy.team_spaces.own
        self.normalize_images = policy.normalize_images
        self.extractor = copy.deepcopy(policy.features_extractor).cpu()

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode (K, *shape) raw own observations as (K, d)."""
        return self.extractor(preprocess_obs(observations, self.space, self.normalize_images))


# --- describing -------------------------------------------------------------------------------------------------------


def _selection(policy: ExportablePolicy) -> Selection | Literal["greedy"]:
    if isinstance(policy, QPLEXPolicy):
        return "greedy"
    return policy.actor.selection if isinstance(policy.actor, PolicyPool) else "mixture"


def _action_mask(policy: ExportablePolicy) -> Literal["none", "optional", "required"]:
    """Return whether action masks are required, optional or not supported by the policy."""
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
    """Describe the encoder; None for classes of users, subclasses included."""
    encoder, features_dim = _inner_encoder(policy), policy.features_dim
    divide = bool(policy.normalize_images and spec_of(policy.team_spaces.own).picture)
    if type(encoder) not in (PaperCNN, NatureEncoder, MLPEncoder, LightEncoder):
        return None
    net = EncoderNet(cast(EncoderName, type(encoder).__name__), features_dim, divide)
    if isinstance(encoder, MLPEncoder):
        return replace(net, hidden=_hidden(encoder.net)[0])
    if isinstance(encoder, LightEncoder):
        return replace(
            net,
            tile_size=int(encoder.tile_size),
            embedding_dim=encoder.embed.out_features,
            hidden=_hidden(encoder.net)[0],
            one_hot_codes=encoder.one_hot_codes,
        )
    return net


def _describe_actor(policy: ExportablePolicy) -> ActorNet:
    actor = policy.actor
    head = next(module for module in actor.modules() if isinstance(module, ActionHead))
    name: Literal["AgentPolicies", "PolicyPool", "SinglePolicy"] = "SinglePolicy"
    n_policies, latent_dim = 1, 1
    projection: tuple[int, ...] = ()
    if isinstance(actor, PolicyPool):
        name, n_policies, latent_dim = "PolicyPool", actor.n_policies, actor.signature_keys.shape[1]
        projection = _hidden(actor.query_net)
    elif isinstance(actor, SinglePolicy) and isinstance(actor.head, AgentHeads):
        name = "AgentPolicies"
    activation = cast(Activation, policy.activation_fn.__name__)
    identity = actor.n_identities > 0
    return ActorNet(name, _hidden(head.net), activation, n_policies, latent_dim, projection, identity)


def _hidden(net: nn.Sequential) -> tuple[int, ...]:
    """Return the sizes of the hidden layers of an MLP."""
    return tuple(layer.out_features for layer in net if isinstance(layer, nn.Linear))[:-1]


def _check_counts_from_zero(space: AnySpace, what: str) -> None:
    if np.any(getattr(space, "start", 0)):
        raise ExportError(
            f"expected the {what} space Box, Discrete, MultiDiscrete (of one axis) or MultiBinary, counting from 0, "
            f"got {space}"
        )
