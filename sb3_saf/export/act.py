"""
Act with an exported actor. Needs Python, NumPy and onnxruntime, nothing else.

    python act.py observation.npy [--agent 3] [--action-mask mask.npy] [--sample] [--seed 0]

or, from a program beside this file:

    from act import Memory, OnnxActor
    actor = OnnxActor("folder of actor.json and actor.onnx")
    action = actor.act(observation)

An actor with a memory takes ``memory=Memory()``, made anew at the start of each episode; to the command line, the
observations of such an actor are the steps of one episode.

Letters: K rows (a batch of observations), U policies, P parameters of one policy, D action dimensions, A actions, M
choices of all dimensions, H size of a memory.
"""

from __future__ import annotations

import argparse
import json
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
#: What an LSTM remembers: hidden and cell state, (layers, K, H) each; empty without memory.
States = tuple[Array, ...]

#: Up to this many joint actions, the most likely action of a mixture is found by enumeration.
MAX_ENUMERATED_ACTIONS = 4096
#: Logit of what a mask forbids: its probability is zero to the last bit.
FORBIDDEN = np.float32(-1e8)


class Outputs(NamedTuple):
    """
    What the network says about a batch of observations.

    :param log_weights: (K, U) how likely each policy of the pool is to be chosen
    :param parameters: (K, U, P) parameters of each policy's action distribution: logits, or means and then log
        standard deviations; values of actions if the selection is greedy
    :param log_probs: (K, A) of every action, for discrete actions that are drawn
    """

    log_weights: Array
    parameters: Array
    log_probs: Array | None = None


class Memory:
    """
    What an actor remembers of an episode: the state of its LSTM, zeros at first. Make a new one for each episode.

    :param hidden: (layers, K, H); None for zeros
    :param cell: (layers, K, H); None for zeros
    """

    def __init__(self, hidden: Array | None = None, cell: Array | None = None):
        self.hidden, self.cell = hidden, cell

    def arrays(self, net: dict[str, Any], n_rows: int) -> tuple[Array, Array]:
        """
        Hidden and cell state, (layers, K, H) each.

        :param net: ``"memory"`` of ``actor.json``
        :param n_rows: K, as many as at the last step
        """
        shape = (net["n_layers"], n_rows, net["hidden_size"])
        zeros = np.zeros(shape, np.float32)
        hidden, cell = (zeros if part is None else part for part in (self.hidden, self.cell))
        if hidden.shape != shape or cell.shape != shape:
            raise ValueError(
                f"this memory is of {hidden.shape[1]} observations at once, got {n_rows}; give each agent and each "
                "game a memory of its own, and make a new one for each episode"
            )
        return hidden, cell


def masked(action: dict[str, Any], outputs: Outputs, mask: Array) -> Outputs:
    """
    Take forbidden choices out of every policy, as the trained model does before it mixes them.

    :param action: the action space, as in ``actor.json``
    :param outputs: of the network
    :param mask: (K, M) bool, True for what is allowed: the choices of each dimension in turn (of multi-binary actions:
        off, on). A dimension of which nothing is allowed leaves its choices equally likely
    """
    if action["kind"] == "multi_binary":
        off, on = mask[:, 0::2], mask[:, 1::2]
        kept, otherwise = off & on, FORBIDDEN * (off.astype(np.float32) - on.astype(np.float32))
    else:
        parts = np.split(mask, np.cumsum(action["choices"])[:-1], axis=1)
        some = [np.broadcast_to(part.any(axis=1, keepdims=True), part.shape) for part in parts]
        kept, otherwise = mask, FORBIDDEN * np.concatenate(some, axis=1).astype(np.float32)
    parameters = np.where(kept[:, np.newaxis], outputs.parameters, otherwise[:, np.newaxis]).astype(np.float32)
    if outputs.log_probs is None:
        return outputs._replace(parameters=parameters)
    (log_probs,) = factors(action, parameters)
    mixed = np.logaddexp.reduce(outputs.log_weights[:, :, np.newaxis] + log_probs, axis=1)
    return outputs._replace(parameters=parameters, log_probs=mixed)


