"""Which object a goal's word means."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from robotcell.errors import ConfigError, NoTarget
from robotcell.perception.colors import PALETTE, palette_name

if TYPE_CHECKING:
    from robotcell.perception.segmentation import Instance, Segmentation


def goal_color(word: str) -> str:
    """The colour of the palette that a goal's word means, in any case.

    Raises:
        ConfigError: the word is no colour; the message lists the palette.
    """
    color = palette_name(word)
    if color is None:
        raise ConfigError(
            f"goal {word!r} is not a colour that is known; known are {', '.join(PALETTE)}, and the colour names of CSS"
        )
    return color


def find_goal(segmentation: Segmentation, word: str) -> Instance:
    """The most visible object of the colour that a goal's word means.

    Raises:
        ConfigError: the word is no colour.
        NoTarget: no object on the table has that colour; the message lists those that are there.
    """
    color = goal_color(word)
    for instance in segmentation.instances:
        if instance.color_name == color:
            return instance
    there = Counter(instance.color_name for instance in segmentation.instances)
    listing = ", ".join(name if n == 1 else f"{name} ({n})" for name, n in sorted(there.items()))
    asked = color if word.lower() == color else f"{word} ({color})"
    raise NoTarget(f"no {asked} object is seen on the table; there is: {listing or 'nothing'}")
