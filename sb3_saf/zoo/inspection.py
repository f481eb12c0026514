"""What the zoo writes to TensorBoard about a policy while it trains, and how often."""

from __future__ import annotations

from typing import Final

from sb3_saf.inspection.callback import InspectionCallback
from sb3_saf.zoo.seeds import evaluation_seed
from sb3_saf.zoo.settings import Settings

#: Team episodes that are played to look into a policy, each in a game of its own.
INSPECTED_EPISODES: Final = 16
#: Evaluations and inspections of a run, unless a frequency is given.
PER_RUN: Final = 20


def frequency(given: int | None, game_steps: int) -> int:
    """
    Game steps from one look at the policy to the next.

    :param given: by the user; 0 or less for none, None for so many that there are 20 in a run
    :param game_steps: of the run
    """
    return max(1, game_steps // PER_RUN) if given is None else given


def inspection(settings: Settings, seed: int, every_game_steps: int) -> InspectionCallback:
    """
    What looks into the policy for TensorBoard, on games that no run trains on, and shows the level beside it.

    :param settings: of the run
    :param seed: of the run
    :param every_game_steps: game steps between inspections
    """
    games = settings.make_env(seed, evaluation=True, n_envs=INSPECTED_EPISODES, render_mode="rgb_array")
    return InspectionCallback(
        games,
        every_game_steps,
        INSPECTED_EPISODES,
        seed=evaluation_seed(seed),
        hparams={"algo": settings.algo, "task": settings.task, "size": settings.size, **settings.env_kwargs},
    )
