"""What the zoo writes to TensorBoard about a policy while it trains, and how often."""

from __future__ import annotations

from typing import Final

from sb3_saf.inspection.callback import InspectionCallback
from sb3_saf.training.seeds import evaluation_seed
from sb3_saf.training.settings import Settings

#: Team episodes that are played to look into a policy, each in a game of its own.
INSPECTED_EPISODES: Final = 16
#: Inspections of a run, unless a frequency is given.
INSPECTIONS: Final = 10


def inspection(settings: Settings, seed: int, every_game_steps: int | None = None) -> InspectionCallback:
    """
    What looks into the policy for TensorBoard, on games that no run trains on, and shows the level beside it.

    :param settings: of the run
    :param seed: of the run
    :param every_game_steps: game steps between inspections; None for so many that there are 10 in a run
    """
    if every_game_steps is None:
        every_game_steps = max(1, settings.game_steps // INSPECTIONS)
    games = settings.make_env(seed, evaluation=True, n_envs=INSPECTED_EPISODES, render_mode="rgb_array")
    return InspectionCallback(
        games,
        every_game_steps,
        INSPECTED_EPISODES,
        seed=evaluation_seed(seed),
        hparams={"algo": settings.algo, "task": settings.task, "size": settings.size, **settings.env_kwargs},
    )
