"""
Figures of the TensorBoard page, and an episode as a GIF.

Colours are safe for colour-blind readers (Okabe and Ito's, and cividis); zones have the environment's colours. Letters:
U policies, K zones, N agents, L slots, T game steps, n values.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from sb3_saf.inspection.recording import Picture
from sb3_saf.inspection.scalars import Attention, Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Doubles = npt.NDArray[np.float64]
Colour = tuple[float, float, float]

_BLUE: Final = "#0072B2"
_ORANGE: Final = "#D55E00"
_GREY: Final = "#666666"
_SCATTERED: Final = 1500
_STYLE: Final[dict[Any, Any]] = {
    "font.size": 12,
    "axes.titlesize": 13,
    "axes.labelsize": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def _figure(width: float, height: float, rows: int = 1, title: str = "") -> tuple[Figure, list[Axes]]:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
        axes = figure.subplots(rows, 1, squeeze=False, sharex=True)
    if title:
        figure.suptitle(title, fontsize=13)
    return figure, list(axes.flat)


def _heat_map(axes: Axes, table: Doubles, unit: str, vmax: float | None = None, percent: bool = True) -> None:
    """Draw a table with its numbers in it."""
    highest = vmax or max(float(np.nanmax(table, initial=0.0)), 1e-9)
    image = axes.imshow(np.ma.masked_invalid(table), cmap="cividis", vmin=0, vmax=highest, aspect="auto")
    size = 12 if table.size <= 60 else 9
    if table.size <= 150:
        for (row, column), value in np.ndenumerate(table):
            if np.isfinite(value):
                text = f"{100 * value:.0f}" if percent else f"{value:.2f}"
                ink = "black" if value > 0.55 * highest else "white"
                axes.text(column, row, text, ha="center", va="center", fontsize=size, color=ink)
    axes.spines[:].set_visible(False)
    bar = axes.figure.colorbar(image, ax=axes, pad=0.02, label=unit)
    bar.outline.set_visible(False)
    if percent:
        from matplotlib.ticker import PercentFormatter

        bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0))


def _ticks(axes: Axes, rows: Sequence[str], columns: Sequence[str]) -> None:
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(range(len(columns)), columns, rotation=0 if len("".join(columns)) < 45 else 90)
    axes.tick_params(length=0)


def _numbers(count: int) -> list[str]:
    """Return tick labels 0, 1, 2 ..., thinned out if there are many."""
    step = 1 + count // 16
    return [str(index) if index % step == 0 else "" for index in range(count)]


def chosen_by_zone(table: Doubles, colours: Sequence[Colour] | None) -> Figure:
    """Draw how often each policy is chosen in each zone, (K, U); with the zones' ``colours``."""
    n_zones, n_policies = table.shape
    figure, (axes,) = _figure(5.6, 1.8 + 0.55 * max(3, n_zones), title="Which policy acts in which zone")
    _heat_map(axes, table, "chosen", vmax=1.0)
    _ticks(axes, [f"zone {zone}" for zone in range(n_zones)], [f"policy {policy}" for policy in range(n_policies)])
    if colours:
        from matplotlib.patches import Rectangle

        # A band of the zone's colour between the labels and the table.
        for zone in range(n_zones):
            axes.add_patch(Rectangle((-0.58, zone - 0.5), 0.07, 1, color=colours[zone % len(colours)], clip_on=False))
        axes.tick_params(axis="y", pad=10)
    return figure


def chosen_by_agent(table: Doubles) -> Figure:
    """Draw how often each policy is chosen by each agent, (N, U)."""
    n_agents, n_policies = table.shape
    figure, (axes,) = _figure(5.6, min(12.0, 1.8 + 0.42 * max(3, n_agents)), title="Which policy acts for which agent")
    _heat_map(axes, table, "chosen", vmax=1.0)
    _ticks(axes, _numbers(n_agents), [f"policy {policy}" for policy in range(n_policies)])
    axes.set_ylabel("agent")
    return figure


def policy_differences(table: Doubles) -> Figure:
    """Draw the Hellinger distances between policies, (U, U)."""
    names = [f"policy {policy}" for policy in range(len(table))]
    figure, (axes,) = _figure(5.6, 4.4, title="How differently policies act (0 alike, 1 never alike)")
    _heat_map(axes, table, "Hellinger distance", vmax=1.0, percent=False)
    _ticks(axes, names, names)
    return figure


