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
from mani_skill.utils.structs import Articulation, Link
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


def load_faucet(scene: Any, faucet: Faucet, lane: int = 0) -> Any:
    """Build a faucet into that lane of a ManiSkill scene; its `Articulation`. Friction and damping of the joints are ManiSkill 2's."""
    loader = scene.create_urdf_loader()
    loader.name, loader.scale, loader.fix_root_link = faucet.model.name, faucet.scale, True
    loader.load_multiple_collisions_from_file = True
    loader.set_material(1, 1, 0)
    loader.set_density(faucet.density)
    with faucet.model.file() as path:
        builder = loader.parse(path)["articulation_builders"][0]
    builder.initial_pose = sapien.Pose([0, 0, faucet.height])
    builder.set_scene_idxs([lane])
    built = builder.build(name=f"{faucet.model.name}-{lane}")
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
    """Each lane has the one out of `models`, and is to turn that handle, which the seed says that its scene was built for.

    On a CPU there is one lane, and its scene is built anew for every episode.
    """

    def __init__(self, *args: Any, models: tuple[Faucet, ...], **kwargs: Any):
        self.models = models
        super().__init__(*args, robot_uids="panda", **kwargs)

    def _load_scene(self, options: dict) -> None:
        self.scene_builder = TableSceneBuilder(self)
        self.scene_builder.build()
        self.starts = [faucet_start(int(seed), self.models) for seed in self._episode_seed]
        self.faucets, handles = [], []
        for lane, start in enumerate(self.starts):
            model = self.models[start.model]
            self.faucets.append(load_faucet(self.scene, model, lane))
            self.remove_from_state_dict_registry(self.faucets[-1])
            handles.append(self.faucets[-1].links_map[model.switches[start.switch]])
        self.faucet = Articulation.merge(self.faucets, name="faucet")
        self.add_to_state_dict_registry(self.faucet)
        self.target_switch_link = Link.merge(handles, name="switch")
        low, high = self.target_switch_link.joint.get_limits().unbind(dim=-1)
        self.init_angle = torch.where(low.isinf(), 0.0, low)
        self.target_angle = torch.where(high.isinf(), torch.pi / 2, low + (high - low) * 0.9)
        self.target_angle_diff = self.target_angle - self.init_angle
        self.first_angles = torch.zeros((self.num_envs, self.faucet.max_dof), device=self.device)  # of all joints when an episode starts
        self.first_angles[torch.arange(self.num_envs, device=self.device), self.target_switch_link.joint.active_index] = self.init_angle
        self.target_link_pos, self.target_joint_axis = torch.zeros((2, self.num_envs, 3), device=self.device)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        lanes = env_idx.tolist()
        self.scene_builder.initialize(env_idx)
        self.agent.reset(np.stack([self.starts[lane].joints for lane in lanes]))
        self.agent.robot.set_pose(sapien.Pose(BASE))
        poses = [start.pose(self.models[start.model]) for start in self.starts]
        self.faucet.set_pose(Pose.create(torch.tensor(np.stack([[*poses[lane].p, *poses[lane].q] for lane in lanes]), device=self.device)))
        self.faucet.set_qpos(self.first_angles[env_idx])
        if self.gpu_sim_enabled:  # links follow their joints only then
            self.scene._gpu_apply_all()
            self.scene.px.gpu_update_articulation_kinematics()
            self.scene._gpu_fetch_all()
        self._look(env_idx)

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """As an episode's start: the observation goes on to show where the handles are now."""
        super().set_state_dict(state, env_idx)
        self._look(torch.arange(self.num_envs) if env_idx is None else env_idx)

    def _look(self, env_idx: torch.Tensor) -> None:
        """Where handles and their axes are at the start, which the observation shows all along."""
        link = self.target_switch_link
        self.target_link_pos[env_idx] = (link.pose * link.cmass_local_pose).p[env_idx]
        self.target_joint_axis[env_idx] = Pose.create(link.joint.get_global_pose()).to_transformation_matrix()[env_idx, :3, 0]
