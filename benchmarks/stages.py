"""
Measure training time by stage: ``python -m benchmarks.stages``.

One table per setting: SAF, MAPPO and IPPO in the size ``small`` of the zoo, with its 80 games and with 16 and 128, SAF
and MAPPO with a GRU, and SAF with the paper's network. A stage excludes the stages inside it: for example, the rollout
does not include the games that it steps. Wall-clock; the functions that SB3's PPO calls are wrapped, so the numbers are
of the real program and sum to the total.

On a GPU, ``--device cuda --only "SAF, paper size"`` waits for the device between stages, so that each includes its own
kernels, and prints the time of 10 million game steps; ``--no-wait`` lets stages overlap as in training.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, Final
from unittest import mock

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common import on_policy_algorithm

from sb3_saf import PaperCNN, TeamRolloutBuffer, make_team_env
from sb3_saf.training.settings import load_settings

REST: Final = "all else"
TRANSFER: Final = "arrays to the device"


class Stopwatch(ExitStack):
    """
    Sums the seconds of nested stages, each without those inside it; at its exit no function is watched any more.

    :param wait: waits until the device is idle; None if calls are synchronous
    :param clock: returns seconds
    """

    def __init__(self, wait: Callable[[], None] | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        super().__init__()
        self.seconds: dict[str, float] = defaultdict(float)
        self._wait = wait
        self._clock = clock
        self._stack: list[str] = []
        self._since = clock()

    def _charge(self) -> None:
        if self._wait is not None:
            self._wait()
        now = self._clock()
        self.seconds[self._stack[-1] if self._stack else REST] += now - self._since
        self._since = now

    def start(self) -> None:
        """Reset all times."""
        self.seconds.clear()
        self._since = self._clock()

    def stop(self) -> dict[str, float]:
        """Return seconds by stage."""
        self._charge()
        return dict(self.seconds)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a block as this stage."""
        self._charge()
        self._stack.append(name)
        try:
            yield
        finally:
            self._charge()
            self._stack.pop()

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Measure the calls of a function or method as a stage."""
        inner: Callable[..., Any] = getattr(owner, method)

        @wraps(inner)
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.stage(name):
                return inner(*args, **kwargs)

        self.enter_context(mock.patch.object(owner, method, timed))

    def watch_items(self, owner: Any, method: str, name: str) -> None:
        """Measure a generator as a stage: the time between its items."""
        inner: Callable[..., Any] = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Iterator[Any]:
            items = inner(*args, **kwargs)
            while True:
                with self.stage(name):
                    item = next(items, None)
                if item is None:
                    return
                yield item

        self.enter_context(mock.patch.object(owner, method, timed))


#: Settings by number of games, with minibatches of 2,000 rows: the zoo's own, and rollouts of whole episodes.
SMALL_GAMES: Final[Mapping[int, dict[str, int]]] = {
    80: {},
    16: {"n_envs": 16, "n_steps": 50, "n_minibatches": 2},
    128: {"n_envs": 128, "n_steps": 50, "n_minibatches": 16},
}
PAPER_GAME_STEPS: Final = 10_000_000


def small_model(
    algo: str, overrides: Mapping[str, Any], device: str = "cpu", env_kwargs: Mapping[str, Any] | None = None
) -> PPO:
    """Create PPO with the zoo's settings of the size ``small``."""
    settings = load_settings(algo, "TeamSupport-v0", "small", env_kwargs, overrides)
    model = settings.make_model(settings.make_env(0), 0, device=device)
    assert isinstance(model, PPO)
    return model


def paper_model(policy: str, n_games: int, device: str) -> PPO:
    """Create SAF, MAPPO or IPPO with the paper's games and network."""
    env = make_team_env("TeamSupport", n_envs=n_games, seed=0)
    return PPO(
        policy,
        env,
        n_steps=50,
        batch_size=50 * env.num_envs,
        n_epochs=10,
        learning_rate=7e-4,
        gae_lambda=1.0,
        ent_coef=0.01,
        max_grad_norm=9.0,
        rollout_buffer_class=TeamRolloutBuffer,
        policy_kwargs={"features_extractor_class": PaperCNN},
        seed=0,
        device=device,
    )


