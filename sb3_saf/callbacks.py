"""
Callbacks: game steps in the logs (SB3 counts agent steps), evaluation by team episodes, checks for NaN and infinity,
and a schedule of the entropy coefficient, of which SB3 has none.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch.utils.hooks import RemovableHandle

from sb3_saf.evaluation import EvaluationResult, evaluate_team
from sb3_saf.policies.rows import TeamRowsPolicy
from sb3_saf.teams.checks import NonFiniteError, SettingsError, check_hears_rollouts
from sb3_saf.teams.files import atomic_file
from sb3_saf.teams.rows import TEAM_KEY, TEAM_KEYS
from sb3_saf.teams.vec_env import agent_names, check_other_games, find_n_agents, layers, require_n_agents

GAME_STEPS_TAG = "time/game_steps"
GAME_STEPS_PER_SECOND_TAG = "time/game_steps_per_second"


def game_steps(model: BaseAlgorithm) -> int | None:
    """
    Return the game steps that a model was trained for: its ``num_timesteps`` (agent steps) divided by N.

    :return: None if it has no environment, or one without teams
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    return None if n_agents is None else model.num_timesteps // n_agents


def team_steps(model: BaseAlgorithm) -> int:
    """Return :func:`game_steps` of a model whose environment is known to have teams."""
    steps = game_steps(model)
    assert steps is not None
    return steps


def check_training(model: BaseAlgorithm) -> None:
    """
    Check a model before training; the callbacks of this package call it.

    Warns about SB3's own ``"MultiInputPolicy"``: it reads all entries of a row, the joint observation included, so that
    execution is not decentralised. It is allowed as a centralised policy.
    """
    entries = getattr(model.observation_space, "spaces", {})
    extractor = getattr(model.policy, "features_extractor", None)
    if set(TEAM_KEYS) <= set(entries) and isinstance(extractor, CombinedExtractor):
        own = sorted(
            name
            for name, policy in model.policy_aliases.items()
            if issubclass(policy, TeamRowsPolicy) and name == policy.__name__
        )
        warnings.warn(
            f"{type(model.policy).__name__} reads whole rows of teams: its actor sees {TEAM_KEY!r}, what all agents "
            "see, so that agents cannot act on their own observations. Use a policy whose critic alone reads the team: "
            f"{', '.join(own)}, as in {type(model).__name__}({own[-1]!r}, env)",
            UserWarning,
            stacklevel=3,
        )


