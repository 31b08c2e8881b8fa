"""ManiSkill's GPU simulation on a CPU: `with emulated_gpu():` makes `sim_backend="physx_cuda"` simulate each lane in a world of its own.

PhysX for CUDA is replaced: its buffers for the poses of all bodies and the joints of all articulations, and the calls that copy between
these and the simulation; and where ManiSkill looks whether there is a GPU. So its own code for many lanes runs, with its reset masks,
padded joints and arm control, and what it forgets to apply, to update or to fetch is stale here, too. What stays for test_cuda.py: what
PhysX itself does otherwise on a GPU, tensors on the wrong device, and lanes that meet (here each has a world of its own).
"""
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.envs import sapien_env
from mani_skill.envs.utils.system.backend import BackendInfo
from mani_skill.utils.sapien_utils import get_pairwise_contact_impulse
from mani_skill.utils.structs import Articulation, ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct

POSE, LINEAR, ANGULAR = slice(0, 7), slice(7, 10), slice(10, 13)


class Buffer:
    """As SAPIEN's arrays on a GPU."""

    def __init__(self, *shape):
        self._values = torch.full(shape, torch.nan)  # nobody says what a GPU's hold at first

    def torch(self):
        return self._values


class EmulatedSystem:
    """As `sapien.physx.PhysxGpuSystem`, with a world of PhysX for CPUs for each scene."""

    def __init__(self, device=None):
        self.worlds, self.scenes, self._timestep = [], [], 0.01

    timestep = property(lambda self: self._timestep, lambda self, seconds: self._set_timestep(seconds))

    def _set_timestep(self, seconds):
        self._timestep = seconds
        for world in self.worlds:
            world.timestep = seconds

    def set_scene_offset(self, scene, offset):
        """Worlds of their own need not lie apart."""

    def gpu_init(self):
        self.links = [body for world in self.worlds for body in world.articulation_link_components]
        self.free = [body for world in self.worlds for body in world.rigid_dynamic_components]
        self.bodies = self.free + self.links
        self.articulations = [link.articulation for link in self.links if link.is_root]
        self.row = {body: row for row, body in enumerate(self.bodies)}
        self.number = {articulation: number for number, articulation in enumerate(self.articulations)}
        self.cuda_rigid_body_data = Buffer(len(self.bodies), 13)
        most = max((articulation.dof for articulation in self.articulations), default=0)
        for name in ("qpos", "qvel", "qacc", "qf", "target_qpos", "target_qvel"):
            setattr(self, f"cuda_articulation_{name}", Buffer(len(self.articulations), most))
        for name in ("target_qpos", "target_qvel"):
            self._joints(name).zero_()
        self._lay_floors()
        self.step()  # as a GPU's does
        self._fetch_bodies(self.bodies)

    def _lay_floors(self):
        """ManiSkill gives the first lane alone a floor, because on a GPU all lanes stand on it."""
        floors = [shape for body in self.worlds[0].rigid_static_components for shape in body.collision_shapes]
        for scene in self.scenes[1:]:
            floor = sapien.physx.PhysxRigidStaticComponent()
            for shape in floors:
                copy = sapien.physx.PhysxCollisionShapePlane(shape.physical_material)
                copy.set_local_pose(shape.local_pose)
                copy.set_collision_groups(shape.collision_groups)
                floor.attach(copy)
            entity = sapien.Entity()
            entity.add_component(floor)
            scene.add_entity(entity)

    def step(self):
        for world in self.worlds:
            world.step()
        self.gpu_update_articulation_kinematics()

    def gpu_create_contact_pair_impulse_query(self, pairs):
        return SimpleNamespace(pairs=pairs, cuda_impulses=Buffer(len(pairs), 3))

    def gpu_query_contact_pair_impulses(self, query):
        """By how much the first body of each pair is pushed by the second, N s."""
        contacts = [contact for world in self.worlds for contact in world.get_contacts()]
        for row, (one, other) in enumerate(query.pairs):
            impulse = get_pairwise_contact_impulse(contacts, one.entity, other.entity)
            query.cuda_impulses.torch()[row] = torch.from_numpy(impulse)

    # ---- from the buffers to the simulation ----

    def gpu_apply_rigid_dynamic_data(self):
        for body in self.free:
            values = self._row(body)
            body.entity.pose = sapien.Pose(values[:3], values[3:7])
            if not body.kinematic:
                body.linear_velocity, body.angular_velocity = values[LINEAR], values[ANGULAR]

    def gpu_apply_articulation_root_pose(self):
        for articulation in self.articulations:
            values = self._row(articulation.root)
            articulation.set_root_pose(sapien.Pose(values[:3], values[3:7]))

    def gpu_apply_articulation_root_velocity(self):
        for articulation in self.articulations:
            values = self._row(articulation.root)
            articulation.set_root_linear_velocity(values[LINEAR])
            articulation.set_root_angular_velocity(values[ANGULAR])

    def gpu_apply_articulation_qpos(self):
        self._apply("qpos")

    def gpu_apply_articulation_qvel(self):
        self._apply("qvel")

    def gpu_apply_articulation_qf(self):
        self._apply("qf")

    def gpu_apply_articulation_target_position(self):
        self._apply_targets("target_qpos", "set_drive_target")

    def gpu_apply_articulation_target_velocity(self):
        self._apply_targets("target_qvel", "set_drive_velocity_target")

    def gpu_update_articulation_kinematics(self):
        """On a CPU links follow their joints at once; what is fetched follows only then."""
        self._poses = {link: link.entity_pose for link in self.links}

    def _apply(self, name):
        for number, articulation in enumerate(self.articulations):
            getattr(articulation, f"set_{name}")(self._joints(name)[number, : articulation.dof].numpy())

    def _apply_targets(self, name, method):
        for number, articulation in enumerate(self.articulations):
            for joint, target in zip(articulation.active_joints, self._joints(name)[number].numpy(), strict=False):
                getattr(joint, method)(target)

    # ---- from the simulation to the buffers ----

    def gpu_fetch_rigid_dynamic_data(self):
        self._fetch_bodies(self.free)

    def gpu_fetch_articulation_link_pose(self):
        self._fetch_bodies(self.links, POSE)

    def gpu_fetch_articulation_link_velocity(self):
        self._fetch_bodies(self.links, slice(7, 13))

    def gpu_fetch_articulation_qpos(self):
        self._fetch("qpos")

    def gpu_fetch_articulation_qvel(self):
        self._fetch("qvel")

    def gpu_fetch_articulation_qacc(self):
        self._fetch("qacc")

    def gpu_fetch_articulation_target_qpos(self):
        """Nobody but the buffers sets targets."""

    gpu_fetch_articulation_target_qvel = gpu_fetch_articulation_target_qpos

    def _fetch(self, name):
        for number, articulation in enumerate(self.articulations):
            self._joints(name)[number, : articulation.dof] = torch.from_numpy(getattr(articulation, name))

    def _fetch_bodies(self, bodies, columns=slice(0, 13)):
        for body in bodies:
            pose = self._poses.get(body) or body.entity_pose
            values = np.concatenate([pose.p, pose.q, body.linear_velocity, body.angular_velocity])
            self.cuda_rigid_body_data.torch()[self.row[body], columns] = torch.from_numpy(values[columns])

    def _joints(self, name):
        return getattr(self, f"cuda_articulation_{name}").torch()

    def _row(self, body):
        return self.cuda_rigid_body_data.torch()[self.row[body]].numpy()


