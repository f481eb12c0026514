"""Settings as YAML: safe loading, and merging of base files, environments and sizes to one mapping."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from copy import deepcopy
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, Literal, get_args

import yaml

from sb3_saf.teams.checks import unknown_name

#: Sizes from the paper's experiments to a test that trains in seconds.
Size = Literal["paper", "medium", "small", "smoke"]
SIZES: Final[tuple[Size, ...]] = get_args(Size)

#: The entry for all environments, and the key of the base file.
DEFAULT: Final = "default"
BASE: Final = "base"
SIZES_KEY: Final = "sizes"
#: Keys whose mappings are merged key by key; all other values are replaced.
MERGED: Final = ("env_kwargs", "policy_kwargs")
#: Limits on files: bytes, and values after expanding all aliases.
_MAX_BYTES: Final = 200_000
_MAX_VALUES: Final = 100_000
_MERGE_TAG: Final = "tag:yaml.org,2002:merge"


class _StrictLoader(yaml.SafeLoader):
    """
    PyYAML's safe loader without merge keys, whose expansion may exceed the memory, and without duplicate keys, of which
    it would silently use the last.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        problems = [f"the key {key!r} is there twice" for key in sorted({key for key in keys if keys.count(key) > 1})]
        if any(key.tag == _MERGE_TAG for key, _ in node.value):
            problems = ["merge keys (<<) are not supported; repeat the settings, or refine a file with base"]
        if problems:
            raise yaml.constructor.ConstructorError(
                "while reading a mapping", node.start_mark, problems[0], node.start_mark
            )
        return super().construct_mapping(node, deep)


def load_yaml(text: str, source: str) -> Any:
    """
    Read plain data from YAML; ``source`` names the origin in errors.

    :raises ValueError: for invalid YAML, data that are not plain, or too many values after expanding aliases
    """
    try:
        content = yaml.load(text, Loader=_StrictLoader)
        size = _size(content, {})
    except (yaml.YAMLError, ValueError) as error:
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
    Count the values after expanding all aliases; ``known`` has the sizes of containers by identity.

    :raises ValueError: for dates, sets and other values that settings do not have
    """
    if not isinstance(content, (dict, list)):
        if not isinstance(content, (bool, int, float, str, type(None))):
            raise ValueError(f"expected numbers, text, lists and mappings, got the {type(content).__name__} {content}")
        return 1
    if id(content) not in known:
        parts = [*content, *content.values()] if isinstance(content, dict) else content
        known[id(content)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(content)]


def parse_value(text: str) -> Any:
    """Read a value typed on a command line: plain YAML, never Python."""
    return load_yaml(text, f"the value {_short(text)}")


def read_plain_file(path: Path) -> Any:
    """Read the plain data in a YAML file; ValueError if it cannot be read or is too large."""
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read the settings in {path}: {error}") from None
    if len(data) > _MAX_BYTES:
        raise ValueError(f"cannot read the settings in {path}: it has more than {_MAX_BYTES:,} bytes")
    return load_yaml(text, str(path))


def read_file(path: Path) -> dict[str, Any]:
    """Read a settings file and its base files."""
    return _with_base(read_plain_file(path), str(path), ())


def read_config(name: str, refined_by: Sequence[str] = ()) -> dict[str, Any]:
    """
    Read a file of the package ``zoo_configs`` and its base files.

    :param name: file name without ``.yml``
    :param refined_by: files that refine this one
    """
    return _with_base(deepcopy(_content_of(name)), f"zoo_configs/{name}.yml", (*refined_by, name))


@cache
def _content_of(name: str) -> Any:
    """Read a file of ``zoo_configs`` once in a process: an experiment asks for the settings of every cell."""
    text = files("zoo_configs").joinpath(f"{name}.yml").read_text(encoding="utf-8")
    return load_yaml(text, f"zoo_configs/{name}.yml")


def config_names() -> list[str]:
    """Return the names of the files of ``zoo_configs``, without ``.yml``."""
    return sorted(file.name[:-4] for file in files("zoo_configs").iterdir() if file.name.endswith(".yml"))


def _with_base(content: object, source: str, refined_by: Sequence[str]) -> dict[str, Any]:
    """Return a mapping from environment ids to settings, merged into that of its base file."""
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{source} must map 'default' and environment ids to settings, got {_short(content)}")
    base = content.pop(BASE, None)
    for key, entry in content.items():
        _check_entry(entry, f"{source}: the entry {key!r}")
    if base is None:
        return content
    if base not in config_names() or base in refined_by:
        raise ValueError(f"{source}: {unknown_name('base', base, set(config_names()) - set(refined_by))}")
    result = read_config(base, refined_by)
    for key, entry in content.items():
        result[key] = _refined(result.get(key) or {}, entry or {})
    return result


def _check_entry(entry: object, what: str) -> None:
    if entry is None:
        return
    if not isinstance(entry, dict):
        raise ValueError(f"{what} must map names to values, got {_short(entry)}")
    sizes = entry.get(SIZES_KEY, {})
    if not isinstance(sizes, dict):
        raise ValueError(f"{what}: {SIZES_KEY!r} must map sizes to settings, got {_short(sizes)}")
    for size, section in sizes.items():
        if size not in SIZES:
            raise ValueError(f"{what}: {unknown_name('size', size, SIZES)}")
        if not isinstance(section, dict):
            raise ValueError(f"{what}: size {size!r} must map names to values, got {_short(section)}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refined(entry: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of a base file merged with a file's own entry, also within sizes."""
    result = merge(entry, own)
    sections = [one.get(SIZES_KEY, {}) for one in (entry, own)]
    if any(sections):
        result[SIZES_KEY] = {size: merge(*(section.get(size, {}) for section in sections)) for size in SIZES}
    return result


def entry_of(content: Mapping[str, Any], keys: Sequence[str], size: Size) -> dict[str, Any]:
    """
    Merge entries of a file, the most general first, then their sections of the size; entries may be missing.

    Sections of sizes are merged last because they are the most specific; ``paper`` is the content outside of them.
    """
    entries = [dict(content.get(key) or {}) for key in keys]
    sections = [entry.pop(SIZES_KEY, {}).get(size, {}) for entry in entries]
    return merge(*entries, *sections)


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Merge mappings; later values take precedence, mappings under the keys of ``MERGED`` are merged in turn."""
    result: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            both = key in MERGED and isinstance(result.get(key), Mapping) and isinstance(value, Mapping)
            result[key] = {**result[key], **value} if both else value
    return result
