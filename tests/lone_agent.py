"""
One agent in a separate process: ``python lone_agent.py FOLDER RUNTIME AGENT``.

Reads own observations from standard input, with action masks and starts of episodes if there are any, and answers
with actions and probabilities. Packages for training cannot be imported here, as if they were not installed.
"""

from __future__ import annotations

import importlib.abc
import json
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

TRAINING = {"stable_baselines3", "sb3_contrib", "gymnasium", "pettingzoo", "supersuit", "hecogrid_envs", "cloudpickle"}


class Absent(importlib.abc.MetaPathFinder):
    """Hides some packages from imports."""

    def __init__(self, names: set[str]):
        self.names = names

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)
        return None


def main(folder: str, runtime: str, agent: str) -> None:
    """Act until there are no more observations."""
    absent = TRAINING | ({"torch", "safetensors"} if runtime == "onnx" else {"onnxruntime"})
    sys.meta_path.insert(0, Absent(absent))
    import numpy as np

    import sb3_saf

    assert runtime in ("torch", "onnx")
    actor = sb3_saf.Actor.load(folder, agent=int(agent), runtime="onnx" if runtime == "onnx" else "torch")
    memory = None
    for line in sys.stdin:
        question = json.loads(line)
        observation = np.array(question["observation"], dtype=question["dtype"])
        mask = question.get("action_mask")
        if actor.has_memory and question.get("start"):
            memory = actor.new_memory()
        probabilities = actor.probabilities(observation, action_mask=mask, memory=memory)
        action = actor.act(observation, action_mask=mask, memory=memory)
        loaded = sorted(absent & set(sys.modules))
        print(
            json.dumps({"action": int(action), "probabilities": probabilities.tolist(), "loaded": loaded}), flush=True
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
