"""Access to attributes, methods and action masks of a PettingZoo game and of its wrappers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_MISSING = object()


def layers_of(env: Any) -> list[Any]:
    """Return the environment and all that it wraps, down to the bare game."""
    layers: list[Any] = [env]
    while True:
        # Not getattr: PettingZoo's wrappers forward unknown names to the environment they wrap.
        own = getattr(layers[-1], "__dict__", {})
        inner = own.get("env", own.get("aec_env"))
        if inner is None:
            break
        layers.append(inner)
    bare = env.unwrapped
    return layers if any(layer is bare for layer in layers) else [*layers, bare]


def has_attribute(env: Any, name: str) -> bool:
    """Return whether the game, or a wrapper around it, has an attribute."""
    return any(hasattr(layer, name) for layer in layers_of(env))


def get_attribute(env: Any, name: str) -> Any:
    """Return an attribute of the game or of a wrapper around it, also one that PettingZoo's wrappers hide."""
    for layer in layers_of(env):
        value = getattr(layer, name, _MISSING)
        if value is not _MISSING:
            return value
    raise AttributeError(f"neither {env} nor what it wraps has an attribute {name!r}")


def call_method(env: Any, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Call a method of the game or of a wrapper around it."""
    return get_attribute(env, name)(*args, **kwargs)


def set_attribute(env: Any, name: str, value: Any) -> None:
    """Set an attribute on the outermost layer that has it itself, else on the bare game."""
    layers = layers_of(env)
    owners = (layer for layer in layers if name in getattr(layer, "__dict__", {}) or hasattr(type(layer), name))
    setattr(next(owners, layers[-1]), name, value)


def is_wrapped(env: Any, module: str, qualname: str) -> bool:
    """
    Return whether the game is wrapped in a class or in a subclass of it.

    Classes are compared by name, since pickling may have copied the class in another process.

    :param env: the outermost layer
    :param module: module of the class
    :param qualname: qualified name of the class
    """
    classes = {kind for layer in layers_of(env) for kind in type(layer).__mro__}
    return any((kind.__module__, kind.__qualname__) == (module, qualname) for kind in classes)


def action_masks(env: Any, agents: Sequence[Any]) -> list[Any]:
    """
    Return the masks of the game's method ``action_masks``.

    :param env: the outermost layer
    :param agents: N names
    :return: N masks. For ended agents, which a dict of masks leaves out, any action is legal
    """
    masks = get_attribute(env, "action_masks")()
    if not isinstance(masks, Mapping):
        return [masks] * len(agents)
    anything = np.ones_like(next(iter(masks.values())), dtype=bool) if masks else None
    return [masks.get(agent, anything) for agent in agents]
