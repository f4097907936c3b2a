"""The twin's UR5e with its RG2: links, joints, masses and shapes, as a URDF text and as triangle meshes.

Every joint sits where `robotcell.geometry.ur5e` and `robotcell.geometry.rg2` put it, so no length exists twice. A link
frame is the Denavit-Hartenberg frame before it, turned by the joint: the joint turns about z of its own link. The
fingers close along x of the flange; the tcp is `CLOSED_LENGTH_M` in front of the flange, in its orientation.

The shapes are the twin's own: tubes and boxes with the offsets and diameters of the arm's data sheet drawings, rounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import Array, make_transform, transform_points

if TYPE_CHECKING:
    from collections.abc import Sequence

ARM_JOINTS = tuple(f"joint_{i}" for i in range(1, 7))
LEFT_CRANK, LEFT_FINGER = "left_crank", "left_finger"
RIGHT_CRANK, RIGHT_FINGER = "right_crank", "right_finger"
BASE_LINK, GRIPPER_LINK = "base", "gripper"
SLIDE_X, SLIDE_Z = "slide_x", "slide_z"

# Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR5e: masses [kg] and centres of mass
# [m] of the six links, each in its own Denavit-Hartenberg frame.
LINK_MASS_KG = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
LINK_CENTRE_M = (
    (0.0, -0.02561, 0.00193),
    (0.2125, 0.0, 0.11336),
    (0.15, 0.0, 0.0265),
    (0.0, -0.0018, 0.01634),
    (0.0, 0.0018, 0.01634),
    (0.0, 0.0, -0.001159),
)
# Universal Robots, UR5e data sheet: sizes of the joints 3, 3, 3, 1, 1, 1.
JOINT_TORQUE_NM = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)

# OnRobot, RG2 data sheet: the whole gripper. How it is divided between body and fingers is assumed.
RG2_MASS_KG = 0.78
_CRANK_MASS_KG = 0.03
_FINGER_MASS_KG = 0.03
# A crank's pivot is just behind the palm, 17 mm off the middle, and its second, parallel crank further in (public RG2
# models, rounded).
_PIVOT_X = 0.017
_PIVOT_Z = rg2.PIVOTS_M
_SECOND_PIVOT = (-0.009, 0.014)
_KNUCKLE_TO_TIP = rg2.CLOSED_LENGTH_M - _PIVOT_Z - rg2.CRANK_LENGTH_M * math.cos(rg2.CLOSED_ANGLE)
# From the knuckle to the inner face of the finger: closed, the two faces meet in the middle.
_KNUCKLE_TO_FACE = -(_PIVOT_X + rg2.CRANK_LENGTH_M * math.sin(rg2.CLOSED_ANGLE))

# About what of an arm moves with its tool.
_SLIDE_MASS_KG = 3.0

_GREY = (196, 200, 204)
_BLUE = (92, 152, 196)
_DARK = (58, 61, 66)
_BLACK = (34, 35, 38)

Color = tuple[int, int, int]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """A cylinder or a box of a link, in the link frame.

    Attributes:
        kind: of the shape.
        size: (radius, length along z) of a cylinder, (x, y, z) lengths of a box [m].
        T_link_part: (4, 4); the shape's centre and axes.
        color: RGB.
        collides: False for trim that lies on another part.
    """

    kind: Literal["cylinder", "box"]
    size: tuple[float, ...]
    T_link_part: Array
    color: Color
    collides: bool = True


@dataclass(frozen=True)
class Link:
    """A link and the joint that carries it.

    Attributes:
        name: of the link.
        joint: its name.
        parent: the link that carries the joint.
        T_parent_link: (4, 4) at joint angle 0.
        axis: of the joint, in link axes; None for a fixed joint.
        mass_kg: of the link.
        centre_m: of mass, in the link frame.
        parts: its shapes.
    """

    name: str
    joint: str
    parent: str
    T_parent_link: Array
    axis: Vector | None
    mass_kg: float
    centre_m: Vector
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Machine:
    """What carries the gripper.

    Attributes:
        urdf: its links, joints, masses and collision shapes, as URDF text; inertias are left to the engine.
        start: angles [rad] by the names of joints; all others start at 0.
        visible: whether it stands on the table and a camera can see it.
    """

    urdf: str
    start: dict[str, float]
    visible: bool


def links(fingertip_offset_m: float = 0.0) -> tuple[Link, ...]:
    """Every link but the base, parents first; the finger tips reach inwards from the bare fingers by that much [m]."""
    return (*_arm_links(), *_gripper_links(fingertip_offset_m))


def base_parts() -> tuple[Part, ...]:
    """The shapes of the arm's foot, in the base frame."""
    return (
        _tube((0, 0, 0), (0, 0, 0.014), 0.0745, _GREY),
        _tube((0, 0, 0.014), (0, 0, 0.086), 0.064, _GREY),
        _tube((0, 0, 0.086), (0, 0, 0.099), 0.062, _BLUE),
    )


