"""TurnFaucet as a stock ManiSkill 3 environment. Imports the simulator, so it is itself imported only when one is built.

ManiSkill 3.0.1 has a TurnFaucet-v1 that was not finished: the arm starts inside the faucet, and the handle is never turned back.
This environment takes its observation and its success rule, and start poses, joints' friction and damping from ManiSkill 2.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.tasks.tabletop.turn_faucet import TurnFaucetEnv
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs.pose import Pose

from .faucet_assets import Faucet

ENV_ID = "pdkit-TurnFaucet"
BASE = (-0.56, 0.0, 0.0)  # where the robot stands, metres
REST = (0, -0.785, 0, -2.356, 0, 1.57, 0.785, 0, 0)  # joint positions, the gripper closed


@dataclass(frozen=True)
class FaucetStart:
    """Everything that the seed of an episode decides."""

    model: int  # which of the faucets
    switch: int  # which of its handles
    place: np.ndarray  # (2,) on the table, metres
    yaw: float  # radians
    joints: np.ndarray  # (9,) float32

    def pose(self, faucet: Faucet) -> sapien.Pose:
        """The faucet's, a centimetre over the table as in ManiSkill."""
        turn = [np.cos(self.yaw / 2), 0, 0, np.sin(self.yaw / 2)]
        return sapien.Pose([*self.place, faucet.height + 0.01], turn)


def faucet_start(seed: int, models: tuple[Faucet, ...]) -> FaucetStart:
    """Where and with what the episode of `seed` starts: ManiSkill 2's distributions."""
    rng = np.random.RandomState(seed)
    model = rng.randint(len(models))
    switch = rng.randint(len(models[model].switches))
    place, yaw = rng.uniform(-0.05, 0.05, 2), rng.uniform(-np.pi / 12, np.pi / 12)
    joints = np.float32(REST)
    joints[:7] += rng.normal(0, 0.02, 7).astype(np.float32)
    return FaucetStart(model, switch, place, yaw, joints)


def load_faucet(scene: Any, faucet: Faucet) -> Any:
    """Build a faucet into a ManiSkill scene; its `Articulation`. Friction and damping of the joints are ManiSkill 2's."""
    loader = scene.create_urdf_loader()
    loader.name, loader.scale, loader.fix_root_link = faucet.model.name, faucet.scale, True
    loader.load_multiple_collisions_from_file = True
    loader.set_material(1, 1, 0)
    loader.set_density(faucet.density)
    with faucet.model.file() as path:
        builder = loader.parse(path)["articulation_builders"][0]
    builder.initial_pose = sapien.Pose([0, 0, faucet.height])
    built = builder.build(name=faucet.model.name)
    for joint in built.active_joints:
        joint.set_friction(1.0)
        joint.set_drive_properties(0, 10.0)
    for name in faucet.switches:
        built.links_map[name].joint.set_friction(0.1)
        built.links_map[name].joint.set_drive_properties(0, 2.0)
    if scene.can_render():
        sapien_utils.set_articulation_render_material(built._objs[0], color=[0.67, 0.67, 0.67, 1], metallic=1, roughness=0.4)
    return built


@register_env(ENV_ID, override=True)
class FaucetEnv(TurnFaucetEnv):
    """One faucet after another out of `models`."""

    def __init__(self, *args: Any, models: tuple[Faucet, ...], **kwargs: Any):
        self._models = models
        super().__init__(*args, robot_uids="panda", **kwargs)

    def _load_scene(self, options: dict) -> None:
        self.scene_builder = TableSceneBuilder(self)
        self.scene_builder.build()
        self.start = faucet_start(int(self._episode_seed[0]), self._models)
        model = self._models[self.start.model]
        self.faucet = load_faucet(self.scene, model)
        self.target_switch_link = self.faucet.links_map[model.switches[self.start.switch]]
        low, high = self.target_switch_link.joint.get_limits()[0]
        self.init_angle = torch.zeros(1) if torch.isinf(low) else low[None]
        self.target_angle = torch.full((1,), torch.pi / 2) if torch.isinf(high) else (low + (high - low) * 0.9)[None]
        self.target_angle_diff = self.target_angle - self.init_angle

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.scene_builder.initialize(env_idx)
        self.agent.reset(self.start.joints)
        self.agent.robot.set_pose(sapien.Pose(BASE))
        self.faucet.set_pose(self.start.pose(self._models[self.start.model]))
        joints = self.faucet.get_qpos() * 0
        joints[0, self.target_switch_link.joint.active_index] = self.init_angle
        self.faucet.set_qpos(joints)
        link = self.target_switch_link
        self.target_link_pos = (link.pose * link.cmass_local_pose).p
        self.target_joint_axis = Pose.create(link.joint.get_global_pose()).to_transformation_matrix()[:, :3, 0]
