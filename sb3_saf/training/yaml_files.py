"""Settings as YAML: safe loading, and merging of base files, environments and sizes to one mapping."""

from __future__ import annotations

import re
import reprlib
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
#: Two words for one setting, of which the later one counts.
EITHER: Final = {"batch_size": "n_minibatches", "n_minibatches": "batch_size"}


class _StrictLoader(yaml.SafeLoader):
    """
    PyYAML's safe loader without what it misreads: duplicate keys, ``key:value`` in braces without a space, and numbers
    as ``1e-3``, which YAML 1.1 takes for text.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        for key, value in node.value if node.flow_style else ():
            if isinstance(key, yaml.ScalarNode) and key.style is None and ":" in key.value and value.value == "":
                raise yaml.constructor.ConstructorError(
                    None, None, f"write a space after the colon of {key.value!r}", key.start_mark
                )
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    "while reading a mapping", node.start_mark, f"the key {key!r} is there twice", node.start_mark
                )
        return super().construct_mapping(node, deep)


_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
_StrictLoader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def load_yaml(text: str, source: str) -> Any:
    """Read YAML, never Python; the ValueError for invalid text names its ``source``."""
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as error:  # of wrong tags, too
        reason = " ".join(str(error).split())
        raise ValueError(f"{source} is not valid YAML: {reason}") from None


def read_settings(source: str | Path) -> dict[str, Any]:
    """
    Read a settings file, merged into its base files.

    :param source: name of a file of ``zoo_configs`` without ``.yml``, or the path of any other file
    :return: mapping from ``"default"``, suites and environment ids to settings
    :raises ValueError: if a file cannot be read, or is no such mapping
    """
    if isinstance(source, Path):
        try:
            content = load_yaml(source.read_text(encoding="utf-8"), str(source))
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"cannot read the settings in {source}: {error}") from None
        file = str(source)
    else:
        content, file = deepcopy(_config(source)), f"zoo_configs/{source}.yml"
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{file} must map 'default' and environment ids to settings, got {reprlib.repr(content)}")
    base = content.pop(BASE, None)
    for key, entry in content.items():
        what = f"{file}: the entry {key!r}"
        entry = content[key] = {} if entry is None else entry
        if not isinstance(entry, dict):
            raise ValueError(f"{what} must map names to values, got {reprlib.repr(entry)}")
        sections = entry.get(SIZES_KEY, {})
        if not isinstance(sections, dict) or not all(isinstance(section, dict) for section in sections.values()):
            raise ValueError(f"{what}: {SIZES_KEY!r} must map sizes to settings, got {reprlib.repr(sections)}")
        for size in sections:
            if size not in SIZES:
                raise ValueError(f"{what}: {unknown_name('size', size, SIZES)}")
        for layer in (entry, *sections.values()):
            check_either(layer, what)
    if base is None:
        return content
    if base not in config_names():
        raise unknown_name(f"base of {file}", base, config_names())
    result = read_settings(base)
    for key, entry in content.items():
        refined = merge(result.get(key, {}), entry)
        sizes = [one.get(SIZES_KEY, {}) for one in (result.get(key, {}), entry)]
        refined[SIZES_KEY] = {size: merge(*(sections.get(size, {}) for sections in sizes)) for size in SIZES}
        result[key] = refined
    return result


@cache
def _config(name: str) -> Any:
    """Read a file of ``zoo_configs`` once in a process: an experiment asks for the settings of every cell."""
    return load_yaml(files("zoo_configs").joinpath(f"{name}.yml").read_text("utf-8"), f"zoo_configs/{name}.yml")


def config_names() -> list[str]:
    """Return the names of the files of ``zoo_configs``, without ``.yml``."""
    return sorted(file.name[:-4] for file in files("zoo_configs").iterdir() if file.name.endswith(".yml"))


def entry_of(content: Mapping[str, Any], keys: Sequence[str], size: Size) -> dict[str, Any]:
    """
    Merge entries of a file, the most general first, then their sections of the size; entries may be missing.

    Sections of sizes are merged last because they are the most specific; ``paper`` is the content outside of them.
    """
    entries = [dict(content.get(key, {})) for key in keys]
    sections = [entry.pop(SIZES_KEY, {}).get(size, {}) for entry in entries]
    return merge(*entries, *sections)


def check_either(layer: Mapping[str, Any], source: str) -> None:
    """Check that settings have one word only of ``EITHER``; the ValueError names their ``source``."""
    if all(layer.get(word) is not None for word in EITHER):
        raise ValueError(f"{source}: {' and '.join(EITHER)} say the same thing; give one of them")


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Merge mappings; later values take precedence, mappings under the keys of ``MERGED`` are merged in turn."""
    result: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            both = key in MERGED and isinstance(result.get(key), Mapping) and isinstance(value, Mapping)
            result[key] = {**result[key], **value} if both else value
            if key in EITHER and value is not None and layer.get(EITHER[key]) is None:
                result.pop(EITHER[key], None)
    return result
