"""
Act with an exported actor. Needs only Python, NumPy and onnxruntime.

A program beside this file::

    from act import Actor
    actor = Actor.load("folder of actor.onnx")
    action = actor.act(observation)

An actor with memory takes ``memory=actor.new_memory()``, a new one for each episode.

Letters: K rows (a batch of observations), M choices of all action dimensions, A actions.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

# export_actors writes this code in place of its import.
from sb3_saf.teams.conversion import CLASSIC, AgentConversion, Given, RowForm, given_by_game, pixels_to_codes, tupled

Array: TypeAlias = npt.NDArray[Any]


class Memory:
    """
    Memory of an actor in an episode: its states (K, ...) by name, or those of each agent by the agent's name; zeros at
    first, updated by :meth:`Actor.act`. Make a new one for each episode, and for an agent that comes back after steps
    in which it did not take part.
    """

    def __init__(self) -> None:
        self.states: dict[Any, Any] = {}


class Actor:
    """
    One agent's part of a trained team, read from the files of ``sb3_saf.export_actors``.

    It reads the agent's own observation only, and acts as the trained model's ``predict``. Nothing is unpickled, no
    code is imported by a name from the files, and neither the training code nor the environment is needed.

    Make one with :meth:`load`. An actor trained with action masks needs a mask in each call, and one with memory a new
    memory for each episode::

        actor = sb3_saf.Actor.load("actor", agent=3)
        memory = actor.new_memory()  # at the start of each episode, where has_memory
        action = actor.act(own_observation, action_mask=legal, memory=memory)

    :param session: onnxruntime's session of the graph
    :param description: spaces, agents and memory, from the metadata of the graph
    :param agent: index of the agent in its team, if known
    """

    def __init__(self, session: Any, description: Mapping[str, Any], agent: int | None = None):
        self.session, self.description, self.agent = session, description, agent
        self._rng = np.random.default_rng()
        conversions = description["conversions"]
        self._conversions = None if conversions is None else [AgentConversion.from_plain(one) for one in conversions]
        atlas = description["observation"]["atlas"]
        self._atlas = None
        if atlas is not None:
            self._atlas = np.frombuffer(base64.b64decode(atlas["pixels"]), np.uint8).reshape(atlas["shape"])

    @classmethod
    def load(cls, folder: str | PathLike[str], agent: int | str | None = None) -> Actor:
        """
        Read an export.

        :param folder: written by ``sb3_saf.export_actors``
        :param agent: index or name of the agent in its team; needed if the actor depends on it, except for observations
            by agent
        :raises ValueError: if the files are missing or damaged, or the agent is unknown
        """
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError("Actor needs onnxruntime: pip install onnxruntime") from error
        path = Path(folder) / "actor.onnx"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
            description = json.loads(session.get_modelmeta().custom_metadata_map["sb3_saf"])
            description["agents"] = tupled(description["agents"])
            actor = cls(session, description)
            n_agents, names = actor.n_agents, description["agents"]
        except Exception as error:  # those of onnxruntime have no common class
            raise ValueError(f"expected {path} to be written by sb3_saf.export_actors, got {error!r:.300}") from error
        index: Any = names.index(agent) if names is not None and agent in names else agent
        is_number = isinstance(index, (int, np.integer)) and not isinstance(index, bool)
        if index is not None and not (is_number and 0 <= index < n_agents):
            or_name = "" if names is None else f" or one of {', '.join(map(repr, names))}"
            raise ValueError(f"agent must be a whole number in 0..{n_agents - 1}{or_name}, got {agent!r}")
        actor.agent = None if index is None else int(index)
        return actor

    @property
    def n_agents(self) -> int:
        """N, the size of the trained team."""
        return int(self.description["n_agents"])

    @property
    def reads_agent(self) -> bool:
        """Whether the actor depends on the agent's index."""
        return bool(self.description["reads_agent"])

    @property
    def has_memory(self) -> bool:
        """Whether the actor has memory."""
        return bool(self.description["states"])

    def new_memory(self) -> Memory:
        """Make the empty memory for the start of an episode, which :meth:`act` updates."""
        if not self.has_memory:
            raise ValueError(f"{self.description['policy']} has no memory: leave memory out")
        return Memory()

    def act(
        self,
        observation: Any,
        deterministic: bool = True,
        rng: int | np.random.Generator | None = None,
        action_mask: Any = None,
        memory: Memory | None = None,
    ) -> Any:
        """
        Choose an action, by default that of ``model.predict(observation, deterministic=True)``. The default of
        ``predict`` itself is to sample.

        :param observation: what the game gives: the agent's own observation, with or without its action mask, or
            ``{agent: observation}``, alone or as ``(observations, infos)``. Dicts, Tuples and unequal spaces become
            rows as in training, and actions are those of the game. Or own observations of rows, one or a batch. An
            actor of tile codes also takes the game's pixels
        :param deterministic: whether to take the most likely action instead of sampling
        :param rng: seed or NumPy generator for sampling; None continues from the last call
        :param action_mask: (M,) zeros and ones, one more axis for a batch, or by agent: legal choices, in the form of
            the training masks. Required if the training environment's observations had masks
        :param memory: memory of the episode, from :meth:`new_memory`, if the actor has one; it is updated. For a batch
            of K observations it holds K memories
        :return: the action, or a batch of actions, as from ``predict``; ``{agent: action}`` for observations by agent
        :raises ValueError: for observations with a shape or dtype other than the observation space's, or not finite,
            and for invalid masks or memories
        """
        rows, given = self._rows(observation, action_mask)
        by_agent = given is not None and given.agents is not None
        states = self._states(memory, by_agent)
        generator = None
        if not deterministic and not self.description["greedy"]:
            if isinstance(rng, bool) or not isinstance(rng, (int, np.integer, np.random.Generator, type(None))):
                raise ValueError(f"rng must be a seed, a numpy.random.Generator or None, got {rng!r}")
            generator = self._rng if rng is None else np.random.default_rng(rng)
        predict = partial(self._predict, generator=generator)
        if given is None:
            actions, after = predict(rows, states)
        else:
            actions, after = given.act(predict, states, None, deterministic)
        if memory is not None:  # of those that act now: an agent that waits begins anew, as in training
            memory.states.clear()
            memory.states.update(after if by_agent else zip(self.description["states"], after, strict=True))
        return actions

    def _predict(
        self,
        rows: Mapping[str, Any],
        states: Any,
        *_: Any,
        action_masks: Any = None,
        generator: np.random.Generator | None = None,
    ) -> tuple[Any, Any]:
        """Return actions for rows, drawn if there is a generator, and the states after them."""
        inputs, is_batch = self._inputs({"action_mask": action_masks, **rows}, states)
        names = ["most_likely" if generator is None else "drawn"]
        names += [f"next_{name}" for name in self.description["states"]]
        actions, *after = self._run(names, inputs, generator)
        return (actions if is_batch else actions.squeeze(axis=0)), after or None

    def _rows(self, observation: Any, action_mask: Any) -> tuple[dict[str, Any], Given | None]:
        """Return rows, and what the game gives, if the observation is none of rows."""
        description = self.description
        form = RowForm(
            self.n_agents,
            description["agents"],
            self._conversions,
            tuple(description["observation"]["shape"]),
            description["action_mask"] == "required",
        )
        takes_masks = description["action_mask"] != "none"
        given = given_by_game(form, observation, action_mask, takes_masks, self.agent)
        if given is not None:
            return {"action_mask": given.action_masks, **given.rows}, given
        if isinstance(observation, Mapping) and set(observation) == CLASSIC:
            action_mask = observation["action_mask"] if action_mask is None else action_mask
            observation = observation["observation"]
        return {"obs": observation, "action_mask": action_mask}, None

    def probabilities(self, observation: Any, action_mask: Any = None, memory: Memory | None = None) -> Array:
        """
        Return the probability of every discrete action, (A,) or (K, A) for a batch.

        Arguments as in :meth:`act`; the memory is not updated.
        """
        inputs, is_batch, _ = self._checked(observation, action_mask, memory)
        self._check_is_drawn()
        if "log_probs" not in {output.name for output in self.session.get_outputs()}:
            raise ValueError("only Discrete actions have a list of probabilities: use log_prob")
        probabilities: Array = np.exp(self._run(["log_probs"], inputs)[0])
        return probabilities if is_batch else probabilities[0]

    def log_prob(self, observation: Any, action: Any, action_mask: Any = None, memory: Memory | None = None) -> Array:
        """
        Return the log-likelihood of actions under the mixture of the pool's policies, () or (K,) for a batch.

        Arguments as in :meth:`act`, and actions as it returns them; the memory is not updated.
        """
        inputs, is_batch, given = self._checked(observation, action_mask, memory)
        self._check_is_drawn()
        choices = np.asarray(self.description["choices"])
        actions = np.asarray(action) if given is None else given.row_actions(action)
        actions = actions.reshape(len(inputs["observation"]), -1)
        if choices.size and ((actions < 0) | (actions >= choices)).any():
            raise ValueError(f"expected action of at least 0 and below {choices.tolist()}, got {actions.tolist()}")
        (result,) = self._run(["log_prob"], inputs | {"action": actions})
        return result if is_batch else result[0]

    def _check_is_drawn(self) -> None:
        if self.description["greedy"]:
            raise ValueError(f"{self.description['policy']} takes the action of the highest value: nothing is drawn")

    def _run(self, names: list[str], inputs: dict[str, Array], rng: np.random.Generator | None = None) -> list[Array]:
        """
        Return outputs of the graph.

        :param names: names of the outputs
        :param inputs: inputs by name; others are zeros, and a mask allows everything
        :param rng: draws noise, inputs that are called as its methods: ``gumbel_policy``, ``normal_action``
        """
        n_rows, feeds = len(inputs["observation"]), {}
        types = {"tensor(int64)": np.int64, "tensor(bool)": np.bool_, "tensor(float)": np.float32}
        for entry in self.session.get_inputs():
            shape, (method, _, noise) = [n_rows, *entry.shape[1:]], entry.name.partition("_")
            if entry.name in inputs:
                value = inputs[entry.name]
            elif entry.name == "action_mask":
                value = np.ones(shape)
            elif noise and rng is not None:
                value = {"gumbel": rng.gumbel, "normal": rng.normal, "logistic": rng.logistic}[method](size=shape)
            else:
                value = np.zeros(shape)
            feeds[entry.name] = value.astype(types.get(entry.type, value.dtype), copy=False)
        outputs: list[Array] = self.session.run(names, feeds)
        return outputs

    def _checked(
        self, observation: Any, action_mask: Any, memory: Memory | None
    ) -> tuple[dict[str, Array], bool, Given | None]:
        """Return the graph's inputs for an observation of any form, whether they are a batch, and what was given."""
        rows, given = self._rows(observation, action_mask)
        by_agent = given is not None and given.agents is not None
        states = self._states(memory, by_agent)
        inputs, is_batch = self._inputs(rows, states if given is None else given.memory(states)[0])
        return inputs, is_batch and (given is None or by_agent), given

    def _inputs(self, rows: Mapping[str, Any], states: Any) -> tuple[dict[str, Array], bool]:
        """Return the checked inputs of the graph by name, and whether they are a batch."""
        batch, is_batch = self._batch(rows["obs"])
        inputs = {"observation": batch, **dict(zip(self.description["states"], states or (), strict=False))}
        for state in states or ():
            if len(state) != len(batch):
                raise ValueError(
                    f"expected memory of {len(batch)} observations at once, got one of {len(state)}; give each agent "
                    "and each game a memory of its own, and make a new one for each episode"
                )
        mask = self._mask(rows["action_mask"], len(batch))
        if mask is not None:
            inputs["action_mask"] = mask
        if self.reads_agent:
            agent = rows.get("agent", self.agent)
            if agent is None:
                raise ValueError(f"this actor needs agent= of Actor.load, 0 to {self.n_agents - 1}: it reads who acts")
            inputs["agent"] = np.broadcast_to(agent, len(batch))
        return inputs, is_batch

    def _batch(self, observation: Any) -> tuple[Array, bool]:
        """Return own observations (K, *shape) of the space's dtype, and whether they were a batch."""
        space = self.description["observation"]
        array, shape, dtype = np.asarray(observation), tuple(space["shape"]), np.dtype(space["dtype"])
        if self._atlas is not None:
            (_, tile, _, channels), (rows, columns) = self._atlas.shape, shape
            sizes = rows * tile, columns * tile
            if array.ndim in (3, 4) and array.shape[-3:] in ((*sizes, channels), (channels, *sizes)):
                array = pixels_to_codes(array, self._atlas)
        if not _fits(array, dtype):
            raise ValueError(f"expected observation of {dtype}, got {array.dtype} that does not fit into it")
        if space["picture"] and array.ndim >= 3 and shape not in (array.shape, array.shape[1:]):
            array = np.moveaxis(array, -1, -3)
        if shape not in (array.shape, array.shape[1:]):
            raise ValueError(
                f"expected one own observation of shape {shape} or a batch, got observation of shape "
                f"{np.shape(observation)}"
            )
        is_batch = array.shape != shape
        batch = np.ascontiguousarray(array if is_batch else array[np.newaxis], dtype=dtype)
        if batch.dtype.kind == "f" and not np.isfinite(batch).all():
            raise ValueError("observation has NaN or infinity; repair the environment or the sensor it comes from")
        choices = space["choices"]
        if choices is not None and ((batch < 0) | (batch >= np.asarray(choices))).any():
            raise ValueError(f"expected observation of at least 0 and below {choices}, got {batch.tolist()}")
        return batch, is_batch

    def _mask(self, action_mask: Any, n_rows: int) -> Array | None:
        """Return legal choices (K, M) bool; None for all."""
        use, n_choices = self.description["action_mask"], sum(self.description["choices"])
        if action_mask is None:
            if use == "required":
                raise ValueError(f"this actor needs action_mask, {n_choices} zeros and ones for each observation")
            return None
        if use == "none":
            raise ValueError("this policy was trained without masks of actions: leave them out")
        mask = np.asarray(action_mask)
        mask = mask[np.newaxis] if mask.ndim == 1 else mask
        if mask.shape != (n_rows, n_choices) or not ((mask == 0) | (mask == 1)).all():
            raise ValueError(
                f"expected action_mask of {n_choices} zeros and ones for each of {n_rows} observations, got shape "
                f"{np.shape(action_mask)}"
            )
        mask = mask.astype(bool)
        if use == "required" and not mask.any(axis=1).all():
            raise ValueError(f"expected at least one legal action in each action_mask, got {mask.astype(int).tolist()}")
        return mask

    def _states(self, memory: Memory | None, by_agent: bool) -> Any:
        """Return the states of a memory, (K, ...) each, or those of agents by name; None if it is new."""
        if self.has_memory and not isinstance(memory, Memory):
            raise ValueError(
                f"this actor needs memory = actor.new_memory() at the start of each episode, got memory={memory!r}"
            )
        if memory is None:
            return None
        if not self.has_memory:
            self.new_memory()  # raises an error: the actor has no memory
        if any(isinstance(state, tuple) != by_agent for state in memory.states.values()):
            raise ValueError(
                "expected observations in the form of the episode so far, all of them {agent: observation} or none: "
                "make a new memory for each episode"
            )
        return (memory.states if by_agent else tuple(memory.states.values())) or None


def _fits(array: Array, dtype: np.dtype[Any]) -> bool:
    """Return whether conversion to ``dtype`` is valid: any number to float, otherwise without change of value."""
    if array.dtype.kind not in "biuf":
        return False
    if dtype.kind == "f" or np.can_cast(array.dtype, dtype):
        return True
    with np.errstate(invalid="ignore"):
        return bool((array.astype(dtype) == array).all())