class EmulatedScene(sapien.Scene):
    """A scene in a world of its own that an EmulatedSystem leads."""

    def __init__(self, systems=None):
        self._leader = next((system for system in systems or () if isinstance(system, EmulatedSystem)), None)
        if self._leader is None:
            super().__init__(systems)
        else:
            self._leader.worlds.append(sapien.physx.PhysxCpuSystem())
            self._leader.scenes.append(self)
            super().__init__(self._leader.worlds[-1:])

    @property
    def physx_system(self):
        return self._leader or super().physx_system


def _backend(sim_backend, render_backend, original=sapien_env.parse_sim_and_render_backend):
    if sim_backend != "physx_cuda":
        return original(sim_backend, render_backend)
    return BackendInfo(torch.device("cpu"), SimpleNamespace(is_cuda=lambda: True), "physx_cuda", None, "none")


def _arm_control(kinematics, original=Kinematics._setup_cpu):
    together = kinematics.articulation.scene.gpu_sim_enabled
    kinematics._setup_gpu() if together else original(kinematics)


def _rows(kind, name, where, what):
    """Where a struct's bodies or articulations (`what`) lie in the buffers, which ManiSkill asks of SAPIEN's objects."""
    original = getattr(kind, name).func

    def rows(struct):
        if not isinstance(struct.px, EmulatedSystem):
            return original(struct)
        return torch.tensor([getattr(struct.px, where)[one] for one in getattr(struct, what)], dtype=torch.int32)

    return patch.object(kind, name, property(rows))


@contextmanager
def emulated_gpu():
    """Within this block ManiSkill finds a GPU that can simulate (but not draw)."""
    with (
        patch.object(sapien.physx, "PhysxGpuSystem", EmulatedSystem),
        patch.object(sapien, "Scene", EmulatedScene),
        patch.object(sapien_env, "parse_sim_and_render_backend", _backend),
        patch.object(Kinematics, "_setup_cpu", _arm_control),
        _rows(PhysxRigidBodyComponentStruct, "_body_data_index", "row", "_bodies"),
        _rows(Articulation, "_data_index", "number", "_objs"),
        _rows(ArticulationJoint, "_data_index", "number", "_physx_articulations"),
    ):
        yield
