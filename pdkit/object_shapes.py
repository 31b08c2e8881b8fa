"""The shapes of an articulated object with all joints at zero, from its URDF: what lesson 14 draws without a graphics driver."""
from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from .tasks.partnet import Model


@dataclass(frozen=True)
class Part:
    """One shape of an object."""

    name: str  # as PartNet names it, without its number: "switch", "seat", "wheel"
    link: str
    triangles: np.ndarray  # (N, 3, 3) corners, metres, z up


def parts(model: Model) -> list[Part]:
    """The visual shapes of `model`: boxes, spheres, and the meshes of a PartNet-Mobility object."""
    root = ElementTree.fromstring(model.urdf)
    places, found = _places(root), []
    for link in root.iter("link"):
        name = link.get("name", "")
        for visual in link.iter("visual"):
            mesh = _mesh(visual.find("geometry"), model)
            mesh.apply_transform(places[name] @ _transform(visual.find("origin")))
            found.append(Part(visual.get("name", "").rsplit("-", 1)[0], name, np.asarray(mesh.triangles)))
    return found


def _places(root: ElementTree.Element) -> dict[str, np.ndarray]:
    """Where each link is, (4, 4), in the frame of the link that hangs on none."""
    above = {joint.find("child").get("link"): joint for joint in root.iter("joint")}

    def place(link: str) -> np.ndarray:
        joint = above.get(link)
        return np.eye(4) if joint is None else place(joint.find("parent").get("link")) @ _transform(joint.find("origin"))

    return {link.get("name", ""): place(link.get("name", "")) for link in root.iter("link")}


def _transform(origin: ElementTree.Element | None) -> np.ndarray:
    matrix = np.eye(4)
    if origin is not None:
        matrix[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
        matrix[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"))).as_matrix()  # about fixed axes, as URDF has it
    return matrix


def _mesh(geometry: ElementTree.Element, model: Model) -> trimesh.Trimesh:
    shape = geometry[0]
    if shape.tag == "box":
        return trimesh.creation.box(_numbers(shape.get("size")))
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(1, float(shape.get("radius")))
    mesh = trimesh.load(model.path.parent / shape.get("filename"), force="mesh", process=False)
    mesh.apply_scale(_numbers(shape.get("scale", "1 1 1")))
    return mesh


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