def second_crank_parts() -> tuple[Part, ...]:
    """The shapes of the parallel second crank, in a frame at its pivot; it is drawn and does not collide."""
    return (_bar(rg2.CRANK_LENGTH_M, 0.007, 0.020, _DARK),)


def second_crank_frames(left_angle: float, right_angle: float) -> Array:
    """T_gripper_crank (2, 4, 4) of the two second cranks, left and right, at the crank angles [rad]."""
    dx, dz = _SECOND_PIVOT
    return np.stack(
        [
            make_transform(_about_y(side * angle), (side * (_PIVOT_X + dx), 0.0, _PIVOT_Z + dz))
            for side, angle in ((1, left_angle), (-1, right_angle))
        ]
    )


def finger_angles(crank_angle: float) -> dict[str, float]:
    """Angles [rad] of the four gripper joints at a crank angle: the fingers keep their direction."""
    return {
        LEFT_CRANK: crank_angle,
        RIGHT_CRANK: crank_angle,
        LEFT_FINGER: -crank_angle,
        RIGHT_FINGER: -crank_angle,
    }


def arm_machine(home_q: Sequence[float], fingertip_offset_m: float = 0.0) -> Machine:
    """The arm and its gripper, the arm's joints (6,) [rad] at home; see `links` for the tips."""
    return Machine(_arm_urdf(fingertip_offset_m), dict(zip(ARM_JOINTS, home_q, strict=True)), visible=True)


def gantry_machine(fingertip_offset_m: float = 0.0) -> Machine:
    """The gripper alone, on two slides: along x and along z of a base that stands in the axes of the flange."""
    return Machine(_gantry_urdf(fingertip_offset_m), {}, visible=False)


