"""
Suites of cooperative games by name: ``make_team_env("lbf/Foraging-8x8-2p-3f-v3", n_envs=8)``.

A suite is one file of this folder with a constant ``SUITE``, an object of :class:`sb3_saf.suites.registry.Suite`, which
adapts an installed package. ``make_team_env``, the commands and the experiments find it by the part of an id before the
slash; ``python -m sb3_saf.suites`` lists all. Packages are imported only when a game is made or listed.

A suite provides its games in one of two forms, or in both as HECOGrid does. Letters: E games, N agents, B = E * N rows.

``game(task, *, render_mode=None, **params)`` returns **one game**, a PettingZoo ParallelEnv, which SuperSuit converts
to rows, in one or several processes (:class:`sb3_saf.envs.supersuit_vec_env.SuperSuitVecEnv`). Agents may have
different spaces and action masks (``infos[agent]["action_mask"]`` or observations of the form {"observation",
"action_mask"}), and the game a ``state()`` with a ``state_space``.

``vec_env(task, n_envs, seed, *, state=False, render_mode=None, **params)`` returns **all games at once**, for engines
that step many games in one call: an SB3 VecEnv of B rows, game-major, then agent (row ``e * N + i``). It has

- ``n_games``, ``n_agents`` and ``possible_agents`` (N names) as attributes;
- ``observation_space`` of one row: the own observation, a Box, Discrete, MultiDiscrete or MultiBinary. With signals it
  is a Dict of ``"obs"`` and any of ``"active"``, Discrete(2); ``"action_mask"``, MultiBinary(A); ``"state"``, a Box
  that is equal in all rows of a game and there only if ``state=True`` (see :class:`sb3_saf.teams.rows.TeamSpaces`);
- ``action_space`` of one row, counted from 0;
- ``seed(seed)``, for the next reset, where game ``e`` gets its own random stream, independent of E; and
  ``seeded_with``, a tuple of the seeds of the games, None for random ones, which distinguishes evaluation from
  training. ``sb3_saf.game_seeds(seed, E)`` makes 32-bit seeds. ``vec_env(..., seed=None)`` draws one;
- ``reset()``: observations of the rows, a NumPy array or a dict of arrays as in the space;
- ``step_async(actions)``, (B, ...) NumPy; ``step_wait()``: observations, each agent's rewards (B,) float32, dones (B,)
  bool, equal within a team, and infos, a list of B dicts. Games of done teams have been reset: observations are those
  of the next episode;
- infos of done rows: ``"terminal_observation"``, in the form of a row's observation (with ``"active"`` 1 if a time
  limit stopped the agent, and ``"state"`` if there is one; masks may be zeros), and ``"TimeLimit.truncated"``, True if
  only a time limit ended the episode. The info of agent 0 has ``"is_success"``, a bool, if the suite reports wins: it
  becomes ``rollout/success_rate`` and ``EvaluationResult.success_rate``. Rows that are not done may share one empty
  dict, which is never modified;
- ``render_mode`` and, with ``"rgb_array"``, ``get_images()``, a picture for each row (rows of one game share theirs);
- ``get_attr``, ``set_attr``, ``env_method``, ``env_is_wrapped`` as SB3 declares them; engines without objects for
  single games raise AttributeError, as SB3 expects for missing attributes;
- ``checkpoint_state()`` and ``load_checkpoint_state(state)``, plain data and NumPy arrays, random state included, for
  exact resume.

Arrays may be read-only, and may be reused by the engine's next step: :class:`CentralizedValueWrapper` copies them.
Observations must be finite. Every suite is wrapped in :class:`TeamMonitor` (which counts episodes and returns), the
reward of the team, and the joint observation. Films and ``enjoy`` make one game, ``vec_env(task, 1, seed,
render_mode="rgb_array")``.
"""
