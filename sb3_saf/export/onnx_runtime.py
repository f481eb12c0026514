"""Run an exported actor in onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_saf.export.act import NumpyDraws, Outputs, States
from sb3_saf.export.errors import ExportError
from sb3_saf.export.files import read_checked
from sb3_saf.export.manifest import ONNX_FILE, Manifest

Array = npt.NDArray[Any]


class OnnxRuntime:
    """
    The graph, on one thread of the CPU.

    :param folder: of the export
    :param manifest: what it says
    :param agent: index of the agent, where each has a policy of its own
    """

    def __init__(self, folder: Path, manifest: Manifest, agent: int | None):
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError('runtime="onnx" needs onnxruntime: pip install "sb3-saf[export]"') from error
        if ONNX_FILE not in manifest.files:
            raise ExportError(f'{folder} was exported without {ONNX_FILE}; load it with runtime="torch"')
        data = read_checked(folder / ONNX_FILE, manifest.files[ONNX_FILE])
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self.session = onnxruntime.InferenceSession(
                data, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:  # its errors have no common class but this
            raise ExportError(f"{ONNX_FILE} is not a valid ONNX file: {str(error)[:200]}") from error
        self.manifest = manifest
        self.agent = agent
        self.rng = np.random.default_rng()

    def __call__(self, observations: Array, states: States = ()) -> tuple[Outputs, States]:
        """(K, *shape) own observations and what is remembered, to the network's outputs and what is remembered then."""
        inputs = {"observation": observations, **dict(zip(("hidden", "cell"), states, strict=False))}
        if self.manifest.reads_agent:
            inputs["agent"] = np.full(len(observations), self.agent, dtype=np.int64)
        try:
            outputs = self.session.run(None, inputs)
        except Exception as error:
            raise ExportError(f"{ONNX_FILE} does not run on such observations: {str(error)[:200]}") from error
        return self._checked(outputs, len(observations), states)

    def draws(self, seed: int | None) -> NumpyDraws:
        """The actor's own generator, or a new one with a seed."""
        return NumpyDraws(self.rng if seed is None else np.random.default_rng(seed))

    def _checked(self, outputs: list[Any], n_rows: int, states: States) -> tuple[Outputs, States]:
        """Nothing ties a stranger's graph to its manifest but this."""
        action = self.manifest.action
        n_parameters = action.n_outputs * (2 if action.kind == "box" else 1)
        arrays = [np.asarray(output) for output in outputs]
        n_policies = arrays[0].shape[-1] if arrays and arrays[0].ndim else 0
        shapes: list[tuple[int, ...]] = [(n_rows, n_policies), (n_rows, n_policies, n_parameters)]
        if self.manifest.gives_log_probs:
            shapes.append((n_rows, n_parameters))
        n_outputs = len(shapes)
        shapes += [state.shape for state in states]
        found = [array.shape for array in arrays]
        if found != shapes or n_policies < 1 or any(array.dtype != np.float32 for array in arrays):
            raise ExportError(f"{ONNX_FILE} gives outputs of the shapes {found}, expected float32 of {shapes}")
        if any(np.isnan(array).any() for array in arrays):
            raise ExportError(f"{ONNX_FILE} gives NaN")
        return Outputs(*arrays[:n_outputs]), tuple(arrays[n_outputs:])
