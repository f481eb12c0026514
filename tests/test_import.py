"""Importing the package adds names to ``policy_aliases`` and changes nothing else in other libraries."""

from __future__ import annotations

import subprocess
import sys

_SCRIPT = """
import importlib, pkgutil, sys
import sb3_contrib, stable_baselines3, supersuit

def modules():
    for package in (stable_baselines3, sb3_contrib, supersuit):
        for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            try:
                importlib.import_module(info.name)
            except ImportError:  # an optional dependency
                pass
    return {name: module for name, module in list(sys.modules.items()) if name.split(".")[0] in NAMES}

NAMES = {"stable_baselines3", "sb3_contrib", "supersuit"}

def contents():
    found = {}
    for name, module in modules().items():
        for key, value in vars(module).items():
            found[name, key] = id(value)
            if isinstance(value, type) and value.__module__.split(".")[0] in NAMES:
                for attribute, member in vars(value).items():
                    kept = dict(member) if isinstance(member, dict) and attribute == "policy_aliases" else None
                    found[name, key, attribute] = kept if kept is not None else id(member)
    return found

modules()
before = contents()
IMPORTS
after = contents()
assert len(before) > 5000 and before.keys() == after.keys(), sorted(before.keys() ^ after.keys())
changed = {key for key in before if before[key] != after[key] and key[-1] not in ("_abc_impl", "__warningregistry__")}
assert {key[-1] for key in changed} == {"policy_aliases"}, changed
for key in changed:
    assert after[key].items() >= before[key].items(), key
print("same", len(before))
"""


def test_importing_changes_nothing_of_the_libraries() -> None:
    """Compare all modules and classes of SB3, sb3-contrib and SuperSuit before and after, in a separate process."""
    script = _SCRIPT.replace("IMPORTS", "import sb3_saf, hecogrid_envs")
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("same")