class Draws(Protocol):
    """Where random numbers come from."""

    def categorical(self, probabilities: Array) -> Array:
        """(K,) indices: (K, n)."""

    def bernoulli(self, probabilities: Array) -> Array:
        """(K, D) zeros and ones: (K, D)."""

    def normal(self, shape: tuple[int, ...]) -> Array:
        """Standard normal numbers."""

    def uniform(self, shape: tuple[int, ...]) -> Array:
        """Numbers in [0, 1)."""


class NumpyDraws:
    """
    Random numbers of a NumPy generator.

    :param rng: the generator
    """

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    def categorical(self, probabilities: Array) -> Array:
        """(K,) indices: (K, n)."""
        # An exponential race: the first of n clocks with these rates. No cumulative sum that could miss 1.
        times = self.rng.standard_exponential(probabilities.shape) / np.maximum(probabilities, np.finfo(float).tiny)
        return times.argmin(axis=1)

    def bernoulli(self, probabilities: Array) -> Array:
        """(K, D) zeros and ones: (K, D)."""
        return (self.rng.random(probabilities.shape) < probabilities).astype(np.float32)

    def normal(self, shape: tuple[int, ...]) -> Array:
        """Standard normal numbers."""
        return self.rng.standard_normal(shape).astype(np.float32)

    def uniform(self, shape: tuple[int, ...]) -> Array:
        """Numbers in [0, 1)."""
        return self.rng.random(shape).astype(np.float32)


def decide(action: dict[str, Any], selection: str, outputs: Outputs, draws: Draws | None = None) -> Array:
    """
    Choose actions as the trained model's ``predict`` does.

    :param action: the action space, as in ``actor.json``
    :param selection: ``"mixture"``, ``"gumbel"``, or ``"greedy"`` if parameters are values of actions
    :param outputs: of the network
    :param draws: random numbers to sample with; None takes the most likely action
    :return: (K, ...) actions
    """
    if selection == "greedy":
        # Values, not logits: there is nothing to draw.
        chosen = _of_policy(outputs.parameters, outputs.log_weights.argmax(axis=1)).argmax(axis=1)
    elif draws is None:
        chosen = _likeliest(action, selection, outputs)
    elif selection == "mixture" and outputs.log_probs is not None:
        chosen = draws.categorical(np.exp(outputs.log_probs))
    else:
        chosen = _sample(action, _drawn_policy(selection, outputs, draws), draws)
    chosen = chosen.reshape(len(outputs.log_weights), *action["shape"])
    if action["kind"] != "box":
        return chosen
    return np.clip(chosen, *(np.asarray(action[side], dtype=action["dtype"]) for side in ("low", "high")))


def _likeliest(action: dict[str, Any], selection: str, outputs: Outputs) -> Array:
    """The mixture's most likely action, or that of the likeliest policy where there is no telling."""
    if selection == "mixture" and outputs.log_probs is not None:
        return outputs.log_probs.argmax(axis=1)
    is_pool = selection == "mixture" and outputs.log_weights.shape[1] > 1
    if is_pool and action["kind"] != "box" and prod(action["choices"]) <= MAX_ENUMERATED_ACTIONS:
        return _likeliest_joint_action(action, outputs)
    return _mode(action, _of_policy(outputs.parameters, outputs.log_weights.argmax(axis=1)))


def _likeliest_joint_action(action: dict[str, Any], outputs: Outputs) -> Array:
    best = []
    for log_weights, parameters in zip(outputs.log_weights, outputs.parameters, strict=True):
        joint = log_weights[:, np.newaxis]
        for factor in factors(action, parameters):
            joint = (joint[:, :, np.newaxis] + factor[:, np.newaxis, :]).reshape(len(joint), -1)
        best.append(np.exp(joint - joint.max()).sum(axis=0).argmax())
    chosen = np.stack(np.unravel_index(best, action["choices"]), axis=1)
    return chosen.astype(np.float32 if action["kind"] == "multi_binary" else np.int64)


