"""IPPO's critic: an agent's value from its own observation."""

from __future__ import annotations

from sb3_saf.networks.critic import OwnValueHead


class OwnCritic(OwnValueHead):
    """V_i from z_i: (K, d) features of own observations to (K,) values; see the base class for the parameters."""
