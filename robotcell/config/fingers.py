"""What the mounted finger tips can reach, and whether that fits what a cell's file asks of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotcell.config.backends import find_backend

if TYPE_CHECKING:
    from robotcell.config.schema import CellConfig
    from robotcell.interfaces import GripperRange

# The gripper counts in tenths of a millimetre.
_ROUNDING_M = 0.0001


def gripper_range(config: CellConfig) -> GripperRange:
    """What the gripper of a configuration can reach, with the tips that its backend's options say are mounted.

    Raises:
        ConfigError: its backend is not installed.
    """
    return find_backend(config.backend.name).gripper_range(config)


def closed_width(config: CellConfig) -> float:
    """The opening [m] to which the fingers close: the narrowest that the mounted tips reach."""
    return gripper_range(config).min_width_m


def narrowest_hold(config: CellConfig) -> float:
    """The opening [m] below which the fingers, sent to `closed_width`, hold nothing."""
    return closed_width(config) + config.gripper.empty_width_m


def with_tips(reach: GripperRange) -> str:
    """Words that name the tips behind a range; "" for bare fingers."""
    if not reach.fingertip_offset_m:
        return ""
    return f" (with finger tips that reach {1000 * reach.fingertip_offset_m:+.1f} mm inwards)"


def finger_problems(config: CellConfig, reach: GripperRange) -> list[str]:
    """Everything in a cell's file that a gripper with this range cannot do, or that says something else of its tips.

    Args:
        config: of the cell.
        reach: what its gripper reports, or what its backend's options say.
    """
    problems = []
    use, said = config.gripper, gripper_range(config)
    if abs(reach.fingertip_offset_m - said.fingertip_offset_m) > _ROUNDING_M:
        problems.append(
            f"the gripper reports finger tips that reach {1000 * reach.fingertip_offset_m:+.1f} mm inwards, and the "
            f"cell's backend.options say {1000 * said.fingertip_offset_m:+.1f} mm: correct the one that is wrong"
        )
    # Closed fingers cannot tell what they hold from nothing below the second number.
    lowest = reach.min_width_m + use.empty_width_m
    if not lowest < use.preshape_m <= reach.max_width_m + _ROUNDING_M:
        problems.append(
            f"gripper.preshape_m = {use.preshape_m}: outside what the fingers open to between holding nothing and "
            f"wide open, {1000 * lowest:.0f} to {1000 * reach.max_width_m:.0f} mm{with_tips(reach)}; change it, or "
            "correct the fingertip offset in backend.options"
        )
    if not reach.min_force_n <= use.force_n <= reach.max_force_n:
        problems.append(
            f"gripper.force_n = {use.force_n}: outside the gripper's {reach.min_force_n:g} to {reach.max_force_n:g} N"
        )
    return problems
