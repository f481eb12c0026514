"""
What an algorithm is made of: its actor and its critic.

Policy classes differ in what SB3 asks of them (PPO's, recurrent, maskable ...); parts differ in the algorithm. A policy
class names its parts and takes their fields as constructor arguments, so that each default is written once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

from gymnasium import spaces
from torch import nn

from sb3_saf.networks.actor import ActorNetwork, SinglePolicy
from sb3_saf.networks.critic import Heads, OwnValueHead, StateCritic, TeamCritic, TeamStates

#: What a critic may read: the agent's own part, the whole team's, or the state of the game.
CriticInput = Literal["own", "team", "state"]


class NetworkSpec(NamedTuple):
    """
    What a policy tells its parts.

    :param features_dim: size of an encoded observation
    :param n_agents: N
    :param action_space: one agent's action space
    :param actor_hidden: sizes of the hidden layers of each action head
    :param value_hidden: sizes of the hidden layers of each value head
    :param activation_fn: activation of hidden layers
    :param log_std_init: first log standard deviation, Box actions only
    :param state_space: space of the game's state where rows have it
    """

    features_dim: int
    n_agents: int
    action_space: spaces.Space[Any]
    actor_hidden: list[int]
    value_hidden: list[int]
    activation_fn: type[nn.Module]
    log_std_init: float
    state_space: spaces.Space[Any] | None = None


@dataclass(frozen=True)
class TeamParts(ABC):
    """
    Base of all parts: the actor that MAPPO and IPPO share.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param actor_identity: whether a shared actor reads, as a one-hot vector, who acts: for teams whose agents have
        roles that their observations do not tell
    """

    heads: Heads = "shared"
    actor_identity: bool = False

    def __post_init__(self) -> None:
        check_choice("heads", self.heads, get_args(Heads))

    def n_identities(self, spec: NetworkSpec) -> int:
        """Return N if a shared actor reads who acts, else 0."""
        return spec.n_agents if self.actor_identity else 0

    def actor(self, spec: NetworkSpec) -> ActorNetwork:
        """Make the actor; with one for each agent there is nothing to tell them."""
        per_agent = self.heads == "per_agent"
        return SinglePolicy(
            spec.features_dim,
            spec.action_space,
            spec.actor_hidden,
            spec.activation_fn,
            spec.log_std_init,
            n_agents=spec.n_agents if per_agent else None,
            n_identities=0 if per_agent else self.n_identities(spec),
        )

    @abstractmethod
    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """Make the critic."""

    def team_states(self, spec: NetworkSpec) -> TeamStates | None:
        """Make what a critic with memory reads of each agent; None for the features of its own observation."""
        return None


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """
    Check an argument that is one of a few words.

    :raises ValueError: with the choices
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


def check_at_least_one(name: str, value: object) -> None:
    """
    Check a count.

    :raises ValueError: with the value
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
