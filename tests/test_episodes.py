"""Recorded episodes are reproduced bit for bit: those of the released environments, and our golden ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hecogrid_envs
from tests import golden_episodes

TRACES = Path(__file__).parents[2] / "shared" / "traces"
RECORDINGS = sorted(TRACES.glob("*.npz"))
STATE_ENTRIES = ("walls", "treasures", "keys", "agent_pos", "agent_dir", "agent_has_key")


@pytest.mark.skipif(not TRACES.is_dir(), reason="the recordings are not kept in this repository")
def test_there_are_recordings() -> None:
    assert len(RECORDINGS) >= 6


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_released_episodes(path: Path) -> None:
    with np.load(path) as recording:
        data: dict[str, Any] = {name: recording[name] for name in recording}
    config = json.loads(str(data["config"]))
    config.update(rules="released", agent_order="index")
    env = hecogrid_envs.parallel_env(**config)
    observations, _ = env.reset(options={"state": {name: data[name][0] for name in STATE_ENTRIES}})
    np.testing.assert_array_equal(list(observations.values()), data["observations"][0])
    for step, actions in enumerate(data["actions"]):
        result = env.step(dict(zip(env.agents, actions, strict=True)))
        state: Any = env.get_state()
        for name in STATE_ENTRIES:
            np.testing.assert_array_equal(state[name], data[name][step + 1], err_msg=f"{name} after step {step}")
        assert list(result.rewards.values()) == data["rewards"][step].tolist()
        pixels = list(result.observations.values())
        np.testing.assert_array_equal(pixels, data["observations"][step + 1], err_msg=f"step {step}")


def test_golden_episodes() -> None:
    assert golden_episodes.digests() == json.loads(golden_episodes.PATH.read_text())
