"""Run an exported actor in onnxruntime."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_saf.export.act import feeds
from sb3_saf.export.files import read_checked
from sb3_saf.export.manifest import ONNX_FILE, Manifest
from sb3_saf.export.runtime import Array, Inputs, Rng, Runtime, States
from sb3_saf.networks.spaces import MAX_SIZE
from sb3_saf.teams.errors import ExportError

if TYPE_CHECKING:
    from sb3_saf.networks.actor import PoolOutput


def make_session(data: bytes) -> Any:
    """Return an onnxruntime session of a graph, on one thread of the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"], enable_fallback=0)


def make_onnx_runtime(folder: Path, manifest: Manifest, agent: int | None) -> Runtime:
    """Make the runtime for the graph of an export."""
    graph = Graph(folder, manifest, agent)
    return OnnxRuntime(graph) if manifest.format_version > 2 else _version_2(graph)


class Graph:
    """A graph in onnxruntime with checked outputs; ``agent`` is needed if the actor depends on it."""

    def __init__(self, folder: Path, manifest: Manifest, agent: int | None):
        try:
            import onnxruntime  # noqa: F401
        except ImportError as error:
            raise ImportError("runtime='onnx' needs onnxruntime: pip install -e '.[export]'") from error
        if ONNX_FILE not in manifest.files:
            raise ExportError(f'{folder} was exported without {ONNX_FILE}; load it with runtime="torch"')
        data = read_checked(folder / ONNX_FILE, manifest.files[ONNX_FILE])
        try:
            self.session = make_session(data)
        except Exception as error:  # its errors have no other common class
            raise ExportError(f"{ONNX_FILE} is not a valid ONNX file: {str(error)[:200]}") from error
        sizes = [size for entry in self.session.get_inputs() for size in entry.shape[1:] if isinstance(size, int)]
        if any(not 1 <= size <= MAX_SIZE for size in sizes):
            raise ExportError(f"{ONNX_FILE} has an input of the sizes {sizes}")
        self.manifest, self.agent = manifest, agent

    def known(self, inputs: Inputs) -> dict[str, Array]:
        """Return the inputs of the graph that all queries share."""
        known = {"observation": inputs.observation, **dict(zip(("hidden", "cell"), inputs.states, strict=False))}
        if inputs.action_mask is not None:
            known["action_mask"] = inputs.action_mask
        if self.manifest.reads_agent:
            known["agent"] = np.full(len(inputs.observation), self.agent, dtype=np.int64)
        return known

    def run(self, names: list[str], values: dict[str, Array]) -> list[Array]:
        """Return the named outputs; ExportError if the graph fails, or returns NaN."""
        try:
            outputs = [np.asarray(output) for output in self.session.run(names, values)]
        except Exception as error:
            raise ExportError(f"{ONNX_FILE} does not run on such observations: {str(error)[:200]}") from error
        if any(output.dtype.kind == "f" and np.isnan(output).any() for output in outputs):
            raise ExportError(f"{ONNX_FILE} gives NaN")
        return outputs


class OnnxRuntime:
    """Runtime for graphs of the current format version, which choose actions."""

    def __init__(self, graph: Graph):
        self.graph, self.manifest = graph, graph.manifest
        self.rng = np.random.default_rng()
        self.atlas = _atlas(graph)

    def act(self, inputs: Inputs, deterministic: bool, rng: Rng) -> tuple[Array, States]:
        """See :class:`Runtime`."""
        name = "most_likely" if deterministic or self.manifest.selection == "greedy" else "drawn"
        source = None if name == "most_likely" else self.rng if rng is None else np.random.default_rng(rng)
        names = [name, *(["next_hidden", "next_cell"] if inputs.states else [])]
        shape = (len(inputs.observation), *self.manifest.action.shape)
        actions, *states = self._run(names, inputs, source, [shape, *(state.shape for state in inputs.states)])
        return actions, tuple(states)

    def log_probs(self, inputs: Inputs) -> Array:
        """See :class:`Runtime`."""
        return self._run(["log_probs"], inputs, None, [(len(inputs.observation), self.manifest.action.n_outputs)])[0]

    def log_prob(self, inputs: Inputs, actions: Array) -> Array:
        """See :class:`Runtime`."""
        given = actions.astype(np.int64 if self.manifest.action.is_one_hot else np.float32)
        return self._run(["log_prob"], inputs, None, [(len(inputs.observation),)], action=given)[0]

    def _run(
        self,
        names: list[str],
        inputs: Inputs,
        rng: np.random.Generator | None,
        shapes: list[tuple[int, ...]],
        **more: Array,
    ) -> list[Array]:
        try:
            values = feeds(self.graph.session, self.graph.known(inputs) | more, rng)
        except (KeyError, TypeError, ValueError) as error:
            raise ExportError(f"{ONNX_FILE} has inputs that no export has: {error}") from error
        outputs = self.graph.run(names, values)
        if (found := [output.shape for output in outputs]) != shapes:
            raise ExportError(f"{ONNX_FILE} gives outputs of the shapes {found}, expected {shapes}")
        return outputs


def _atlas(graph: Graph) -> Array | None:
    """Return the pixels of tile codes, stored in the metadata of the graph's file."""
    shape = graph.manifest.observation.atlas
    text = graph.session.get_modelmeta().custom_metadata_map.get("atlas")
    if shape is None or text is None:
        return None
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), dtype=np.uint8).reshape(shape)
    except ValueError as error:
        raise ExportError(f"{ONNX_FILE} does not have the pixels of {shape[0]} tile codes: {error}") from error


def _version_2(graph: Graph) -> Runtime:
    """Make the runtime for format version 2, whose graphs return weights and parameters; torch chooses actions."""
    try:
        import torch as th

        from sb3_saf.export.torch_runtime import TorchRuntime
        from sb3_saf.networks.actor import PoolOutput
    except ImportError as error:
        raise ImportError(
            "this graph was exported by an earlier version: install torch, use the act.py beside it, or export again"
        ) from error

    class Version2(TorchRuntime):
        def __init__(self) -> None:
            self.manifest, self.agent, self.atlas = graph.manifest, graph.agent, None

        def evaluate(self, inputs: Inputs) -> tuple[PoolOutput, States]:
            names = ["log_weights", "parameters", *(["next_hidden", "next_cell"] if inputs.states else [])]
            log_weights, parameters, *states = graph.run(names, graph.known(inputs))
            self._check(log_weights, parameters, [state.shape for state in states], inputs)
            return PoolOutput(th.as_tensor(log_weights), th.as_tensor(parameters)), tuple(states)

        def _check(self, log_weights: Array, parameters: Array, states: list[Any], inputs: Inputs) -> None:
            space, n_rows = self.manifest.action, len(inputs.observation)
            n_parameters = space.n_outputs * (2 if space.kind == "box" else 1)
            n_policies = log_weights.shape[-1] if log_weights.ndim else 0
            shapes = [(n_rows, n_policies), (n_rows, n_policies, n_parameters), *(s.shape for s in inputs.states)]
            found = [log_weights.shape, parameters.shape, *states]
            floats = log_weights.dtype == parameters.dtype == np.float32
            if found != shapes or n_policies < 1 or not floats:
                raise ExportError(f"{ONNX_FILE} gives outputs of the shapes {found}, expected float32 of {shapes}")

    return Version2()
