"""The faucets of TurnFaucet: ours, generated from seeds, or the paper's from PartNet-Mobility where the user has them.

PartNet-Mobility needs a download and forbids commercial use, so the default faucets are boxes put together: 10 source faucets
for demonstrations and 3 novel ones for online learning and evaluation, in six styles, described as PartNet-Mobility describes
its own (a URDF with `link_0`, `link_1` for the handles). The novel ones have other sizes, places of the handles and ranges of
turning, and no style that the source faucets lack.

With PDKIT_PARTNET (see partnet.py) the faucets of the paper are used instead. Their sizes and semantics come with ManiSkill. The
paper's text speaks of 3 novel faucets, its code registers 4: with PartNet these four are used.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import PdkitError
from ..files import read_json
from .partnet import Model, UrdfWriter, partnet_models

PARTNET_SOURCE = (5002, 5021, 5023, 5028, 5029, 5045, 5047, 5051, 5056, 5063)
PARTNET_NOVEL = (5014, 5037, 5053, 5062)
NUM_SOURCE, NUM_NOVEL = 10, 3
STYLES = ("lever on top", "lever at the side", "cross", "knob", "two levers", "two crosses")
FIRST_SEED = 100  # of the generator

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector, Vector]  # edges, middle, roll-pitch-yaw: metres and radians


@dataclass(frozen=True)
class Faucet:
    """One faucet: its description, and what ManiSkill's metadata add to it."""

    model: Model
    switches: tuple[str, ...]  # the links that are handles
    scale: float = 1.0
    height: float = 0.0  # of its origin over the table, metres
    density: float = 2000.0  # kg / m^3


def faucets(novel: bool) -> tuple[Faucet, ...]:
    """The novel or the source faucets: PartNet-Mobility's where PDKIT_PARTNET names a folder, else ours.

    Raises PdkitError where that folder is missing, or lacks a faucet or a part of one.
    """
    models = partnet_models(PARTNET_NOVEL if novel else PARTNET_SOURCE)
    if models is not None:
        return with_metadata(models)
    numbers = range(NUM_SOURCE, NUM_SOURCE + NUM_NOVEL) if novel else range(NUM_SOURCE)
    return tuple(generated_faucet(number) for number in numbers)


def with_metadata(models: Sequence[Model]) -> tuple[Faucet, ...]:
    """PartNet's faucets with handles, sizes and densities from ManiSkill's table. Raises PdkitError for one that is not in it."""
    from mani_skill import PACKAGE_ASSET_DIR

    known = read_json(PACKAGE_ASSET_DIR / "partnet_mobility/meta/info_faucet_train.json")
    for model in models:
        if model.name not in known:
            raise PdkitError(f"ManiSkill does not describe faucet {model.name}; reinstall mani-skill from environment.txt.")
    return tuple(_described(model, known[model.name]) for model in models)


def _described(model: Model, about: dict) -> Faucet:
    switches = tuple(link for link, _, meaning in about["semantics"] if meaning == "switch")
    return Faucet(model, switches, about["scale"], about["offset"][2], about.get("density", 8000.0))


def generated_faucet(number: int) -> Faucet:
    """Faucet `number` of ours: the style goes round, everything else is drawn."""
    rng = np.random.default_rng(FIRST_SEED + number)
    body, handles = _BUILD[STYLES[number % len(STYLES)]](rng)
    urdf = UrdfWriter(f"faucet-{number}")
    urdf.link("base")
    urdf.link("link_base")
    _add_boxes(urdf, "body", body)
    urdf.joint("joint_base", "fixed", "base", "link_base")
    switches = []
    for i, (boxes, place, direction, range_) in enumerate(handles):
        switches.append(f"link_{i}")
        urdf.link(switches[-1])
        _add_boxes(urdf, "switch", boxes)
        urdf.joint(f"joint_{i}", "revolute", "link_base", switches[-1], place, direction, limits=(0, round(range_, 4)))
    return Faucet(Model(f"ours-{number}", urdf.text()), tuple(switches))


def _add_boxes(urdf: UrdfWriter, part: str, boxes: list[Box]) -> None:
    for size, middle, direction in boxes:
        urdf.box(part, size, middle, direction)


# ---- shapes: handles are described about their axis, which is z ------------------------------------------------------

Handle = tuple[list[Box], Vector, Vector, float]  # boxes, place, roll-pitch-yaw of the axis, range of turning


