"""Evaluation during training, in team episodes and game steps."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_saf.callbacks.game_steps import GAME_STEPS_TAG, check_training, show_game_steps, team_steps
from sb3_saf.evaluation import EvaluationResult, evaluate_team
from sb3_saf.teams.files import atomic_file
from sb3_saf.teams.vec_env import agent_names, check_other_games, require_n_agents


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
    :param deterministic: whether the model takes its most likely actions
    :param render: whether to render the evaluation
    :param verbose: 0 for silence, 1 to print results
    :param warn: warn if ``eval_env`` has no TeamMonitor
    :raises ValueError: if ``eval_env`` has no teams, or its games are those of training
    """

    def __init__(
        self,
        eval_env: VecEnv,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 5,
        eval_freq: int = 10_000,
        log_path: str | None = None,
        best_model_save_path: str | None = None,
        deterministic: bool = True,
        render: bool = False,
        verbose: int = 1,
        warn: bool = True,
    ) -> None:
        require_n_agents(eval_env)
        super().__init__(
            eval_env,
            callback_on_new_best=callback_on_new_best,
            callback_after_eval=callback_after_eval,
            n_eval_episodes=n_eval_episodes,
            eval_freq=eval_freq,
            log_path=log_path,
            best_model_save_path=best_model_save_path,
            deterministic=deterministic,
            render=render,
            verbose=verbose,
            warn=warn,
        )
        self.evaluations_game_steps: list[int] = []
        self.evaluations_agent_results: list[list[list[float]]] = []
        self._next_evaluation = 0
        self._is_done_for_rollout = False
        #: Seconds of the evaluations of this training.
        self.seconds = 0.0
        self._started = 0.0

    def _init_callback(self) -> None:
        require_n_agents(self.training_env)
        check_training(self.model)
        show_game_steps(self.model)
        check_other_games(self.training_env, self.eval_env)
        super()._init_callback()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._started, self.seconds = time.monotonic(), 0.0
        self._plan_next()

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        self._is_done_for_rollout = False

    def _on_training_end(self) -> None:
        super()._on_training_end()
        if self.seconds:
            share = self.seconds / (time.monotonic() - self._started)
            self._say(f"Evaluation took {100 * share:.0f} % of the time")

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
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        result = evaluate_team(
            self.model, self.eval_env, self.n_eval_episodes, self.deterministic, render=self.render, warn=self.warn
        )
        self.last_mean_reward = result.mean
        self._store(result)
        self._log(result)
        go_on = self._react(result)
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
        if result.successes:
            self.evaluations_successes.append(list(result.successes))
            arrays["successes"] = np.array(self.evaluations_successes)
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

    def _react(self, result: EvaluationResult) -> bool:
        """Save the best model and call the callbacks; return whether training continues."""
        go_on = True
        if result.mean > self.best_mean_reward:
            self._say("New best mean team return")
            self.best_mean_reward = result.mean
            if self.best_model_save_path is not None:
                with atomic_file(Path(self.best_model_save_path, "best_model.zip")) as file:
                    self.model.save(file)
            if self.callback_on_new_best is not None:
                go_on = self.callback_on_new_best.on_step()
        return go_on and (self.callback is None or self._on_event())

    def _say(self, text: str) -> None:
        if self.verbose >= 1:
            print(text)
