"""PushChair as a stock ManiSkill 3 environment: the dual-arm mobile Panda, the floor, one swivel chair.

ManiSkill 3 has no PushChair. This one follows ManiSkill 2 (`mani_skill2/envs/ms1/push_chair.py`, `agents/robots/mobile_panda.py`)
with the rule for "static" of the paper's PushChair-v2. The robot's description is the one in mani-skill's wheel. `chair.py` drives
the same scene without torch. Importing this module imports ManiSkill.
"""
from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDBaseVelControllerConfig, PDJointPosMimicControllerConfig, PDJointVelControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_axis_angle
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Articulation, Pose
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig

from ..errors import PdkitError
from .chair_assets import SCALE, Chair
from .chair_body import CLOSE, HZ, ROOM, STILL, UPRIGHT, ChairBody, chair_start, set_frictions
from .maniskill import building
from .mobile_panda import ACTING, BASE_JOINTS, CONTROL, FINGERS, SIDES, TIP_JOINTS, arm_joints, finger_joints, first_joints, joint_order
from .partnet import link_parts

NAME = "PdkitPushChair-v1"
TORSO, SEAT = 30, 31  # bits of collision groups that ignore each other: torso and floor, seat and foot


@register_agent()
class MobilePandaDualArm(BaseAgent):
    """Two Panda arms on a torso that rolls in any direction, turns and rises; every joint but the fingers is velocity-controlled."""

    uid = "pdkit_mobile_panda_dual_arm"
    urdf_path = f"{PACKAGE_ASSET_DIR}/robots/panda/mobile_panda_dual_arm.urdf"
    disable_self_collisions = True
    urdf_config = dict(
        _materials=dict(gripper=dict(static_friction=2.0, dynamic_friction=2.0, restitution=0.0)),
        link={f"{side}_panda_{finger}finger": dict(material="gripper", patch_radius=0.1, min_patch_radius=0.1)
              for side in SIDES for finger in ("left", "right")},
    )

    @property
    def _controller_configs(self) -> dict[str, Any]:
        reach = [0.5, 0.5, 3.14, 0.5]
        parts = dict(base=PDBaseVelControllerConfig(
            list(BASE_JOINTS), lower=[-value for value in reach], upper=reach, damping=1000, force_limit=500))
        for side in ACTING:
            first, second = finger_joints(side)
            parts[f"{side}_arm"] = PDJointVelControllerConfig(arm_joints(side), lower=-3.14, upper=3.14, damping=100, force_limit=100)
            parts[f"{side}_gripper"] = PDJointPosMimicControllerConfig(
                [first, second], lower=-0.01, upper=0.04, stiffness=1e3, damping=1e2, force_limit=100, mimic={second: dict(joint=first)})
        return {CONTROL: parts}


@contextmanager
def _drawn_description() -> Iterator[None]:
    """Within this block the robot is described with meshes that can be drawn: the wheel's URDF names .dae files, and has .glb ones."""
    folder, original = Path(MobilePandaDualArm.urdf_path).parent, MobilePandaDualArm.urdf_path
    text = Path(original).read_text().replace(".dae", ".glb").replace('filename="', f'filename="{folder}/')
    with tempfile.TemporaryDirectory() as temporary:
        MobilePandaDualArm.urdf_path = f"{temporary}/drawn.urdf"
        Path(MobilePandaDualArm.urdf_path).write_text(text)
        try:
            yield
        finally:
            MobilePandaDualArm.urdf_path = original


