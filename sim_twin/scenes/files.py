"""Scenes from files: the twin's own TOML format, and the two text formats of the published block scenes.

docs/reference/scene-files.md describes all three. Metres, radians; a scene's frame has x and y from the centre of the
workspace and z from the table top.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import cycle, permutations
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from robotcell.errors import ConfigError
from robotcell.geometry.transforms import make_transform, rotation_z, rotvec_to_matrix
from robotcell.io.input_file import SETTINGS_MAX_BYTES, parse_toml, read_text, read_toml
from robotcell.perception.colors import PALETTE, word_to_rgb
from sim_twin.scenes.meshes import MESH_SUFFIXES, Mesh, bounds_center, mesh_inertia
from sim_twin.scenes.scene import Scene, SceneObject
from sim_twin.scenes.shapes import BLOCK_NAMES, Shape, block, load_shape

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array

FRAMES_FILE = "frames.toml"

# The frame of the published scenes: table z = 0, workspace x -0.724..-0.276 and y -0.224..0.224.
_PUBLIC_CENTRE = np.array([-0.5, 0.0, 0.0])
_PUBLIC_HALF_WIDTH_M = 0.224
# Their authors park unused objects beside or below the table; the nearest parked row is much farther than this.
_PARKED_BESIDE_M = 0.10
_PARKED_BELOW_M = 0.05
# Principal moments that differ by a smaller share count as equal: an arch's two large ones differ by 2 %.
_TIE = 0.005


def read_scene(path: Path, meshes: Path | None) -> Scene:
    """The scene that a file describes: TOML by the suffix `.toml`, otherwise one of the two text formats.

    Args:
        path: the file.
        meshes: folder of the mesh files that it names; a TOML file may also have them beside itself.

    Raises:
        ConfigError: the file or a mesh is missing or malformed; the message names file, line or key, and reason.
    """
    if meshes is not None and not meshes.is_dir():
        raise ConfigError(f"{meshes}: no such folder; --meshes names that of the mesh files")
    text = read_text(path, SETTINGS_MAX_BYTES)
    if path.suffix.lower() == ".toml":
        return _read_toml(path, text, meshes)
    return _read_rows(path, text, meshes)


def mesh_frame(mesh: Mesh) -> Array:
    """The rotation (3, 3) from the frame that V-REP gives an imported mesh to the mesh's own axes.

    Its columns are the principal axes of inertia: x that of the largest moment, z that of the smallest. Equal
    moments leave the mesh's own axes where they are, as far as they can be; x and y point along the mesh axis
    nearest to them, never against it. The rule was fitted to published scenes (docs/reference/scene-files.md).
    """
    moments, axes = np.linalg.eigh(mesh_inertia(mesh))
    moments, axes = moments[::-1], axes[:, ::-1]
    equal = np.abs(moments[:, None] - moments) <= _TIE * moments[0]
    # Onto the space of each axis and of those that share its moment.
    projections = [axes[:, same] @ axes[:, same].T for same in equal]

    def alignment(order: tuple[int, ...]) -> tuple[float, int]:
        kept = sum(i == axis for i, axis in enumerate(order))
        return round(math.prod(float(projections[i][axis, axis]) for i, axis in enumerate(order)), 6), kept

    order = max(permutations(range(3)), key=alignment)
    x = projections[0][:, order[0]]
    x /= np.linalg.norm(x)
    y = projections[1][:, order[1]]
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# Far beyond any table, and small enough to calculate with.
_LARGEST = 1000.0

Number = Annotated[float, Field(strict=True, ge=-_LARGEST, le=_LARGEST)]
Vector = tuple[Number, Number, Number]
Channel = Annotated[int, Field(ge=0, le=255)]


class _ObjectTable(_Strict):
    """`[[object]]` of a scene file."""

    name: Annotated[str, Field(min_length=1)]
    shape: str | None = None
    mesh: str | None = None
    color: str | tuple[Channel, Channel, Channel]
    position: Vector
    rotation: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _is_known(self) -> _ObjectTable:
        if (self.shape is None) == (self.mesh is None):
            raise ValueError("give either shape (a block) or mesh (a mesh file)")
        if self.shape is not None and self.shape not in BLOCK_NAMES:
            raise ValueError(f"shape {self.shape!r} is no block; there are {', '.join(BLOCK_NAMES)}")
        if isinstance(self.color, str) and word_to_rgb(self.color) is None:
            raise ValueError(
                f"color {self.color!r} is no colour; there are {', '.join(PALETTE)}, the names of CSS, or [r, g, b]"
            )
        return self


class _SceneTable(_Strict):
    """A scene file."""

    name: Annotated[str, Field(min_length=1)]
    drop: bool = False
    center: tuple[Number, Number] = (0.0, 0.0)
    yaw: Number = 0.0
    object: Annotated[tuple[_ObjectTable, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_differ(self) -> _SceneTable:
        twice = [name for name, n in Counter(item.name for item in self.object).items() if n > 1]
        if twice:
            raise ValueError(f"objects share the name {', '.join(map(repr, twice))}")
        return self


def _read_toml(path: Path, text: str, meshes: Path | None) -> Scene:
    try:
        table = _SceneTable.model_validate(parse_toml(text, path))
    except ValidationError as error:
        problems = [_describe(detail["loc"], detail["msg"]) for detail in error.errors()]
        raise ConfigError("\n  ".join([f"{path}: {len(problems)} mistake(s)", *problems])) from None
    T_scene_group = make_transform(rotation_z(table.yaw), (*table.center, 0.0))
    objects = []
    load = cache(load_shape)
    for item in table.object:
        shape = block(item.shape) if item.shape else load(_toml_mesh(path, item, meshes))
        R = rotvec_to_matrix(item.rotation)
        T = T_scene_group @ _centred_at(item.position, R, shape)
        color = _rgb(item.color)
        objects.append(SceneObject(item.name, shape, color, T))
    return Scene(table.name, tuple(objects), table.drop)


def _describe(place: tuple[int | str, ...], message: str) -> str:
    if place[:1] == ("object",) and len(place) > 1:
        place = (f"object {int(place[1]) + 1}", *place[2:])
    where = ", ".join(str(part) for part in place) or "scene"
    return f"{where}: {message.removeprefix('Value error, ')}"


def _toml_mesh(path: Path, item: _ObjectTable, meshes: Path | None) -> Path:
    folders = [path.parent, *([meshes] if meshes else [])]
    for folder in folders:
        with suppress(OSError, ValueError):  # of a name that no file can have
            if (folder / str(item.mesh)).is_file():
                return folder / str(item.mesh)
    places = " or ".join(str(folder) for folder in folders)
    raise ConfigError(
        f"{path}: object {item.name!r}: no mesh {str(item.mesh)[:80]!r} in {places}; name its folder with --meshes"
    )


def _centred_at(position: tuple[float, ...] | Array, R: Array, shape: Shape) -> Array:
    """The pose of a shape whose bounding box, along the shape's own axes, is centred at a position (3,) [m]."""
    return make_transform(R, np.asarray(position) - R @ bounds_center(shape.mesh))


