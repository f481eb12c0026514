"""Export of an agent's network as an ONNX graph that also chooses actions."""

from __future__ import annotations

import base64
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from torch import nn

from sb3_saf.export.comparison import check_close
from sb3_saf.export.network import AgentNetwork, Array, decide
from sb3_saf.export.onnx_runtime import make_session
from sb3_saf.networks.actor import PoolOutput
from sb3_saf.networks.distributions import (
    masked_parameters,
    mixture_log_prob,
    mixture_log_probs,
    n_action_parameters,
    policy_parameters,
)
from sb3_saf.networks.spaces import SpaceSpec
from sb3_saf.teams.errors import ExportError

_OPSET = 18
#: NumPy's name of the noise that samples actions when added to parameters, by kind of space.
_NOISE = {"box": "normal", "multi_binary": "logistic", "discrete": "gumbel", "multi_discrete": "gumbel"}


class DecidingNetwork(nn.Module):
    """An agent's network that also chooses actions; random numbers are inputs."""

    low: th.Tensor
    high: th.Tensor

    def __init__(self, network: AgentNetwork, space: SpaceSpec, selection: str):
        super().__init__()
        self.network, self.space, self.selection = network, space, selection
        if space.kind == "box":
            for side, bound in zip(("low", "high"), space.bounds(), strict=True):
                self.register_buffer(side, th.tensor(bound, dtype=th.float32).expand(space.shape).clone())

    def forward(self, inputs: dict[str, th.Tensor]) -> tuple[th.Tensor, ...]:
        """Return the outputs of :func:`output_names` for the inputs of :func:`onnx_bytes`."""
        states = (inputs["hidden"], inputs["cell"]) if "hidden" in inputs else ()
        output, states = self.network(inputs["observation"], inputs.get("agent"), states)
        if "action_mask" in inputs:
            output = output._replace(actions=masked_parameters(self.space, output.actions, inputs["action_mask"]))
        likeliest = self._in_space(decide(self.space, self.selection, output, deterministic=True))
        if self.selection == "greedy":
            return likeliest, *states
        drawn = self._in_space(self._drawn(output, inputs))
        log_prob = mixture_log_prob(self.space, output.log_weights, output.actions, inputs["action"])
        log_probs = (mixture_log_probs(*output),) if self.space.kind == "discrete" else ()
        return likeliest, drawn, log_prob, *log_probs, *states

    def _drawn(self, output: PoolOutput, inputs: dict[str, th.Tensor]) -> th.Tensor:
        """Sample (K, D) as the argmax of parameters plus noise: first the policy, then its choices."""
        policy = (output.log_weights + inputs["gumbel_policy"]).argmax(dim=1)
        parameters = policy_parameters(output.actions, policy)
        noise = inputs[f"{_NOISE[self.space.kind]}_action"]
        if self.space.kind == "box":
            mean, log_std = parameters.chunk(2, dim=1)
            return mean + noise * log_std.exp()
        if self.space.kind == "multi_binary":
            return (parameters + noise > 0).to(parameters.dtype)
        parts = th.split(parameters + noise, list(self.space.choices), dim=1)
        return th.stack([part.argmax(dim=1) for part in parts], dim=1)

    def _in_space(self, chosen: th.Tensor) -> th.Tensor:
        """Convert actions (K, D) to the space, (K, *shape)."""
        chosen = chosen.reshape(-1, *self.space.shape)
        return chosen if self.space.kind != "box" else th.minimum(th.maximum(chosen, self.low), self.high)


def output_names(space: SpaceSpec, selection: str, has_memory: bool) -> list[str]:
    """Return the names of a graph's outputs."""
    names = ["most_likely"]
    if selection != "greedy":
        names += ["drawn", "log_prob"] + (["log_probs"] if space.kind == "discrete" else [])
    return names + (["next_hidden", "next_cell"] if has_memory else [])


