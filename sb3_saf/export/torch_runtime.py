"""Run an exported actor in torch. Letters: K rows, D action dimensions, A actions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch as th

from sb3_saf.export.files import read_checked
from sb3_saf.export.manifest import WEIGHTS_FILE, Manifest
from sb3_saf.export.network import decide, load_network
from sb3_saf.export.runtime import Array, Inputs, Rng, States
from sb3_saf.networks.actor import PoolOutput
from sb3_saf.networks.distributions import masked_parameters, mixture_log_prob, mixture_log_probs
from sb3_saf.teams.errors import ExportError


class TorchRuntime:
    """Network of an export on the CPU; ``agent`` is needed if the actor depends on it."""

    def __init__(self, folder: Path, manifest: Manifest, agent: int | None):
        if WEIGHTS_FILE not in manifest.files:
            raise ExportError(
                f"{folder} has no {WEIGHTS_FILE}, because its encoder or activation is not one that a file can name; "
                'load it with runtime="onnx"'
            )
        self.manifest, self.agent = manifest, agent
        weights = read_checked(folder / WEIGHTS_FILE, manifest.files[WEIGHTS_FILE])
        self.network, self.atlas = load_network(manifest, weights)

    def evaluate(self, inputs: Inputs) -> tuple[PoolOutput, States]:
        """Evaluate the network, without masks."""
        agent = None
        if self.manifest.reads_agent:
            assert self.agent is not None
            agent = th.full((len(inputs.observation),), self.agent)
        states = tuple(th.tensor(state) for state in inputs.states)
        output, next_states = self.network(th.tensor(inputs.observation), agent, states)
        return output, tuple(state.numpy() for state in next_states)

    def act(self, inputs: Inputs, deterministic: bool, rng: Rng) -> tuple[Array, States]:
        """See :class:`Runtime`."""
        with th.inference_mode():
            output, states = self._masked(inputs)
            with _seeded(None if deterministic else rng):
                chosen = decide(self.manifest.action, self.manifest.selection, output, deterministic)
        return chosen.reshape(len(chosen), *self.manifest.action.shape).numpy(), states

    def log_probs(self, inputs: Inputs) -> Array:
        """See :class:`Runtime`."""
        with th.inference_mode():
            return mixture_log_probs(*self._masked(inputs)[0]).numpy()

    def log_prob(self, inputs: Inputs, actions: Array) -> Array:
        """See :class:`Runtime`."""
        with th.inference_mode():
            output, _ = self._masked(inputs)
            given = th.as_tensor(actions)
            given = given.long() if self.manifest.action.is_one_hot else given.to(output.actions.dtype)
            return mixture_log_prob(self.manifest.action, *output, given).numpy()

    def _masked(self, inputs: Inputs) -> tuple[PoolOutput, States]:
        output, states = self.evaluate(inputs)
        if inputs.action_mask is None:
            return output, states
        masks = th.as_tensor(inputs.action_mask)
        return output._replace(actions=masked_parameters(self.manifest.action, output.actions, masks)), states


@contextmanager
def _seeded(rng: Rng) -> Iterator[None]:
    """Sample from torch's global generator, or from a temporarily seeded one."""
    if rng is None:
        yield
        return
    seed = int(rng.integers(1 << 63)) if isinstance(rng, np.random.Generator) else rng
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        yield