def factors(action: dict[str, Any], parameters: Array) -> list[Array]:
    """Log-probabilities (..., choices) of each action dimension: (..., P)."""
    if action["kind"] == "multi_binary":
        both = -np.logaddexp(0.0, np.stack([parameters, -parameters], axis=-1))
        return [both[..., dimension, :] for dimension in range(both.shape[-2])]
    logits = np.split(parameters, np.cumsum(action["choices"])[:-1], axis=-1)
    return [part - np.logaddexp.reduce(part, axis=-1, keepdims=True) for part in logits]


def _of_policy(parameters: Array, policy: Array) -> Array:
    """(K, P) parameters of one policy per row: (K, U, P), (K,)."""
    chosen: Array = parameters[np.arange(len(policy)), policy]
    return chosen


def _drawn_policy(selection: str, outputs: Outputs, draws: Draws) -> Array:
    """(K, P) parameters of a policy drawn by its weight."""
    log_weights = outputs.log_weights
    if log_weights.shape[1] == 1:
        return outputs.parameters[:, 0]
    if selection == "mixture":
        return _of_policy(outputs.parameters, draws.categorical(np.exp(log_weights)))
    uniform = np.maximum(draws.uniform(log_weights.shape), np.finfo(np.float32).tiny)
    return _of_policy(outputs.parameters, (log_weights - np.log(-np.log(uniform))).argmax(axis=1))


def _mode(action: dict[str, Any], parameters: Array) -> Array:
    if action["kind"] == "box":
        return np.split(parameters, 2, axis=1)[0]
    if action["kind"] == "multi_binary":
        return (parameters > 0).astype(np.float32)
    return np.stack([factor.argmax(axis=1) for factor in factors(action, parameters)], axis=1)


def _sample(action: dict[str, Any], parameters: Array, draws: Draws) -> Array:
    if action["kind"] == "box":
        mean, log_std = np.split(parameters, 2, axis=1)
        return mean + draws.normal(mean.shape) * np.exp(log_std)
    if action["kind"] == "multi_binary":
        return draws.bernoulli(1.0 / (1.0 + np.exp(-parameters)))
    return np.stack([draws.categorical(np.exp(factor)) for factor in factors(action, parameters)], axis=1)


def as_batch(observation: Any, space: dict[str, Any]) -> tuple[Array, bool]:
    """
    Bring observations into the network's layout.

    :param observation: one own observation or a batch of them; pictures with channels first or last
    :param space: the observation space, as in ``actor.json``
    :return: (K, *shape) of the space's dtype, and whether a batch came
    """
    array, shape = np.asarray(observation), tuple(space["shape"])
    if space.get("picture") and array.shape != shape and array.shape[1:] != shape and array.ndim >= 3:
        array = np.moveaxis(array, -1, -3)
    if array.shape != shape and array.shape[1:] != shape:
        raise ValueError(
            f"expected one own observation of shape {shape} or a batch of them, got shape {np.shape(observation)}"
        )
    is_batch = array.shape != shape
    return np.ascontiguousarray(array if is_batch else array[np.newaxis], dtype=space["dtype"]), is_batch


def as_masks(action_mask: Any, manifest: dict[str, Any], n_rows: int) -> Array | None:
    """
    Check masks of actions.

    :param action_mask: (M,) for one observation, (K, M) for a batch; or None
    :param manifest: ``"action"`` and ``"action_mask"`` as in ``actor.json``
    :param n_rows: K
    :return: (K, M) bool, or None for none
    :raises ValueError: if masks are missing, not wanted, of another shape, or allow nothing where something must be
    """
    wanted = manifest["action_mask"]
    n_choices = sum(manifest["action"]["choices"])
    if action_mask is None:
        if wanted == "required":
            raise ValueError(
                f"this actor was trained to keep to masks: pass action_mask, {n_choices} zeros and ones per observation"
            )
        return None
    if wanted == "none":
        raise ValueError("this actor was trained without masks of actions, and does not know what to do with one")
    mask = np.asarray(action_mask)
    mask = mask[np.newaxis] if mask.ndim == 1 else mask
    if mask.shape != (n_rows, n_choices) or not ((mask == 0) | (mask == 1)).all():
        raise ValueError(
            f"expected {n_choices} zeros and ones for each of {n_rows} observations as action_mask, got shape "
            f"{np.shape(action_mask)}"
        )
    mask = mask.astype(bool)
    if wanted == "required" and not mask.any(axis=1).all():
        raise ValueError(f"expected at least one legal action in each action_mask, got {mask.astype(int).tolist()}")
    return mask


