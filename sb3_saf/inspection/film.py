"""An episode as pictures: a few moments in two rows, and a GIF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Final

import numpy as np

from sb3_saf.inspection.games import Picture

#: Height in pixels of a moment in the strip, and of the GIF.
_HEIGHT: Final = 320
_GAP: Final = 6
_N_MOMENTS: Final = 6
_PER_ROW: Final = 3
_SECONDS_PER_STEP: Final = 0.125
_COLOURS: Final = 64


def strip(pictures: Sequence[Picture]) -> Picture:
    """Join six evenly spaced pictures (height, width, 3) in two rows, or all in one row if there are fewer."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, _N_MOMENTS).round().astype(int))
    moments = [_scaled(pictures[index]) for index in chosen]
    rows = [moments] if len(moments) < _N_MOMENTS else [moments[:_PER_ROW], moments[_PER_ROW:]]
    return _joined([_joined(row, axis=1) for row in rows], axis=0)


def _joined(pictures: Sequence[Picture], axis: int) -> Picture:
    """Join pictures with white gaps."""
    height, width, _ = pictures[0].shape
    gap = np.full((height, _GAP, 3) if axis == 1 else (_GAP, width, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=axis)


def gif(pictures: Sequence[Picture]) -> bytes:
    """
    Encode all pictures as a repeating GIF. TensorBoard shows a GIF like any image; SB3's ``Video`` would need moviepy.

    :param pictures: (height, width, 3) each
    """
    from PIL import Image

    frames = [Image.fromarray(_scaled(picture)) for picture in pictures]
    # One palette for all, from the first, the middle and the last frame.
    sample = np.concatenate([np.asarray(frames[index]) for index in (0, len(frames) // 2, -1)])
    palette = Image.fromarray(sample).quantize(_COLOURS)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    file = io.BytesIO()
    indexed[0].save(
        file, "GIF", save_all=True, append_images=indexed[1:], duration=round(1000 * _SECONDS_PER_STEP), loop=0
    )
    return file.getvalue()


def png(picture: Picture) -> bytes:
    """Encode a picture, (height, width, 3), as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", optimize=True)
    return file.getvalue()


def _scaled(picture: Picture) -> Picture:
    """Scale a picture down to ``_HEIGHT``."""
    from PIL import Image

    height, width, _ = picture.shape
    if height <= _HEIGHT:
        return picture
    image = Image.fromarray(picture).resize((round(width * _HEIGHT / height), _HEIGHT), Image.Resampling.BILINEAR)
    return np.asarray(image)
