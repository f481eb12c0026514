"""
The paper's parameter table: ``python -m sb3_saf.parameters`` counts every weight and prints it beside the paper's
numbers.

The table is for 10 agents, 28 x 28 x 3 observations, 7 actions, one head per agent; the paper's text and its final
code share MAPPO's heads instead (docs/reference/differences.md, 17). Declarations define which algorithms are in it,
and with which arguments.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.parts import Declaration
from sb3_saf.registration import DECLARATIONS
from sb3_saf.teams.rows import TeamSpaces

N_AGENTS: Final = 10
#: Parts of the released code only, which the paper's number for SAF includes.
RELEASED_ONLY: Final = {"variational bottleneck": 125_216, "extra attention projection": 16_640}


class TableRow(NamedTuple):
    """One line of the table: our model's number of parameters, and the paper's, None if it has none."""

    name: str
    counted: int
    paper: int | None
    made_of: str


def count(module: nn.Module) -> int:
    """Return the number of trainable weights."""
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


def paper_policy(declaration: Declaration) -> TeamPolicy:
    """Make a policy as in the paper's table."""
    assert declaration.paper_table is not None
    rows = TeamSpaces(spaces.Box(0, 255, (3, 28, 28), np.uint8), N_AGENTS).to_dict_space()
    policy_class: Any = declaration.policies[PPO][0]
    kwargs = declaration.paper_table.policy_kwargs
    return policy_class(rows, spaces.Discrete(7), lambda _: 0.0, ortho_init=False, **kwargs)


def parameter_table() -> list[TableRow]:
    """Count the encoder and the models, the smallest first."""
    rows = []
    for declaration in DECLARATIONS:
        if declaration.paper_table is not None:
            policy = paper_policy(declaration)
            made_of = f"CNN + actors {count(policy.actor):,} + critics {count(policy.value_net):,}"
            rows.append(TableRow(declaration.name, count(policy), declaration.paper_table.n_parameters, made_of))
    encoder = TableRow("CNN", count(policy.features_extractor), None, "shared by all models and agents")
    return [encoder, *sorted(rows, key=lambda row: row.counted)]


def format_table(rows: list[TableRow]) -> str:
    """Return the table as text, with an explanation of SAF's difference."""
    lines = [f"{'model':<8}{'counted':>12}{'paper':>12}{'difference':>12}  made of"]
    for row in rows:
        paper = "" if row.paper is None else f"{row.paper:,}"
        difference = "" if row.paper is None else f"{row.counted - row.paper:,}"
        lines.append(f"{row.name:<8}{row.counted:>12,}{paper:>12}{difference:>12}  {row.made_of}")
    saf = rows[-1].counted
    parts = " + ".join(f"{number:,} ({name})" for name, number in RELEASED_ONLY.items())
    lines += [
        "",
        "The paper's figure for SAF counts two parts that only the released code has:",
        f"{saf:,} + {parts} = {saf + sum(RELEASED_ONLY.values()):,}",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(format_table(parameter_table()))
