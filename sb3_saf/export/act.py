"""
Act with an exported actor. Needs only Python, NumPy and onnxruntime.

    python act.py observation.npy [--agent 3] [--action-mask mask.npy] [--sample] [--seed 0]

or, from a program beside this file:

    from act import Memory, OnnxActor
    actor = OnnxActor("folder of actor.json and actor.onnx")
    action = actor.act(observation)

An actor with memory takes ``memory=Memory()``, a new one for each episode; on the command line, the observations of
such an actor are the steps of one episode.

Letters: K rows (a batch of observations), M choices of all action dimensions, H size of a memory.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class Memory:
    """
    Memory of an actor in an episode: hidden and cell state of its LSTM, (layers, K, H), initially zeros.

    Make a new one for each episode.
    """

    def __init__(self, hidden: Array | None = None, cell: Array | None = None):
        self.hidden, self.cell = hidden, cell

    def arrays(self, net: dict[str, Any], n_rows: int) -> tuple[Array, Array]:
        """Return hidden and cell state, (layers, K, H) each; ``net`` is ``"memory"`` of ``actor.json``."""
        shape = (net["n_layers"], n_rows, net["hidden_size"])
        zeros = np.zeros(shape, np.float32)
        hidden, cell = (zeros if part is None else part for part in (self.hidden, self.cell))
        if hidden.shape != shape or cell.shape != shape:
            raise ValueError(
                f"this memory is of {hidden.shape[1]} observations at once, got {n_rows}; give each agent and each "
                "game a memory of its own, and make a new one for each episode"
            )
        return hidden, cell


def as_batch(observation: Any, space: dict[str, Any]) -> tuple[Array, bool]:
    """
    Convert observations to the network's layout.

    :param observation: one own observation or a batch of them; pictures with channels first or last
    :param space: the observation space, as in ``actor.json``
    :return: (K, *shape) of the space's dtype, and whether ``observation`` was a batch
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
    Check action masks; ValueError if they are missing, not supported, of a wrong shape, or allow nothing.

    :param action_mask: (M,) for one observation, (K, M) for a batch; or None
    :param manifest: ``"action"`` and ``"action_mask"`` as in ``actor.json``
    :return: (K, M) bool, or None for none
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


def feeds(session: Any, known: dict[str, Array], rng: np.random.Generator | None) -> dict[str, Array]:
    """
    Return a value for every input of the graph: known values, noise, masks that allow all actions, and zeros.

    :param session: session of onnxruntime
    :param known: inputs by name, including ``"observation"``
    :param rng: generator of noise; its method is the prefix of the input's name, as in ``gumbel_policy`` or
        ``normal_action``; None for zeros
    """
    rows, values = len(known["observation"]), dict(known)
    for entry in session.get_inputs():
        shape = [rows, *entry.shape[1:]]
        if entry.name not in known and "_" in entry.name:
            method = entry.name.partition("_")[0]
            values[entry.name] = np.zeros(shape, np.float32)
            if method == "action":
                values[entry.name] = np.ones(shape, bool)
            elif rng is not None:
                draw = {"gumbel": rng.gumbel, "normal": rng.normal, "logistic": rng.logistic}[method]
                values[entry.name] = draw(size=shape).astype(np.float32)
        elif entry.name == "action" and entry.name not in known:
            values[entry.name] = np.zeros(shape, np.int64 if entry.type == "tensor(int64)" else np.float32)
    return values


class OnnxActor:
    """
    Run ``actor.onnx``. The folder is trusted; ``sb3_saf.Actor`` checks it first.

    :param folder: folder of ``actor.json`` and ``actor.onnx``
    :param agent: index of the agent, if the actor depends on it
    """

    def __init__(self, folder: str | Path, agent: int | None = None):
        import onnxruntime

        self.manifest: dict[str, Any] = json.loads((Path(folder) / "actor.json").read_text(encoding="utf-8"))
        if self.manifest["reads_agent"] and agent is None:
            raise ValueError("what is done depends on who acts: say which agent acts (agent=..., --agent)")
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
        Choose an action.

        :param observation: one own observation, or a batch
        :param rng: generator for sampling; None takes the most likely action
        :param action_mask: legal actions, if the actor was trained with masks
        :param memory: memory of the episode, if the actor has one; it is updated
        """
        batch, is_batch = as_batch(observation, self.manifest["observation"])
        known = {"observation": batch}
        mask = as_masks(action_mask, self.manifest, len(batch))
        if mask is not None:
            known["action_mask"] = mask
        if self.manifest["reads_agent"]:
            known["agent"] = np.full(len(batch), self.agent)
        names = ["most_likely" if rng is None or self.manifest["selection"] == "greedy" else "drawn"]
        if self.manifest["memory"] is not None:
            if memory is None:
                raise ValueError("this actor has a memory: pass memory=Memory(), new at the start of each episode")
            known["hidden"], known["cell"] = memory.arrays(self.manifest["memory"], len(batch))
            names += ["next_hidden", "next_cell"]
        actions, *states = self.session.run(names, feeds(self.session, known, rng))
        if memory is not None and states:
            memory.hidden, memory.cell = states
        return actions if is_batch else actions.squeeze(axis=0)


def main() -> None:
    """Print the action for an observation in a ``.npy`` file."""
    parser = argparse.ArgumentParser(description="act with an exported actor")
    parser.add_argument(
        "observation", help="a .npy file of one own observation, or of a batch (with a memory: of an episode's steps)"
    )
    parser.add_argument("--folder", default=Path(__file__).parent, help="the exported folder; this file's own")
    parser.add_argument("--agent", type=int, help="which agent acts, where what is done depends on it")
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
        steps, memory = as_batch(observations, actor.manifest["observation"])[0], Memory()
        each = [None] * len(steps) if masks is None else masks
        actions = np.stack([actor.act(own, rng, mask, memory) for own, mask in zip(steps, each, strict=True)])
    print(json.dumps(actions.tolist()))


if __name__ == "__main__":
    main()
