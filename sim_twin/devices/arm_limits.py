"""What the controller of a UR5e allows its arm, in the twin's devices and in the served controller alike."""

from __future__ import annotations

from robotcell.geometry import rg2, ur5e

# A stop brakes the tool at 10 m/s^2 (what ur_rtde passes to stopl), here 0.5 m from the joint that turns fastest.
STOP_DECELERATION_RAD_S2 = 20.0
# Universal Robots, factory safety preset of the UR5e: force limit.
PROTECTIVE_FORCE_N = 150.0
# A joint this far from where it should be could not follow: its motor is at its limit. Assumed.
TRACKING_ERROR_RAD = 0.05
# Half more than at the fastest joint speed: a target that leaps further within a period is no path. The real controller
# stops with "path sanity check failed"; its threshold is not public. Assumed.
MAX_TARGET_SPEED_RAD_S = 1.5 * ur5e.MAX_JOINT_SPEED
# A motion that starts pressed against something may press this much more. Assumed.
LEAVING_FORCE_N = 30.0
# A rotation counts as the way that the flange goes when it turns about the tcp: no end of the tool outruns the speed.
ROTATION_LEVER_M = rg2.CLOSED_LENGTH_M
