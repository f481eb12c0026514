"""Which policies can be looked into, and by what."""

from __future__ import annotations

from stable_baselines3.common.policies import BasePolicy

from sb3_saf.inspection.insides import Insides, RecurrentInsides
from sb3_saf.inspection.q_insides import QInsides
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.recurrent import TeamRecurrentPolicy
from sb3_saf.qplex.policies import QPLEXPolicy

#: Policies of this package.
OurPolicy = TeamPolicy | QPLEXPolicy


def require_our_policy(policy: BasePolicy) -> OurPolicy:
    """
    Refuse what cannot be looked into.

    :raises ValueError: if it is none of this package's policies
    """
    if isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        return policy
    raise ValueError(
        "expected a policy of sb3_saf such as 'SAFPolicy', 'MAPPOPolicy', 'IPPOPolicy' or 'QPLEXPolicy', got "
        f"{type(policy).__name__}"
    )


def insides_of(policy: OurPolicy, n_rows: int, deterministic: bool = False) -> Insides | QInsides:
    """
    Insides of a policy of any kind.

    :param policy: to look into
    :param n_rows: B
    :param deterministic: whether it takes its most likely actions; those of a value-based policy always are its best
    """
    if isinstance(policy, QPLEXPolicy):
        return QInsides(policy)
    if isinstance(policy, TeamRecurrentPolicy):
        return RecurrentInsides(policy, n_rows, deterministic)
    return Insides(policy, deterministic)
