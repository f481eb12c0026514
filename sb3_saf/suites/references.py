"""
Known results of tasks (``references.csv``), to tell whether a return is normal.

The same game is quoted in several units and with several lengths of an episode. A reference therefore names the
parameters of the game that differ from the suite's defaults, and its unit: ``return``, the team's in the suite's unit
(sum or mean over agents, ``Suite.team_return``), or ``won``, the fraction of games won. Others are never compared.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, Final, NamedTuple

import yaml

from sb3_saf.suites.registry import HOME, TeamEnvironment, find_environment

RANDOM: Final = "random"


class Reference(NamedTuple):
    """
    A known result of a task.

    :param params: parameters of the game that differ from the suite's defaults
    :param unit: ``"return"`` or ``"won"``
    :param game_steps: of its training; 0 for players that do not learn
    """

    task: str
    params: Mapping[str, Any]
    unit: str
    value: float
    method: str
    game_steps: int
    source: str

    def __str__(self) -> str:
        value = f"{100 * self.value:.0f} % won" if self.unit == "won" else f"{self.value:g}"
        steps = f" after {self.game_steps:,} game steps" if self.game_steps else ""
        return f"{self.method} {value}{steps}"


@cache
def _all_references() -> tuple[Reference, ...]:
    lines = files("sb3_saf.suites").joinpath("references.csv").read_text(encoding="utf-8").splitlines()
    return tuple(
        Reference(
            row["task"],
            {key: yaml.safe_load(value) for key, _, value in (word.partition(":") for word in row["params"].split())},
            row["unit"],
            float(row["value"]),
            row["method"],
            int(row["game_steps"]),
            row["source"],
        )
        for row in csv.DictReader(lines)
    )


def references(env: str | TeamEnvironment, params: Mapping[str, Any] | None = None) -> list[Reference]:
    """
    Return what is known of a task.

    :param env: the environment, or its id, whose package need not be installed
    :param params: only references of games with these parameters, in training or in evaluation; None for all
    """
    name = (env if isinstance(env, str) else env.id).removeprefix(f"{HOME}/")
    known = [one for one in _all_references() if one.task in (name, f"{name}-v0")]
    if params is None:
        return known
    environment = find_environment(env) if isinstance(env, str) else env
    shaping = () if environment.suite is None else environment.suite.training_params
    played = _without(environment.complete(params), shaping)
    return [one for one in known if _without(environment.complete(one.params), shaping) == played]


def _without(params: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: value for name, value in params.items() if name not in names}


class Standing(NamedTuple):
    """
    A result beside what is known of its task.

    :param share: of the way from a random team to the closest published result; None if one of them is unknown
    """

    text: str
    share: float | None


def standing(
    env: TeamEnvironment, params: Mapping[str, Any], scores: Mapping[str, float], game_steps: int
) -> Standing | None:
    """
    Compare a result with what is known of its task: players that do not learn, and the published result whose training
    is closest in game steps, as a ratio.

    :param scores: the result by unit, from the most telling one: ``won``, ``return``
    :return: None if nothing is known in these units
    """
    over = "sum" if env.suite is None else env.suite.team_return
    texts, share = [], None
    for unit, score in scores.items():
        known = [one for one in references(env, params) if one.unit == unit]
        trained = [one for one in known if one.game_steps]
        if not known:
            continue
        here = f"{100 * score:.0f} % won" if unit == "won" else f"return, {over} over agents: {score:.4g}"
        texts += [here, *(str(one) for one in known if not one.game_steps)]
        floor = next((one.value for one in known if one.method == RANDOM), None)
        if trained:
            closest = min(trained, key=lambda one: (abs(math.log(one.game_steps / max(1, game_steps))), -one.value))
            texts.append(f"{closest} ({closest.source})")
            if share is None and floor is not None and closest.value > floor:
                share = (score - floor) / (closest.value - floor)
    if not texts:
        return None
    if share is not None:
        texts.append("below random" if share < 0 else f"{share:.0%} of the way from random to published")
    return Standing("; ".join(texts), share)
