"""Articulated objects in the layout of PartNet-Mobility: the user's own copy of that data set, and writing objects like its own.

PartNet-Mobility (Xiang et al., SAPIEN, CVPR 2020) may be used non-commercially and has to be requested, so nothing is ever
downloaded here: objects made of boxes and spheres are the default, and the real ones are used where the environment variable
PDKIT_PARTNET names the folder that holds them as ID/mobility.urdf with their meshes (https://sapien.ucsd.edu).
"""
from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from ..errors import PdkitError
from .spec import TaskSpec

VARIABLE = "PDKIT_PARTNET"
NAMES = ("mobility_cvx.urdf", "mobility_fixed.urdf", "mobility.urdf")  # ManiSkill 2's corrected files first

Vector = Sequence[float]


@dataclass(frozen=True)
class Model:
    """One articulated object: its description, and where that lies if its meshes lie beside it."""

    name: str
    urdf: str  # the text of the description
    path: Path | None = None  # None: made of primitives, nothing on disk

    @contextmanager
    def file(self) -> Iterator[str]:
        """A path from which a loader can read the description within this block."""
        if self.path:
            yield str(self.path)
            return
        with tempfile.TemporaryDirectory(prefix="pdkit-") as folder:
            path = Path(folder) / "mobility.urdf"
            path.write_text(self.urdf)
            yield str(path)


def partnet_models(ids: Sequence[int]) -> list[Model] | None:
    """The objects called `ids` in the user's PartNet-Mobility folder; None where PDKIT_PARTNET is not set.

    Raises PdkitError where the folder, an object or one of its meshes is missing, or a description is not readable.
    """
    folder = _folder()
    return None if folder is None else [_model(folder, str(one)) for one in ids]


def _folder() -> Path | None:
    """The user's PartNet-Mobility folder, None where none is named. Raises PdkitError where what is named is no folder."""
    named = os.environ.get(VARIABLE)
    if not named:
        return None
    folder = Path(named).expanduser()
    if not folder.is_dir():
        raise PdkitError(f"{VARIABLE} names {folder}, which is not a folder; let it name the folder with the PartNet-Mobility objects, "
                         "or unset it to use generated objects.")
    return folder


def object_set(spec: TaskSpec) -> str:
    """What results must not be mixed over: "PartNet-Mobility" where a task's objects are the user's own now; "" for generated ones, and
    for a task without. Raises PdkitError where PDKIT_PARTNET names no folder."""
    return "PartNet-Mobility" if spec.own_objects and _folder() else ""


def _model(folder: Path, name: str) -> Model:
    path = next((folder / name / file for file in NAMES if (folder / name / file).is_file()), None)
    advice = f"put the whole object there, or unset {VARIABLE} to use generated objects."
    if path is None:
        raise PdkitError(f"{folder} lacks {name}/mobility.urdf, PartNet-Mobility object {name}; {advice}")
    try:
        text = path.read_text()
        meshes = [mesh.get("filename", "") for mesh in ElementTree.fromstring(text).iter("mesh")]
    except (OSError, UnicodeDecodeError, ElementTree.ParseError):
        raise PdkitError(f"{path} is not a readable URDF file; {advice}") from None
    missing = [mesh for mesh in meshes if not (path.parent / mesh).is_file()]
    if missing:
        raise PdkitError(f"{path} uses {missing[0]} ({len(missing)} such files), which is missing; {advice}")
    return Model(name, text, path)


def link_parts(urdf: str) -> dict[str, str]:
    """What PartNet calls the parts of each link, joined by spaces: the names of its visual shapes, as "seat-1 caster-2"."""
    links = ElementTree.fromstring(urdf).iter("link")
    return {link.get("name", ""): " ".join(visual.get("name", "") for visual in link.iter("visual")) for link in links}


def _text(values: Vector) -> str:
    return " ".join(f"{value:.5f}" for value in values)


class UrdfWriter:
    """Describes an object made of boxes and spheres. Lengths in metres, angles in radians, x forward, z up."""

    def __init__(self, name: str):
        self._robot = ElementTree.Element("robot", name=name)
        self._shapes = 0

    def link(self, name: str) -> None:
        """Add a link, as yet without shapes."""
        self._link = ElementTree.SubElement(self._robot, "link", name=name)

    def box(self, part: str, size: Vector, at: Vector, turned: Vector = (0, 0, 0)) -> None:
        """Give the last link a box of edges `size` (3,) with its middle `at` (3,), `turned` by roll, pitch and yaw."""
        self._shape(part, "box", {"size": _text(size)}, at, turned)

    def sphere(self, part: str, radius: float, at: Vector = (0, 0, 0)) -> None:
        """Give the last link a sphere."""
        self._shape(part, "sphere", {"radius": f"{radius:.5f}"}, at, (0, 0, 0))

    def _shape(self, part: str, kind: str, size: dict[str, str], at: Vector, turned: Vector) -> None:
        self._shapes += 1
        for purpose in ("visual", "collision"):
            shape = ElementTree.SubElement(self._link, purpose, name=f"{part}-{self._shapes}")
            ElementTree.SubElement(shape, "origin", xyz=_text(at), rpy=_text(turned))
            ElementTree.SubElement(ElementTree.SubElement(shape, "geometry"), kind, size)

    def joint(self, name: str, kind: str, parent: str, child: str, at: Vector = (0, 0, 0), turned: Vector = (0, 0, 0),
              axis: Vector = (0, 0, 1), limits: tuple[float, float] | None = None) -> None:
        """Hang `child` on `parent`: "fixed", "continuous", or "revolute" and "prismatic" with their `limits`."""
        joint = ElementTree.SubElement(self._robot, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "origin", xyz=_text(at), rpy=_text(turned))
        ElementTree.SubElement(joint, "axis", xyz=_text(axis))
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        if limits:
            ElementTree.SubElement(joint, "limit", lower=f"{limits[0]:.5f}", upper=f"{limits[1]:.5f}", effort="100", velocity="10")

    def text(self) -> str:
        return ElementTree.tostring(self._robot, encoding="unicode")