@register_env(NAME, max_episode_steps=200)
class PushChairEnv(BaseEnv):
    """Push the chair to the origin. Each lane has the one out of `chairs`, with those frictions, which the seed says that its scene was
    built for.

    On a CPU there is one lane, and its scene is built anew for every episode. On a GPU episodes start where `reset` is told that they do,
    by states (batched.py).
    """

    SUPPORTED_ROBOTS = [MobilePandaDualArm.uid]
    SUPPORTED_REWARD_MODES = ("sparse", "none")

    def __init__(self, *args: Any, chairs: Sequence[Chair], reconfiguration_freq: int = 1, **kwargs: Any):
        self.chairs, self._drawn = chairs, kwargs.get("render_backend") != "none"
        super().__init__(*args, robot_uids=MobilePandaDualArm.uid, reconfiguration_freq=reconfiguration_freq, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=100, control_freq=HZ, spacing=24,  # metres between lanes on a GPU, which could meet: in 10 s a base gets 9.5 m far
            scene_config=SceneConfig(solver_position_iterations=15),
            default_materials_config=DefaultMaterialsConfig(static_friction=0.5, dynamic_friction=0.5, restitution=0))

    def _reconfigure(self, options: dict) -> None:
        with building(self._drawn):
            super()._reconfigure(options)

    def _load_agent(self, options: dict) -> None:
        with _drawn_description() if self._drawn else nullcontext():
            super()._load_agent(options, sapien.Pose())
        self.agent.robot.links_map["adjustable_body"].set_collision_group_bit(2, TORSO, 1)
        self.order = joint_order(self.agent.robot)

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene).set_collision_group_bit(2, TORSO, 1)  # the torso's box reaches into the floor
        self.starts = [chair_start(int(seed), len(self.chairs)) for seed in self._episode_seed]
        self.built = [self._build(self.chairs[start.chair], lane) for lane, start in enumerate(self.starts)]
        self.chair = Articulation.merge(self.built, name="chair")
        self.add_to_state_dict_registry(self.chair)
        for built, start in zip(self.built, self.starts, strict=True):
            chair = self.chairs[start.chair]
            seat = self._prepare_links(built, chair)
            if self.gpu_sim_enabled:
                set_frictions(built._objs[0].active_joints, start)
            else:
                self.body = ChairBody(built._objs[0], chair, seat)

    def _build(self, chair: Chair, lane: int) -> Articulation:
        loader = self.scene.create_urdf_loader()
        loader.name, loader.scale, loader.fix_root_link, loader.load_multiple_collisions_from_file = f"chair-{lane}", SCALE, False, True
        loader.set_material(0.1, 0.1, 0)
        loader.set_density(200)
        with chair.model.file() as path:
            builder = loader.parse(path)["articulation_builders"][0]
        # A GPU simulates a step when its scene is set up, and the robot stands at the origin then.
        builder.initial_pose = sapien.Pose(np.add(chair.position, (2.0 * self.gpu_sim_enabled, 0, 0)), chair.rotation)
        builder.set_scene_idxs([lane])
        built = builder.build(fix_root_link=False)
        self.remove_from_state_dict_registry(built)
        return built

    def _prepare_links(self, built: Articulation, chair: Chair) -> Any:
        """Wheels that grip and a seat that does not collide with its foot, as in ManiSkill 2; the seat's link, SAPIEN's."""
        links, parts = built.links_map, link_parts(chair.model.urdf)
        if not any("seat" in named for named in parts.values()):
            raise PdkitError(f"Chair {chair.model.name} has no part called seat; put PartNet-Mobility's own description there.")
        seats = [link for name, link in links.items() if "seat" in parts[name]]
        feet = [link for name, link in links.items() if "leg" in parts[name] or "foot" in parts[name]]
        if seats[0] not in feet:
            for link in (seats[0], *feet):
                link.set_collision_group_bit(2, SEAT, 1)
        grip = sapien.physx.PhysxMaterial(1, 1, 0)
        for name, link in links.items():
            if "wheel" in parts[name]:
                for shape in link._objs[0].collision_shapes:
                    shape.physical_material = grip
        return seats[0]._objs[0]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        if not self.gpu_sim_enabled:
            self.body.place(self.starts[0])
            self.agent.reset(first_joints(self.starts[0].base, self.order))
        self._now = self.chair.pose

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Judges a step: the chair's motion is measured from one call to the next, so call it once a step as `step` does."""
        before, self._now = self._now, self.chair.pose
        tilt = torch.arccos(self._now.to_transformation_matrix()[:, 2, 2].clip(-1, 1))
        moved = torch.linalg.norm(self._now.p - before.p, dim=1)
        turned = torch.linalg.norm(quaternion_to_axis_angle((before.inv() * self._now).q), dim=1)
        turned = torch.minimum(turned, 2 * torch.pi - turned)
        verdicts = dict(
            chair_close=torch.linalg.norm(self._now.p[:, :2], dim=1) < CLOSE,
            chair_standing=tilt < UPRIGHT,
            chair_static=(moved <= STILL[0] / HZ) & (turned <= STILL[1] / HZ),
        )
        return verdicts | dict(success=torch.stack(list(verdicts.values())).all(dim=0))

    def _get_obs_agent(self) -> dict[str, torch.Tensor]:
        qpos, qvel = self.agent.robot.qpos[:, self.order], self.agent.robot.qvel[:, self.order]
        return dict(qpos=qpos[:, 3:], qvel=qvel[:, 3:], base=qpos[:, :3], base_velocity=qvel[:, :3])

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        fingers = torch.cat([self.agent.robot.links_map[name].linear_velocity for name in FINGERS], dim=1)
        if self.gpu_sim_enabled:
            return dict(chair=self._chair_state(), finger_places=self._tips(), finger_velocities=fingers)
        # With SAPIEN's roundings, as the fast step has them.
        joints = self.agent.robot.joints_map
        tips = [(joints[name]._objs[0].global_pose * sapien.Pose([0, along, 0])).p for name, along in TIP_JOINTS]
        return dict(chair=torch.from_numpy(self.body.state())[None], finger_places=torch.tensor(np.concatenate(tips))[None],
                    finger_velocities=fingers)

    def _chair_state(self) -> torch.Tensor:
        """As `ChairBody.state`, of all lanes: (N, 63)."""
        root, joints = self.chair.root, (self.chair.qpos, self.chair.qvel)
        padded = [torch.nn.functional.pad(values, (0, ROOM - values.shape[1])) for values in joints]
        return torch.cat([root.pose.raw_pose, root.linear_velocity, root.angular_velocity, *padded], dim=1)

    def _tips(self) -> torch.Tensor:
        """Places of the finger tips of all lanes: (N, 12)."""
        joints = self.agent.robot.joints_map
        along = torch.tensor([[0, along, 0] for _, along in TIP_JOINTS], dtype=torch.float32, device=self.device)
        return torch.cat([(joints[name].global_pose * Pose.create_from_pq(p=here)).p
                          for (name, _), here in zip(TIP_JOINTS, along, strict=True)], dim=1)
