"""
SAF, MAPPO and IPPO for Stable-Baselines3: importing this package registers their policies by name.

Without Stable-Baselines3, only :class:`Actor` for exported actors is available.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NoReturn

from sb3_saf.export.act import Actor
from sb3_saf.teams import package_version
from sb3_saf.teams.checks import ExportError

if find_spec("stable_baselines3") is not None:
    from sb3_saf.buffers.replay import TeamReplayBuffer
    from sb3_saf.buffers.rollout import TeamRolloutBuffer
    from sb3_saf.callbacks import EntropySchedule, FiniteCallback, GameStepsCallback, TeamEvalCallback
    from sb3_saf.checkpoints.learning import TeamCheckpointCallback, resumable_learn, resume
    from sb3_saf.envs.audit import check_team_env
    from sb3_saf.envs.curriculum import Curriculum, Stage
    from sb3_saf.envs.gymnasium_team import GymnasiumTeam
    from sb3_saf.envs.joint_observation import CentralizedValueWrapper
    from sb3_saf.envs.monitor import TeamMonitor
    from sb3_saf.envs.turns import TurnsInParallel
    from sb3_saf.evaluation import (
        EvaluationResult,
        RandomPolicy,
        confidence_interval,
        evaluate_policy,
        evaluate_team,
    )
    from sb3_saf.export.writer import export_actors, load_weights, save_weights
    from sb3_saf.inspection.callback import Inspection, InspectionCallback, inspect_team
    from sb3_saf.inspection.replay import replay
    from sb3_saf.make import make_team_env, make_vec_env
    from sb3_saf.networks.encoders import (
        LightEncoder,
        MLPEncoder,
        NatureEncoder,
        ObservationEncoder,
        PaperCNN,
        PartsEncoder,
    )
    from sb3_saf.policies.ippo import IPPOMaskablePolicy, IPPOPolicy
    from sb3_saf.policies.mappo import MAPPOMaskablePolicy, MAPPOPolicy
    from sb3_saf.policies.saf import SAFMaskablePolicy, SAFPolicy
    from sb3_saf.qplex.policies import QPLEXPolicy, QPLEXPoolPolicy
    from sb3_saf.qplex.pqn import PQN, PQNPolicy
    from sb3_saf.qplex.qplex import QPLEX
    from sb3_saf.registration import register_all
    from sb3_saf.teams.checks import CheckpointError, NonFiniteError
    from sb3_saf.teams.randomness import game_seeds
    from sb3_saf.training.folders import load_team
    from sb3_saf.training.settings import ppo_settings

    register_all()
else:

    def __getattr__(name: str) -> NoReturn:
        """Raise an error that names the missing package."""
        needs = "needs stable_baselines3, which is not installed" if name in __all__ else "does not exist"
        raise AttributeError(f"sb3_saf.{name} {needs}")


__version__ = package_version()

__all__ = [
    "PQN",
    "QPLEX",
    "Actor",
    "CentralizedValueWrapper",
    "CheckpointError",
    "Curriculum",
    "EntropySchedule",
    "EvaluationResult",
    "ExportError",
    "FiniteCallback",
    "GameStepsCallback",
    "GymnasiumTeam",
    "IPPOMaskablePolicy",
    "IPPOPolicy",
    "Inspection",
    "InspectionCallback",
    "LightEncoder",
    "MAPPOMaskablePolicy",
    "MAPPOPolicy",
    "MLPEncoder",
    "NatureEncoder",
    "NonFiniteError",
    "ObservationEncoder",
    "PQNPolicy",
    "PaperCNN",
    "PartsEncoder",
    "QPLEXPolicy",
    "QPLEXPoolPolicy",
    "RandomPolicy",
    "SAFMaskablePolicy",
    "SAFPolicy",
    "Stage",
    "TeamCheckpointCallback",
    "TeamEvalCallback",
    "TeamMonitor",
    "TeamReplayBuffer",
    "TeamRolloutBuffer",
    "TurnsInParallel",
    "check_team_env",
    "confidence_interval",
    "evaluate_policy",
    "evaluate_team",
    "export_actors",
    "game_seeds",
    "inspect_team",
    "load_team",
    "load_weights",
    "make_team_env",
    "make_vec_env",
    "ppo_settings",
    "replay",
    "resumable_learn",
    "resume",
    "save_weights",
]