@dataclass(frozen=True)
class _Row:
    """A line of a public scene file: position (3,) [m] of the bounding box's centre, V-REP angles (3,) [rad]."""

    number: int
    mesh: str
    color: str | tuple[int, int, int] | None
    position: Array
    angles: Array


def _read_rows(path: Path, text: str, meshes: Path | None) -> Scene:
    lines = [(n, fields) for n, line in enumerate(text.splitlines(), start=1) if (fields := line.split())]
    lines = [(number, fields) for number, fields in lines if not fields[0].startswith("#")]
    if not lines:
        raise ConfigError(f"{path}: holds no objects; see docs/reference/scene-files.md for the formats")
    widths = {10: _vpg_row, 8: _named_row}
    width = len(lines[0][1])
    if width not in widths:
        raise ConfigError(
            f"{path}, line {lines[0][0]}: {width} fields; a scene row has 10 (mesh r g b x y z alpha beta gamma) "
            "or 8 (name mesh x y z alpha beta gamma)"
        )
    rows = []
    for number, fields in lines:
        try:
            if len(fields) != width:
                raise ValueError(f"{len(fields)} fields where the rows above have {width}")
            rows.append(widths[width](number, fields))
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {error}") from None
    present = [row for row in rows if not _parked(row)]
    if not present:
        raise ConfigError(f"{path}: every object is parked outside the workspace; nothing is left to pick")
    if meshes is None:
        raise ConfigError(f"{path}: the scene names mesh files; give their folder with --meshes DIR")
    return Scene(path.stem, _row_objects(path, present, meshes), drop=False)


def _vpg_row(number: int, fields: list[str]) -> _Row:
    color = _numbers(fields[1:4], ("r", "g", "b"))
    if not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"the colour {' '.join(fields[1:4])} is outside 0..1")
    red, green, blue = (round(255 * float(channel)) for channel in color)
    return _row(number, fields[0], (red, green, blue), fields[4:])


def _named_row(number: int, fields: list[str]) -> _Row:
    name = fields[0].lower()
    if name != "block" and word_to_rgb(name) is None:
        raise ValueError(
            f"{fields[0]!r} is neither 'block' nor a colour; there are {', '.join(PALETTE)}, and the names of CSS"
        )
    return _row(number, fields[1], None if name == "block" else name, fields[2:])


