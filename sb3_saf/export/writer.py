"""Export of a trained model: its actors as an ONNX graph that chooses actions, its weights as safetensors."""

from __future__ import annotations

import base64
import copy
import inspect
import io
import json
import logging
import re
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors.torch import load, save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_saf.export import act
from sb3_saf.networks.actor import PolicyPool, SinglePolicy
from sb3_saf.networks.distributions import (
    is_one_hot,
    likeliest_action,
    masked_parameters,
    mixture_log_prob,
    mixture_log_probs,
    mixture_mode,
    n_action_parameters,
    policy_parameters,
)
from sb3_saf.networks.encoders import encoded
from sb3_saf.policies.base import TeamMaskablePolicy, TeamPolicy
from sb3_saf.qplex.policies import AgentMemory, QPLEXPolicy
from sb3_saf.teams import conversion, package_version
from sb3_saf.teams.checks import ExportError
from sb3_saf.teams.files import atomic_file, write_text
from sb3_saf.teams.rows import NormalizedSpace, choices_of

#: Policies whose actors read only one agent's own observation, index, mask and memory.
ExportablePolicy: TypeAlias = TeamPolicy | QPLEXPolicy
Tensors: TypeAlias = dict[str, th.Tensor]

_OPSET: Final = 18
#: Maximum relative difference between the model's and the graph's numbers, and how many observations are compared.
#: Rounding differs by processor: with memory and large weights 2e-4 was seen.
_TOLERANCE: Final = 1e-3
_N_CHECKED: Final = 16