def attention(write: Attention, read: Attention) -> Figure:
    """Draw the attention of writing, (L, N), and of reading, (N, L)."""
    n_slots, n_agents = write.mean.shape
    width, height = min(14.0, 4.2 + 0.28 * n_agents), 2.4 + 0.7 * n_slots
    figure, (above, below) = _figure(width, height, 2, title="Knowledge source: mean attention")
    _heat_map(above, write.mean, "attention")
    above.set_title("writing: each row sums to 100 %")
    _heat_map(below, read.mean.T, "attention")
    below.set_title("reading: each column sums to 100 %")
    for axes in (above, below):
        _ticks(axes, [f"slot {slot}" for slot in range(n_slots)], _numbers(n_agents))
    below.set_xlabel("agent")
    return figure


def attention_over_time(write: npt.NDArray[np.float32]) -> Figure:
    """Draw the attention of writing at each step of one episode, (T, L, N)."""
    n_steps, n_slots, n_agents = write.shape
    n_shown = min(n_slots, 6)
    height = 1.4 + n_shown * (0.35 + 0.12 * min(n_agents, 20))
    figure, panels = _figure(5.6, height, n_shown, title="Who writes to which slot, in one episode")
    highest = float(write.max())
    for slot, axes in enumerate(panels):
        picture = axes.imshow(
            write[:, slot].T,
            cmap="cividis",
            vmin=0,
            vmax=highest,
            aspect="auto",
            interpolation="nearest",
            extent=(0, n_steps, n_agents - 0.5, -0.5),
        )
        axes.set_ylabel(f"slot {slot}\nagent")
        axes.set_yticks([0, n_agents - 1])
    panels[-1].set_xlabel("game step")
    from matplotlib.ticker import PercentFormatter

    figure.colorbar(picture, ax=panels, label="attention", pad=0.02, aspect=25, format=PercentFormatter(1.0))
    return figure


def calibration(values: npt.NDArray[Any], returns: npt.NDArray[Any], summary: Calibration) -> Figure:
    """Draw values (n,) against returns (n,), and mean returns of tenths by value."""
    figure, (axes,) = _figure(5.4, 4.8, title="Critic calibration")
    few = np.linspace(0, len(values) - 1, min(len(values), _SCATTERED)).astype(int)
    axes.scatter(values[few], returns[few], s=6, alpha=0.25, color=_GREY, linewidths=0, label="single steps")
    ends = [float(min(values.min(), returns.min())), float(max(values.max(), returns.max()))]
    axes.plot(ends, ends, color="black", linestyle="--", linewidth=1, label="value = return")
    bins = np.array_split(np.argsort(values, kind="stable"), min(10, len(values)))
    axes.errorbar(
        [float(values[rows].mean()) for rows in bins],
        [float(returns[rows].mean()) for rows in bins],
        yerr=[float(returns[rows].std()) for rows in bins],
        fmt="o",
        markersize=7,
        color=_BLUE,
        ecolor=_BLUE,
        elinewidth=1.5,
        capsize=3,
        label="tenths: mean ± standard deviation",
    )
    axes.set(xlabel="value", ylabel="discounted return")
    numbers = [
        ("explained variance", summary.explained_variance, ".2f"),
        ("slope", summary.slope, ".2f"),
        ("bias", summary.bias, "+.2g"),
    ]
    title = ", ".join(f"{name} {value:{form}}" for name, value, form in numbers if value is not None)
    axes.set_title(title, fontsize=11, color=_ORANGE)
    axes.legend(loc="upper left", fontsize=10, frameon=False)
    return figure


# --- pictures of an episode -------------------------------------------------------------------------------------------

#: Largest height in pixels of the GIF.
_HEIGHT: Final = 320
_COLOURS: Final = 256
#: Pictures that the colours are taken from.
_SAMPLED: Final = 200


def gif(pictures: Sequence[Picture], seconds: float = 0.125) -> bytes:
    """
    Encode all pictures as a repeating GIF. TensorBoard shows a GIF like any image; SB3's ``Video`` would need moviepy.

    :param pictures: (height, width, 3) each
    :param seconds: time that each is shown
    """
    from PIL import Image

    frames = [Image.fromarray(picture) for picture in pictures]
    for frame in frames:
        frame.thumbnail((frame.width, _HEIGHT), Image.Resampling.BILINEAR, reducing_gap=None)
    # One palette for all. The median cut would leave out colours of few pixels, such as those of agents.
    sample = np.concatenate([np.asarray(frame) for frame in frames[:: 1 + len(frames) // _SAMPLED]])
    palette = Image.fromarray(sample).quantize(_COLOURS, method=Image.Quantize.FASTOCTREE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = 10 * max(2, round(100 * seconds))  # whole hundredths, and browsers slow down what is shown for one
    file = io.BytesIO()
    indexed[0].save(file, "GIF", save_all=True, append_images=indexed[1:], duration=duration, loop=0)
    return file.getvalue()


def png(picture: Picture) -> bytes:
    """Encode a picture, (height, width, 3), as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", optimize=True)
    return file.getvalue()
