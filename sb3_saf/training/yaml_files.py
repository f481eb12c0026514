"""Settings as YAML: safe loading, and how ``default``, an environment's entry and their sizes become one mapping."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, Literal, get_args

import yaml

from sb3_saf.training.names import unknown_name

#: The paper's experiments, what a laptop trains in an hour, and what a test trains in seconds.
Size = Literal["paper", "small", "smoke"]
SIZES: Final[tuple[Size, ...]] = get_args(Size)

DEFAULT: Final = "default"
SIZES_KEY: Final = "sizes"
#: Keys whose mappings are merged key by key; all other values are replaced.
MERGED: Final = ("env_kwargs", "policy_kwargs")
#: What a file may hold: some aliases of aliases unfold to more than a memory.
_MAX_VALUES: Final = 100_000


class _UniqueKeyLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which alone would take the last of two equal keys without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE_TAG]
        twice = sorted({key for key in keys if keys.count(key) > 1})
        if twice:
            raise yaml.constructor.ConstructorError(
                "while reading a mapping", node.start_mark, f"the key {twice[0]!r} is there twice", node.start_mark
            )
        return super().construct_mapping(node, deep)


_MERGE_TAG: Final = "tag:yaml.org,2002:merge"


def load_yaml(text: str, source: str) -> Any:
    """
    Plain data from YAML.

    :param text: the YAML
    :param source: where it came from, for errors
    :raises ValueError: for what is no YAML, needs more than plain data, or unfolds to more than a person would write
    """
    try:
        content = yaml.load(text, Loader=_UniqueKeyLoader)
        size = _size(content, {})
    except yaml.YAMLError as error:
        what = " ".join(str(error).split())
        raise ValueError(f"{source} is not valid YAML: {what}") from None
    except RecursionError:
        raise ValueError(f"{source} is nested too deep, or refers to itself; settings are a few levels deep") from None
    if size > _MAX_VALUES:
        raise ValueError(
            f"{source} unfolds to more than {_MAX_VALUES:,} values; write out what its aliases (*) stand for"
        )
    return content


def _size(content: object, known: dict[int, int]) -> int:
    """
    How many values there are when all aliases are unfolded.

    :param known: sizes of containers by identity, so that none is counted twice
    """
    if not isinstance(content, (dict, list, set)):
        return 1
    if id(content) not in known:
        parts = [*content, *content.values()] if isinstance(content, dict) else content
        known[id(content)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(content)]


def parse_value(text: str) -> Any:
    """
    A value typed on a command line: plain YAML, never Python.

    :raises ValueError: for what is no YAML
    """
    return load_yaml(text, f"the value {text!r}")


def read_file(path: Path) -> dict[str, Any]:
    """
    Read a file of settings.

    :param path: a YAML file
    :raises ValueError: if it cannot be read or is no mapping of environment ids
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read the settings in {path}: {error}") from None
    return _checked_file(load_yaml(text, str(path)), str(path))


def read_config(name: str) -> dict[str, Any]:
    """
    Read a file of the package ``zoo_configs``.

    :param name: without ``.yml``
    """
    source = f"zoo_configs/{name}.yml"
    text = files("zoo_configs").joinpath(f"{name}.yml").read_text(encoding="utf-8")
    return _checked_file(load_yaml(text, source), source)


def _checked_file(content: object, source: str) -> dict[str, Any]:
    """A mapping from environment ids to mappings."""
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{source} must map 'default' and environment ids to settings, got {_short(content)}")
    for env_id, entry in content.items():
        if entry is not None and not isinstance(entry, dict):
            raise ValueError(f"{source}: the entry {env_id!r} must map names to values, got {_short(entry)}")
        for size, section in _sizes(entry or {}, f"{source}, {env_id}").items():
            if size not in SIZES:
                raise ValueError(f"{source}, {env_id}: {unknown_name('size', size, SIZES)}")
            if not isinstance(section, dict):
                raise ValueError(f"{source}, {env_id}: size {size!r} must map names to values, got {_short(section)}")
    return content


def _sizes(entry: Mapping[str, Any], source: str) -> Mapping[str, Any]:
    sizes = entry.get(SIZES_KEY, {})
    if not isinstance(sizes, dict):
        raise ValueError(f"{source}: {SIZES_KEY!r} must map sizes to settings, got {_short(sizes)}")
    return sizes


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def entry_of(content: Mapping[str, Any], env_id: str, size: Size) -> dict[str, Any]:
    """
    The settings of an environment at a size: ``default``, its entry, then the size's sections of both.

    Sections of sizes come last because they are the most specific; ``paper`` is what stands outside of them.

    :param content: what a file holds
    :param env_id: such as ``"TeamTogether-v0"``
    :param size: one of ``SIZES``
    """
    entries = [dict(content.get(key) or {}) for key in (DEFAULT, env_id)]
    sections = [entry.pop(SIZES_KEY, {}).get(size, {}) for entry in entries]
    return merge(*entries, *sections)


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """
    One mapping of several; later values win, and mappings under the keys of ``MERGED`` are merged in turn.

    :param layers: from the most general to the most specific
    """
    result: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            both = key in MERGED and isinstance(result.get(key), Mapping) and isinstance(value, Mapping)
            result[key] = {**result[key], **value} if both else value
    return result
