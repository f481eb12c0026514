"""
Measure which joint action QPLEX, QMIX and VDN learn in matrix games: ``python -m benchmarks.matrix_games``.

Data are uniform over joint actions (epsilon stays 1), so that only the factorisation matters.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np

from sb3_saf import QPLEX, make_team_env
from sb3_saf.qplex.mixers import MIXER_NAMES, MixerName
from tests.matrix_games import CLIMBING, ONE_STEP, Floats, MatrixGame

GAMES: dict[str, Floats] = {"one-step": ONE_STEP, "climbing": CLIMBING}


def learned_payoff(payoffs: Floats, mixer: MixerName, seed: int, game_steps: int) -> float:
    """
    Return the payoff of the greedy joint action after training.

    :param payoffs: (A, A)
    :param mixer: ``"qplex"``, ``"qmix"`` or ``"vdn"``
    :param seed: of everything
    :param game_steps: one gradient step for every 8 of them
    """
    env = make_team_env(MatrixGame(payoffs), n_envs=8, active=False)
    model = QPLEX(
        "QPLEXPolicy",
        env,
        mixer=mixer,
        seed=seed,
        learning_rate=1e-3,
        batch_size=32,
        buffer_size=2_000,
        learning_starts=500,
        train_freq=8,
        exploration_final_eps=1.0,
        policy_kwargs={"n_kernels": 10, "kernel_arch": (64, 64)},
        device="cpu",
    )
    model.learn(game_steps * env.n_agents)
    row, column = model.predict(env.reset(), deterministic=True)[0][:2]
    env.close()
    return float(payoffs[row, column])


def main() -> None:
    """Print how often each payoff was learned."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.matrix_games", description=__doc__)
    parser.add_argument("--game", choices=list(GAMES), default="one-step")
    parser.add_argument("--mixers", nargs="+", choices=MIXER_NAMES, default=list(MIXER_NAMES))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--game-steps", type=int, default=4_000)
    options = parser.parse_args()
    payoffs = GAMES[options.game]
    print(f"{options.game}: best payoff {payoffs.max():g}; {options.game_steps} game steps, {options.seeds} seeds")
    for mixer in options.mixers:
        found = [learned_payoff(payoffs, mixer, seed, options.game_steps) for seed in range(options.seeds)]
        counts = ", ".join(f"{payoff:g}: {count}" for payoff, count in sorted(Counter(found).items(), reverse=True))
        print(f"{mixer:<6} mean {np.mean(found):6.2f}   payoff: seeds  {counts}", flush=True)


if __name__ == "__main__":
    main()
