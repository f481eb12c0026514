"""
The base of policies for MaskablePPO: one mask of actions per row, that is, per agent.

sb3-contrib asks the environment: ``venv.env_method("action_masks")`` gives one mask per row.

Letters: B rows, M choices.
"""

from __future__ import annotations

from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy

from sb3_saf.policies.base import TeamPolicy


class TeamMaskablePolicy(TeamPolicy, MaskableActorCriticPolicy):  # type: ignore[misc]  # value_net: ours
    """
    Policy for MaskablePPO on rows of teams; see :class:`TeamPolicy` for the parameters.

    Masks are (B, M): one flag per choice of an action, those of each dimension in turn (of a MultiBinary: off, on).
    The actions of each policy of a pool are masked before they are mixed: likelihood and entropy are exactly those of
    drawing a policy and then one of its allowed actions. A mask that allows nothing leaves the actions equally likely.
    Where observations have masks, too, an action must be allowed by both.
    """

    #: There are no masks for Box actions, so nothing reads it.
    log_std_init: float = 0.0
