"""
Train the suites' own baselines, to be compared with ours: ``results/suites_baselines.csv``.

``python -m benchmarks.peers --jaxmarl CLONE --epymarl CLONE`` runs what the file lacks, each program in its own process
and with its own settings; only the number of game steps is ours. JaxMARL's and EPyMARL's programs are not in their
packages, so both need a clone: of https://github.com/FLAIROx/JaxMARL and https://github.com/uoe-agents/epymarl.
Without one its rows are left out. JaxMARL's programs hang on a single core. Requirements conflict with this project's;
``--python`` names interpreters that have them. ``--rates`` measures only speed: JaxMARL's IPPO, Stable-Baselines3's own
PPO and ours on one environment, with equal networks, epochs and minibatches; the same with memory on SMAX; then whole
trainings of BenchMARL's and EPyMARL's MAPPO, and ours on the same tasks, each with its own settings.
``--rates memory`` and the like choose among them.

- JaxMARL: jax 0.4.38, flax, optax, distrax, chex, gymnax, jaxtyping, matplotlib, omegaconf, pyyaml, safetensors
- BenchMARL: benchmarl 1.5.2, torchrl 0.11.1, vmas
- EPyMARL: torch, sacred, setuptools < 81, tensorboard-logger, gymnasium, lbforaging, rware, pyyaml, scipy, pettingzoo
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final, NamedTuple

FILE: Final = Path("results", "suites_baselines.csv")
COLUMNS: Final = ("task", "program", "seed", "game_steps", "return", "won", "processor_seconds", "source")
#: Game steps of an episode of VMAS, as ours.
_VMAS_STEPS: Final = 100
#: The last training episodes whose mean counts, as a share of all updates.
_LAST: Final = 20
#: Speed: what is played (also JaxMARL's own choice), and game steps of a measured run.
_SPREAD: Final = "MPE_simple_spread_v3"
_RATE_TASK: Final = f"jaxmarl/{_SPREAD}"
_RATE_STEPS: Final = 200_000
#: The same with memory, whose units are JaxMARL's, for numbers of games.
_MEMORY_TASK: Final = "3m"
_MEMORY_UNITS: Final = 128
_MEMORY_STEPS: Final = 50_000
_MEMORY_GAMES: Final = (64, 256)
#: JaxMARL's program of values, whose settings for these games are in a file of another name.
_PQN: Final = "pqn_vdn_ff"
_RATES: Final = ("feedforward", "memory", "trainings")


class Peer(NamedTuple):
    """
    A program of others and what it is trained on.

    :param task: our id, with the parameters of the game that the program sets
    :param program: name in the table
    :param kind: key of ``PROGRAMS``
    :param own_task: their name of the task
    :param algorithm: their name of the method
    :param game_steps: of one training
    :param settings: what differs from the program's own settings
    """

    task: str
    program: str
    kind: str
    own_task: str
    algorithm: str
    game_steps: int
    settings: Mapping[str, float] = MappingProxyType({})


class Outcome(NamedTuple):
    """
    What a training reached.

    :param value: team return in the suite's unit
    :param won: share of episodes, or None
    :param source: what was run and what is averaged
    """

    value: float
    won: float | None
    source: str


KITCHENS: Final = ("cramped_room", "asymm_advantages", "coord_ring", "forced_coord", "counter_circuit")
PEERS: Final = (
    Peer("smax/3m", "JaxMARL's IPPO", "jaxmarl", "3m", "ippo_rnn_smax", 100_000),
    Peer("smax/3m", "JaxMARL's IPPO", "jaxmarl", "3m", "ippo_rnn_smax", 1_000_000),
    Peer("smax/2s3z", "JaxMARL's IPPO", "jaxmarl", "2s3z", "ippo_rnn_smax", 60_000),
    Peer("overcooked/cramped_room", "JaxMARL's IPPO", "jaxmarl", "cramped_room", "ippo_ff_overcooked", 200_000),
    *(
        Peer(f"overcooked/{layout}", "JaxMARL's IPPO", "jaxmarl", layout, "ippo_ff_overcooked", 5_000_000)
        for layout in KITCHENS
    ),
    *(
        Peer(f"jaxmarl/{_SPREAD}", "JaxMARL's IPPO", "jaxmarl", _SPREAD, "ippo_ff_mpe", game_steps)
        for game_steps in (200_000, 10_000_000)
    ),
    Peer(
        f"jaxmarl/{_SPREAD}",
        "JaxMARL's IPPO with a discount of 0.9",
        "jaxmarl",
        _SPREAD,
        "ippo_ff_mpe",
        10_000_000,
        {"GAMMA": 0.9},
    ),
    *(
        Peer(f"jaxmarl/{game}", "JaxMARL's PQN-VDN", "jaxmarl", game, _PQN, 10_000_000)
        for game in (_SPREAD, "MPE_simple_speaker_listener_v4")
    ),
    *(
        Peer(f"smax/{battle}", "JaxMARL's IPPO", "jaxmarl", battle, "ippo_rnn_smax", 10_000_000)
        for battle in ("2s3z", "3s_vs_5z")
    ),
    *(
        Peer(f"vmas/{ours}", "BenchMARL's MAPPO", "benchmarl", theirs, "Mappo", 100_000)
        for ours, theirs in (
            ("balance n_agents:4", "BALANCE"),
            ("navigation n_agents:3 shared_rew:False", "NAVIGATION"),
            ("transport", "TRANSPORT"),
        )
    ),
    Peer(
        "lbf/Foraging-8x8-2p-3f-v3",
        "EPyMARL's MAPPO",
        "epymarl",
        "lbforaging:Foraging-8x8-2p-3f-v3",
        "mappo",
        200_000,
    ),
    Peer("rware/rware-tiny-2ag-v2", "EPyMARL's MAPPO", "epymarl", "rware:rware-tiny-2ag-v2", "mappo", 40_000),
)
#: Whole trainings whose time is compared with ours.
RATED: Final = (
    Peer("vmas/simple_spread", "BenchMARL's MAPPO", "benchmarl", "SIMPLE_SPREAD", "Mappo", 60_000),
    next(peer for peer in PEERS if peer.task.startswith("lbf")),
)
_ALL: Final = (*PEERS, *RATED)


def _open_jaxmarl(algorithm: str, clone: Path, logged: list[Mapping[str, Any]]) -> tuple[Any, dict[str, Any]]:
    """Return a program of JaxMARL and its settings; what it logs is appended to ``logged``."""
    _replace("wandb", log=logged.append)
    _replace("hydra", main=lambda **_: lambda function: function)
    sys.path.insert(0, str(clone))
    folder, name = ("QLearning", f"alg/{_PQN}_mpe") if algorithm == _PQN else ("IPPO", algorithm)
    text = (clone / "baselines" / folder / "config" / f"{name}.yaml").read_text(encoding="utf-8")
    config = import_module("yaml").safe_load(text.replace("${oc.env:WANDB_ENTITY}", "none"))
    return import_module(f"baselines.{folder}.{algorithm}"), {key: _number(value) for key, value in config.items()}


def train_jaxmarl(peer: Peer, seed: int, clone: Path) -> Outcome:
    """
    Run a baseline of JaxMARL and average its last training episodes, of values take its last test with best actions.

    Its own settings fall over the run: learning rate, shaped rewards (to 0 after the same share of the run).
    """
    logged: list[Mapping[str, Any]] = []
    program, config = _open_jaxmarl(peer.algorithm, clone, logged)
    share = peer.game_steps / config["TOTAL_TIMESTEPS"]
    config |= {"TOTAL_TIMESTEPS": peer.game_steps, "SEED": seed, "NUM_SEEDS": 1, **peer.settings}
    if "MAP_NAME" in config:
        config["MAP_NAME"] = peer.own_task
    elif "REW_SHAPING_HORIZON" in config:
        layouts = import_module("jaxmarl.environments.overcooked").overcooked_layouts
        config["REW_SHAPING_HORIZON"] *= share
        config["ENV_KWARGS"] = {"layout": layouts[peer.own_task]}
    else:
        config["ENV_NAME"] = peer.own_task
    jax = import_module("jax")
    ran = f"`make_train` of baselines/{{}}/{peer.algorithm}.py at {_commit(clone)}, jax {jax.__version__}"
    if peer.algorithm == _PQN:
        config["WANDB_MODE"] = "disabled"
        env, _ = program.env_from_config(dict(config))
        _, _, test, _ = jax.jit(program.make_train(config, env))(jax.random.PRNGKey(seed))["runner_state"]
        value = float(test["returned_episode_returns"])
        return Outcome(value, None, f"{ran.format('QLearning')}; {config['TEST_NUM_ENVS']} games, best actions")
    jax.block_until_ready(jax.jit(program.make_train(config))(jax.random.PRNGKey(seed)))

    def last(name: str) -> float:
        values = [float(one[name].mean()) for one in logged[-max(1, len(logged) // _LAST) :]]
        return sum(values) / len(values)

    value = last("returned_episode_returns" if "returned_episode_returns" in logged[-1] else "returns")
    won = last("win_rate") if "win_rate" in logged[-1] else None
    return Outcome(value, won, f"{ran.format('IPPO')}; training episodes")


def train_benchmarl(peer: Peer, seed: int, clone: Path) -> Outcome:
    """Run an algorithm of BenchMARL with its base configuration, and evaluate it with drawn actions."""
    experiment = import_module("benchmarl.experiment")
    config = experiment.ExperimentConfig.get_from_yaml()
    config.max_n_frames, config.loggers, config.evaluation = peer.game_steps, [], True
    config.evaluation_interval = -(-peer.game_steps // config.on_policy_collected_frames_per_batch)
    config.evaluation_interval *= config.on_policy_collected_frames_per_batch
    config.evaluation_episodes, config.evaluation_deterministic_actions, config.render = 64, False, False
    config.create_json, config.checkpoint_interval, config.checkpoint_at_end = False, 0, False
    task = import_module("benchmarl.environments").VmasTask[peer.own_task].get_from_yaml()
    task.config["max_steps"] = _VMAS_STEPS
    mlp = import_module("benchmarl.models.mlp").MlpConfig.get_from_yaml()
    algorithm = getattr(import_module("benchmarl.algorithms"), f"{peer.algorithm}Config").get_from_yaml()
    run = experiment.Experiment(
        task=task, algorithm_config=algorithm, model_config=mlp, critic_model_config=mlp, seed=seed, config=config
    )
    run.run()
    version = import_module("importlib.metadata").version("benchmarl")
    return Outcome(float(run.mean_return), None, f"BenchMARL {version}, base configuration; 64 episodes, drawn actions")


def train_epymarl(peer: Peer, seed: int, clone: Path) -> Outcome:
    """Run a method of EPyMARL with its own settings, and evaluate it with its most likely actions."""
    limit = 500 if peer.own_task.startswith("rware") else 50
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "smaclite.py").touch()  # imported by EPyMARL at start
        words = ["src/main.py", f"--config={peer.algorithm}", "--env-config=gymma", "with", "use_cuda=False"]
        words += [f"env_args.time_limit={limit}", f"env_args.key={peer.own_task}", f"t_max={peer.game_steps}"]
        words += [f"seed={seed}", f"test_interval={peer.game_steps // 2}", "test_nepisode=100"]
        variables = {**os.environ, "PYTHONPATH": folder}
        done = subprocess.run([sys.executable, *words], cwd=clone, env=variables, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
    files = Path(clone, "results", "sacred").rglob("info.json")  # always written there, one folder for each run
    results = json.loads(max(files, key=os.path.getmtime).read_text(encoding="utf-8"))
    value = results["test_return_mean"][-1]
    value = value["value"] if isinstance(value, dict) else value
    source = f"src/main.py at {_commit(clone)}, config {peer.algorithm}; 100 episodes, most likely actions"
    return Outcome(float(value), None, source)


PROGRAMS: Final[Mapping[str, Callable[[Peer, int, Path], Outcome]]] = {
    "jaxmarl": train_jaxmarl,
    "benchmarl": train_benchmarl,
    "epymarl": train_epymarl,
}


def _replace(name: str, **attributes: object) -> None:
    """Provide a module that a program imports only to log or to read its command line."""
    module = ModuleType(name)
    vars(module).update(attributes)
    sys.modules[name] = module


def _number(value: object) -> Any:
    """Convert numbers that YAML reads as text, such as 1e7."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _commit(clone: Path) -> str:
    command = ["git", "-C", str(clone), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _train_here(peer: Peer, seed: int, clone: Path) -> None:
    """Train in this process, and print the row as JSON."""
    value, won, source = PROGRAMS[peer.kind](peer, seed, clone)
    spent = sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )
    row = [peer.task, peer.program, seed, peer.game_steps, round(value, 3)]
    print(json.dumps([*row, "" if won is None else round(won, 3), round(spent), source]))