def export_actors(model: BaseAlgorithm | ExportablePolicy, folder: str | PathLike[str]) -> Path:
    """
    Write the actor of one agent: encoder, memory, policies and their selection.

    ============== =================================================================================================
    file           content
    ============== =================================================================================================
    ``actor.onnx`` the graph from raw observations to actions, and what describes it (spaces, agents, masks, pixels
                   of tile codes) as metadata
    ``act.py``     :class:`sb3_saf.Actor` as a module that needs only NumPy and onnxruntime
    ============== =================================================================================================

    The critic is not exported, nor are VecNormalize's statistics, of which a warning tells. ``sb3_saf.Actor.load``
    reads the folder. Actors of models with action masks need a mask with each observation, those of models with memory
    a memory (see :class:`~sb3_saf.Actor`). Files of an earlier export are replaced, each atomically.

    :param model: an algorithm with a SAF, MAPPO or IPPO policy, also maskable, or of QPLEX, QMIX or VDN, each also with
        memory; or the policy itself
    :param folder: output folder
    :return: the folder
    :raises ImportError: without ``pip install 'sb3-saf[export]'``
    :raises ExportError: if the model has no such actor, or the graph's outputs differ from the model's
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401 - torch's exporter is built on it
    except ImportError as error:
        raise ImportError(
            "export_actors needs onnx, onnxscript and onnxruntime: pip install 'sb3-saf[export]'"
        ) from error
    policy = _checked_policy(model)
    if isinstance(policy.team_spaces.own, NormalizedSpace):
        warnings.warn(
            "the model was trained on observations normalised by VecNormalize, whose statistics are not exported; "
            "normalise what the actors observe, as env.normalize_obs does",
            UserWarning,
            stacklevel=2,
        )
    network = ActingNetwork(policy)
    inputs = network.some_inputs()
    graph = _written(network, inputs, {"sb3_saf": json.dumps(_description(policy, network))})
    _check(graph, network, policy, inputs)
    path = Path(folder)
    with atomic_file(path / "actor.onnx") as file:
        file.write(graph)
    # act.py with the code that it imports from this package.
    _, _, code = inspect.getsource(conversion).partition("from __future__ import annotations\n")
    line = r"from sb3_saf.teams.conversion import .*\n"
    write_text(path / "act.py", re.sub(line, lambda _: f"{code.strip()}\n\n\n", inspect.getsource(act)))
    return path


def _checked_policy(model: object) -> ExportablePolicy:
    policy = getattr(model, "policy", model)
    if not isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        raise ExportError(
            f"expected model with SAFPolicy, MAPPOPolicy or IPPOPolicy, or of QPLEX, got {type(policy).__name__}; "
            "policies of Stable-Baselines3 itself read whole rows and have no actor of one agent"
        )
    if type(policy.actor) not in (SinglePolicy, PolicyPool):
        raise ExportError(f"expected the actor SinglePolicy or PolicyPool, got {type(policy.actor).__name__}")
    for space in (policy.team_spaces.own, policy.action_space):
        if np.any(getattr(space, "start", 0)):
            raise ExportError(f"expected spaces counting from 0, got {space}")
    wrong = [name for name, tensor in policy.state_dict().items() if not bool(tensor.isfinite().all())]
    if wrong:
        raise ExportError(f"the model's {wrong[0]} has NaN or infinity: training went wrong before it was exported")
    return policy


def _plain_names(names: Sequence[Any]) -> Any:
    """Return names of agents as JSON holds them: tuples as lists, NumPy's numbers as Python's."""
    try:
        plain = json.loads(json.dumps(list(names), default=lambda number: number.item()))
    except (AttributeError, TypeError, ValueError):
        plain = None
    if plain is None or conversion.tupled(plain) != tuple(names):
        raise ExportError(
            f"expected names of agents in possible_agents to be text, numbers or tuples of these, got {list(names)}"
        )
    return plain


def _description(policy: ExportablePolicy, network: ActingNetwork) -> dict[str, Any]:
    """Return what :class:`sb3_saf.Actor` needs to know of a graph, as plain data."""
    own, names, conversions = policy.team_spaces.own, policy.team_spaces.names, policy.team_spaces.conversions
    choices, pixels = None, None
    if is_one_hot(own):
        choices = np.reshape(choices_of(own), own.shape or ()).tolist()
    if (atlas := getattr(own, "atlas", None)) is not None:
        choices, pixels = len(atlas), {"shape": atlas.shape, "pixels": base64.b64encode(atlas.tobytes()).decode()}
    masks = "optional" if isinstance(policy, TeamMaskablePolicy) else "none"
    return {
        "version": package_version(),
        "policy": type(policy).__name__,
        "n_agents": policy.team_spaces.n_agents,
        "agents": _plain_names(names) if names else None,
        "reads_agent": network.reads_agent,
        "action_mask": masks if policy.team_spaces.action_mask is None else "required",
        "greedy": network.greedy,
        "states": network.state_shapes,
        "choices": choices_of(policy.action_space),
        "conversions": None if conversions is None else [asdict(one) for one in conversions],
        "observation": {
            "shape": own.shape or (),
            "dtype": str(own.dtype),
            "choices": choices,
            "picture": is_image_space(own),
            "atlas": pixels,
        },
    }


# --- the network ------------------------------------------------------------------------------------------------------


class ActingNetwork(nn.Module):
    """
    From raw own observations of an agent to its actions; random numbers are inputs.

    Inputs, by name: ``observation`` (rows, *shape) of the observation space's dtype; ``agent`` (rows,) int64 if the
    actor depends on it; ``action_mask`` (rows, M) bool if masks are supported; the memory's states (rows, ...); and
    unless the network is greedy, ``action`` (rows, D), the argument of ``log_prob``, and the noise of ``drawn``:
    ``gumbel_policy`` (rows, U) and ``normal_action``, ``logistic_action`` or ``gumbel_action``, named by distribution.

    Outputs: ``most_likely`` (rows, *shape); ``drawn``, ``log_prob`` (rows,) and, for discrete actions, ``log_probs``
    (rows, A), or of a greedy network ``values`` (rows, A); and ``next_`` with the name of each state.

    :param policy: its encoder, memory and actor are copied to the CPU
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: ExportablePolicy):
        super().__init__()
        self.own, self.action_space = policy.team_spaces.own, policy.action_space
        self.n_agents, self.normalize_images = policy.team_spaces.n_agents, policy.normalize_images
        self.greedy = isinstance(policy, QPLEXPolicy)
        self.has_masks = policy.team_spaces.action_mask is not None or isinstance(policy, TeamMaskablePolicy)
        self.reads_agent = policy.acts_by_index
        modules = policy.features_extractor, policy.actor, policy.actor_memory
        self.extractor, self.actor, self.memory = copy.deepcopy(modules)
        self.state_shapes: dict[str, tuple[int, ...]] = {}
        if self.memory is not None:
            self.state_shapes["memory"] = (self.memory.state_dim,)
        if isinstance(self.memory, AgentMemory):
            self.state_shapes["last_action"] = (self.memory.n_actions,)
        if isinstance(self.action_space, spaces.Box):
            self.register_buffer("low", th.as_tensor(self.action_space.low, dtype=th.float32))
            self.register_buffer("high", th.as_tensor(self.action_space.high, dtype=th.float32))
        self.requires_grad_(False).eval().cpu()

    @property
    def noise(self) -> str:
        """NumPy's name of the noise that draws an action when added to parameters."""
        if isinstance(self.action_space, spaces.Box):
            return "normal"
        return "logistic" if isinstance(self.action_space, spaces.MultiBinary) else "gumbel"

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs."""
        names = ["most_likely", "values"] if self.greedy else ["most_likely", "drawn", "log_prob"]
        if not self.greedy and isinstance(self.action_space, spaces.Discrete):
            names.append("log_probs")
        return names + [f"next_{name}" for name in self.state_shapes]

    def some_inputs(self) -> Tensors:
        """Make random inputs without using the space's generator or torch's."""
        space, generator = copy.deepcopy(self.own), th.Generator().manual_seed(0)
        space.seed(0)
        inputs = {"observation": th.as_tensor(np.stack([np.asarray(space.sample()) for _ in range(_N_CHECKED)]))}
        if self.reads_agent:
            inputs["agent"] = th.arange(_N_CHECKED) % self.n_agents
        if self.has_masks:
            inputs["action_mask"] = th.ones(_N_CHECKED, sum(choices_of(self.action_space)), dtype=th.bool)
        for name, shape in self.state_shapes.items():
            inputs[name] = th.randn(_N_CHECKED, *shape, generator=generator)
        if not self.greedy:
            n_policies = self.actor.n_policies if isinstance(self.actor, PolicyPool) else 1
            n_parameters = n_action_parameters(self.action_space)
            is_box = isinstance(self.action_space, spaces.Box)
            n_dimensions = n_parameters // 2 if is_box else len(choices_of(self.action_space))
            inputs["action"] = th.zeros(
                _N_CHECKED, n_dimensions, dtype=th.int64 if is_one_hot(self.action_space) else th.float32
            )
            inputs["gumbel_policy"] = th.zeros(_N_CHECKED, n_policies)
            inputs[f"{self.noise}_action"] = th.zeros(_N_CHECKED, n_dimensions if is_box else n_parameters)
        return inputs

    def forward(self, inputs: Tensors) -> tuple[th.Tensor, ...]:
        """Return the outputs for inputs by name."""
        return self.of_features(encoded(self.extractor, inputs["observation"], self.own, self.normalize_images), inputs)

    def of_features(self, features: th.Tensor, inputs: Tensors) -> tuple[th.Tensor, ...]:
        """Return the outputs for features (rows, d) of the observations, and the other inputs."""
        states: list[th.Tensor] = []
        if isinstance(self.memory, AgentMemory):
            identity = nn.functional.one_hot(inputs["agent"], self.n_agents)
            features = th.cat([features, inputs["last_action"], identity.to(features.dtype)], dim=1)
        if self.memory is not None:
            features, after = self.memory.step(features, inputs["memory"])
            states.append(after)
        log_weights, parameters = self.actor.evaluate(features, inputs["agent"] if self.actor.reads_agent else None)
        if "action_mask" in inputs:
            parameters = masked_parameters(self.action_space, parameters, inputs["action_mask"])
        favourite = policy_parameters(parameters, log_weights.argmax(dim=1))
        if self.greedy:
            best = favourite.argmax(dim=1)
            if isinstance(self.memory, AgentMemory):
                states.append(nn.functional.one_hot(best, self.memory.n_actions).to(favourite.dtype))
            return best, favourite, *states
        is_mixture = isinstance(self.actor, PolicyPool) and self.actor.selection == "mixture"
        likeliest = likeliest_action(self.action_space, favourite)
        if is_mixture:
            likeliest = mixture_mode(self.action_space, log_weights, parameters)
        drawn = self._drawn(log_weights, parameters, inputs)
        log_prob = mixture_log_prob(self.action_space, log_weights, parameters, inputs["action"])
        is_discrete = isinstance(self.action_space, spaces.Discrete)
        log_probs = [mixture_log_probs(log_weights, parameters)] if is_discrete else []
        return self._in_space(likeliest), self._in_space(drawn), log_prob, *log_probs, *states

    def _drawn(self, log_weights: th.Tensor, of_policies: th.Tensor, inputs: Tensors) -> th.Tensor:
        """Sample (rows, D) as the argmax of parameters plus noise: first the policy, then its choices."""
        policy = (log_weights + inputs["gumbel_policy"]).argmax(dim=1)
        parameters, noise = policy_parameters(of_policies, policy), inputs[f"{self.noise}_action"]
        if isinstance(self.action_space, spaces.Box):
            mean, log_std = parameters.chunk(2, dim=1)
            return mean + noise * log_std.exp()
        if isinstance(self.action_space, spaces.MultiBinary):
            return (parameters + noise > 0).to(parameters.dtype)
        parts = th.split(parameters + noise, list(choices_of(self.action_space)), dim=1)
        return th.stack([part.argmax(dim=1) for part in parts], dim=1)

    def _in_space(self, actions: th.Tensor) -> th.Tensor:
        """Convert actions (rows, D) to the space, (rows, *shape)."""
        actions = actions.reshape(-1, *(self.action_space.shape or ()))
        return th.minimum(th.maximum(actions, self.low), self.high) if hasattr(self, "low") else actions


# --- the graph --------------------------------------------------------------------------------------------------------


def _written(network: ActingNetwork, inputs: Tensors, metadata: dict[str, str]) -> bytes:
    rows = th.export.Dim("rows", max=2**31 - 1)  # torch 2.7 fails without a limit
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it prints its progress
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = th.onnx.export(
                network,
                kwargs={"inputs": inputs},
                input_names=list(inputs),
                output_names=network.outputs,
                opset_version=_OPSET,
                dynamo=True,
                dynamic_shapes={"inputs": {name: {0: rows} for name in inputs}},
                external_data=False,
                verbose=False,
            )
    except Exception as error:  # a user's encoder may raise anything
        raise ExportError(f"the network cannot be written as ONNX: {error}") from error
    finally:
        logger.setLevel(level)
    assert program is not None
    proto = program.model_proto
    for key, value in metadata.items():
        proto.metadata_props.add(key=key, value=value)
    return proto.SerializeToString(deterministic=True)


def _check(graph: bytes, network: ActingNetwork, policy: ExportablePolicy, inputs: Tensors) -> None:
    """Run the graph and compare its numbers with the model's; ExportError if they differ by more than rounding."""
    import onnxruntime

    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    found = session.run(network.outputs, {name: tensor.numpy() for name, tensor in inputs.items()})
    was_training = policy.training
    policy.set_training_mode(False)
    with th.no_grad():
        features = policy.extract_features(inputs["observation"].to(policy.device)).cpu()
        expected = network.of_features(features, inputs)
    policy.set_training_mode(was_training)
    for name, one, other in zip(network.outputs, found, expected, strict=True):
        is_number = other.is_floating_point()  # choices may differ where two are equally good
        if is_number and not np.allclose(one, other.numpy(), rtol=_TOLERANCE, atol=_TOLERANCE):
            raise ExportError(
                f"the graph's {name} is not the model's: {type(policy).__name__} does more than its encoder and actor"
            )


