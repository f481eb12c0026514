"""
Games of JaxMARL, batched by ``vmap`` and ``jit``.

Each game has its own random stream, so that it depends on its seed and the actions only. New episodes begin by the
suite's ``reset`` after ``step_env``: its ``step`` also resets, but loses the last observation.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache, partial
from operator import itemgetter
from typing import Any, Final, NamedTuple

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

# JaxMARL resets ``sys.stdout`` and ``sys.stderr`` of notebooks and tests: undone here.
with contextlib.redirect_stdout(sys.stdout), contextlib.redirect_stderr(sys.stderr):
    import jaxmarl
    from jaxmarl.environments import MABRAX_AVAILABLE, SUBMODULE_ENVIRONMENTS, overcooked_layouts
    from jaxmarl.environments import spaces as jax_spaces
    from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO

from sb3_saf.suites.engines.batch import BatchStep, ResumableBatch, ResumableBatchVecEnv
from sb3_saf.teams.rows import ACTION_MASK_KEY, ACTIVE_KEY, OBS_KEY, STATE_KEY, Array, TeamSpaces

#: What the tasks of Overcooked and SMAX set, by their names.
LAYOUTS: Final[Mapping[str, Any]] = overcooked_layouts
SCENARIOS: Final[Mapping[str, Any]] = MAP_NAME_TO_SCENARIO

_ALL: Final = "__all__"
_PARTICLES: Final = "MPE_"
_WORLD_STATE: Final = "world_state"


class Rules(NamedTuple):
    """
    Rules of an environment that JaxMARL's interface does not define.

    :param is_undecided: ``(env, state) -> bool``, whether an ended game was stopped by its time limit; None if
        ``state.step`` reaching ``env.max_steps`` decides
    :param is_won: ``(env, state) -> bool`` of an ended game, None if success is not defined
    :param shares_reward: whether every agent receives the team's reward, extra rewards aside
    :param pays_the_dead: whether dead agents receive the team's reward until its episode ends. Their rows then
        continue: if they ended, dead agents would not learn from the team's success
    :param extra_reward: ``infos -> {agent: reward}`` for :attr:`JaxGames.extra_weight`
    :param draw: ``(env, state) -> picture``, (height, width, 3)
    """

    is_undecided: Callable[[Any, Any], Any] | None = None
    is_won: Callable[[Any, Any], Any] | None = None
    shares_reward: bool = False
    pays_the_dead: bool = False
    extra_reward: Callable[[Any], Mapping[str, Any]] | None = None
    draw: Callable[[Any, Any], npt.NDArray[np.uint8]] | None = None


class Game(NamedTuple):
    """
    A game, or with a leading axis all of them.

    :param key: (2,) key of its random stream
    :param state: state of the environment
    :param active: (N,) bool, agents that take part
    """

    key: Any
    state: Any
    active: Any


class Packing:
    """Joins the arrays of a game to one buffer for each item size: XLA takes time for every array at every call."""

    def __init__(self, form: Game) -> None:
        self._forms, self._tree = jax.tree.flatten(form)
        self._sizes = sorted({leaf.dtype.itemsize for leaf in self._forms})

    def pack(self, game: Game) -> list[Any]:
        """Return buffers of unsigned integers, (K,) each."""
        parts: dict[int, list[Any]] = {size: [] for size in self._sizes}
        for leaf, form in zip(jax.tree.leaves(game), self._forms, strict=True):
            parts[form.dtype.itemsize].append(jnp.asarray(leaf, form.dtype).ravel().view(f"u{form.dtype.itemsize}"))
        return [jnp.concatenate(part) for part in parts.values()]

    def unpack(self, buffers: Sequence[Any]) -> Game:
        """Return the game, or all games, in buffers (..., K) of NumPy or JAX."""
        left, leaves = dict(zip(self._sizes, buffers, strict=True)), []
        for form in self._forms:
            size, buffer = form.size, left[form.dtype.itemsize]
            leaves.append(buffer[..., :size].view(form.dtype).reshape(*buffer.shape[:-1], *form.shape))
            left[form.dtype.itemsize] = buffer[..., size:]
        return jax.tree.unflatten(self._tree, leaves)


class JaxPrograms:
    """
    Compiled functions of an environment, shared by its users and compiled once per number of games.

    :param with_state: whether rows have the state of the game
    :raises ValueError: if agents differ in more than lengths of observations and actions, or a requested state is
        missing
    """

    def __init__(self, env: Any, rules: Rules, with_state: bool = False) -> None:
        self.env = env
        self.rules = rules
        self.agents: list[Any] = list(env.agents)
        key = jax.random.PRNGKey(0)
        observations, self._state_form = jax.eval_shape(env.reset, key)
        self._has_world_entry = _WORLD_STATE in observations
        self._action_spaces = [env.action_space(agent) for agent in self.agents]
        width = max(_size(observations[agent]) for agent in self.agents)
        counts = self._n_actions
        has_masks = bool(counts) and (self.legal_actions is not None or len(set(counts)) > 1)
        self.rows = TeamSpaces(
            # Also flags and counts in bytes: as a Box of bytes they would be scaled as pictures are.
            spaces.Box(-np.inf, np.inf, (width,), np.float32),
            len(self.agents),
            has_active=not rules.pays_the_dead,
            n_masked_actions=max(counts) if has_masks else None,
            state=self._world_space() if with_state else None,
            is_dict=True,
        )
        active = jax.ShapeDtypeStruct((len(self.agents),), np.bool_)
        self.packing = Packing(Game(jax.eval_shape(lambda: key), self._state_form, active))
        self.begin = jax.jit(jax.vmap(self._begin))
        self.step = jax.jit(self._step_all)

    # ---- spaces

    @cached_property
    def legal_actions(self) -> Callable[[Any], Mapping[str, Any]] | None:
        """The environment's method that gives action masks of a state by agent, None if it has none."""
        for name in ("get_avail_actions", "get_legal_moves"):
            method: Callable[[Any], Mapping[str, Any]] | None = getattr(self.env, name, None)
            with contextlib.suppress(NotImplementedError, AttributeError):
                if method is not None:
                    jax.eval_shape(method, self._state_form)
                    return method
        return None

    @cached_property
    def _n_actions(self) -> list[int]:
        """Numbers of actions of the agents; empty if actions are not Discrete."""
        if not all(isinstance(space, jax_spaces.Discrete) for space in self._action_spaces):
            return []
        return [int(space.n) for space in self._action_spaces]

    @cached_property
    def action_space(self) -> spaces.Space[Any]:
        """Action space of a row."""
        first = self._action_spaces[0]
        if self._n_actions:
            return spaces.Discrete(max(self._n_actions))
        if all(isinstance(space, jax_spaces.Box) for space in self._action_spaces):
            widest = max(self._action_spaces, key=lambda space: int(space.shape[0]))
            low, high = (
                np.broadcast_to(np.asarray(bound, dtype=np.float32), widest.shape)
                for bound in (widest.low, widest.high)
            )
            return spaces.Box(low, high, dtype=np.float32)
        if isinstance(first, jax_spaces.MultiDiscrete):
            choices = {tuple(np.asarray(space.num_categories).tolist()) for space in self._action_spaces}
            if len(choices) == 1:
                return spaces.MultiDiscrete(list(next(iter(choices))))
        raise ValueError(
            f"expected actions of one kind, Discrete, Box or equal MultiDiscrete, got {self._action_spaces} in "
            f"{type(self.env).__name__}"
        )

    def _world_space(self) -> spaces.Box:
        if not self._has_world_entry and not hasattr(self.env, "get_world_state"):
            raise ValueError(f"{type(self.env).__name__} tells no state of the game; leave state=True out")
        key = jax.random.PRNGKey(0)
        form = jax.eval_shape(lambda key: self._world(*self.env.reset(key)), key)
        return spaces.Box(-np.inf, np.inf, (_size(form),), np.float32)

    # ---- all games

    def _step_all(self, games: list[Any], actions: Any, extra_weight: Any) -> Any:
        """
        Step, and begin new episodes of ended games, if there are any.

        :param actions: (E, N, ...)
        :return: games; (E, N, ...) their rows, and those before new episodes began; (E, R) see :meth:`_step`
        """
        games, last, results = jax.vmap(self._step, in_axes=(0, 0, None))(games, actions, extra_weight)
        ended = results[:, len(self.agents)] != 0

        def begin_where_ended(games: list[Any], last: dict[str, Any]) -> Any:
            fresh = jax.vmap(self._begin)(self.packing.unpack(games).key)
            choose = jax.vmap(lambda one, other, is_over: jax.tree.map(partial(jnp.where, is_over), one, other))
            return choose(fresh, (games, last), ended)

        games, rows = jax.lax.cond(ended.any(), begin_where_ended, lambda *same: same, games, last)
        return games, rows, last, results

    # ---- one game

    def _begin(self, key: Any) -> tuple[list[Any], dict[str, Any]]:
        key, now = jax.random.split(key)
        observations, state = self.env.reset(now)
        active = jnp.ones(len(self.agents), dtype=bool)
        return self.packing.pack(Game(key, state, active)), self._rows(observations, state, active, active)

    def _step(self, buffers: list[Any], actions: Any, extra_weight: Any) -> tuple[list[Any], dict[str, Any], Any]:
        """Return the game, its rows, and in one vector rewards (N,), ended, truncated and, if reported, won."""
        game = self.packing.unpack(buffers)
        key, now = jax.random.split(game.key)
        observations, state, rewards, dones, infos = self.env.step_env(now, game.state, self._chosen(game, actions))
        ended = dones[_ALL]
        done = jnp.stack([dones[agent] for agent in self.agents])
        truncated = ended & self._is_undecided(state)
        # If a time limit stops a team, all its agents are done, also those still active.
        goes_on = ~done | (truncated & done.all())
        active = game.active & goes_on & (~ended | truncated)
        team = jnp.stack([rewards[agent] for agent in self.agents])
        if self.rules.extra_reward is not None:
            extra = self.rules.extra_reward(infos)
            team = team + extra_weight * jnp.stack([extra[agent] for agent in self.agents])
        won = [] if self.rules.is_won is None else [self.rules.is_won(self.env, state)]
        results = jnp.concatenate([team, jnp.stack([ended, truncated, *won])], dtype=np.float32)
        rows = self._rows(observations, state, active, active | (ended & game.active))
        return self.packing.pack(Game(key, state, active)), rows, results

    def _chosen(self, game: Game, actions: Any) -> dict[str, Any]:
        """Return the agents' actions, limited to their own spaces; a padded action becomes the first legal one."""
        if not self._n_actions:
            shapes = [space.shape for space in self._action_spaces]
            return {
                agent: actions[index, : shape[0]]
                for index, (agent, shape) in enumerate(zip(self.agents, shapes, strict=True))
            }
        legal = None if self.legal_actions is None else self.legal_actions(game.state)
        chosen = {}
        for index, (agent, count) in enumerate(zip(self.agents, self._n_actions, strict=True)):
            chosen[agent] = actions[index]
            if count < max(self._n_actions):
                first = 0 if legal is None else jnp.argmax(legal[agent])
                chosen[agent] = jnp.where(actions[index] < count, actions[index], first)
        return chosen

    def _is_undecided(self, state: Any) -> Any:
        if self.rules.is_undecided is not None:
            return self.rules.is_undecided(self.env, state)
        limit, step = getattr(self.env, "max_steps", None), getattr(state, "step", None)
        return False if limit is None or step is None else step >= limit

    def _rows(self, observations: Mapping[str, Any], state: Any, active: Any, shown: Any) -> dict[str, Any]:
        """
        Return the rows of a game, (N, ...).

        :param active: (N,) the signal ``"active"`` of rows
        :param shown: (N,) agents whose observations are shown, other rows are zeros
        """
        width = self.rows.own.shape[0]  # type: ignore[index]
        own = jnp.stack([_padded(observations[agent], width, np.float32) for agent in self.agents])
        rows = {OBS_KEY: jnp.where(shown[:, None], own, 0)}
        if self.rows.active:
            rows[ACTIVE_KEY] = active
        if self.rows.n_masked_actions is not None:
            rows[ACTION_MASK_KEY] = self._masks(state)
        if self.rows.state is not None:
            world = self._world(observations, state)
            rows[STATE_KEY] = jnp.broadcast_to(world, (len(self.agents), *world.shape))
        return rows

    def _masks(self, state: Any) -> Any:
        """Return legal actions (N, A); actions that an agent lacks are illegal."""
        legal: Mapping[str, Any] = {} if self.legal_actions is None else self.legal_actions(state)
        width = max(self._n_actions)
        own = [legal.get(agent, np.ones(n)) for agent, n in zip(self.agents, self._n_actions, strict=True)]
        return jnp.stack([_padded(one, width, np.int8) for one in own])

    def _world(self, observations: Mapping[str, Any], state: Any) -> Any:
        world = observations[_WORLD_STATE] if self._has_world_entry else self.env.get_world_state(state)
        return jnp.ravel(world).astype(jnp.float32)


