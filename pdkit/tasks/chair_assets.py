"""The chairs of PushChair: generated swivel chairs, or the paper's own where the user has PartNet-Mobility.

Five source chairs for demonstrations and three novel ones for online training and evaluation, as many as in the paper.
"""
from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import PdkitError, unknown
from .partnet import Model, UrdfWriter, partnet_models

SCALE = 0.8  # every description is scaled by this when it is built (ManiSkill 2)
GENERATED = {"source": range(5), "novel": range(5, 8)}  # seeds of generated chairs
PARTNET = {"source": (3022, 3027, 3030, 3070, 3076), "novel": (3003, 3013, 3020)}  # policy_decorator, envs/maniskill_fixed.py


@dataclass(frozen=True)
class Chair:
    """One chair, and how it stands at rest."""

    model: Model
    position: tuple[float, ...] = (0.0, 0.0, 0.002)  # of the root link, metres
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)  # of the root link, quaternion with w first
    joints: tuple[float, ...] = ()  # joint positions; empty: all zero


def chairs(kind: str) -> list[Chair]:
    """The "source" or the "novel" chairs.

    Raises PdkitError for another kind, and where PDKIT_PARTNET names a folder that does not hold the paper's chairs.
    """
    if kind not in GENERATED:
        raise unknown("kind of chairs", kind, GENERATED)
    models = partnet_models(PARTNET[kind])
    if models is None:
        return [Chair(generated_chair(seed)) for seed in GENERATED[kind]]
    return with_rest(models, _recorded_rest())


def with_rest(models: Sequence[Model], rest: dict[str, dict]) -> list[Chair]:
    """PartNet chairs as they stand in `rest` (ManiSkill 2's table: position, rotation and initial_qpos of each)."""
    for model in models:
        if model.name not in rest:
            raise PdkitError(f"ManiSkill does not say how chair {model.name} stands at rest; reinstall mani-skill from environment.txt.")
    entries = [rest[model.name] for model in models]
    return [Chair(model, tuple(entry["position"]), tuple(entry["rotation"]), tuple(entry["initial_qpos"]))
            for model, entry in zip(models, entries, strict=True)]


def _recorded_rest() -> dict[str, dict]:
    from mani_skill import PACKAGE_ASSET_DIR

    return json.loads((PACKAGE_ASSET_DIR / "partnet_mobility/meta/info_chair_train.json").read_text())


def generated_chair(seed: int) -> Model:
    """A swivel chair on four to six castors, of a size and with or without arm rests as `seed` decides; lengths before SCALE.

    The root link is upright on the floor at the chair's middle; its -y is where the chair faces, as in PartNet's seat frames
    when turned upright. The "helper" link between foot and seat carries the swivel joint, by whose name ManiSkill 2 knows it.
    """
    rng = np.random.default_rng(seed)
    height, width, depth, back = rng.uniform((0.42, 0.40, 0.40, 0.30), (0.52, 0.50, 0.48, 0.50))
    reach, wheel = rng.uniform((0.27, 0.040), (0.32, 0.050))
    castors, arm_rests = int(rng.integers(4, 7)), bool(rng.integers(2))
    foot = 2 * wheel + 0.04  # height of the legs
    urdf = UrdfWriter(f"chair-{seed}")
    urdf.link("base")
    urdf.link("support")
    urdf.joint("base_joint", "fixed", "base", "support")
    column = height - foot - 0.06
    urdf.box("leg", (0.10, 0.10, column), (0, 0, foot + column / 2))
    angles = 2 * np.pi * np.arange(castors) / castors
    for angle in angles:
        urdf.box("leg", (reach, 0.07, 0.05), (reach / 2 * np.cos(angle), reach / 2 * np.sin(angle), foot), (0, 0, angle))
    for index, angle in enumerate(angles):
        castor, wheels = f"castor_{index}", f"wheel_{index}"
        urdf.link(castor)
        urdf.box("caster", (0.04, 0.06, 0.04), (0, 0, 0))
        at = (reach * np.cos(angle), reach * np.sin(angle), foot - 0.04)
        urdf.joint(f"{castor}_joint", "continuous", "support", castor, at, (0, 0, angle))
        urdf.link(wheels)
        urdf.sphere("wheel", wheel)
        urdf.joint(f"{wheels}_joint", "continuous", castor, wheels, (-0.02, 0, wheel - at[2]), axis=(0, 1, 0))
    urdf.link("helper")
    urdf.joint("helper_joint", "fixed", "support", "helper", (0, 0, height - 0.05))
    urdf.link("seat")
    urdf.joint("seat_joint", "continuous", "helper", "seat")
    urdf.box("seat", (width, depth, 0.05), (0, 0, 0.025))
    behind = depth / 2 - 0.02
    urdf.box("seat", (0.08, 0.04, 0.2), (0, behind, 0.08))
    urdf.box("seat", (0.9 * width, 0.04, back), (0, behind, 0.10 + back / 2), (-0.1, 0, 0))
    if arm_rests:
        for side in (-width / 2, width / 2):
            urdf.box("seat", (0.04, 0.04, 0.2), (side, behind - 0.1, 0.13))
            urdf.box("seat", (0.05, 0.7 * depth, 0.03), (side, 0, 0.24))
    return Model(f"chair-{seed}", urdf.text())
