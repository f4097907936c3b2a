"""The ten named colours of the blocks, as goals are called and as the twin paints them."""

from __future__ import annotations

# RGB, 0..255: the colours that the block scenes of the push-grasp papers share.
PALETTE: dict[str, tuple[int, int, int]] = {
    "blue": (78, 121, 167),
    "green": (89, 161, 79),
    "brown": (156, 117, 95),
    "orange": (242, 142, 43),
    "yellow": (237, 201, 72),
    "gray": (186, 176, 172),
    "red": (255, 87, 89),
    "purple": (176, 122, 161),
    "cyan": (118, 183, 178),
    "pink": (255, 157, 167),
}