def _size(form: Any) -> int:
    return int(np.prod(form.shape))


def _padded(vector: Any, width: int, dtype: npt.DTypeLike) -> Any:
    flat = jnp.ravel(vector).astype(dtype)
    return jnp.pad(flat, (0, width - flat.shape[0]))


class JaxGames(ResumableBatch):
    """
    E games of an environment.

    :param extra_weight: weight of the rules' extra rewards, such as those for shaping
    :param extra_steps: game steps, summed over games, over which that weight decreases to 0; None for never
    """

    def __init__(
        self, programs: JaxPrograms, n_games: int, extra_weight: float = 0.0, extra_steps: int | None = None
    ) -> None:
        super().__init__(
            *(n_games, programs.agents, programs.rows, programs.action_space, programs.env),
            shares_reward=programs.rules.shares_reward and not extra_weight,
        )
        self._programs = programs
        if extra_weight:
            self.settings |= {"reward_shaping": extra_weight, "reward_shaping_steps": extra_steps}
        self._extra_weight = extra_weight
        self._extra_steps = extra_steps
        self._n_steps = 0
        #: All games, packed; None before the first reset.
        self._buffers: list[Any] | None = None

    @property
    def games(self) -> Game:
        """All games, on the host."""
        assert self._buffers is not None, "the games have begun"
        return self._programs.packing.unpack([np.asarray(buffer) for buffer in self._buffers])

    def reset(self, seeds: Sequence[int] | None) -> dict[str, Array]:
        """Begin an episode in every game (see the base class); with seeds, extra rewards have their first weight."""
        self._n_steps = self._n_steps if seeds is None else 0
        keys = self.games.key if seeds is None else np.array([divmod(s, 2**32) for s in seeds], dtype=np.uint32)
        self._buffers, rows = self._programs.begin(keys)
        return self._on_host(rows)

    def shorten(self) -> npt.NDArray[np.bool_]:
        """Cut the episodes that have just begun (see the base class)."""
        games, limit = self.games, getattr(self.env, "max_steps", None)
        if limit is None or not hasattr(games.state, "step"):
            return super().shorten()
        steps = np.arange(self.n_games) * limit // self.n_games
        state = games.state.replace(step=steps.astype(games.state.step.dtype))
        self._buffers = jax.vmap(self._programs.packing.pack)(games._replace(state=state))
        return steps > 0

    def step(self, actions: Array) -> BatchStep:
        """Step every game (see the base class)."""
        narrow = actions.astype(np.int32) if actions.dtype.kind == "i" else actions
        left = 1.0 if self._extra_steps is None else max(0.0, 1.0 - self._n_steps / self._extra_steps)
        weight = np.float32(self._extra_weight * left)
        self._buffers, rows, last, results = self._programs.step(self._buffers, narrow, weight)
        self._n_steps += self.n_games
        rewards = np.asarray(results)
        ended, truncated, *won = (rewards[:, len(self.agents) :] != 0).T
        shown = self._on_host(rows)
        last_shown = self._on_host(last) if ended.any() else shown
        return BatchStep(shown, rewards[:, : len(self.agents)], ended, truncated, last_shown, *won)

    def _on_host(self, rows: dict[str, Any]) -> dict[str, Array]:
        """Convert (E, N, ...) on the device to NumPy (B, ...), without a copy on a CPU."""
        n_rows = self.n_games * len(self.agents)
        return {key: np.asarray(part).reshape(n_rows, *part.shape[2:]) for key, part in rows.items()}

    def picture(self, game: int) -> npt.NDArray[np.uint8]:
        """Return JaxMARL's picture of a game (see the base class)."""
        if self._programs.rules.draw is None:
            raise ValueError(f"JaxMARL draws no pictures of {type(self.env).__name__}; leave render_mode out")
        state = jax.tree.map(lambda leaf: leaf[game], self.games.state)
        return self._programs.rules.draw(self.env, state)

    def snapshot(self) -> dict[str, Array]:
        """Return copies of all games, by the paths of the environment's state (see the base class)."""
        leaves = jax.tree_util.tree_leaves_with_path(self.games)
        arrays = {jax.tree_util.keystr(path): np.array(leaf) for path, leaf in leaves}
        return {**arrays, "n_steps": np.array(self._n_steps)}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Restore a snapshot (see the base class)."""
        own, tree = jax.tree_util.tree_flatten_with_path(self.games)
        games = jax.tree.unflatten(tree, [jnp.array(state[jax.tree_util.keystr(path)]) for path, _ in own])
        self._buffers = jax.vmap(self._programs.packing.pack)(games)
        self._n_steps = int(state["n_steps"])


Picture = npt.NDArray[np.uint8]

#: Side of matplotlib pictures in inches.
_INCHES: Final = 4


def _sides(env: Any, state: Any) -> tuple[Any, Any]:
    """Return whether any ally, and any enemy, is alive in SMAX."""
    alive = _battle(state).unit_alive
    return alive[: env.num_allies].any(), alive[env.num_allies :].any()


def _battle(state: Any) -> Any:
    """Return the battle within the state of an environment with scripted enemies."""
    return getattr(state, "state", state)


def _never(_env: Any, _state: Any) -> Any:
    return False


def _both_alive(env: Any, state: Any) -> Any:
    allies, enemies = _sides(env, state)
    return allies & enemies


def _enemies_dead(env: Any, state: Any) -> Any:
    allies, enemies = _sides(env, state)
    return allies & ~enemies


def _draw_smax(env: Any, state: Any) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_INCHES, _INCHES))
    FigureCanvasAgg(figure)
    battle = _battle(state)
    names = getattr(env, "all_agents", env.agents)
    attacks = dict(zip(names, battle.prev_attack_actions.tolist(), strict=True))
    image = env.init_render(figure.subplots(), (None, battle, attacks), 0, int(battle.step))
    return np.array(image.get_array())[..., :3]


def _draw_overcooked(env: Any, state: Any) -> Picture:
    import imageio.v3 as imageio
    from jaxmarl.viz.overcooked_visualizer import OvercookedVisualizer

    film = io.BytesIO()
    OvercookedVisualizer().animate([state], env.agent_view_size, film)
    return np.asarray(imageio.imread(film.getvalue(), extension=".gif"))[0, ..., :3]


def _draw_overcooked_v2(env: Any, state: Any) -> Picture:
    from jaxmarl.viz.overcooked_v2_visualizer import OvercookedV2Visualizer

    one = jax.tree.map(lambda leaf: jnp.asarray(leaf)[np.newaxis], state)
    return np.asarray(OvercookedV2Visualizer().render_sequence(one)[0], dtype=np.uint8)


def _draw_particles(env: Any, state: Any) -> Picture:
    from jaxmarl.environments.mpe import MPEVisualizer
    from matplotlib import pyplot
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with contextlib.redirect_stdout(io.StringIO()):
        figure = MPEVisualizer(env, [state]).fig
    pyplot.close(figure)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


#: Of the infos of both kitchens.
_shaped: Final = itemgetter("shaped_reward")
_SMAX: Final = Rules(
    is_undecided=_both_alive, is_won=_enemies_dead, shares_reward=True, pays_the_dead=True, draw=_draw_smax
)
_RULES: Final[dict[str, Rules]] = {
    "SMAX": _SMAX._replace(is_won=None, shares_reward=False),  # both sides are trained, one wins
    "HeuristicEnemySMAX": _SMAX,
    "switch_riddle": Rules(is_undecided=_never),  # its number of days is a rule of the riddle
    "overcooked": Rules(shares_reward=True, extra_reward=_shaped, draw=_draw_overcooked),
    "overcooked_v2": Rules(extra_reward=_shaped, draw=_draw_overcooked_v2),
}


def rules_of(name: str) -> Rules:
    """Return the rules of an environment."""
    if name.startswith(_PARTICLES):
        return Rules(draw=_draw_particles)
    return _RULES.get(name, Rules())


#: Environments that need another package (brax, jaxrobotarium), or a trained enemy.
_BRAX: Final = ("ant_4x2", "halfcheetah_6x1", "hopper_3x1", "humanoid_9|8", "walker2d_2x3")
_NEEDS_A_POLICY: Final = "LearnedPolicyEnemySMAX"
#: Environments whose observations and rewards are not by agent name.
_NOT_BY_AGENT: Final = ("storm", "storm_2p", "storm_np")
#: Maximum number of cached compiled environments; one takes tens of MB.
_N_KEPT: Final = 8


def registered() -> list[str]:
    """Return the names of the supported environments."""
    missing = {_NEEDS_A_POLICY, *_NOT_BY_AGENT}
    if not MABRAX_AVAILABLE:
        missing.update(_BRAX)
    names = [name for name in jaxmarl.registered_envs if name not in missing]
    return [name for name in names if SUBMODULE_ENVIRONMENTS or not name.startswith("JaxRobotarium")]


@lru_cache(_N_KEPT)
def _programs(name: str, pickled: tuple[tuple[str, bytes], ...], with_state: bool) -> JaxPrograms:
    """Make an environment with arguments as they are now, compared by value."""
    params = {key: cloudpickle.loads(value) for key, value in pickled}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Overcooked recommends its second version
        env = jaxmarl.make(name, **params)
    if name.startswith(_PARTICLES):  # which ignore parameters that they do not know
        known = {one for base in type(env).__mro__ for one in inspect.signature(base).parameters} | set(vars(env))
        if unknown := sorted(params.keys() - known):
            raise ValueError(
                f"{name} has no parameters {unknown}; its number of agents is num_agents, its time limit max_steps"
            )
    return JaxPrograms(env, rules_of(name), with_state)


def vec_env(
    name: str,
    n_envs: int,
    seed: int | None,
    *,
    state: bool = False,
    render_mode: str | None = None,
    stagger: bool = False,
    reward_shaping: float = 0.0,
    reward_shaping_steps: int | None = None,
    fixed: Mapping[str, Any] | None = None,
    **params: Any,
) -> ResumableBatchVecEnv:
    """
    Make games of an environment.

    :param render_mode: None or ``"rgb_array"``
    :param reward_shaping: weight of the shaped rewards, if the environment has any
    :param reward_shaping_steps: game steps, summed over games, over which that weight decreases to 0; None for never
    :param fixed: arguments of the environment that the task sets
    :raises ValueError: if the state, picture or reward is missing, the environment has no teams of named agents, or the
        task sets an argument
    """
    if reward_shaping_steps is not None and not reward_shaping_steps >= 1:
        raise ValueError(f"reward_shaping_steps must be at least 1, got {reward_shaping_steps}; None for never")
    if params.keys() & (fixed or {}).keys():
        raise ValueError(f"expected no {' or '.join(fixed or {})}, which the task's name sets; choose another task")
    given = sorted({**params, **(fixed or {})}.items())
    programs = _programs(name, tuple((key, cloudpickle.dumps(value)) for key, value in given), state)
    if reward_shaping and programs.rules.extra_reward is None:
        raise ValueError(f"{name} has no rewards for steps on the way, got reward_shaping={reward_shaping}")
    if render_mode is not None and programs.rules.draw is None:
        raise ValueError(f"JaxMARL draws no pictures of {name}; leave render_mode={render_mode!r} out")
    games = JaxGames(programs, n_envs, reward_shaping, reward_shaping_steps)
    return ResumableBatchVecEnv(games, seed, render_mode, stagger)
