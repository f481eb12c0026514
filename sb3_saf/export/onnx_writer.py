"""The network of an actor as an ONNX graph."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

from sb3_saf.export.errors import ExportError
from sb3_saf.export.network import ActorNetwork
from sb3_saf.export.writer import agents_of, check_close

_OPSET = 18


def onnx_bytes(
    network: ActorNetwork, observations: th.Tensor, reads_agent: bool, expected: tuple[th.Tensor, ...]
) -> bytes:
    """
    Write the graph, run it, and compare.

    Inputs: ``observation`` (rows, *shape) of the observation space's own dtype, and ``agent`` (rows,) int64 where each
    agent has a policy of its own. Outputs: ``log_weights`` (rows, U), ``parameters`` (rows, U, P), and for discrete
    actions ``log_probs`` (rows, A).

    :param network: what to write
    :param observations: (K, *shape), to trace and to compare with
    :param reads_agent: whether there is an input ``agent``
    :param expected: the network's outputs
    :raises ImportError: if onnx, onnxscript or onnxruntime are missing
    :raises ExportError: if the network cannot be written as a graph, or the graph gives other numbers
    """
    try:
        import onnxruntime
        import onnxscript  # noqa: F401 - torch's exporter is built on it
    except ImportError as error:
        raise ImportError(
            'writing ONNX needs onnx, onnxscript and onnxruntime: pip install "sb3-saf[export]", or pass onnx=False'
        ) from error
    inputs = {"observation": observations}
    if reads_agent:
        inputs["agent"] = agents_of(observations, len(network.actor.heads))  # type: ignore[arg-type]
    data = _written(network, inputs)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    found = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
    for output, wanted in zip(found, expected, strict=True):
        check_close(th.as_tensor(output), wanted, "its ONNX graph differs")
    return data


def _written(network: ActorNetwork, inputs: dict[str, th.Tensor]) -> bytes:
    rows = th.export.Dim("rows")
    names = ["log_weights", "parameters", "log_probs"][: 3 if network.gives_log_probs else 2]
    try:
        with _quiet():
            program = th.onnx.export(
                network,
                tuple(inputs.values()),
                input_names=list(inputs),
                output_names=names,
                opset_version=_OPSET,
                dynamo=True,
                dynamic_shapes=tuple({0: rows} for _ in inputs),
                external_data=False,
                verbose=False,
            )
    except Exception as error:  # a user's own encoder may do anything
        raise ExportError(f"the network cannot be written as ONNX: {error}") from error
    assert program is not None
    data: bytes = program.model_proto.SerializeToString(deterministic=True)
    return data


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's talk about its own inside."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