SETTINGS: Final[Mapping[str, Callable[[str], PPO]]] = {
    **{
        f"{algo.upper()}, small, {n_games} games": partial(small_model, algo, overrides)
        for n_games, overrides in SMALL_GAMES.items()
        for algo in ("saf", "mappo", "ippo")
    },
    **{f"{algo.upper()}, small, 80 games": partial(small_model, algo, {}) for algo in ("saf-gru", "mappo-gru")},
    "SAF, paper network, 16 games": partial(paper_model, "SAFPolicy", 16),
}
#: This size needs a GPU; without one, a rollout takes a minute.
PAPER_SIZE: Final[Mapping[str, Callable[[str], PPO]]] = {
    f"{name}, paper size": partial(paper_model, f"{name}Policy", 128) for name in ("SAF", "MAPPO", "IPPO")
}


def watch(model: Any, wait: bool = True) -> Stopwatch:
    """
    Measure everything that PPO does with its parts.

    :param wait: for a GPU, between stages
    """
    watch = Stopwatch(th.cuda.synchronize if wait and model.device.type == "cuda" else None)
    policy, buffer, env = model.policy, model.rollout_buffer, model.env
    watch.watch(env.unwrapped, "step_wait", "games")
    watch.watch(env, "step", "joint view, monitor")
    watch.watch(buffer, "add", "rollout buffer")
    watch.watch(buffer, "compute_returns_and_advantage", "advantages")
    watch.watch_items(buffer, "get", "minibatches")
    watch.watch(buffer, "to_torch", TRANSFER)
    watch.watch(on_policy_algorithm, "obs_as_tensor", TRANSFER)
    watch.watch(policy, "forward", "rollout: heads, drawing actions")
    watch.watch(policy, "predict_values", "rollout: heads, drawing actions")
    watch.watch(policy, "evaluate_actions", "update: likelihood, entropy, gathering")
    for module, name in ((policy.features_extractor, "encoder"), (policy.actor, "actor"), (policy.value_net, "critic")):
        watch.watch(module, "forward", f"{name}, forward")
    for memory in (policy.actor_memory, policy.value_net.memory):
        if memory is not None:
            for method in ("forward", "step", "every"):
                watch.watch(memory, method, "memories, forward")
    watch.watch(policy.row_encoder, "find", "which observations are equal")
    watch.watch(th.Tensor, "backward", "backward")
    watch.watch(th.nn.utils, "clip_grad_norm_", "clipping of gradients")
    watch.watch(policy.optimizer, "step", "Adam")
    return watch


def profile(model: PPO, rollouts: int, wait: bool = True) -> tuple[dict[str, float], int]:
    """Return seconds by stage, and agent-steps, after a rollout and update as warm-up."""
    assert model.env is not None
    rows = model.n_steps * model.env.num_envs
    model.learn(rows)
    with watch(model, wait) as stopwatch:
        stopwatch.start()
        model.learn(rollouts * rows, reset_num_timesteps=False)
        return stopwatch.stop(), rollouts * rows


def main() -> None:
    """Print a Markdown table: microseconds per agent-step of each stage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollouts", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", help="such as cuda")
    parser.add_argument(
        "--no-wait", action="store_true", help="for the device between stages: its time goes to whom waits"
    )
    parser.add_argument("--only", choices=[*SETTINGS, *PAPER_SIZE], help="one setting")
    options = parser.parse_args()
    if options.device.startswith("cuda") and not th.cuda.is_available():
        parser.error(
            f"--device {options.device}: torch {th.__version__} finds no GPU here; leave it out to measure the CPU"
        )
    th.set_num_threads(options.threads)
    for name in [options.only] if options.only else SETTINGS:
        model = {**SETTINGS, **PAPER_SIZE}[name](options.device)
        seconds, rows = profile(model, options.rollouts, not options.no_wait)
        whole = sum(seconds.values())
        print(f"\n{name}: {rows / whole:,.0f} agent-steps/s, {options.device}, {options.threads} thread(s)\n")
        print("| stage | us per agent-step | share |\n| --- | --- | --- |")
        for stage, spent in sorted(seconds.items(), key=lambda item: -item[1]):
            print(f"| {stage} | {1e6 * spent / rows:.2f} | {100 * spent / whole:.1f} % |")
        if name in PAPER_SIZE:
            hours = PAPER_GAME_STEPS * 10 * whole / rows / 3600
            print(f"\n{PAPER_GAME_STEPS:,} game steps of 10 agents at this rate: {hours:.2f} hours")


if __name__ == "__main__":
    main()