class OnnxActor:
    """
    Run ``actor.onnx``. Trusts its folder; ``sb3_saf.Actor`` checks it first.

    :param folder: of ``actor.json`` and ``actor.onnx``
    :param agent: index of the agent, where every agent has a policy of its own
    """

    def __init__(self, folder: str | Path, agent: int | None = None):
        import onnxruntime

        self.manifest: dict[str, Any] = json.loads((Path(folder) / "actor.json").read_text(encoding="utf-8"))
        if self.manifest["reads_agent"] and agent is None:
            raise ValueError("every agent has a policy of its own: say which agent acts (agent=..., --agent)")
        self.agent = agent
        self.session = onnxruntime.InferenceSession(Path(folder) / "actor.onnx", providers=["CPUExecutionProvider"])

    def act(
        self,
        observation: Any,
        rng: np.random.Generator | None = None,
        action_mask: Any = None,
        memory: Memory | None = None,
    ) -> Array:
        """
        Act.

        :param observation: one own observation, or a batch
        :param rng: to sample with; None takes the most likely action
        :param action_mask: which actions are legal, where the actor was trained with masks
        :param memory: of the episode, where the actor has one; it is brought up to date
        """
        batch, is_batch = as_batch(observation, self.manifest["observation"])
        outputs = self._outputs(batch, memory)
        mask = as_masks(action_mask, self.manifest, len(batch))
        action = self.manifest["action"]
        outputs = outputs if mask is None else masked(action, outputs, mask)
        draws = None if rng is None else NumpyDraws(rng)
        actions = decide(action, self.manifest["selection"], outputs, draws)
        return actions if is_batch else actions.squeeze(axis=0)

    def _outputs(self, batch: Array, memory: Memory | None) -> Outputs:
        inputs = {"observation": batch}
        if self.manifest["reads_agent"]:
            inputs["agent"] = np.full(len(batch), self.agent)
        net = self.manifest["memory"]
        if net is None:
            return Outputs(*self.session.run(None, inputs))
        if memory is None:
            raise ValueError("this actor has a memory: pass memory=Memory(), made anew at the start of each episode")
        inputs["hidden"], inputs["cell"] = memory.arrays(net, len(batch))
        *outputs, memory.hidden, memory.cell = self.session.run(None, inputs)
        return Outputs(*outputs)


def main() -> None:
    """Print the action for an observation in a ``.npy`` file."""
    parser = argparse.ArgumentParser(description="act with an exported actor")
    parser.add_argument(
        "observation", help="a .npy file of one own observation, or of a batch (with a memory: of an episode's steps)"
    )
    parser.add_argument("--folder", default=Path(__file__).parent, help="the exported folder; this file's own")
    parser.add_argument("--agent", type=int, help="which agent acts, where every agent has a policy of its own")
    parser.add_argument("--action-mask", help="a .npy file with the legal actions of each observation")
    parser.add_argument("--sample", action="store_true", help="draw the action instead of taking the most likely one")
    parser.add_argument("--seed", type=int, help="seed of --sample")
    options = parser.parse_args()
    actor = OnnxActor(options.folder, options.agent)
    rng = np.random.default_rng(options.seed) if options.sample else None
    observations = np.load(options.observation, allow_pickle=False)
    masks = None if options.action_mask is None else np.load(options.action_mask, allow_pickle=False)
    if actor.manifest["memory"] is None:
        actions = actor.act(observations, rng, masks)
    else:
        actions = _act_on_steps(actor, observations, rng, masks)
    print(json.dumps(actions.tolist()))


def _act_on_steps(actor: OnnxActor, observations: Array, rng: np.random.Generator | None, masks: Array | None) -> Array:
    """(T, ...) actions of the steps of one episode."""
    steps, memory = as_batch(observations, actor.manifest["observation"])[0], Memory()
    return np.stack(
        [actor.act(own, rng, None if masks is None else masks[step], memory) for step, own in enumerate(steps)]
    )


if __name__ == "__main__":
    main()