# --- weights ----------------------------------------------------------------------------------------------------------


def save_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> Path:
    """
    Write the policy's weights as safetensors, atomically; :func:`load_weights` reads them.

    :param model: an algorithm or a policy
    :param path: the file; ``.safetensors`` is appended if missing
    :return: the file
    """
    path = Path(path)
    path = path if path.suffix == ".safetensors" else path.with_name(f"{path.name}.safetensors")
    policy: Any = getattr(model, "policy", model)
    tensors = policy.state_dict()
    names = set(_first_names(tensors).values())
    content = save({name: tensor.contiguous() for name, tensor in tensors.items() if name in names})
    with atomic_file(path) as file:
        file.write(content)
    return path


def load_weights(model: BaseAlgorithm | BasePolicy, path: str | PathLike[str]) -> None:
    """
    Load the weights of a policy, without running code from the file.

    SB3's ``load`` unpickles the whole model, so an untrusted file can run arbitrary code. Here the caller makes the
    model (with the same ``policy_kwargs``), and only tensors are read. The optimiser's state and the hyperparameters
    are not read.

    :param model: an algorithm or a policy, changed only if the whole file matches
    :param path: the file of :func:`save_weights`, or the zip file of SB3's ``save``, with or without ``.zip``
    :raises ExportError: if the file is damaged, malformed, or of a differently built policy
    """
    policy: Any = getattr(model, "policy", model)
    own: dict[str, th.Tensor] = policy.state_dict()
    path = Path(path)
    path = path if path.is_file() or path.suffix in (".zip", ".safetensors") else path.with_name(f"{path.name}.zip")
    tensors = read_weights(path)
    if path.suffix == ".safetensors":  # each tensor is stored under the first of its names
        tensors |= {name: tensors[first] for name, first in _first_names(own).items() if first in tensors}
    fix = "; make the model with the policy and policy_kwargs it was trained with"
    if missing := sorted(own.keys() - tensors.keys()):
        raise ExportError(f"{path} lacks the tensor {missing[0]!r}{fix}")
    if unknown := sorted(map(str, tensors.keys() - own.keys())):
        raise ExportError(f"{path} has a tensor that the network does not have: {unknown[0][:80]!r}{fix}")
    for name, expected in own.items():
        tensor = tensors[name]
        if not isinstance(tensor, th.Tensor) or (tensor.shape, tensor.dtype) != (expected.shape, expected.dtype):
            is_tensor = isinstance(tensor, th.Tensor)
            got = f"{tuple(tensor.shape)} and {tensor.dtype}" if is_tensor else type(tensor).__name__
            raise ExportError(
                f"{path}: expected {name!r} of shape {tuple(expected.shape)} and {expected.dtype}, got {got}{fix}"
            )
        if not bool(tensor.isfinite().all()):
            raise ExportError(f"{path}: {name!r} has NaN or infinity")
    policy.load_state_dict(tensors)


def _first_names(tensors: dict[str, th.Tensor]) -> dict[str, str]:
    """Return for every tensor the first name of the same memory: modules may be shared."""
    first: dict[tuple[Any, ...], str] = {}
    return {
        name: first.setdefault((tensor.data_ptr(), tensor.shape) if tensor.numel() else (name,), name)
        for name, tensor in tensors.items()
    }


def read_weights(path: Path) -> dict[str, th.Tensor]:
    """
    Return the weights in a file of safetensors or of a saved model; only tensors are read.

    :raises ExportError: if the file is missing, damaged, or has other content
    """
    if not path.is_file():
        raise ExportError(f"expected a model saved by Stable-Baselines3 or its weights, found no file {path}")
    try:
        if path.suffix == ".safetensors":
            return load(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} in it is damaged")
            data = archive.read("policy.pth")
        tensors = th.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # zips, the unpickler and safetensors have no common class of errors
        raise ExportError(f"{path} does not hold the tensors of a saved model: {str(error)[:200]}") from error
    if not isinstance(tensors, dict):
        raise ExportError(f"{path} must map names to tensors, got {type(tensors).__name__}")
    return tensors
