"""
The same critics and pool in the algorithms of sb3-contrib.

- ``TRPO`` takes the policies of PPO: ``TRPO("SAFPolicy", env)``. Its policy step moves encoder and actor, its value
  step the critic alone, so the critic learns on features that the actor shapes. Where a pool's KL divergence has no
  closed form (all but Discrete actions) it is bounded from above, see ``common.distributions.PolicyAndAction``.
  ``selection="gumbel"`` has none and is refused at the first update; ``sub_sampling_factor`` above 1 fails in
  sb3-contrib itself, which cannot thin out Dict observations.
- ``RecurrentPPO("SAFLstmPolicy", env)``: policies that remember, in ``recurrent.py``.
- ``MaskablePPO("SAFMaskablePolicy", env)``: one mask of actions per agent, in ``maskable.py``.

The last two have ``MAPPO...`` and ``IPPO...``, too.
"""
