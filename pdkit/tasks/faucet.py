"""TurnFaucet: push a handle of a faucet round to nine tenths of its range; every episode another faucet and place."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from .faucet_assets import faucets
from .maniskill import POSE_CONTROL, FastSim, StockSim, building, renew_physics
from .maniskill_headless import make_env, quiet
from .spec import TaskSpec


@dataclass(frozen=True)
class HandleView:
    """The handle that is to be turned, as it stands now; more than the observation shows. World coordinates, metres."""

    corners: np.ndarray  # (N, 3) of its collision shapes, in an order that stays
    origin: np.ndarray  # (3,) a point on its axis
    axis: np.ndarray  # (3,) unit; it turns anticlockwise about it


class TurnFaucet(FastSim):
    """TurnFaucet after ManiSkill 2, `pd_ee_delta_pose`, state observations: the fast step, on the novel faucets.

    A faucet is built into the scene when an episode first needs it and taken out while another is there.
    """

    control = "pd_ee_delta_pose"
    camera = ((0.5, 0.45, 0.5), (-0.15, 0.0, 0.22))
    novel: ClassVar[bool] = True

    def __init__(self, render: bool = False):
        super().__init__(render)
        self.models = faucets(self.novel)
        self._model, faucet = self._env.starts[0].model, self._env.faucets[0]
        self._built = {self._model: faucet}  # number of a faucet: ManiSkill's articulation
        self._entities = {self._model: _entities(faucet)}  # SAPIEN forgets one that is in no scene and in no hand

    @classmethod
    def build(cls, render: bool, **options: Any) -> Any:
        models = faucets(cls.novel)
        with quiet():
            from .faucet_env import ENV_ID
        return make_env(ENV_ID, cls.control, cls.camera if render else None, models=models, **options)

    def reset(self, seed: int) -> np.ndarray:
        from .faucet_env import faucet_start

        start = faucet_start(seed, self.models)
        model = self.models[start.model]
        self._use(start.model)
        self._physics = renew_physics(self._env)
        self._panda.place(start.joints)
        faucet = self._built[start.model]
        self._faucet, link = faucet._objs[0], faucet.links_map[model.switches[start.switch]]
        self._link, self._joint = link._objs[0], link.joint._objs[0]
        self._index = self._faucet.active_joints.index(self._joint)
        self._aim()
        joints = np.zeros(self._faucet.dof, np.float32)
        joints[self._index] = self._first_angle
        self._faucet.set_root_pose(start.pose(model))
        self._faucet.set_qpos(joints)
        self._faucet.set_qvel(np.zeros_like(joints))
        self._look(link)
        return self._observe()

    def _use(self, number: int) -> None:
        """Take the last episode's faucet out of the scene and put this one in."""
        from .faucet_env import load_faucet

        scene = self._env.scene.sub_scenes[0]
        for entity in self._entities[self._model]:
            scene.remove_entity(entity)
        if number in self._built:
            for entity in self._entities[number]:
                scene.add_entity(entity)
        else:
            with building(self._can_render):
                self._built[number] = load_faucet(self._env.scene, self.models[number])
            self._entities[number] = _entities(self._built[number])
        self._model = number

    def _aim(self) -> None:
        """The handle's angles at the start and at success, radians: ManiSkill 2's rule."""
        low, high = self._joint.limit[0]
        self._first_angle = np.float32(0) if np.isinf(low) else low
        self._target_angle = np.float32(np.pi / 2) if np.isinf(high) else low + (high - low) * np.float32(0.9)

    def _look(self, link: Any) -> None:
        """Where the handle and its axis are at the start, which the observation shows all along; ManiSkill's own arithmetic."""
        from mani_skill.utils.structs.pose import Pose

        self._link_position = (link.pose * link.cmass_local_pose).p[0].numpy()
        self._axis = Pose.create(link.joint.get_global_pose()).to_transformation_matrix()[0, :3, 0].numpy()

    def _observe(self) -> np.ndarray:
        span, left = self._target_angle - self._first_angle, self._target_angle - self._faucet.qpos[self._index]
        return np.concatenate((*self._robot_state(), [span], self._axis, self._link_position, [left]), dtype=np.float32)

    def _success(self) -> bool:
        """ManiSkill 2's rule: the handle has been turned beyond nine tenths of its range."""
        return bool(self._target_angle - self._faucet.qpos[self._index] < 0)

    def handle(self) -> HandleView:
        """The handle now, for a scripted expert."""
        pose, joint = self._link.entity_pose, self._link.entity_pose * self._joint.pose_in_child
        to_world = pose.to_transformation_matrix()
        corners = np.concatenate([_corners(shape) for shape in self._link.collision_shapes])
        return HandleView(corners @ to_world[:3, :3].T + to_world[:3, 3], joint.p, joint.to_transformation_matrix()[:3, 0])


class TurnFaucetSource(TurnFaucet):
    """The same task on the source faucets."""

    novel = False


class StockTurnFaucet(StockSim):
    """The task on the novel faucets through ManiSkill's own step."""

    fast = TurnFaucet


class StockTurnFaucetSource(StockSim):
    """The task on the source faucets through ManiSkill's own step."""

    fast = TurnFaucetSource


def _entities(faucet: Any) -> list[Any]:
    return [link.entity for link in faucet._objs[0].links]


def _corners(shape: Any) -> np.ndarray:
    """Corners (N, 3) of a collision shape, a box or a convex mesh, in its link's frame, metres."""
    if hasattr(shape, "half_size"):
        corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T * shape.half_size
    else:
        corners = shape.vertices * shape.scale
    to_link = shape.local_pose.to_transformation_matrix()
    return corners @ to_link[:3, :3].T + to_link[:3, 3]


def _spec(name: str, make: type[TurnFaucet], which: str, **options: str) -> TaskSpec:
    return TaskSpec(
        name=name,
        suite="maniskill",
        obs_dim=40,
        act_dim=7,
        max_episode_steps=200,
        control=POSE_CONTROL,
        success_rule="the handle has been turned beyond nine tenths of its range (ManiSkill 2's rule)",
        absolute_actions=False,
        make=make,
        summary=f"A Panda arm must push the handle of a faucet round; {which}.",
        joints=9,
        rate=20.0,
        own_objects=True,
        held_actions=(6,),
        **options,
    )


TURN_FAUCET_SOURCE = _spec("TurnFaucetSource", TurnFaucetSource, "the 10 faucets of the demonstrations")
TURN_FAUCET = _spec("TurnFaucet", TurnFaucet, "3 faucets that no demonstration shows", demo_task="TurnFaucetSource")
