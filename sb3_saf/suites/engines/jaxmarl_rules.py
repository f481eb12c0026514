"""Rules of JaxMARL's environments for success, time limits and pictures."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from sb3_saf.suites.engines.jaxmarl import Rules

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


def _shaped(infos: Mapping[str, Any]) -> Mapping[str, Any]:
    return infos["shaped_reward"]


_SMAX: Final = Rules(is_undecided=_both_alive, is_won=_enemies_dead, pays_the_dead=True, draw=_draw_smax)
_RULES: Final[dict[str, Rules]] = {
    "SMAX": _SMAX._replace(is_won=None),  # both sides are trained, one wins
    "HeuristicEnemySMAX": _SMAX,
    "overcooked": Rules(extra_reward=_shaped, draw=_draw_overcooked),
    "overcooked_v2": Rules(extra_reward=_shaped, draw=_draw_overcooked_v2),
}


def rules_of(name: str) -> Rules:
    """Return the rules of an environment."""
    if name.startswith("MPE_"):
        return Rules(draw=_draw_particles)
    return _RULES.get(name, Rules())