def part_mesh(part: Part) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Vertices (N, 3) [m] in the link frame and triangles (M, 3) of a part, wound outwards."""
    vertices, triangles = _box_mesh(part.size) if part.kind == "box" else _cylinder_mesh(part.size[0], part.size[1])
    return transform_points(part.T_link_part, vertices).astype(np.float32), triangles


def _arm_urdf(fingertip_offset_m: float) -> str:
    lines = ['<?xml version="1.0"?>', '<robot name="ur5e_rg2">']
    lines += _urdf_link(BASE_LINK, 4.0, (0.0, 0.0, 0.0), base_parts())
    for link in links(fingertip_offset_m):
        lines += _urdf_jointed(link, "continuous" if link.axis else "fixed")
    lines.append("</robot>")
    return "\n".join(lines)


def _gantry_urdf(fingertip_offset_m: float) -> str:
    lines = ['<?xml version="1.0"?>', '<robot name="rg2_gantry">']
    lines += _urdf_link(BASE_LINK, 1.0, (0.0, 0.0, 0.0), ())
    parent = BASE_LINK
    for joint, axis in ((SLIDE_X, (1.0, 0.0, 0.0)), (SLIDE_Z, (0.0, 0.0, 1.0))):
        slide = Link(joint, joint, parent, np.eye(4), axis, _SLIDE_MASS_KG, (0.0, 0.0, 0.0), ())
        lines += _urdf_jointed(slide, "prismatic")
        parent = joint
    for link in _gripper_links(fingertip_offset_m):
        if link.name == GRIPPER_LINK:
            link = replace(link, parent=parent, T_parent_link=np.eye(4))  # noqa: PLW2901
        lines += _urdf_jointed(link, "continuous" if link.axis else "fixed")
    lines.append("</robot>")
    return "\n".join(lines)


def _arm_links() -> list[Link]:
    names = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    parts = (_shoulder(), _upper_arm(), _forearm(), _wrist_1(), _wrist_2(), _wrist_3())
    result = []
    T_parent_link = np.eye(4)
    for i, name in enumerate(names):
        T_link_dh = _dh_offset(i)
        x, y, z = transform_points(T_link_dh, np.array(LINK_CENTRE_M[i]))
        parent = names[i - 1] if i else BASE_LINK
        result.append(Link(name, ARM_JOINTS[i], parent, T_parent_link, (0, 0, 1), LINK_MASS_KG[i], (x, y, z), parts[i]))
        T_parent_link = T_link_dh
    return result


def _dh_offset(i: int) -> Array:
    """T_link_dh (4, 4): from the link frame to its Denavit-Hartenberg frame, Tz(d) Tx(a) Rx(alpha)."""
    rotation = Rotation.from_euler("x", ur5e.DH_ALPHA[i]).as_matrix()
    return make_transform(rotation, (ur5e.DH_A[i], 0.0, ur5e.DH_D[i]))


# Sideways offsets of upper arm and forearm from the plane of the shoulder (UR5e drawing, rounded); the wrist's own
# offset, DH_D[3], is the sum of what follows the forearm.
_UPPER_ARM_OFFSET = 0.138
_FOREARM_OFFSET = 0.007


def _shoulder() -> tuple[Part, ...]:
    z = ur5e.DH_D[0]
    return (
        _tube((0, 0, 0.100), (0, 0, z), 0.060, _GREY),
        _tube((0, 0.062, z), (0, -0.072, z), 0.060, _GREY),
        _tube((0, 0.062, z), (0, 0.069, z), 0.055, _BLUE, collides=False),
    )


def _upper_arm() -> tuple[Part, ...]:
    x, z = ur5e.DH_A[1], _UPPER_ARM_OFFSET
    return (
        _tube((0, 0, 0.074), (0, 0, z + 0.056), 0.058, _GREY),
        _tube((0, 0, z + 0.056), (0, 0, z + 0.063), 0.053, _BLUE, collides=False),
        _tube((0, 0, z), (x, 0, z), 0.047, _GREY),
        _tube((x, 0, 0.080), (x, 0, z + 0.050), 0.052, _GREY),
        _tube((x, 0, z + 0.050), (x, 0, z + 0.057), 0.048, _BLUE, collides=False),
    )


def _forearm() -> tuple[Part, ...]:
    x, z = ur5e.DH_A[2], _FOREARM_OFFSET
    return (
        _tube((0, 0, z - 0.050), (0, 0, 0.078), 0.050, _GREY),
        _tube((0, 0, z - 0.057), (0, 0, z - 0.050), 0.046, _BLUE, collides=False),
        _tube((0, 0, z), (x, 0, z), 0.036, _GREY),
        _tube((x, 0, z - 0.042), (x, 0, z + 0.050), 0.040, _GREY),
        _tube((x, 0, z - 0.049), (x, 0, z - 0.042), 0.036, _BLUE, collides=False),
    )


def _wrist_1() -> tuple[Part, ...]:
    d = ur5e.DH_D[3]
    return (
        _tube((0, 0, 0.058), (0, 0, d + 0.040), 0.040, _GREY),
        _tube((0, 0, d + 0.040), (0, 0, d + 0.047), 0.036, _BLUE, collides=False),
        _tube((0, 0, d), (0, -0.052, d), 0.040, _GREY),
    )


def _wrist_2() -> tuple[Part, ...]:
    d = ur5e.DH_D[4]
    return (
        _tube((0, 0, 0.053), (0, 0, d + 0.040), 0.040, _GREY),
        _tube((0, 0, d + 0.040), (0, 0, d + 0.047), 0.036, _BLUE, collides=False),
        _tube((0, 0, d), (0, 0.052, d), 0.040, _GREY),
    )


def _wrist_3() -> tuple[Part, ...]:
    d = ur5e.DH_D[5]
    return (_tube((0, 0, 0.053), (0, 0, d), 0.0375, _GREY),)


def _gripper_links(fingertip_offset_m: float) -> list[Link]:
    body_mass = RG2_MASS_KG - 2 * (_CRANK_MASS_KG + _FINGER_MASS_KG)
    body = Link(GRIPPER_LINK, "flange", "wrist_3", _dh_offset(5), None, body_mass, (0.0, 0.0, 0.065), _gripper_body())
    L = rg2.CRANK_LENGTH_M
    result = [body]
    for side, crank, finger in ((1, LEFT_CRANK, LEFT_FINGER), (-1, RIGHT_CRANK, RIGHT_FINGER)):
        # Positive angles open; at angle 0 the crank points along the approach axis.
        axis = (0.0, float(side), 0.0)
        pivot = make_transform(np.eye(3), (side * _PIVOT_X, 0.0, _PIVOT_Z))
        knuckle = make_transform(np.eye(3), (0.0, 0.0, L))
        result += [
            Link(
                crank,
                crank,
                GRIPPER_LINK,
                pivot,
                axis,
                _CRANK_MASS_KG,
                (0.0, 0.0, L / 2),
                (_bar(L, 0.010, 0.024, _DARK),),
            ),
            Link(
                finger,
                finger,
                crank,
                knuckle,
                axis,
                _FINGER_MASS_KG,
                (0.0, 0.0, _KNUCKLE_TO_TIP / 2),
                _finger(side, fingertip_offset_m),
            ),
        ]
    return result


def _gripper_body() -> tuple[Part, ...]:
    return (
        _tube((0, 0, 0), (0, 0, 0.014), 0.036, _DARK),
        _block((-0.035, -0.024, 0.014), (0.035, 0.024, 0.088), _GREY),
        _block((-0.030, -0.0245, 0.040), (0.030, 0.0245, 0.052), _BLUE, collides=False),
        _block((-0.030, -0.020, 0.088), (0.030, 0.020, rg2.PALM_M), _DARK),
    )


def _finger(side: int, fingertip_offset_m: float) -> tuple[Part, ...]:
    breadth, thickness = rg2.FINGER_BREADTH_M, rg2.FINGER_THICKNESS_M
    inner = side * (_KNUCKLE_TO_FACE - fingertip_offset_m)
    outer = side * (_KNUCKLE_TO_FACE + thickness)
    low, high = min(inner, outer), max(inner, outer)
    carrier = side * 0.005
    return (
        _block((low, -breadth / 2, 0.0), (high, breadth / 2, _KNUCKLE_TO_TIP), _BLACK),
        # The carrier between the two knuckles.
        _block((min(inner, carrier), -0.010, -0.004), (max(inner, carrier), 0.010, 0.012), _DARK, collides=False),
    )


def _tube(start: Vector, end: Vector, radius: float, color: Color, *, collides: bool = True) -> Part:
    a, b = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    rotation, _ = Rotation.align_vectors([(b - a) / length], [[0.0, 0.0, 1.0]])
    return Part("cylinder", (radius, length), make_transform(rotation.as_matrix(), (a + b) / 2), color, collides)


def _block(low: Vector, high: Vector, color: Color, *, collides: bool = True) -> Part:
    a, b = np.array(low), np.array(high)
    x, y, z = b - a
    return Part("box", (x, y, z), make_transform(np.eye(3), (a + b) / 2), color, collides)


def _bar(length: float, thickness: float, breadth: float, color: Color) -> Part:
    return _block((-thickness / 2, -breadth / 2, 0.0), (thickness / 2, breadth / 2, length), color)


def _about_y(angle: float) -> Array:
    return np.asarray(Rotation.from_euler("y", angle).as_matrix())


def _urdf_link(name: str, mass: float, centre: Vector, parts: tuple[Part, ...]) -> list[str]:
    # The engine replaces these inertias by those of the collision shapes; the format wants some.
    lines = [
        f'<link name="{name}"><inertial><origin xyz="{_numbers(centre)}"/><mass value="{mass!r}"/>'
        '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>'
    ]
    for part in parts:
        if part.collides:
            if part.kind == "box":
                shape = f'<box size="{_numbers(part.size)}"/>'
            else:
                shape = f'<cylinder radius="{part.size[0]!r}" length="{part.size[1]!r}"/>'
            lines.append(f"<collision>{_origin(part.T_link_part)}<geometry>{shape}</geometry></collision>")
    lines.append("</link>")
    return lines


def _urdf_jointed(link: Link, kind: str) -> list[str]:
    """A link and the joint that carries it."""
    axis = f'<axis xyz="{_numbers(link.axis)}"/>' if link.axis else ""
    limit = '<limit lower="-2" upper="2" effort="1000" velocity="10"/>' if kind == "prismatic" else ""
    return [
        *_urdf_link(link.name, link.mass_kg, link.centre_m, link.parts),
        f'<joint name="{link.joint}" type="{kind}"><parent link="{link.parent}"/><child link="{link.name}"/>'
        f"{_origin(link.T_parent_link)}{axis}{limit}</joint>",
    ]


def _origin(T: Array) -> str:
    return f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers(_roll_pitch_yaw(T))}"/>'


def _roll_pitch_yaw(T: Array) -> tuple[float, float, float]:
    """The angles [rad] about fixed x, y, z that URDF wants; with the pitch upright the roll is set to 0."""
    pitch = math.atan2(-T[2, 0], math.hypot(T[0, 0], T[1, 0]))
    if math.hypot(T[0, 0], T[1, 0]) < 1e-9:
        return 0.0, pitch, math.atan2(-T[0, 1], T[1, 1])
    return math.atan2(T[2, 1], T[2, 2]), pitch, math.atan2(T[1, 0], T[0, 0])


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())


def _box_mesh(size: tuple[float, ...]) -> tuple[Array, npt.NDArray[np.int32]]:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return corners * np.array(size), np.array(triangles, dtype=np.int32)


def _cylinder_mesh(radius: float, length: float, sides: int = 24) -> tuple[Array, npt.NDArray[np.int32]]:
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, length / 2)])
    vertices = np.vstack([ring * (1, 1, -1), ring, [[0, 0, -length / 2], [0, 0, length / 2]]])
    i = np.arange(sides)
    j = (i + 1) % sides
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    triangles = np.vstack(
        [
            np.column_stack([i, j, j + sides]),
            np.column_stack([i, j + sides, i + sides]),
            np.column_stack([j, i, low]),
            np.column_stack([i + sides, j + sides, high]),
        ]
    )
    return vertices, triangles.astype(np.int32)
