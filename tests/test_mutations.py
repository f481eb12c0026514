"""
mutations of valid settings and states raise ValueErrors or work, and nothing hangs.

A thousand of each, and of exported actors and models: ``MUTATIONS=1000 python -m pytest -k mutat``.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import numpy as np
import pytest

import hecogrid_envs
from sb3_saf.experiments.definitions import Selection
from sb3_saf.experiments.results import Results
from sb3_saf.training.settings import ALGOS, load_settings
from sb3_saf.training.yaml_files import SIZES

ENV_IDS = [f"{task}-v0" for task in hecogrid_envs.TASK_NAMES]
COUNT = int(os.environ.get("MUTATIONS", "100"))
#: Processor seconds after which a mutation counts as a hang.
PATIENCE = 30
SMALL = {"n_agents": 3, "grid_size": 8, "n_treasures": 4, "n_keys": 2, "coordination": 1, "max_cycles": 9}
CONFIGS = sorted(Path(hecogrid_envs.__file__).parents[1].glob("zoo_configs/*.yml"))


@contextmanager
def no_hang() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise AssertionError(f"still at it after {PATIENCE} s")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def refused(attempt: Callable[[], object]) -> bool:
    """Whether one of our errors is raised; any other error fails the test."""
    with no_hang():
        try:
            attempt()
        except ValueError as error:
            return bool(str(error))  # our errors have a message
    return False


def scrambled(text: str, rng: random.Random) -> str:
    """Change, remove, duplicate or exchange a few characters, words or lines."""
    for _ in range(rng.choice((1, 1, 1, 4))):
        place, other = sorted(rng.randrange(len(text) + 1) for _ in range(2))
        change = rng.randrange(6)
        if change == 0:
            text = text[:place] + chr(rng.choice((rng.randrange(1, 128), rng.randrange(1, 0x3000)))) + text[place + 1 :]
        elif change == 1:
            text = text[:place] + text[place + rng.randrange(1, 30) :]
        elif change == 2:
            text = text[:place] + text[place : place + 40] + text[place:]
        elif change == 3:
            text = text[:place] + text[other : other + 20] + text[place:other] + text[other + 20 :]
        else:
            words = text.split(" ")
            words[rng.randrange(len(words))] = rng.choice(ODD_WORDS)
            text = " ".join(words)
        text = text or "#"
    return text


ODD_WORDS = (
    *("null", "true", "-1", "0", "1e400", ".nan", "-.inf", "99999999999999999999", "0.5", "''", "[]", "{}", "[1, 2]"),
    *("../../etc/passwd", "2024-99-99", "2024-01-01", "0x", "0o9", "12:30:45", "*unknown", "&a", "!!set {a, b}"),
    *("!!python/object/apply:os.system ['false']", "!!binary abc", "!!int abc", "? [a]: b", "[" * 2000, "{a: " * 500),
    *("lin_x", "lin_-1", "os.system", "a\x00b", "&r [*r]", "\ufeff", "%YAML 9", "--- 1", "1" * 5000, "<<: 1"),
)


def test_mutated_settings_are_refused_in_our_own_words_or_load(tmp_path: Path) -> None:
    rng = random.Random(0)
    texts = {path.stem: path.read_text(encoding="utf-8") for path in CONFIGS if path.stem in ALGOS}
    count = 0
    for _ in range(COUNT):
        algo = rng.choice(sorted(texts))
        path = tmp_path / "settings.yml"
        path.write_text(scrambled(texts[algo], rng), encoding="utf-8")
        env_id, size = rng.choice(ENV_IDS), rng.choice(SIZES)
        count += refused(lambda: load_settings(algo, env_id, size, config=path))  # noqa: B023
    assert count > COUNT / 4


def a_game(seed: int = 0) -> hecogrid_envs.HECOGridEnv:
    env = hecogrid_envs.parallel_env("KeyForTreasure", observation="tiles", **SMALL)  # type: ignore[arg-type]
    env.reset(seed=seed)
    return env


def play_on(env: hecogrid_envs.HECOGridEnv, rng: random.Random) -> None:
    """Play two steps and observe, which must work for every accepted state."""
    for _ in range(2):
        env.step({agent: rng.randrange(7) for agent in env.possible_agents})
    env.state()
    assert env.reset(seed=1)


def odd_array(array: np.ndarray[Any, Any], rng: random.Random) -> Any:
    """Return an invalid entry of a state; sometimes a valid one."""
    flat = rng.randrange(array.size)
    changed = array.astype(np.int64)
    changed.flat[flat] = rng.choice((0, 1, 2, 3, -1, 7, 255, 256, 2**31, -(2**63)))
    return rng.choice(
        (
            *([changed] * 4),
            *(changed.tolist(), array.T, array[:-1], array.ravel(), array.astype(float), array.astype(complex)),
            *(array.astype(object), array.astype(str), array.astype("M8[s]"), array[..., np.newaxis], array[:0]),
            *(None, "abc", 3, float("nan"), [[1], [2, 3]], {"a": 1}, {1, 2}, b"abc", object(), [10**30], print),
            *(np.full(array.shape, 2**63, np.uint64), np.full(array.shape, np.nan), np.ma.masked_array(array, True)),
        )
    )


def test_mutated_states_are_refused_in_our_own_words_or_can_be_played() -> None:
    rng = random.Random(0)
    env, count = a_game(), 0
    for number in range(COUNT):
        env.reset(seed=number % 7)
        state: dict[Any, Any] = dict(env.get_state())
        for _ in range(rng.choice((1, 1, 2))):
            name = rng.choice(list(state) or [0])
            change = rng.randrange(8)
            if change == 0:
                state.pop(name, None)
            elif change == 1:
                state[rng.choice((1, None, "wall", ("a",), "agent_pos "))] = 1
            elif isinstance(state.get(name), np.ndarray) and state[name].size and state[name].dtype.kind in "bui":
                state[name] = odd_array(state[name], rng)

        def attempt(
            state: object = rng.choice((state, state, state, list(state), None, 5)) if number % 9 == 0 else state,
        ) -> None:
            env.set_state(state)
            play_on(env, rng)

        count += refused(attempt)
    assert count > COUNT / 2
    env.reset(seed=0)
    play_on(env, rng)


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "saf/../../x", "..", "", "saf\x00", "C:\\x", "a/b"])
def test_names_with_paths_are_unknown(name: str) -> None:
    assert refused(lambda: load_settings(name, ENV_IDS[0], "smoke"))
    assert refused(lambda: load_settings("saf", name, "smoke"))
    assert refused(lambda: load_settings("saf", ENV_IDS[0], name))  # type: ignore[arg-type]
    assert refused(lambda: Results(Path("nowhere")).experiment(name))
    assert refused(lambda: Selection((0,), (name,)))
    assert refused(lambda: hecogrid_envs.parallel_env(name))
