"""
One agent in a separate process: ``python lone_agent.py FOLDER AGENT``.

Reads own observations from standard input, with action masks and starts of episodes if there are any, and answers
with actions and probabilities. Only NumPy and onnxruntime can be imported here: it runs the exported folder's act.py.
"""

from __future__ import annotations

import json
import sys

#: Packages that an exported actor needs not, nor what these are made of.
ABSENT = ("stable_baselines3", "sb3_contrib", "gymnasium", "pettingzoo", "supersuit", "cloudpickle", "torch", "onnx")


def main(folder: str, agent: str) -> None:
    """Act until there are no more observations."""
    sys.modules.update(dict.fromkeys((*ABSENT, "sb3_saf", "hecogrid_envs", "safetensors", "msgspec")))  # type: ignore[arg-type]
    sys.path.insert(0, folder)
    import numpy as np
    from act import Actor  # type: ignore[import-not-found]

    actor = Actor.load(folder, agent=int(agent))
    memory = None
    for line in sys.stdin:
        question = json.loads(line)
        observation = np.array(question["observation"], dtype=question["dtype"])
        mask = question.get("action_mask")
        if actor.has_memory and question.get("start"):
            memory = actor.new_memory()
        probabilities = actor.probabilities(observation, action_mask=mask, memory=memory)
        action = actor.act(observation, action_mask=mask, memory=memory)
        print(json.dumps({"action": int(action), "probabilities": probabilities.tolist()}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