def _post(radius: float, length: float, middle: Vector) -> list[Box]:
    """An upright post, nearly round: two square ones, one turned by 45 degrees."""
    size = (1.84 * radius, 1.84 * radius, length)
    return [(size, middle, (0, 0, 0)), (size, middle, (0, 0, np.pi / 4))]


def _lever(rng: np.random.Generator) -> list[Box]:
    length, width, height = rng.uniform(0.07, 0.11), rng.uniform(0.012, 0.02), rng.uniform(0.02, 0.035)
    return [*_post(0.018, 0.03, (0, 0, 0)), ((length, width, height), (length / 2, 0, 0.005), (0, 0, 0))]


def _cross(rng: np.random.Generator) -> list[Box]:
    bar = (rng.uniform(0.10, 0.14), rng.uniform(0.010, 0.016), rng.uniform(0.02, 0.035))
    return [*_post(0.016, 0.03, (0, 0, 0)), (bar, (0, 0, 0.005), (0, 0, 0)), (bar, (0, 0, 0.005), (0, 0, np.pi / 2))]


def _knob(rng: np.random.Generator) -> list[Box]:
    radius = rng.uniform(0.025, 0.035)
    length = radius + rng.uniform(0.025, 0.04)
    fin = (length, rng.uniform(0.008, 0.014), rng.uniform(0.03, 0.045))
    return [*_post(radius, 0.03, (0, 0, 0)), (fin, (length / 2, 0, 0.01), (0, 0, 0))]


def _body(rng: np.random.Generator, width: float, tallest: float) -> tuple[list[Box], float, float]:
    """Foot, post and spout (towards the robot, below the handles); height and radius of the post."""
    height, radius, reach = rng.uniform(0.10, tallest), rng.uniform(0.02, 0.03), rng.uniform(0.10, 0.16)
    top = 0.72 * height
    boxes = [
        ((0.07, width, 0.03), (0, 0, 0.015), (0, 0, 0)),
        *_post(radius, height, (0, 0, height / 2)),
        ((reach, 0.025, 0.025), (-reach / 2, 0, top), (0, 0, 0)),
        ((0.025, 0.025, 0.05), (-reach, 0, top - 0.03), (0, 0, 0)),
    ]
    return boxes, height, radius


def _on_top(rng: np.random.Generator, boxes: list[Box], yaw: float) -> tuple[list[Box], list[Handle]]:
    body, height, _ = _body(rng, 0.08, 0.18)
    return body, [(boxes, (0, 0, height + 0.015), (0, 0, yaw), rng.uniform(1.2, 2.2))]


def _lever_on_top(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    return _on_top(rng, _lever(rng), rng.choice([-1, 1]) * np.pi / 2 + rng.uniform(-0.4, 0.4))


def _cross_on_top(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    return _on_top(rng, _cross(rng), rng.uniform(0, np.pi / 2))


def _knob_on_top(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    return _on_top(rng, _knob(rng), np.pi + rng.uniform(-1, 1))


def _lever_at_the_side(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    """The axis lies across; the lever stands up and is pushed over."""
    body, height, radius = _body(rng, 0.08, 0.18)
    side = rng.choice([-1, 1])
    place, direction = (0, side * (radius + 0.016), 0.9 * height), (-side * np.pi / 2, rng.uniform(-2.0, -1.4), 0)
    return body, [(_lever(rng), place, direction, rng.uniform(1.2, 1.4))]


def _two(rng: np.random.Generator, shape, yaw) -> tuple[list[Box], list[Handle]]:
    width = rng.uniform(0.14, 0.20)
    body, _, _ = _body(rng, width + 0.05, 0.12)  # no taller: the palm, 20 cm wide, passes over it beside a handle
    handles = []
    for side in (-1, 1):
        height = rng.uniform(0.08, 0.10)
        body += _post(0.018, height, (0, side * width / 2, height / 2))
        handles.append((shape(rng), (0, side * width / 2, height + 0.015), (0, 0, yaw(side)), rng.uniform(1.2, 1.6)))
    return body, handles


def _two_levers(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    return _two(rng, _lever, lambda side: side * np.pi / 2 + rng.uniform(-0.3, 0.3))


def _two_crosses(rng: np.random.Generator) -> tuple[list[Box], list[Handle]]:
    return _two(rng, _cross, lambda side: rng.uniform(0, np.pi / 2))


_BUILD = dict(zip(STYLES, (_lever_on_top, _lever_at_the_side, _cross_on_top, _knob_on_top, _two_levers, _two_crosses), strict=True))
