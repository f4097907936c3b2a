"""Meshes from files: OBJ, STL, PLY, GLB and DAE, read by trimesh. Metres.

The axes are those of the file. A DAE file says its own unit of length; all others are read in metres.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.errors import ConfigError
from robotcell.io.input_file import read_bytes
from sim_twin.scenes.flat_faces import without_folds
from sim_twin.scenes.meshes import MESH_SUFFIXES, Mesh, hull, join, mesh_volume

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from trimesh import Trimesh

# What a mesh file may hold: cutting a torus of 3600 triangles takes ten seconds.
MAX_TRIANGLES = 5000
# Such a mesh takes below 1 MB; pictures for its surface may come with it.
_MAX_BYTES = 64_000_000

# Share of a surface that may be missing: small cracks, where faces meet in edges that differ, do no harm.
_MAX_GAP = 0.005
# A surface that encloses a smaller share of its hull is flat or open.
_MIN_FILLED = 0.01
# Indices of an OBJ file that count back from the last vertex so far, with more vertices after them.
_RELATIVE = re.compile(rb"^\s*f\s[^\n]*\s-\d[\s\S]*?^\s*v\s", re.MULTILINE)


def load_meshes(path: Path) -> tuple[Mesh, ...]:
    """The objects of a file, as closed meshes with outward normals.

    Objects that are closed only together come as one mesh.

    Raises:
        ConfigError: the file is missing or malformed; a mesh in it is not closed, or its faces disagree about which
            side is outside; there are more than `MAX_TRIANGLES`.
    """
    objects = _read(path)
    if not objects:
        raise ConfigError(f"{path}: holds no faces; a closed mesh is needed")
    if not all(np.isfinite(found.vertices).all() for found in objects):
        raise ConfigError(f"{path}: a coordinate is not a finite number; export the mesh again")
    with _quiet(path):
        meshes = tuple(_mesh(found) for found in objects)
        if not all(map(_is_closed, meshes)):
            meshes = (join(meshes),)
        closed = all(map(_is_closed, meshes))
        consistent = all(map(_is_consistent, meshes))
    if not closed:
        raise ConfigError(f"{path}: the surface is flat or not closed; a closed mesh is needed")
    if not consistent:
        raise ConfigError(f"{path}: neighbouring faces disagree about which side is outside; recalculate the normals")
    return tuple(mesh if mesh_volume(mesh) > 0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1]) for mesh in meshes)


def _read(path: Path) -> list[Trimesh]:
    """The objects of a file, in its order, with their transforms applied."""
    kind = path.suffix.lower()
    if kind not in MESH_SUFFIXES:
        raise ConfigError(f"{path}: no mesh file by its name; the twin reads {', '.join(MESH_SUFFIXES)}")
    data = read_bytes(path, _MAX_BYTES)
    if kind == ".obj":
        # A backslash at its end continues a line.
        data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if kind == ".obj" and _RELATIVE.search(data):
        raise ConfigError(
            f"{path}: its faces count back from vertices among others; write all vertices before the faces"
        )
    with _quiet(path):
        import trimesh

        options: dict[str, Any] = (
            {"split_objects": True, "group_material": False, "skip_materials": True} if kind == ".obj" else {}
        )
        data = data.removeprefix(b"\xef\xbb\xbf")
        if kind == ".glb":
            _check_accessors(data)
        scene: Any = trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], process=False, **options)
        _check_count(scene, path)
        if scene.units is not None:
            scene = scene.convert_units("meters")
        found = [item for item in scene.dump() if isinstance(item, trimesh.Trimesh) and len(item.faces)]
        for item in found:
            if item.faces.max() >= len(item.vertices) or item.faces.min() < 0:
                raise ValueError("a face names a vertex that is not there")
            if not item.is_watertight:
                # Corners that the file gives to each face anew, and those that differ in texture alone.
                item.merge_vertices(merge_tex=True, merge_norm=True)
        # trimesh takes the objects of an OBJ file from its end.
        return found[::-1] if kind == ".obj" else found


def _check_accessors(data: bytes) -> None:
    """Refuse a GLB file that asks for arrays which it does not hold: they would be made, as zeros, of any size."""
    length = int.from_bytes(data[12:16], "little")
    for accessor in json.loads(data[20 : 20 + length]).get("accessors", ()):
        if accessor["count"] > len(data):
            raise ValueError(f"an array of {accessor['count']} entries in a file of {len(data)} bytes")


def _check_count(scene: Any, path: Path) -> None:
    """Refuse too many triangles before objects that are used many times are copied as often."""
    used = (scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    count = sum(len(found.faces) for found in used if hasattr(found, "faces"))
    if count > MAX_TRIANGLES:
        raise ConfigError(f"{path}: {count} triangles; simplify the mesh to at most {MAX_TRIANGLES}")


def _mesh(found: Trimesh) -> Mesh:
    vertices = np.array(found.vertices, np.float64)
    return Mesh(vertices, without_folds(vertices, np.array(found.faces, np.int32)))


def _is_closed(mesh: Mesh) -> bool:
    """Whether the area vectors add up to nothing, and a volume is enclosed."""
    corners = mesh.vertices[mesh.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    gap = np.linalg.norm(areas.sum(axis=0)) / max(np.linalg.norm(areas, axis=1).sum(), 1e-30)
    try:
        limit = mesh_volume(hull(mesh.vertices))
    except ValueError:
        return False
    return bool(gap < _MAX_GAP and _MIN_FILLED * limit < abs(mesh_volume(mesh)) < 1.001 * limit)


def _is_consistent(mesh: Mesh) -> bool:
    """Whether two faces pass the edge between them in opposite directions."""
    import trimesh

    return bool(trimesh.Trimesh(mesh.vertices, mesh.triangles).is_winding_consistent)


@contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """Turn whatever a reader of foreign files raises into a ConfigError, and drop its warnings."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except (ConfigError, MemoryError):
        raise
    except ImportError as error:
        raise ConfigError(
            f"mesh files need trimesh and its readers ({error}): pip install 'robotcell[twin]'"
        ) from error
    except IndexError as error:
        raise ConfigError(
            f"{path}: a face names a vertex that is not in the file ({error}); export the mesh again"
        ) from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        raise ConfigError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); export the mesh again"
        ) from error