def _rate_here(algorithm: str, n_games: int, clone: Path) -> None:
    """Print game steps per processor second of JaxMARL's IPPO, compiled beforehand."""
    program, config = _open_jaxmarl(algorithm, clone, [])
    rollout, n_steps = n_games * config["NUM_STEPS"], _MEMORY_STEPS if "rnn" in algorithm else _RATE_STEPS
    config |= {"NUM_ENVS": n_games, "TOTAL_TIMESTEPS": rollout * max(2, n_steps // rollout), "NUM_SEEDS": 1}
    if "MAP_NAME" in config:
        config["MAP_NAME"] = _MEMORY_TASK
    jax = import_module("jax")
    train = jax.jit(program.make_train(config))
    jax.block_until_ready(train(jax.random.PRNGKey(0)))
    start = time.process_time()
    jax.block_until_ready(train(jax.random.PRNGKey(1)))
    print(config["TOTAL_TIMESTEPS"] / (time.process_time() - start))


def _jaxmarls_rate(algorithm: str, n_games: int, clone: Path, python: str) -> float:
    """Return game steps per processor second of JaxMARL's IPPO, in a process of its own."""
    words = [python, __file__, "--rate-here", algorithm, str(n_games), f"--jaxmarl={clone.resolve()}"]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"JaxMARL's program: {(done.stderr or 'failed').strip().splitlines()[-1]}")
    return float(done.stdout.split()[-1])


def print_memory_rates(clone: Path, python: str) -> None:
    """Print game steps per processor second on SMAX with a GRU; ours have a second one for the critic."""
    loop, saf = import_module("benchmarks.loop"), import_module("sb3_saf")
    ppo = import_module("stable_baselines3").PPO
    print("\n| games | JaxMARL's IPPO | IPPO | MAPPO |\n| --- | --- | --- | --- |")
    kwargs = {"memory": "gru", "memory_size": _MEMORY_UNITS, "net_arch": [_MEMORY_UNITS]}
    kwargs |= {"features_extractor_class": saf.ObservationEncoder}
    kwargs |= {"features_extractor_kwargs": {"features_dim": _MEMORY_UNITS}}
    for n_games in _MEMORY_GAMES:
        theirs, models = _jaxmarls_rate("ippo_rnn_smax", n_games, clone, python), {}
        for name in ("IPPO", "MAPPO"):
            env = saf.make_team_env(f"smax/{_MEMORY_TASK}", n_envs=n_games, seed=0)
            models[name] = ppo(
                f"{name}Policy", env, n_steps=loop.SUITE_STEPS, n_epochs=loop.N_EPOCHS, policy_kwargs=kwargs, seed=0,
                batch_size=loop.SUITE_STEPS * env.num_envs // loop.N_MINIBATCHES, device="cpu",
                rollout_buffer_class=saf.TeamRolloutBuffer,
            )  # fmt: skip
        ours = [1 / cost.whole / loop.N_AGENTS for cost in loop.costs(models, rounds=2).values()]
        print(f"| {n_games} | " + " | ".join(f"{rate:,.0f}" for rate in (theirs, *ours)) + " |", flush=True)


def print_rates(clone: Path, python: str) -> None:
    """Print agent-steps per processor second of whole training loops, SB3's PPO on the rows of the same VecEnv."""
    loop = import_module("benchmarks.loop")
    print("| games | JaxMARL's IPPO | " + " | ".join((loop.SB3, *loop.POLICIES)) + " |")
    print("| --- |" + " --- |" * (2 + len(loop.POLICIES)))
    for n_games in loop.N_STEPS:
        theirs = _jaxmarls_rate("ippo_ff_mpe", n_games, clone, python)
        costs = loop.costs(loop.suite_models(_RATE_TASK, n_games), rounds=3)
        rates = [theirs * loop.N_AGENTS, *(1 / cost.whole for cost in costs.values())]
        print(f"| {n_games} | " + " | ".join(f"{rate:,.0f}" for rate in rates) + " |", flush=True)


def _trained(peer: Peer, seed: int, clones: Mapping[str, Path | None], interpreters: Mapping[str, str]) -> list[Any]:
    """Train in a process of its own; return its row, empty after an error, which is printed."""
    words = ["--here", str(_ALL.index(peer)), "--seeds", str(seed)]
    words += [f"--{kind}={Path(clone).resolve()}" for kind, clone in clones.items() if clone and clone != Path()]
    command = [interpreters.get(peer.kind, sys.executable), __file__, *words]
    with tempfile.TemporaryDirectory() as folder:  # BenchMARL writes into the current one
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    if done.returncode:
        print(f"{peer.task}, {peer.program}, seed {seed}: {(done.stderr or 'failed').strip().splitlines()[-1]}")
        return []
    return list(json.loads(done.stdout.strip().splitlines()[-1]))


def print_trainings(clones: Mapping[str, Path | None], interpreters: Mapping[str, str]) -> None:
    """Print return and processor seconds of whole trainings, seed 0; MAPPO is tested on 32 games with drawn actions."""
    suite_results = import_module("benchmarks.suite_results")
    print("\n| task | program | game steps | return | processor s |\n|" + " --- |" * 5)
    for peer in RATED:
        row = _trained(peer, 0, clones, interpreters) if clones[peer.kind] is not None else []
        if row:
            _print_row(peer.task, peer.program, row[3], row[4], row[6])
        task = suite_results.Task(peer.task, peer.game_steps, ("mappo",))
        with tempfile.TemporaryDirectory() as folder:
            options = argparse.Namespace(folder=Path(folder))
            with contextlib.redirect_stdout(sys.stderr):
                results = suite_results.run(task, 0, options)
            tests = suite_results.read_results(results, task.name).tests
        (test,) = tests[tests["method"] == "mappo"].to_dict("records")
        _print_row(peer.task, "MAPPO", test["game_steps"], test["return_mean"], test["processor_seconds"])


def _print_row(task: str, program: str, game_steps: int, value: float, seconds: float) -> None:
    print(f"| {task} | {program} | {game_steps:,} | {value:.2f} | {seconds:.0f} |", flush=True)


def _key(row: Sequence[object]) -> tuple[str, ...]:
    return tuple(map(str, row[:4]))


def main() -> None:
    """Run what is missing, one training after the other, and write each row when it is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jaxmarl", type=Path, help="a clone")
    parser.add_argument("--epymarl", type=Path, help="a clone")
    parser.add_argument("--python", nargs="*", default=[], metavar="KIND=PATH", help="interpreters, by kind")
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1, 2))
    parser.add_argument("--only", default="", help="tasks that contain this text")
    parser.add_argument(
        "--rates", nargs="*", choices=_RATES, help="measure only speed, by default all; needs --jaxmarl"
    )
    parser.add_argument("--here", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--rate-here", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rate_here is not None:
        algorithm, n_games = options.rate_here
        return _rate_here(algorithm, int(n_games), options.jaxmarl)
    clones = {"jaxmarl": options.jaxmarl, "epymarl": options.epymarl, "benchmarl": Path()}
    if options.here is not None:
        peer = _ALL[options.here]
        return _train_here(peer, options.seeds[0], clones[peer.kind])
    if wrong := [pair for pair in options.python if "=" not in pair]:
        parser.error(f"--python: expected KIND=PATH, such as jaxmarl=/opt/jax/bin/python, got {wrong[0]!r}")
    interpreters = dict(pair.split("=", 1) for pair in options.python)
    if options.rates is not None:
        if options.jaxmarl is None:
            parser.error("--rates: give --jaxmarl, a clone of https://github.com/FLAIROx/JaxMARL")
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"  # before jax is imported, for ours as for theirs
        rates, python = options.rates or _RATES, interpreters.get("jaxmarl", sys.executable)
        if "feedforward" in rates:
            print_rates(options.jaxmarl, python)
        if "memory" in rates:
            print_memory_rates(options.jaxmarl, python)
        return print_trainings(clones, interpreters) if "trainings" in rates else None
    with FILE.open(encoding="utf-8", newline="") as file:
        rows: list[Sequence[object]] = [*csv.reader(file)][1:]
    for seed in options.seeds:
        for peer in PEERS:
            there = any(_key(row) == _key([peer.task, peer.program, seed, peer.game_steps]) for row in rows)
            if there or options.only not in peer.task or clones[peer.kind] is None:
                continue
            if row := _trained(peer, seed, clones, interpreters):
                rows.append(row)
                print(*row, flush=True)
                with FILE.open("w", encoding="utf-8", newline="") as file:
                    csv.writer(file, lineterminator="\n").writerows([COLUMNS, *sorted(rows, key=_key)])


if __name__ == "__main__":
    main()