class GameStepsBoard(TensorBoardOutputFormat):
    """A run's TensorBoard file with game steps on the x-axis instead of SB3's agent steps."""

    def __init__(self, board: TensorBoardOutputFormat, n_agents: int) -> None:
        # Not the base class's constructor, which would open a second file.
        self.board, self.n_agents, self.writer = board, n_agents, board.writer

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """See the base class; ``step`` counts agent steps."""
        self.board.write(key_values, key_excluded, step // self.n_agents)

    def close(self) -> None:
        """Close the file."""
        self.board.close()


def show_game_steps(model: BaseAlgorithm) -> None:
    """
    Make TensorBoard count game steps from now on, of a model in ``learn``; without teams nothing changes.

    Callbacks of this package do so when training starts.
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    if n_agents is None:
        return
    model.logger.output_formats = [
        GameStepsBoard(each, n_agents)
        if isinstance(each, TensorBoardOutputFormat) and not isinstance(each, GameStepsBoard)
        else each
        for each in model.logger.output_formats
    ]


class GameStepsCallback(BaseCallback):
    """
    Log ``time/game_steps`` and ``time/game_steps_per_second`` beside SB3's ``time/total_timesteps`` and ``time/fps``,
    which count agent steps, and make TensorBoard's x-axis count game steps; log each agent's own return beside the
    team's, ``rollout/ep_rew_mean/AGENT``, but not on the screen. Without teams it does nothing.

    Before training it checks the policy (:func:`check_training`).

    ``sb3_saf.train`` and ``resumable_learn`` add it automatically; pass it to any other ``learn``.
    """

    only_shows = True  # has no state in checkpoints

    def _init_callback(self) -> None:
        check_training(self.model)

    def _on_training_start(self) -> None:
        show_game_steps(self.model)
        self._n_agents = find_n_agents(self.training_env)
        self._first_step, self._started = self.num_timesteps, time.monotonic()

    def _on_step(self) -> bool:
        if self._n_agents is not None:
            seconds = max(time.monotonic() - self._started, sys.float_info.epsilon)
            rate = (self.num_timesteps - self._first_step) / self._n_agents / seconds
            self.logger.record(GAME_STEPS_TAG, self.num_timesteps // self._n_agents)
            self.logger.record(GAME_STEPS_PER_SECOND_TAG, round(rate, 1))
        return True

    def _on_rollout_end(self) -> None:
        """Log the agents' own mean returns over the episodes of SB3's ``rollout/ep_rew_mean``."""
        episodes = [episode["agents"] for episode in self.model.ep_info_buffer or () if "agents" in episode]
        if self._n_agents is not None and episodes:
            for name, mean in zip(agent_names(self.training_env), np.mean(episodes, axis=0).tolist(), strict=True):
                self.logger.record(f"rollout/ep_rew_mean/{name}", mean, exclude="stdout")


def copy_normalization(trained: VecEnv, played: VecEnv) -> None:
    """
    Copy the statistics of every VecNormalize of the games that are trained on to those that are played.

    :raises ValueError: if one is normalised more often than the other
    """
    sources, targets = ([one for one in layers(env) if isinstance(one, VecNormalize)] for env in (trained, played))
    if not targets and not any(source.norm_obs for source in sources):  # of rewards only
        return
    if len(sources) != len(targets):
        raise ValueError(
            f"expected as many VecNormalize in the games of evaluation as in those of training, {len(sources)}, got "
            f"{len(targets)}; wrap them alike: VecNormalize(env.venv, training=False, norm_reward=False)"
        )
    for source, target in zip(sources, targets, strict=True):
        target.ret_rms = deepcopy(source.ret_rms)
        if source.norm_obs:
            target.obs_rms = deepcopy(source.obs_rms)


class TeamEvalCallback(EvalCallback):
    """
    SB3's EvalCallback for teams.

    It writes the same results: ``evaluations.npz`` (with two more arrays, ``game_steps`` and ``agent_results``, the
    agents' own returns), ``best_model.zip``, ``eval/mean_reward``, ``eval/mean_ep_length``, ``eval/success_rate``, and
    also ``eval/game_steps`` and, not on the screen, ``eval/mean_reward/AGENT`` for each agent. Returns are the team's,
    lengths are game steps. SB3's ``timesteps`` remain agent steps (game steps x N).

    :param eval_env: environment of teams, for instance from ``make_team_env`` with another seed
    :param callback_on_new_best: called when the mean team return is the best so far
    :param callback_after_eval: called after every evaluation
    :param n_eval_episodes: team episodes per evaluation
    :param eval_freq: **game steps** between evaluations, summed over all parallel games; 0 or less for none. A rollout
        has one evaluation at most, since the model does not change in it
    :param log_path: folder for ``evaluations.npz``
    :param best_model_save_path: folder for ``best_model.zip``
    :param deterministic: whether the model takes its most likely actions; drawn ones take from the random generators
        of the training, as those of SB3's callback do
    :param render: whether to render the evaluation
    :param verbose: 0 for silence, 1 to print results
    :param warn: warn if ``eval_env`` has no TeamMonitor
    :raises ValueError: if ``eval_env`` has no teams, or its games are those of training
    """

    def __init__(self, eval_env: VecEnv, *args: Any, **kwargs: Any) -> None:
        require_n_agents(eval_env)
        super().__init__(eval_env, *args, **kwargs)
        self.evaluations_game_steps: list[int] = []
        self.evaluations_agent_results: list[list[list[float]]] = []
        self._next_evaluation = 0
        self._is_done_for_rollout = False
        #: Seconds of all evaluations.
        self.seconds = 0.0

    def _init_callback(self) -> None:
        check_hears_rollouts(self)
        require_n_agents(self.training_env)
        check_training(self.model)
        show_game_steps(self.model)
        check_other_games(self.training_env, self.eval_env)
        super()._init_callback()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._plan_next()

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        self._is_done_for_rollout = False

    def _plan_next(self) -> None:
        """Set the next multiple of ``eval_freq``, which steps of E games at a time may skip."""
        if self.eval_freq > 0:
            self._next_evaluation = (team_steps(self.model) // self.eval_freq + 1) * self.eval_freq

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or team_steps(self.model) < self._next_evaluation:
            return True
        self._plan_next()
        if self._is_done_for_rollout:
            return True
        self._is_done_for_rollout = True  # the model does not change before the next rollout
        return self._evaluate()

    def _evaluate(self) -> bool:
        """Play, store and log; return whether training continues."""
        began = time.monotonic()
        copy_normalization(self.training_env, self.eval_env)
        try:
            result = evaluate_team(
                self.model, self.eval_env, self.n_eval_episodes, self.deterministic, render=self.render, warn=self.warn
            )
        except NonFiniteError as error:
            raise NonFiniteError(f"in the evaluation, {error}") from error
        self.last_mean_reward = result.mean
        self._store(result)
        self._log(result)
        go_on = True
        if result.mean > self.best_mean_reward:
            self._say("New best mean team return")
            self.best_mean_reward = result.mean
            if self.best_model_save_path is not None:
                with atomic_file(Path(self.best_model_save_path, "best_model.zip")) as file:
                    self.model.save(file)
            if self.callback_on_new_best is not None:
                go_on = self.callback_on_new_best.on_step()
        go_on = go_on and (self.callback is None or self._on_event())
        self.seconds += time.monotonic() - began
        return go_on

    def _store(self, result: EvaluationResult) -> None:
        if self.log_path is None:
            return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_game_steps.append(team_steps(self.model))
        self.evaluations_results.append(result.returns)
        self.evaluations_agent_results.append([list(returns) for returns in result.agent_returns])
        self.evaluations_length.append(result.lengths)
        arrays = {
            "timesteps": np.array(self.evaluations_timesteps),
            "game_steps": np.array(self.evaluations_game_steps),
            "results": np.array(self.evaluations_results),
            "agent_results": np.array(self.evaluations_agent_results),
            "ep_lengths": np.array(self.evaluations_length),
        }
        unknown = [np.nan] * (len(result.returns) - len(result.successes))
        self.evaluations_successes.append([*result.successes, *unknown])  # type: ignore[list-item]
        successes = np.array(self.evaluations_successes)
        if not np.isnan(successes).all():
            arrays["successes"] = successes
        with atomic_file(Path(f"{self.log_path}.npz")) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]

    def _log(self, result: EvaluationResult) -> None:
        steps, mean_length = team_steps(self.model), float(np.mean(result.lengths))
        self._say(f"Evaluation after {steps} game steps: team return {result}, {mean_length:.2f} steps per episode")
        self.logger.record("eval/mean_reward", result.mean)
        self.logger.record("eval/mean_ep_length", mean_length)
        self.logger.record("eval/game_steps", steps)
        for name, mean in zip(agent_names(self.eval_env), result.agent_means, strict=True):
            self.logger.record(f"eval/mean_reward/{name}", mean, exclude="stdout")
        if result.success_rate is not None:
            self._say(f"Success rate: {100 * result.success_rate:.2f} %")
            self.logger.record("eval/success_rate", result.success_rate)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.record(GAME_STEPS_TAG, steps)
        self.logger.dump(self.num_timesteps)

    def _say(self, text: str) -> None:
        if self.verbose >= 1:
            print(text)


#: Arrays of SB3's rollout buffers, in the order of computation.
_ROLLOUT: Final = ("observations", "rewards", "values", "log_probs", "returns", "advantages")


class FiniteCallback(BaseCallback):
    """
    Stop training at NaN or infinity, with the step and the tensor's name, before the weights are damaged.

    It checks gradients before every step of the optimiser, rollouts before every update, losses, weights and the
    policy's statistics after it. ``CentralizedValueWrapper`` checks observations and rewards of teams.

    It checks sums, which keep NaN and infinity and read memory once. Per gradient step that is one sum per parameter,
    and one number copied from the GPU.

    ``resumable_learn`` adds it automatically.
    """

    def __init__(self) -> None:
        super().__init__()
        self._handles: list[RemovableHandle] = []
        self._sums: dict[str, th.Tensor] = {}
        self._losses: dict[str, float] = {}
        self._n_optimizer_steps = 0
        self._n_checked = -1

    def _on_training_start(self) -> None:
        self._remove_hooks()
        policy: Any = self.model.policy
        for name, parameter in policy.named_parameters():
            if parameter.requires_grad:
                self._handles.append(parameter.register_post_accumulate_grad_hook(partial(self._note, name)))
        self._handles.append(policy.optimizer.register_step_pre_hook(self._check_gradients))

    def _on_training_end(self) -> None:
        self._check_update()
        self._remove_hooks()

    def _remove_hooks(self) -> None:
        while self._handles:
            self._handles.pop().remove()

    def _on_step(self) -> bool:
        return True

    # --- gradients --------------------------------------------------------------------------------------------------

    def _note(self, name: str, parameter: th.Tensor) -> None:
        """Record the sum of a gradient before clipping, which would spread a single NaN to all gradients."""
        assert parameter.grad is not None
        self._sums[name] = parameter.grad.sum()

    def _check_gradients(self, *_: object) -> None:
        sums, self._sums = self._sums, {}
        if not sums or math.isfinite(float(th.stack(list(sums.values())).sum())):
            self._n_optimizer_steps += 1
            return
        for name, value in sums.items():  # in backward order, so the first is the nearest to the loss
            if not bool(value.isfinite()):
                self._stop(f"the gradient of {name}", float(value))

    # --- rollouts, losses, statistics -------------------------------------------------------------------------------

    def _on_rollout_start(self) -> None:
        self._check_update()

    def _check_update(self) -> None:
        """Check once per update: off-policy algorithms begin a rollout at every step."""
        if self._n_optimizer_steps == self._n_checked:
            return
        self._n_checked = self._n_optimizer_steps
        logged = self.model.logger.name_to_value.items()
        self._losses = {name: value for name, value in logged if name.startswith("train/") and "loss" in name}
        for name, value in self._losses.items():
            if not math.isfinite(value):
                self._stop(name, value)
        with th.no_grad():
            for name, parameter in self.model.policy.state_dict().items():
                if parameter.is_floating_point() and not math.isfinite(value := float(parameter.sum())):
                    self._stop(f"the weight {name}", value)

    def _on_rollout_end(self) -> None:
        buffer = getattr(self.model, "rollout_buffer", None)
        for name in _ROLLOUT:
            arrays = getattr(buffer, name, None)
            for key, array in arrays.items() if isinstance(arrays, dict) else [("", arrays)]:
                if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
                    continue
                with np.errstate(invalid="ignore"):  # infinity minus infinity
                    value = float(array.sum(dtype=np.float64))
                if not math.isfinite(value):
                    self._stop(f"{name} {key}".strip() + " of the rollout", value)

    def _stop(self, name: str, value: float) -> None:
        steps = game_steps(self.model)
        when = f"step {self.model.num_timesteps:,}" if steps is None else f"game step {steps:,}"
        losses = ", ".join(f"{loss} {number:.3g}" for loss, number in self._losses.items())
        before = f" (the update before had {losses})" if losses else ""
        raise NonFiniteError(
            f"{name} must be finite, got {value} at {when}, after {self._n_optimizer_steps} steps of the "
            f"optimizer{before}; training stops here, for learning from it would ruin the model: look for a learning "
            "rate that is too high, rewards that are too large, or an encoder or loss of your own that divides by zero"
        )


class EntropySchedule(BaseCallback):
    """
    Change the entropy coefficient linearly from the model's ``ent_coef`` to ``end`` over the training.

    An entropy bonus keeps agents exploring, but what it adds to their actions remains in the trained team, whose most
    likely actions may then be worse than drawn ones. With a bonus that decreases to 0 they lose less (results page).

    Each update uses the value at the end of its rollout, as SB3 does for learning rates, and logs it as
    ``train/ent_coef``. Outside updates the model has its own value, so that saved models and longer runs keep it. SB3
    calls no callback when an exception ends ``learn``: after Ctrl-C within an update the lower value stays in the
    model, unless ``sb3_saf.resumable_learn`` or ``sb3_saf.train`` trains it, which restore it.

    In settings: ``callback: sb3_saf.EntropySchedule``.

    :param end: value at the end of training, at least 0
    :raises ValueError: if ``end`` is no such number, or the algorithm has no ``ent_coef`` that differs from it
    """

    def __init__(self, end: float = 0.0) -> None:
        super().__init__()
        if isinstance(end, bool) or not isinstance(end, (int, float)) or not 0 <= end < math.inf:
            raise ValueError(f"end must be a number of at least 0, got {end!r}")
        self.end = end

    def _init_callback(self) -> None:
        check_hears_rollouts(self)
        found = getattr(self.model, "ent_coef", None)
        if not isinstance(found, (int, float)):
            raise SettingsError(
                f"EntropySchedule changes the entropy coefficient of PPO and A2C; {type(self.model).__name__} has "
                f"{'none' if found is None else f'ent_coef={found!r}'}; leave the callback out"
            )
        if found == self.end:
            raise SettingsError(
                f"EntropySchedule has nothing to change: ent_coef is {found} from the start, as end; give the "
                "algorithm another, such as ent_coef=0.01"
            )
        self._start = float(found)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        self.logger.record("train/ent_coef", self._now())  # SB3 writes it beside the losses of the last update
        model.ent_coef = self._start

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        model.ent_coef = self._now()

    def _now(self) -> float:
        done = self.model.num_timesteps / self.locals["total_timesteps"]
        return self._start + min(done, 1.0) * (self.end - self._start)

    def _on_training_end(self) -> None:
        model: Any = self.model
        model.ent_coef = self._start