def onnx_bytes(
    network: AgentNetwork,
    space: SpaceSpec,
    selection: str,
    inputs: dict[str, th.Tensor],
    has_masks: bool,
    atlas: Array | None,
) -> bytes:
    """
    Write the graph, run it, and compare.

    Inputs: ``observation`` (rows, *shape) of the observation space's dtype, ``agent`` (rows,) int64 if the actor
    depends on it, ``action_mask`` (rows, M) bool if masks are supported, ``hidden`` and ``cell`` (layers, rows, H) with
    memory; and unless selection is greedy, ``action`` (rows, D), the argument of ``log_prob``, and the noise of
    ``drawn``: ``gumbel_policy`` (rows, U) and ``normal_action``, ``logistic_action`` or ``gumbel_action``, named by
    distribution.

    Outputs: ``most_likely`` and ``drawn`` (rows, *shape), ``log_prob`` (rows,), for discrete actions ``log_probs``
    (rows, A), and with a memory ``next_hidden`` and ``next_cell``.

    :param network: what to write
    :param space: the action space
    :param selection: see ``sb3_saf.export.network.decide``
    :param inputs: example inputs of the agent's network by name, for tracing and comparison
    :param has_masks: whether actions may be masked
    :param atlas: pixels of tile codes, if observations are tile codes
    :raises ImportError: if onnx, onnxscript or onnxruntime are missing
    :raises ExportError: if the network cannot be written as a graph, or the graph's outputs differ
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401 - torch's exporter is built on it
    except ImportError as error:
        raise ImportError(
            "writing ONNX needs onnx, onnxscript and onnxruntime: pip install -e '.[export]', or pass onnx=False"
        ) from error
    deciding = DecidingNetwork(network, space, selection).requires_grad_(False).eval()
    inputs = inputs | _more_inputs(network, space, selection, inputs, has_masks)
    names = output_names(space, selection, network.memory is not None)
    metadata = {} if atlas is None else {"atlas": base64.b64encode(atlas.tobytes()).decode()}
    data = _written(deciding, inputs, names, metadata)
    found = make_session(data).run(names, {name: tensor.numpy() for name, tensor in inputs.items()})
    with th.no_grad():
        expected = deciding(inputs)
    for output, wanted in zip(found, expected, strict=True):
        check_close(th.as_tensor(output).float(), wanted.float(), "its ONNX graph differs")
    return data


def _more_inputs(
    network: AgentNetwork, space: SpaceSpec, selection: str, inputs: dict[str, th.Tensor], has_masks: bool
) -> dict[str, th.Tensor]:
    """Return example inputs that are only used to choose actions."""
    n_rows = len(inputs["observation"])
    more = {"action_mask": th.ones(n_rows, sum(space.choices), dtype=th.bool)} if has_masks else {}
    if selection == "greedy":
        return more
    with th.no_grad():
        states = (inputs["hidden"], inputs["cell"]) if "hidden" in inputs else ()
        output, _ = network(inputs["observation"], inputs.get("agent"), states)
        n_dimensions = len(space.choices) if space.kind != "box" else space.n_outputs
        n_noise = n_dimensions if space.kind == "box" else n_action_parameters(space)
        return more | {
            "action": th.zeros(n_rows, n_dimensions, dtype=th.int64 if space.is_one_hot else th.float32),
            "gumbel_policy": th.zeros(n_rows, output.log_weights.shape[1]),
            f"{_NOISE[space.kind]}_action": th.zeros(n_rows, n_noise),
        }


def _written(
    network: DecidingNetwork, inputs: dict[str, th.Tensor], names: list[str], metadata: dict[str, str]
) -> bytes:
    rows = th.export.Dim("rows", max=2**31 - 1)  # torch 2.7 fails without a limit
    axes = {name: {1 if name in ("hidden", "cell") else 0: rows} for name in inputs}
    try:
        with _quiet():
            program = th.onnx.export(
                network,
                kwargs={"inputs": inputs},
                input_names=list(inputs),
                output_names=names,
                opset_version=_OPSET,
                dynamo=True,
                dynamic_shapes={"inputs": axes},
                external_data=False,
                verbose=False,
            )
    except Exception as error:  # a user's encoder may raise anything
        raise ExportError(f"the network cannot be written as ONNX: {error}") from error
    assert program is not None
    proto = program.model_proto
    for key, value in metadata.items():
        proto.metadata_props.add(key=key, value=value)
    return proto.SerializeToString(deterministic=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's progress messages."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
