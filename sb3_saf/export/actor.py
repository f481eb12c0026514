"""
Actor from files: one agent's part of a trained team.

This module and its imports use neither Stable-Baselines3 nor Gymnasium: ``sb3_saf.Actor`` works without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, get_args

import msgspec
import numpy as np

from sb3_saf.export.act import Memory, as_batch, as_masks
from sb3_saf.export.files import read_limited
from sb3_saf.export.manifest import MANIFEST_FILE, MAX_MANIFEST_BYTES, Manifest
from sb3_saf.export.runtime import Array, Inputs, Rng, Runtime, States
from sb3_saf.networks.spaces import SpaceSpec, pixels_to_codes

RuntimeName: TypeAlias = Literal["torch", "onnx"]
#: Keys of PettingZoo's observations with masks.
_WITH_MASK: Final = ("observation", "action_mask")


class Actor:
    """
    One agent's part of a trained team, read from the files of ``sb3_saf.export_actors``.

    It reads the agent's own observation only, and acts as the trained model's ``predict``. Nothing is unpickled, no
    code is imported by a name from the files, and the training environment is not needed.

    Make one with :meth:`load`. An actor trained with action masks needs a mask in each call, and one with memory a new
    memory for each episode::

        actor = sb3_saf.Actor.load("actor", agent=3)
        memory = actor.new_memory()  # at the start of each episode, where has_memory
        action = actor.act(own_observation, action_mask=legal, memory=memory)

    :param manifest: manifest of the export
    :param runtime: computes the network
    :param agent: index of the agent in its team, if known
    """

    def __init__(self, manifest: Manifest, runtime: Runtime, agent: int | None = None):
        self.manifest = manifest
        self.agent = agent
        self._runtime = runtime
        self._observation = _plain(manifest.observation)
        self._masks = {"action": _plain(manifest.action), "action_mask": manifest.action_mask}

    @classmethod
    def load(cls, folder: str | PathLike[str], agent: int | None = None, runtime: RuntimeName = "torch") -> Actor:
        """
        Read an export. Files may be untrusted: any fault in them raises :class:`ExportError`.

        :param folder: written by ``sb3_saf.export_actors``
        :param agent: index of the agent in its team; needed if the actor depends on it
        :param runtime: ``"torch"``, or ``"onnx"``, which needs onnxruntime but not torch
        :raises ExportError: if the files are damaged, malformed or of an unknown format
        """
        if runtime not in get_args(RuntimeName):
            raise ValueError(f"runtime must be 'torch' or 'onnx', got {runtime!r}")
        path = Path(folder)
        manifest = Manifest.from_json(read_limited(path / MANIFEST_FILE, MAX_MANIFEST_BYTES))
        agent = _checked_agent(manifest, agent)
        return cls(manifest, _make_runtime(runtime, path, manifest, agent), agent)

    @property
    def n_agents(self) -> int:
        """N, the size of the trained team."""
        return self.manifest.n_agents

    @property
    def has_memory(self) -> bool:
        """Whether the actor has memory."""
        return self.manifest.memory is not None

    def new_memory(self) -> Memory:
        """Make the empty memory for the start of an episode, which :meth:`act` updates."""
        if not self.has_memory:
            raise ValueError(f"{self.manifest.policy} acts on single observations and has no memory; leave memory out")
        return Memory()

    def act(
        self,
        observation: Any,
        deterministic: bool = True,
        rng: int | np.random.Generator | None = None,
        action_mask: Any = None,
        memory: Memory | None = None,
    ) -> Array:
        """
        Choose an action, by default that of ``model.predict(observation, deterministic=True)``. The default of
        ``predict`` itself is to sample.

        :param observation: one own observation of the environment (pictures with channels first or last), or a batch of
            them with one more axis. An actor of tile codes also takes the game's pixels. A dict in PettingZoo's form,
            ``{"observation": ..., "action_mask": ...}``, gives both
        :param deterministic: whether to take the most likely action instead of sampling
        :param rng: seed or NumPy generator for sampling. None continues from the last call; with torch that is torch's
            global generator, and samples equal those of the trained model's ``predict`` (for a seed, those of
            ``predict`` after ``torch.manual_seed``)
        :param action_mask: (M,) zeros and ones, or one more axis for a batch: legal choices, in the form of the
            training masks. Required if the training environment's observations had masks
        :param memory: memory of the episode, from :meth:`new_memory`, if the actor has one; it is updated. For a batch
            of K observations it holds K memories
        :return: the action, or a batch of actions, as from ``predict``
        :raises ValueError: for observations with a shape or dtype other than the observation space's, or not finite,
            and for invalid masks or memories
        """
        inputs, is_batch = self._inputs(observation, action_mask, memory)
        actions, states = self._runtime.act(inputs, deterministic, _checked_rng(rng))
        if memory is not None:
            memory.hidden, memory.cell = states
        if self.manifest.action.kind == "box":
            actions = np.clip(actions, *self.manifest.action.bounds())
        return actions if is_batch else actions.squeeze(axis=0)

    def probabilities(self, observation: Any, action_mask: Any = None, memory: Memory | None = None) -> Array:
        """
        Return the probability of every discrete action, (A,) or (K, A) for a batch.

        Arguments as in :meth:`act`; the memory is not updated.
        """
        inputs, is_batch = self._inputs(observation, action_mask, memory)
        self._refuse_greedy()
        if not self.manifest.gives_log_probs:
            raise ValueError(f"{self.manifest.action.kind} actions have no list of probabilities; use log_prob")
        probabilities: Array = np.exp(self._runtime.log_probs(inputs))
        return probabilities if is_batch else probabilities[0]

    def log_prob(self, observation: Any, action: Any, action_mask: Any = None, memory: Memory | None = None) -> Array:
        """
        Return the log-likelihood of actions under the mixture of the pool's policies, () or (K,) for a batch.

        Arguments as in :meth:`act`; the memory is not updated.
        """
        inputs, is_batch = self._inputs(observation, action_mask, memory)
        self._refuse_greedy()
        actions = np.asarray(action).reshape(len(inputs.observation), -1)
        choices = np.asarray(self.manifest.action.choices)
        if choices.size and ((actions < 0) | (actions >= choices)).any():
            raise ValueError(f"expected actions of at least 0 and below {choices.tolist()}, got {actions.tolist()}")
        result = self._runtime.log_prob(inputs, actions)
        return result if is_batch else result[0]

    def _refuse_greedy(self) -> None:
        if self.manifest.selection == "greedy":
            raise ValueError(f"{self.manifest.policy} has values of actions and takes the best: no action is drawn")

    def _inputs(self, observation: Any, action_mask: Any, memory: Memory | None) -> tuple[Inputs, bool]:
        """Return the checked inputs of the runtime, and whether they are a batch."""
        if isinstance(observation, Mapping) and set(observation) == set(_WITH_MASK) and action_mask is None:
            observation, action_mask = (observation[key] for key in _WITH_MASK)
        batch, is_batch = self._batch(observation)
        mask = as_masks(action_mask, self._masks, len(batch))
        return Inputs(batch, mask, self._states(memory, len(batch))), is_batch

    def _states(self, memory: Memory | None, n_rows: int) -> States:
        net = self.manifest.memory
        if net is None:
            if memory is not None:
                self.new_memory()  # raises an error: the actor has no memory
            return ()
        if not isinstance(memory, Memory):
            raise ValueError(
                "this actor remembers what it has seen: memory = actor.new_memory() at the start of each episode, then "
                f"actor.act(observation, memory=memory); got memory={memory!r}"
            )
        return memory.arrays(msgspec.structs.asdict(net), n_rows)

    def _batch(self, observation: Any) -> tuple[Array, bool]:
        space = self.manifest.observation
        array = np.asarray(observation)
        if self._runtime.atlas is not None and _is_picture(array, space):
            array = pixels_to_codes(array, self._runtime.atlas)
        if not _can_become(array, np.dtype(space.dtype)):
            raise ValueError(f"expected observations of {space.dtype}, got {array.dtype} that does not fit into it")
        batch, is_batch = as_batch(array, self._observation)
        if batch.dtype.kind == "f" and not np.isfinite(batch).all():
            raise ValueError("an observation has NaN or infinity; repair the environment or the sensor it comes from")
        _check_codes(batch, space)
        return batch, is_batch


def _is_picture(array: Array, codes: SpaceSpec) -> bool:
    """Return whether an array holds pixels (one picture or a batch) instead of tile codes."""
    channels, height, width = codes.picture_shape
    return array.ndim in (3, 4) and array.shape[-3:] in ((height, width, channels), (channels, height, width))


def _checked_rng(rng: object) -> Rng:
    if rng is None or isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, bool) or not isinstance(rng, (int, np.integer)):
        raise ValueError(f"rng must be a seed, a numpy.random.Generator or None, got {rng!r}")
    return int(rng)


def _make_runtime(name: RuntimeName, folder: Path, manifest: Manifest, agent: int | None) -> Runtime:
    # Imported here: each needs a library that the other does not.
    if name == "onnx":
        from sb3_saf.export.onnx_runtime import make_onnx_runtime

        return make_onnx_runtime(folder, manifest, agent)
    from sb3_saf.export.torch_runtime import TorchRuntime

    return TorchRuntime(folder, manifest, agent)


def _checked_agent(manifest: Manifest, agent: int | None) -> int | None:
    if agent is None:
        if manifest.reads_agent:
            raise ValueError(
                "what agents of this team do depends on who they are: say which one acts, "
                f"Actor.load(folder, agent=0) to {manifest.n_agents - 1}"
            )
        return None
    if isinstance(agent, bool) or not isinstance(agent, (int, np.integer)) or not 0 <= agent < manifest.n_agents:
        raise ValueError(f"agent must be a whole number in 0..{manifest.n_agents - 1}, got {agent!r}")
    return int(agent)


def _plain(space: SpaceSpec) -> dict[str, Any]:
    """Return a space as ``act.py`` reads it from the file."""
    return {"shape": space.shape, "dtype": space.dtype, "choices": space.choices, "picture": space.picture}


def _can_become(array: Array, dtype: np.dtype[Any]) -> bool:
    """Return whether conversion to ``dtype`` is valid: any number to float, otherwise without change of value."""
    if array.dtype.kind not in "biuf":
        return False
    if dtype.kind == "f" or np.can_cast(array.dtype, dtype):
        return True
    with np.errstate(invalid="ignore"):
        return bool((array.astype(dtype) == array).all())


def _check_codes(batch: Array, space: SpaceSpec) -> None:
    """Raise ValueError for codes and choices that do not exist."""
    if space.atlas is not None:
        limit = np.asarray(space.atlas[0])
    elif space.is_one_hot:
        limit = np.asarray(space.choices).reshape(space.shape)
    else:
        return
    if ((batch < 0) | (batch >= limit)).any():
        raise ValueError(f"observations must be at least 0 and below {limit.tolist()}, got {batch.tolist()}")
