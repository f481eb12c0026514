"""
Draw SAF: ``python -m docs.tools.drawing`` writes ``docs/images/saf.svg``.

Left to right as data flows: own observations, encoder, then the critic's way above (used while training only) and the
actor's way below (all that acting needs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple
from xml.sax.saxutils import escape

FILE: Final = Path(__file__).resolve().parents[1] / "images" / "saf.svg"
WIDTH: Final = 1000
HEIGHT: Final = 430

# Okabe and Ito's palette, which colour-blind readers can tell apart, in light tints.
INK: Final = "#222222"
AGENT: Final = "#fbe3b5"
SHARED: Final = "#cfe5f4"
CRITIC: Final = "#cdeadf"
ACTOR: Final = "#f6d6c2"


class Box(NamedTuple):
    """
    A labelled rectangle.

    :param x: left edge
    :param y: upper edge
    :param width: in pixels
    :param height: in pixels
    :param lines: text, the first line in bold
    :param colour: of the area
    """

    x: float
    y: float
    width: float
    height: float
    lines: tuple[str, ...]
    colour: str

    @property
    def left(self) -> tuple[float, float]:
        """Return the middle of the left edge."""
        return self.x, self.y + self.height / 2

    @property
    def right(self) -> tuple[float, float]:
        """Return the middle of the right edge."""
        return self.x + self.width, self.y + self.height / 2

    @property
    def top(self) -> tuple[float, float]:
        """Return the middle of the upper edge."""
        return self.x + self.width / 2, self.y

    @property
    def bottom(self) -> tuple[float, float]:
        """Return the middle of the lower edge."""
        return self.x + self.width / 2, self.y + self.height

    def svg(self) -> str:
        """Return the rectangle with its text."""
        middle = self.x + self.width / 2
        first = self.y + self.height / 2 - 9 * (len(self.lines) - 1) + 5
        text = "".join(
            f'<text x="{middle}" y="{first + 18 * i}" text-anchor="middle"'
            f"{' font-weight=' + chr(34) + '600' + chr(34) if i == 0 else ''}>{escape(line)}</text>"
            for i, line in enumerate(self.lines)
        )
        return (
            f'<rect x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="8" '
            f'fill="{self.colour}" stroke="{INK}"/>{text}'
        )


def _label(x: float, y: float, text: str, size: int = 13, weight: int = 400) -> str:
    return f'<text x="{x}" y="{y}" font-size="{size}" font-weight="{weight}" text-anchor="middle">{escape(text)}</text>'


def _arrow(*points: tuple[float, float]) -> str:
    """Return a line through some points with a head at its end."""
    path = " L ".join(f"{x} {y}" for x, y in points)
    return f'<path d="M {path}" fill="none" stroke="{INK}" stroke-width="1.5" marker-end="url(#head)"/>'


def _lane(y: float, height: float, text: str, colour: str) -> str:
    """Return a coloured band with its title."""
    return (
        f'<rect x="290" y="{y}" width="690" height="{height}" rx="12" fill="{colour}" fill-opacity="0.35"/>'
        f'<text x="970" y="{y + 20}" text-anchor="end" font-size="13" font-style="italic">{escape(text)}</text>'
    )


def draw() -> str:
    """Return the drawing as SVG."""
    views = [Box(20, 120 + 66 * i, 120, 50, (f"agent {name}", "own view"), AGENT) for i, name in enumerate("123")]
    encoder = Box(170, 170, 90, 82, ("encoder", "shared"), SHARED)
    message = Box(310, 50, 110, 52, ("message", "g_θ(z)"), CRITIC)
    state = Box(310, 150, 110, 52, ("state", "g_ω(z)"), CRITIC)
    slots = Box(480, 40, 170, 72, ("knowledge source", "slots attend", "to all messages"), CRITIC)
    read = Box(700, 150, 110, 52, ("read", "slots → m"), CRITIC)
    critic = Box(850, 150, 110, 52, ("critic", "V(s, m)"), CRITIC)
    query = Box(310, 322, 110, 52, ("query", "g_psel(z)"), ACTOR)
    pool = Box(480, 300, 170, 96, ("policy pool", "4 policies with", "signature keys,", "chosen by query"), ACTOR)
    action = Box(760, 322, 130, 52, ("action", "of the mixture"), ACTOR)
    split = (275, 211)
    arrows = [
        *(_arrow(view.right, (encoder.x, encoder.y + 20 + 21 * i)) for i, view in enumerate(views)),
        _arrow(encoder.right, split, (split[0], 76), message.left),
        _arrow(split, (split[0], 176), state.left),
        _arrow(split, (split[0], 348), query.left),
        _arrow(message.right, slots.left),
        _arrow(slots.right, (read.x + 55, 76), read.top),
        _arrow(state.right, read.left),
        _arrow(read.right, critic.left),
        _arrow(query.right, pool.left),
        _arrow(pool.right, action.left),
    ]
    boxes = [*views, encoder, message, state, slots, read, critic, query, pool, action]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" '
            f'height="{HEIGHT}" font-family="Helvetica, Arial, sans-serif" font-size="14" fill="{INK}" role="img">',
            "<title>SAF: a knowledge source for the critic, a pool of policies for the actor</title>",
            '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
            f'orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="{INK}"/></marker></defs>',
            f'<rect width="{WIDTH}" height="{HEIGHT}" rx="14" fill="#ffffff"/>',
            _lane(20, 230, "critic: while training only, sees the team", CRITIC),
            _lane(270, 140, "actor: own view only", ACTOR),
            *arrows,
            *(box.svg() for box in boxes),
            _label(450, 68, "write", 12),
            _label(560, 168, "own state asks", 12),
            _label(450, 340, "q · k", 12),
            "</svg>",
            "",
        ]
    )


def main() -> None:
    """Write the drawing."""
    FILE.write_text(draw(), encoding="utf-8")
    print(FILE)


if __name__ == "__main__":
    main()
