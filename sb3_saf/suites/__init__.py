"""
Cooperative benchmarks of others by name: ``make_team_env("lbf/Foraging-8x8-2p-3f-v3", n_envs=8)``.

A suite is one file of this folder with a constant ``SUITE``, an object of :class:`sb3_saf.suites.suite.Suite`, which
adapts an installed package; nothing of a game is written anew. ``make_team_env``, the commands and the experiments find
it by the part of an id before the slash; ``python -m sb3_saf.suites`` lists all. Packages are imported when a game is
made or listed, not before.

A suite gives its games in one of two ways. Letters: E games, N agents, B = E * N rows.

``game(task, *, render_mode=None, **params)`` returns **one game**, a PettingZoo ParallelEnv. It goes through SuperSuit
into rows (:class:`sb3_saf.envs.supersuit_vec_env.SuperSuitVecEnv`), several processes included. Agents may differ in
their spaces, give masks (``infos[agent]["action_mask"]`` or observations of the form {"observation", "action_mask"}),
and the game a ``state()`` with a ``state_space``.

``vec_env(task, n_envs, seed, *, state=False, render_mode=None, **params)`` returns **all games at once**, for engines
that step many games in one call: an SB3 VecEnv of B rows, game-major, then agent (row ``e * N + i``). It has

- ``n_games``, ``n_agents`` and ``possible_agents`` (N names) as attributes;
- ``observation_space`` of one row: the own observation, a Box, Discrete, MultiDiscrete or MultiBinary. With signals it
  is a Dict of ``"obs"`` and any of ``"active"``, Discrete(2); ``"action_mask"``, MultiBinary(A); ``"state"``, a Box
  that is equal in all rows of a game and there only if ``state=True`` (see :class:`sb3_saf.envs.row_spaces.RowSpaces`);
- ``action_space`` of one row, counted from 0;
- ``seed(seed)``, for the next reset, where game ``e`` gets a stream of its own, the same whatever E; and
  ``seeded_with``, a tuple of the seeds of the games, None for fresh ones, by which evaluation is told from training.
  ``hecogrid_envs.core.rng.game_seeds(seed, E)`` makes 63-bit seeds. ``vec_env(..., seed=None)`` draws one;
- ``reset()``: observations of the rows, NumPy, an array or a dict of arrays as in the space;
- ``step_async(actions)``, (B, ...) NumPy; ``step_wait()``: observations, rewards (B,) float32 as the suite gives them
  to each agent, dones (B,) bool, equal within a team, and infos, a list of B dicts. Games of done teams have been
  reset: observations are those of the next episode;
- infos of done rows: ``"terminal_observation"``, of the form of a row's observation (with ``"active"`` 1 where a time
  limit stopped the agent, and ``"state"`` if there is one; masks may be zeros), and ``"TimeLimit.truncated"``, True
  where a time limit and nothing else ended the episode. The info of the row of agent 0 has ``"is_success"``, a bool,
  where the suite tells wins: it becomes ``rollout/success_rate`` and ``EvaluationResult.success_rate``. Of rows that
  are not done infos may be one and the same empty dict: nothing here writes to them;
- ``render_mode`` and, with ``"rgb_array"``, ``get_images()``, a picture for each row (rows of one game share theirs);
- ``get_attr``, ``set_attr``, ``env_method``, ``env_is_wrapped`` as SB3 declares them; engines without objects for
  single games raise AttributeError, which is what SB3 expects of attributes that are not there;
- ``checkpoint_state()`` and ``load_checkpoint_state(state)``, plain data and NumPy arrays, random state included, if
  runs are to be resumed exactly; perhaps ``check_checkpoint_state(state)``.

Arrays may be read-only, and may be those of the engine's next step: :class:`CentralizedValueWrapper` copies what it
gives. Observations must be finite. Above come, for every suite, :class:`TeamMonitor` (which counts episodes and
returns), the reward of the team, and the joint observation. Films and ``enjoy`` make one game, ``vec_env(task, 1, seed,
render_mode="rgb_array")``.
"""
