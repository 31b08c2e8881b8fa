"""PegInsertionSide on ManiSkill 3: a peg into the hole of a box, 3 mm wider; the sizes of both change with every episode."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import quaternions
from .draws import Draws, noisy_joints
from .maniskill import POSE_CONTROL, FastSim, StockSim, building, place_body, renew_physics
from .spec import TaskSpec

CLEARANCE = 0.003  # the hole's radius beyond the peg's, metres
DEPTH = 0.015  # how far before the middle of the hole the peg's head may stay, metres


@dataclass(frozen=True)
class PegStart:
    """Everything that the seed of an episode decides."""

    joints: np.ndarray  # (9,) float32
    half_length: float  # of the peg; of the box too, in all directions, metres
    radius: float  # half the peg's width, metres
    centre: np.ndarray  # (2,) the hole's middle on the face of the box, metres
    peg: np.ndarray  # (7,) pose
    box: np.ndarray  # (7,) pose


def peg_start(seed: int) -> PegStart:
    """Where and with what PegInsertionSide-v1 starts for `seed`.

    Draws the same random numbers in the same order as ManiSkill. It seeds its generators twice, once for the sizes
    (`_load_scene`) and once for the poses (`_initialize_episode`, where the table scene first draws joints for nothing).
    """
    rng = np.random.RandomState(seed)
    half_length, radius = rng.uniform(0.085, 0.125), rng.uniform(0.015, 0.025)
    centre = 0.5 * (half_length - radius) * rng.uniform(-1, 1, 2)
    rng = np.random.RandomState(seed)
    noisy_joints(rng, -np.pi / 4)
    draws = Draws(seed)

    def lying(low: list[float], high: list[float], height: float, spread: float) -> np.ndarray:
        xy = draws.uniform(low, high)
        return np.concatenate([xy, [height], draws.turn(np.pi / 2 - spread, np.pi / 2 + spread)], dtype=np.float32)

    peg = lying([-0.1, -0.3], [0.1, 0.0], radius, np.pi / 3)
    box = lying([-0.05, 0.2], [0.05, 0.4], half_length, np.pi / 8)
    return PegStart(noisy_joints(rng, -np.pi / 4), half_length, radius, centre, peg, box)


class PegInsertionSide(FastSim):
    """PegInsertionSide-v1, `pd_ee_delta_pose`, state observations: the fast step.

    For another peg ManiSkill tears its whole scene down and builds it again. Here only the two bodies that differ are
    built anew, by ManiSkill's own builders, into the scene that is there.
    """

    env_id, control = "PegInsertionSide-v1", "pd_ee_delta_pose"
    camera = ((0.5, -0.5, 0.8), (0.05, -0.1, 0.4))

    def __init__(self, render: bool = False):
        super().__init__(render)
        self._bodies = [self._env.peg._objs[0], self._env.box._objs[0]]

    def reset(self, seed: int) -> np.ndarray:
        start = peg_start(seed)
        self._replace_bodies(start)
        self._physics = renew_physics(self._env)
        self._panda.place(start.joints)
        place_body(self._peg, start.peg)
        self._box.entity_pose = _pose(start.box)
        self._half_size = np.float32([start.half_length, start.radius, start.radius])
        self._hole_radius = np.float32(start.radius + CLEARANCE)
        self._centre = np.float32([0, *start.centre])
        return self._observe()

    def _replace_bodies(self, start: PegStart) -> None:
        """Take the last episode's peg and box out of the scene and put new ones in."""
        import sapien

        scene = self._env.scene.sub_scenes[0]
        for entity in self._bodies:
            scene.remove_entity(entity)
        # What bodies are made of is global, and another task's scene may have set its own since this one was built.
        sapien.physx.set_default_material(**self._env.sim_config.default_materials_config.dict())
        with building(self._can_render):
            self._bodies = [_peg(self._env.scene, start), _box(self._env.scene, start)]
        for entity in self._bodies:
            scene.add_entity(entity)
        self._peg, self._box = (e.find_component_by_type(sapien.physx.PhysxRigidBaseComponent) for e in self._bodies)

    def _hole(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and rotation (4,) of the hole, x along it. Read at every step: physics normalises the box's quaternion."""
        box = self._box.entity_pose
        return box.p + quaternions.rotate(box.q, self._centre), box.q

    def _observe(self) -> np.ndarray:
        peg = self._peg.entity_pose
        parts = (*self._robot_state(), peg.p, peg.q, self._half_size, *self._hole(), [self._hole_radius])
        return np.concatenate(parts, dtype=np.float32)

    def _success(self) -> bool:
        """ManiSkill's rule: the head of the peg is in the hole and at least near its middle."""
        peg = self._peg.entity_pose
        head = peg.p + quaternions.rotate(peg.q, np.float32([self._half_size[0], 0, 0]))
        hole, turn = self._hole()
        x, y, z = quaternions.rotate(quaternions.inverse(turn), head - hole)
        return bool(x >= -DEPTH and abs(y) <= self._hole_radius and abs(z) <= self._hole_radius)


class StockPegInsertionSide(StockSim):
    """The same task through ManiSkill's own step."""

    fast = PegInsertionSide


def _pose(pose: np.ndarray) -> Any:
    import sapien

    return sapien.Pose(pose[:3], pose[3:])


def _peg(scene: Any, start: PegStart) -> Any:
    """The peg, not yet in the scene; its head is orange, its tail white."""
    import sapien

    builder = scene.create_actor_builder()
    builder.set_name("peg")
    builder.add_box_collision(half_size=[start.half_length, start.radius, start.radius])
    for end, colour in ((1, (0.93, 0.45, 0.34, 1.0)), (-1, (0.93, 0.96, 0.98, 1.0))):
        builder.add_box_visual(
            sapien.Pose([end * start.half_length / 2, 0, 0]),
            half_size=[start.half_length / 2, start.radius, start.radius],
            material=sapien.render.RenderMaterial(base_color=colour, roughness=0.5, specular=0.5),
        )
    return builder.build_entity()


def _box(scene: Any, start: PegStart) -> Any:
    """The box with its hole along x, not yet in the scene."""
    from mani_skill.envs.tasks.tabletop.peg_insertion_side import _build_box_with_hole

    outer = depth = start.half_length
    builder = _build_box_with_hole(scene, start.radius + CLEARANCE, outer, depth, center=start.centre)
    builder.set_name("box_with_hole")
    builder.set_physx_body_type("kinematic")
    return builder.build_entity()


PEG_INSERTION_SIDE = TaskSpec(
    name="PegInsertionSide",
    suite="maniskill",
    obs_dim=50,
    act_dim=7,
    max_episode_steps=200,
    control=POSE_CONTROL,
    success_rule="the peg's head is in the hole: no further from its axis than the hole's radius, up and sideways, and past the point "
    "1.5 cm before its middle; ManiSkill 3.0.1 sets no bound on the far side, so a peg pushed through counts too, where the paper's "
    "environment lets the head be at most 7.5 cm beyond the middle",
    absolute_actions=False,
    make=PegInsertionSide,
    summary="A Panda arm must pick up the peg and put it into the hole of the box.",
    joints=9,
    rate=20.0,
    held_actions=(6,),
)
