"""
On a GPU: updates are those of the CPU, and the commands train there, continue, and leave models for the CPU.

Skipped without one. Where there is one: ``python -m pytest tests/test_gpu.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed

from sb3_saf import TeamRolloutBuffer
from sb3_saf.training import train as zoo_train
from sb3_saf.training.settings import ALGOS, load_settings

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="there is no GPU")

ENV = "TeamSupport-v0"


@pytest.mark.parametrize("algo", [name for name, spec in ALGOS.items() if spec.algorithm is PPO])
def test_an_update_is_that_of_the_cpu(algo: str) -> None:
    settings = load_settings(algo, ENV, "smoke")
    played, *pair = (settings.make_model(settings.make_env(0), 0, device=device) for device in ("cpu", "cpu", "cuda"))
    assert isinstance(played, PPO)
    played.learn(played.n_steps * played.n_envs)
    first = {name: weights.cpu().clone() for name, weights in pair[0].policy.state_dict().items()}
    for model in pair:
        assert isinstance(model, PPO)
        model.set_logger(Logger(None, []))
        buffer = model.rollout_buffer = played.rollout_buffer
        assert isinstance(buffer, TeamRolloutBuffer)
        buffer.device, buffer._agents_of_steps = model.device, buffer._agents_of_steps.to(model.device)
        set_random_seed(0)
        model.train()
    on_cpu, on_gpu = (model.policy.state_dict() for model in pair)
    assert any(not th.equal(weights, first[name]) for name, weights in on_cpu.items())
    for name, weights in on_cpu.items():
        assert on_gpu[name].is_cuda, name
        assert th.allclose(on_gpu[name].cpu(), weights, rtol=1e-3, atol=1e-3), name


@pytest.mark.parametrize("algo", ["saf", "mappo-gru", "ippo-separate", "qplex-pool", "qmix-gru"])
def test_commands(algo: str, tmp_path: Path) -> None:
    """Two commands, the second of which continues; the model then acts on the CPU as on the GPU."""
    for game_steps in ("120", "240"):
        options = ("--env", ENV, "--size", "smoke", "-n", game_steps, "--checkpoint-freq", "1", "--device", "cuda")
        zoo_train.main(["--algo", algo, *options, "-f", str(tmp_path), "--resume"])
    path = tmp_path / algo / f"{ENV}_1" / f"{ENV}.zip"
    settings = load_settings(algo, ENV, "smoke")
    venv = settings.make_env(1)
    rows = venv.reset()
    on_cpu, on_gpu = (ALGOS[algo].algorithm.load(path, device=device) for device in ("cpu", "cuda"))
    (by_cpu, _), (by_gpu, _) = (model.predict(rows, deterministic=True) for model in (on_cpu, on_gpu))
    assert np.array_equal(by_cpu, by_gpu)
