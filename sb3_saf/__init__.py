"""SAF, MAPPO and IPPO for Stable-Baselines3: importing this package registers their policies by name."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from sb3_saf.common.buffers import TeamRolloutBuffer
from sb3_saf.common.callbacks import TeamEvalCallback
from sb3_saf.common.centralized import CentralizedValueWrapper
from sb3_saf.common.encoders import LightEncoder, MLPEncoder, ObservationEncoder, PaperCNN
from sb3_saf.common.env import make_team_env
from sb3_saf.common.evaluation import (
    EvaluationResult,
    RandomPolicy,
    confidence_interval,
    evaluate_policy,
    evaluate_team,
)
from sb3_saf.common.monitor import TeamMonitor
from sb3_saf.contrib.maskable import IPPOMaskablePolicy, MAPPOMaskablePolicy, SAFMaskablePolicy
from sb3_saf.contrib.recurrent import IPPOLstmPolicy, MAPPOLstmPolicy, SAFLstmPolicy
from sb3_saf.ippo.policies import IPPOPolicy
from sb3_saf.mappo.policies import MAPPOPolicy
from sb3_saf.registration import register_all
from sb3_saf.saf.policies import SAFPolicy

try:
    __version__ = version("sb3-saf")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"

register_all()

__all__ = [
    "CentralizedValueWrapper",
    "EvaluationResult",
    "IPPOLstmPolicy",
    "IPPOMaskablePolicy",
    "IPPOPolicy",
    "LightEncoder",
    "MAPPOLstmPolicy",
    "MAPPOMaskablePolicy",
    "MAPPOPolicy",
    "MLPEncoder",
    "ObservationEncoder",
    "PaperCNN",
    "RandomPolicy",
    "SAFLstmPolicy",
    "SAFMaskablePolicy",
    "SAFPolicy",
    "TeamEvalCallback",
    "TeamMonitor",
    "TeamRolloutBuffer",
    "confidence_interval",
    "evaluate_policy",
    "evaluate_team",
    "make_team_env",
]