def _row(number: int, mesh: str, color: str | tuple[int, int, int] | None, fields: list[str]) -> _Row:
    # Published files use either slash.
    name = PureWindowsPath(mesh).name
    if not name.lower().endswith(MESH_SUFFIXES):
        raise ValueError(f"{mesh[:80]!r} is not the name of a mesh file ({', '.join(MESH_SUFFIXES)})")
    numbers = _numbers(fields, ("x", "y", "z", "alpha", "beta", "gamma"))
    return _Row(number, name, color, numbers[:3], numbers[3:])


def _numbers(fields: list[str], names: tuple[str, ...]) -> Array:
    values = []
    for field, name in zip(fields, names, strict=True):
        try:
            values.append(_number(field))
        except ValueError as error:
            raise ValueError(f"{name} is {error}") from None
        if abs(values[-1]) > _LARGEST:
            raise ValueError(f"{name} is {field[:40]!r}; it must lie within {_LARGEST:.0f}")
    return np.array(values)


def _number(field: str) -> float:
    """A finite number in plain ASCII notation.

    Raises:
        ValueError: it is none; Python's own `1_000` and foreign digits count as none.
    """
    try:
        if "_" in field or not field.isascii():
            raise ValueError
        number = float(field)
    except ValueError:
        raise ValueError(f"{field[:40]!r}, which is no number") from None
    if not math.isfinite(number):
        raise ValueError(f"{field[:40]!r}; it must be finite")
    return number


def _parked(row: _Row) -> bool:
    x, y, z = row.position - _PUBLIC_CENTRE
    return bool(max(abs(x), abs(y)) > _PUBLIC_HALF_WIDTH_M + _PARKED_BESIDE_M or z < -_PARKED_BELOW_M)


def _row_objects(path: Path, rows: list[_Row], meshes: Path) -> tuple[SceneObject, ...]:
    files = sorted(file for file in meshes.iterdir() if file.is_file())
    # Published files name meshes in either case.
    by_name = {file.name.lower(): file for file in files} | {file.name: file for file in files}
    shapes: dict[Path, tuple[Shape, Array]] = {}
    frames = _read_frames(meshes, {file.name for file in files})
    goals = {row.color for row in rows}
    obstacle_colors = cycle([name for name in PALETTE if name not in goals] or list(PALETTE))
    objects = []
    for row in rows:
        mesh = by_name.get(row.mesh) or by_name.get(row.mesh.lower())
        if mesh is None:
            raise ConfigError(f"{path}, line {row.number}: there is no {row.mesh[:80]} in {meshes}; see --meshes")
        if mesh not in shapes:
            shape = load_shape(mesh)
            shapes[mesh] = shape, frames.get(mesh.name, mesh_frame(shape.mesh))
        shape, R_mesh_frame = shapes[mesh]
        R_base_frame = Rotation.from_euler("XYZ", row.angles).as_matrix()
        # The bounding box lies along the frame's axes, which need not be those of the mesh.
        in_frame = Mesh(shape.mesh.vertices @ R_mesh_frame, shape.mesh.triangles)
        origin = row.position - _PUBLIC_CENTRE - R_base_frame @ bounds_center(in_frame)
        T = make_transform(R_base_frame @ R_mesh_frame.T, origin)
        color = row.color or next(obstacle_colors)
        # As the file calls it: a colour for a goal.
        label = row.color if isinstance(row.color, str) else "block"
        rgb = _rgb(color)
        objects.append(SceneObject(f"{label} {shape.name} line {row.number}", shape, rgb, T))
    return tuple(objects)


def _rgb(color: str | tuple[int, int, int]) -> tuple[int, int, int]:
    """RGB, 0..255, of a word that was checked before, or as it is."""
    if not isinstance(color, str):
        return color
    rgb = word_to_rgb(color)
    assert rgb is not None
    return rgb


class _FrameTable(_Strict):
    """A mesh in frames.toml: which mesh axis the frame's x and y axes are."""

    x: Vector
    y: Vector


def _read_frames(meshes: Path, files: set[str]) -> dict[str, Array]:
    """Rotations (3, 3) from frame to mesh axes, by the name of the mesh file."""
    path = meshes / FRAMES_FILE
    if FRAMES_FILE not in files:
        return {}
    frames = {}
    for name, table in read_toml(path).items():
        if name not in files:
            raise ConfigError(f"{path}: there is no mesh {name[:80]!r} beside it")
        try:
            frame = _FrameTable.model_validate(table)
        except ValidationError as error:
            problems = "; ".join(_describe((name, *detail["loc"]), detail["msg"]) for detail in error.errors())
            raise ConfigError(f"{path}: {problems}") from None
        x, y = np.array(frame.x), np.array(frame.y)
        if not np.allclose([x @ x, y @ y, x @ y], (1, 1, 0), atol=1e-3):
            raise ConfigError(f"{path}: {name}: x and y must be unit vectors at right angles, in mesh axes")
        frames[name] = np.column_stack([x, y, np.cross(x, y)])
    return frames
