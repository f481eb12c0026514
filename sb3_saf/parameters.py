"""
The paper's parameter table: ``python -m sb3_saf.parameters`` counts every weight and prints it beside the paper's
numbers.

The table is for 10 agents, 28 x 28 x 3 views, 7 actions, one head per agent (``paper_table_kwargs`` of each policy).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from gymnasium import spaces
from torch import nn

from sb3_saf.envs.teams import TeamSpaces
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.ippo import IPPOPolicy
from sb3_saf.policies.mappo import MAPPOPolicy
from sb3_saf.policies.saf import SAFPolicy

N_AGENTS: Final = 10
#: Parts that only the released code has and that the paper's figure for SAF includes.
RELEASED_ONLY: Final = {"variational bottleneck": 125_216, "extra attention projection": 16_640}


class TableRow(NamedTuple):
    """
    One line of the table.

    :param name: the model
    :param counted: parameters of our model
    :param paper: the paper's figure, None where it gives none
    :param made_of: the parts
    """

    name: str
    counted: int
    paper: int | None
    made_of: str


def count(module: nn.Module) -> int:
    """Number of trainable weights."""
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


def paper_policy(policy_class: type[TeamActorCriticPolicy]) -> TeamActorCriticPolicy:
    """
    A policy as in the paper's table.

    :param policy_class: IPPOPolicy, MAPPOPolicy or SAFPolicy
    """
    views = TeamSpaces.of(spaces.Box(0, 255, (3, 28, 28), np.uint8), N_AGENTS).to_dict_space()
    kwargs = policy_class.paper_table_kwargs()
    return policy_class(views, spaces.Discrete(7), lambda _: 0.0, ortho_init=False, **kwargs)


def parameter_table() -> list[TableRow]:
    """Count the encoder and the three models."""
    ippo, mappo, saf = (paper_policy(policy) for policy in (IPPOPolicy, MAPPOPolicy, SAFPolicy))
    return [
        TableRow("CNN", count(ippo.features_extractor), None, "shared by all models and agents"),
        TableRow("IPPO", count(ippo), 1_740_016, _made_of(ippo)),
        TableRow("MAPPO", count(mappo), 2_477_296, _made_of(mappo)),
        TableRow("SAF", count(saf), 2_698_342, _made_of(saf)),
    ]


def _made_of(policy: TeamActorCriticPolicy) -> str:
    return f"CNN + actors {count(policy.actor):,} + critics {count(policy.value_net):,}"


def format_table(rows: list[TableRow]) -> str:
    """The table as text, with the account of SAF's difference."""
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
