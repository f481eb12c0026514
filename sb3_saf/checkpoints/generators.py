"""States of a process's random generators."""

from __future__ import annotations

import random
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_saf.checkpoints.checks import check_keys, check_like, check_list, check_real, check_whole, refused
from sb3_saf.checkpoints.data import Tree

#: State words of a Mersenne Twister; its position is at most this.
_TWISTER_WORDS: Final = 624


def generator_states(action_space: spaces.Space[Any]) -> dict[str, Tree]:
    """Return the states of Python's, NumPy's and torch's global generators and of the action space's generator."""
    version, words, gauss = random.getstate()
    return {
        "python": [version, np.array(words, dtype=np.uint32), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def check_generator_states(states: Tree, action_space: spaces.Space[Any]) -> None:
    """Check states of generators; a CheckpointError names the first invalid one."""
    own = generator_states(action_space)
    check_keys(states, own, "generators")
    check_list(states["python"], "the state of Python's generator", 3)
    version, words, gauss = states["python"]
    if gauss is not None:
        check_real(gauss, "the state of Python's generator")
    for name, found, like in (
        ("Python's", [version, words], own["python"][:2]),
        ("NumPy's", states["numpy"], own["numpy"]),
        ("torch's", states["torch"], own["torch"]),
        ("the action space's", states["action_space"], own["action_space"]),
    ):
        check_like(found, like, f"the state of {name} generator")
    check_whole(int(words[-1]), "the position of Python's generator", 0, _TWISTER_WORDS)
    check_whole(states["numpy"]["state"]["pos"], "the position of NumPy's generator", 0, _TWISTER_WORDS)
    for name in ("numpy", "action_space"):
        if states[name]["bit_generator"] != own[name]["bit_generator"]:
            raise refused(f"the generator of {name}", own[name]["bit_generator"], repr(states[name]["bit_generator"]))
    check_list(states["cuda"], "the states of CUDA's generators")
    if th.cuda.is_available() and states["cuda"]:
        check_like(states["cuda"], own["cuda"], "the states of CUDA's generators")
    _try_torch(states["torch"])


def _try_torch(state: th.Tensor) -> None:
    """Check a state by loading it into a torch generator."""
    try:
        th.Generator().set_state(state)
    except (RuntimeError, TypeError) as error:
        raise refused("the state of torch's generator", "one that torch takes", error) from error


def load_generator_states(states: Tree, action_space: spaces.Space[Any]) -> None:
    """Restore the states of all generators."""
    version, words, gauss = states["python"]
    random.setstate((version, tuple(words.tolist()), gauss))
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(states["torch"])
    if states["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all(states["cuda"])
    action_space.np_random.bit_generator.state = states["action_space"]
