"""The pictures along demonstrations: drawn by replaying their actions from their seeds, kept under runs/, never shipped.

A file belongs to the demonstrations whose checksum it carries; their states and actions stay where they are.
"""
from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..demos.format import Demos
from ..errors import PdkitError
from ..files import atomic_file, read_json, runs_root, sha256, write_json
from ..tasks import get_task
from ..tasks.spec import TaskSpec
from .cameras import View, view_of
from .encoders import Encoder
from .sim import PixelSim

FORMAT = "pdkit-pictures-1"


@dataclass(frozen=True)
class Pictures:
    """What was seen at each observation of demonstrations, in their order; N observations, k cameras."""

    rgb: np.ndarray  # (N, 3 k, height, width) uint8
    depth: np.ndarray  # (N, k, height, width) uint16, or (N, 0, height, width)


def draw(demos: Demos, progress: Callable[[int, int], None] | None = None, spec: TaskSpec | None = None,
         view: View | None = None) -> Pictures:
    """Replay demonstrations and draw them. `spec` and `view` are for worlds outside the registry.

    Raises PdkitError where the simulator cannot draw, for demonstrations without seeds, and where a replay does not repeat the
    recorded successes step by step.
    """
    if (demos.seeds < 0).any():
        raise PdkitError(f"These {demos.label} demonstrations of {demos.task} have no seeds to be replayed from; use scripted ones or "
                         "those of an agent.")
    sim, frames = PixelSim(spec or get_task(demos.task), view), []
    try:
        for number, (seed, episode) in enumerate(zip(demos.seeds, demos.episodes(), strict=True)):
            frames.append(sim.reset(int(seed)))
            solved = []
            for action in episode["actions"]:
                frame, success = sim.step(action)
                frames.append(frame)
                solved.append(success)
            if not np.array_equal(solved, episode["success"]):
                raise PdkitError(f"Demonstration {number} of {demos.task} does not replay on this machine as it was recorded; make "
                                 f"some here with `pdkit demos {demos.task}`.")
            if progress:
                progress(number + 1, demos.num)
    finally:
        sim.close()
    return Pictures(np.stack([f.rgb for f in frames]), np.stack([f.depth for f in frames]))


def picture_file(demos: Demos) -> Path:
    """Where the pictures of these demonstrations are kept."""
    return runs_root() / "pictures" / f"{demos.task}-{demos.num}-{demos.checksum[:12]}.safetensors"


def pictures_of(demos: Demos, progress: Callable[[int, int], None] | None = None) -> Pictures:
    """The pictures along demonstrations: as kept, or drawn now and kept.

    Raises PdkitError when a kept file is truncated, altered or of other demonstrations or cameras, and as `draw` does.
    """
    path = picture_file(demos)
    if not (path.exists() and path.with_suffix(".json").exists()):  # the card is written last
        save_pictures(draw(demos, progress), demos, path)
    return load_pictures(demos, path)


def _card(demos: Demos) -> dict:
    return json.loads(json.dumps({"format": FORMAT, "demos": demos.checksum, "view": dataclasses.asdict(view_of(demos.task))}))


def save_pictures(pictures: Pictures, demos: Demos, path: Path) -> None:
    """Write the pictures, uncompressed, and beside them a .json with the file's checksum and the command that makes it again."""
    from safetensors.numpy import save_file

    with atomic_file(path) as temporary:
        save_file({"rgb": pictures.rgb, "depth": pictures.depth}, temporary)
        checksum = sha256(temporary)
    write_json(path.with_suffix(".json"), _card(demos) | {"sha256": checksum, "command": f"pdkit demos {demos.task} --pixels"})


def load_pictures(demos: Demos, path: Path) -> Pictures:
    """The pictures kept in `path`. Raises PdkitError when they are truncated, altered, or of other demonstrations or cameras."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    card = read_json(path.with_suffix(".json"))
    again = f"delete it and run `pdkit demos {demos.task} --pixels`"
    if not isinstance(card, dict) or card.get("sha256") != sha256(path):
        raise PdkitError(f"{path} is truncated or altered; {again}.")
    if {name: card.get(name) for name in ("format", "demos", "view")} != _card(demos):
        raise PdkitError(f"{path} holds the pictures of other demonstrations or cameras; {again}.")
    try:
        return Pictures(**load_file(path))
    except (SafetensorError, TypeError) as error:
        raise PdkitError(f"{path} is not a file of pictures; {again}.") from error


def encoded(demos: Demos, pictures: Pictures, encoder: Encoder) -> Demos:
    """The same demonstrations as the derived task shows them: the robot's state, then the features of each picture.

    Raises PdkitError when the pictures are not theirs.
    """
    if len(pictures.rgb) != len(demos.observations):
        raise PdkitError(f"{len(demos.observations)} observations need as many pictures, not {len(pictures.rgb)}.")
    features = encoder.encode(pictures.rgb, pictures.depth)
    return dataclasses.replace(demos, observations=np.concatenate([encoder.view.robot(demos.observations), features], axis=1))
