"""Where the shapes of a URDF's links reach to."""

import itertools
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from fbse_drake.errors import InputError


def link_points(link: Element, kind: str, urdf: Path, axes: np.ndarray) -> np.ndarray:
    """Outermost points of a link's shapes, in its frame.

    Args:
        link: of a URDF.
        kind: of its shapes, collision or visual.
        urdf: its file, near which meshes are looked for.
        axes: of the directions in which a sphere's points are taken, columns in the link's frame,
            (3, 3).

    Returns:
        Shape (N, 3) [m]; N is 0 for a link without shapes.

    Raises:
        InputError: a mesh that is needed cannot be read.
    """
    parts = [_points(shape, urdf, axes) for shape in link.findall(kind)]
    return np.vstack([np.empty((0, 3)), *parts])


def _points(shape: Element, urdf: Path, axes: np.ndarray) -> np.ndarray:
    geometry = shape.find("geometry")
    if geometry is None or not len(geometry):
        return np.empty((0, 3))
    X_LG = _pose(shape.find("origin"))
    axes = X_LG.rotation().matrix().T @ axes
    return X_LG.multiply(_shape_points(geometry[0], urdf, axes).T).T


def _shape_points(shape: Element, urdf: Path, axes: np.ndarray) -> np.ndarray:
    if shape.tag == "box":
        return _box(0.5 * np.array(_numbers(shape.get("size", ""))))
    if shape.tag == "sphere":
        radius = float(shape.get("radius", "0"))
        return radius * np.vstack([axes.T, -axes.T])
    if shape.tag in ("cylinder", "capsule"):
        radius, half = float(shape.get("radius", "0")), 0.5 * float(shape.get("length", "0"))
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.vstack([np.insert(circle, 2, end, axis=1) for end in (-half, half)])
    return _mesh(shape, urdf)


def _box(half: np.ndarray) -> np.ndarray:
    return half * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def _mesh(shape: Element, urdf: Path) -> np.ndarray:
    name = shape.get("filename", "")
    path = find_mesh(name, urdf)
    if path is None:
        raise InputError(f"{urdf}: the mesh {name} is not there")
    try:
        import trimesh
    except ModuleNotFoundError:
        needed = "pip install 'fbse_drake[meshes]'"
        raise InputError(f"{urdf}: to read {path.name}, trimesh is needed: {needed}") from None
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:
        raise InputError(f"{path}: cannot be read: {str(error).partition(chr(10))[0]}") from None
    scale = np.array(_numbers(shape.get("scale", "1 1 1")))
    return scale * np.asarray(mesh.vertices, dtype=float)


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file of a mesh: `package://package/path` below one of the folders above the URDF, or a
    path beside it; None where there is none."""
    if not name.startswith("package://"):
        beside = urdf.parent / name.removeprefix("file://")
        return beside if beside.is_file() else None
    inside = Path(name.removeprefix("package://"))
    for folder in urdf.resolve().parents:
        for path in (folder / inside, folder.joinpath(*inside.parts[1:])):
            if path.is_file():
                return path
    return None


def _pose(origin: Element | None) -> RigidTransform:
    if origin is None:
        return RigidTransform()
    angles, place = (_numbers(origin.get(key, "0 0 0")) for key in ("rpy", "xyz"))
    return RigidTransform(RollPitchYaw(*angles), np.array(place))


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]
