"""Scenes to learn from: drops, packed groups and enclosed objects, of blocks that are scaled and shaped at random.

None of them is a scene of the benchmark: those are drawn from other seeds, or built in by name.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from robotcell.geometry.transforms import make_transform
from robotcell.perception.colors import PALETTE
from sim_twin.scenes.catalog import DROP_HALF_WIDTH_M, drop_scene
from sim_twin.scenes.meshes import Mesh, hull
from sim_twin.scenes.novel import resting_poses
from sim_twin.scenes.scene import Scene, SceneObject, place
from sim_twin.scenes.shapes import BLOCK_NAMES, Shape, block, shape_of

if TYPE_CHECKING:
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array

# Shares of objects: a block as it is, a block scaled along each axis, and another solid.
_PLAIN, _SCALED = 0.5, 0.2
_SCALES = (0.75, 1.15)
_DENSITY_KG_M3 = (250.0, 700.0)
# Widths of a group's gaps: flush, or a little apart.
_GAPS_M = (0.0005, 0.006)
# A group of at most so many rows and columns.
_ROWS = (2, 4)
# An enclosed object has others on at least so many sides, each moved along its side by this share of half of it.
_WALLS = 2
_ASIDE = 0.6
# How often what is longer than wide turns its long side to the middle.
_BROADSIDE = 0.7


def training_scene(kind: str, count: int, config: CellConfig, rng: np.random.Generator) -> Scene:
    """A scene of `count` objects.

    Args:
        kind: "drop", objects that fall one after the other; "packed", a group that stands side by side; or "enclosed",
            an object with others close around it.
        count: number of objects.
        config: of the cell, for workspace and table.
        rng: everything is drawn from it.
    """
    shapes = [_random_shape(rng) for _ in range(count)]
    if kind == "drop":
        scene = _recolored(drop_scene("training drop", shapes, rng), rng)
    else:
        standing = _rows(shapes, rng) if kind == "packed" else _ring(shapes, rng)
        scene = _recolored(Scene(f"training {kind}", tuple(_turned(standing, rng)), drop=False), rng)
    return place(scene, config.workspace, config.table.height_m)


def _random_shape(rng: np.random.Generator) -> Shape:
    draw = rng.random()
    shape = block(BLOCK_NAMES[rng.integers(len(BLOCK_NAMES))])
    if draw > _PLAIN + _SCALED:
        shape = _solid(rng)
    elif draw > _PLAIN:
        shape = _scaled(shape, rng.uniform(*_SCALES, size=3))
    return replace(shape, density_kg_m3=float(rng.uniform(*_DENSITY_KG_M3)))


def _scaled(shape: Shape, scale: Array) -> Shape:
    mesh = Mesh(shape.mesh.vertices * scale, shape.mesh.triangles)
    parts = tuple(Mesh(part.vertices * scale, part.triangles) for part in shape.parts)
    return Shape(f"scaled {shape.name}", mesh, parts, shape.density_kg_m3, shape.volume_m3 * float(scale.prod()))


def _solid(rng: np.random.Generator) -> Shape:
    """A convex solid, two boxes that cross or meet, or a box with smaller ones on its faces."""
    draw = rng.random()
    if draw < 0.3:
        return _assembly(rng)
    if draw < 0.65:
        size = rng.uniform((0.03, 0.03, 0.02), (0.09, 0.06, 0.05))
        points = rng.normal(size=(14, 3))
        points *= size / 2 / np.linalg.norm(points, axis=1, keepdims=True)
        return shape_of("pebble", (hull(points),))
    long, thin = rng.uniform(0.05, 0.10), rng.uniform(0.02, 0.035)
    wide, high = rng.uniform(0.04, 0.07), rng.uniform(0.02, 0.05)
    at = rng.uniform(-0.5, 0.5) * (long - thin)
    bar = _box((0.0, 0.0, 0.0), (long, thin, high))
    arm = _box((at, thin / 2 + wide / 4, 0.0), (thin, wide / 2, high))
    return shape_of("angle", (bar, arm))


def _assembly(rng: np.random.Generator) -> Shape:
    size = rng.uniform((0.03, 0.03, 0.02), (0.08, 0.055, 0.045))
    parts = [_box((0.0, 0.0, 0.0), (size[0], size[1], size[2]))]
    for face in rng.permutation(6)[: int(rng.integers(1, 3))]:
        axis, sign = int(face) // 2, 1 if face % 2 else -1
        small = rng.uniform(0.012, 0.035, size=3)
        center = rng.uniform(-0.5, 0.5, size=3) * np.maximum(size - small, 0)
        # A millimetre inside, so that the parts hold together.
        center[axis] = sign * ((size[axis] + small[axis]) / 2 - 0.001)
        parts.append(_box((center[0], center[1], center[2]), (small[0], small[1], small[2])))
    return shape_of("assembly", tuple(parts))


def _box(center: tuple[float, float, float], size: tuple[float, float, float]) -> Mesh:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return hull(corners * np.array(size) + np.array(center))


def _rows(shapes: list[Shape], rng: np.random.Generator) -> list[tuple[Shape, Array]]:
    """Blocks that stand in rows, side by side; each with its transform (4, 4)."""
    rows = int(rng.integers(_ROWS[0], min(_ROWS[1], max(_ROWS[0], len(shapes) // 2)) + 1))
    per_row = -(-len(shapes) // rows)
    boxes = [(shape, *_standing(shape, rng)) for shape in shapes]
    placed: list[tuple[Shape, Array]] = []
    y = 0.0
    for r in range(rows):
        members = boxes[r * per_row : (r + 1) * per_row]
        depth = max((high[1] - low[1] for _, _, (low, high) in members), default=0.0)
        x = float(rng.uniform(-0.02, 0.02))
        for shape, turn, (low, high) in members:
            position = np.array([x - low[0], y - low[1] + rng.uniform(0, depth - (high[1] - low[1])), -low[2] + 0.0005])
            placed.append((shape, make_transform(turn, position)))
            x += high[0] - low[0] + rng.uniform(*_GAPS_M)
        y += depth + rng.uniform(*_GAPS_M)
    return placed


def _ring(shapes: list[Shape], rng: np.random.Generator) -> list[tuple[Shape, Array]]:
    """The first object with the others around it: each slid in from one of its sides until it meets another."""
    boxes: list[Array] = []
    placed: list[tuple[Shape, Array]] = []
    sides = rng.permutation(4)[: int(rng.integers(_WALLS, 5))]
    for i, shape in enumerate(shapes):
        turn, (low, high) = _standing(shape, rng)
        center = np.zeros(2)
        if i:
            # +x, +y, -x, -y
            side = int(sides[i - 1] if i <= len(sides) else rng.integers(4))
            along, across = side % 2, 1 - side % 2
            if (high - low)[along] > (high - low)[across] and rng.random() < _BROADSIDE:
                turn, (low, high) = _bounds(shape, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ turn)
            half = (high - low)[:2] / 2
            center[across] = rng.uniform(-_ASIDE, _ASIDE) * boxes[0][1, across]
            first, last = center[across] - half[across], center[across] + half[across]
            # The first object is always among them.
            in_way = [box[:, along] for box in boxes if box[0, across] < last and box[1, across] > first]
            if side < 2:
                center[along] = max(box[1] for box in in_way) + half[along] + rng.uniform(*_GAPS_M)
            else:
                center[along] = min(box[0] for box in in_way) - half[along] - rng.uniform(*_GAPS_M)
        half = (high - low)[:2] / 2
        boxes.append(np.array([center - half, center + half]))
        placed.append((shape, make_transform(turn, np.array([*(center - (low + high)[:2] / 2), -low[2] + 0.0005]))))
    return placed


def _standing(shape: Shape, rng: np.random.Generator) -> tuple[Array, Array]:
    """A rotation (3, 3) that lays a shape on one of its faces, and its lowest and highest corner (2, 3) then."""
    return _bounds(shape, _resting(shape, rng))


def _bounds(shape: Shape, turn: Array) -> tuple[Array, Array]:
    vertices = shape.mesh.vertices @ turn.T
    return turn, np.array([vertices.min(axis=0), vertices.max(axis=0)])


def _turned(standing: list[tuple[Shape, Array]], rng: np.random.Generator) -> list[SceneObject]:
    """The group turned and moved about as a whole."""
    middle = np.mean([T[:2, 3] for _, T in standing], axis=0)
    shift = rng.uniform(-0.5, 0.5, size=2) * DROP_HALF_WIDTH_M
    turned = make_transform(Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix(), (*shift, 0.0))
    centred = make_transform(np.eye(3), (-middle[0], -middle[1], 0.0))
    return [
        SceneObject(f"{shape.name} {i + 1}", shape, (0, 0, 0), turned @ centred @ T)
        for i, (shape, T) in enumerate(standing)
    ]


def _resting(shape: Shape, rng: np.random.Generator) -> Array:
    """Rotation (3, 3) that lays the shape on one of its stable faces, its sides along the axes where it has any."""
    poses = list(resting_poses(shape))
    down = poses[rng.integers(len(poses))].down
    to_table, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])
    flat = to_table.apply(shape.mesh.vertices)
    # The quarter turn apart, the direction in which the outline is smallest.
    angles = np.radians(np.arange(0, 90, 3))
    areas = [np.prod(np.ptp(Rotation.from_euler("z", a).apply(flat)[:, :2], axis=0)) for a in angles]
    aligned = Rotation.from_euler("z", angles[int(np.argmin(areas))] + rng.integers(4) * np.pi / 2)
    return np.asarray((aligned * to_table).as_matrix())


def _recolored(scene: Scene, rng: np.random.Generator) -> Scene:
    """Random colours: of the palette with a drift, or any."""
    names = list(PALETTE)
    objects = []
    for item in scene.objects:
        base = (
            np.array(PALETTE[names[rng.integers(len(names))]], float) if rng.random() < 0.7 else rng.uniform(0, 255, 3)
        )
        color = np.clip(base + rng.normal(0, 12, 3), 0, 255).astype(int)
        objects.append(replace(item, color=(int(color[0]), int(color[1]), int(color[2]))))
    return Scene(scene.name, tuple(objects), scene.drop)
