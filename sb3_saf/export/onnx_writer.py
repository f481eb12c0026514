"""The network of an actor as an ONNX graph."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

from sb3_saf.export.comparison import check_close
from sb3_saf.export.errors import ExportError
from sb3_saf.export.network import ActorNetwork

_OPSET = 18


def onnx_bytes(network: ActorNetwork, inputs: dict[str, th.Tensor], expected: tuple[th.Tensor, ...]) -> bytes:
    """
    Write the graph, run it, and compare.

    Inputs: ``observation`` (rows, *shape) of the observation space's own dtype, ``agent`` (rows,) int64 where each
    agent has a policy of its own, and where there is a memory ``hidden`` and ``cell`` (layers, rows, H). Outputs:
    ``log_weights`` (rows, U), ``parameters`` (rows, U, P), for discrete actions ``log_probs`` (rows, A), and with a
    memory ``next_hidden`` and ``next_cell``.

    :param network: what to write
    :param inputs: by name, to trace and to compare with
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
    names += [] if network.memory is None else ["next_hidden", "next_cell"]
    axes = {name: {1 if name in ("hidden", "cell") else 0: rows} for name in inputs}
    try:
        with _quiet():
            program = th.onnx.export(
                network,
                kwargs=inputs,
                input_names=list(inputs),
                output_names=names,
                opset_version=_OPSET,
                dynamo=True,
                dynamic_shapes=axes,
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
