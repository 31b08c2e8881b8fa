"""Drawing ManiSkill simulations: cameras are added to the scene that is there, so that physics does not notice them.

Base cameras stand where ManiSkill 3's environments have theirs. The hand camera and the three on PushChair's mast are ManiSkill 2's
(`mani_skill2/agents/configs`), which the paper used: 90 degrees of view for base and hand, 60 up and down for the mast's.
"""
from __future__ import annotations

from typing import Any

import numpy as np

from .cameras import View

UNITS = 1024  # of a distance, to a metre, as ManiSkill 2 stores it (facts.md 2.2: the encoder sees depth / 1024)
HAND = ([0.0464982, -0.0200011, 0.0360011], [0, 0.70710678, 0, 0.70710678])  # in the frame of the hand: along the fingers
REALSENSE = "camera_link"  # the link of the camera on the hand: 425,160 triangles, three quarters of the scene's, for a pixel or two
GRAIN = 0.002  # metres; pixels are 15 times as wide where the base camera sees that link
MAST = 1.5  # metres over the floor
MAST_TURNS = ([0.9238795, 0, 0.3826834, 0], [0.46193977, 0.33141357, 0.19134172, -0.80010315],
              [-0.46193977, 0.33141357, -0.19134172, -0.80010315])  # 120 degrees apart, 45 degrees down


class SapienEyes:
    """The cameras of one simulation; `look` draws what they see now.

    `sim` was made with render=True. PushChair has a scene for each chair: each gets its cameras when it is first looked at.
    """

    def __init__(self, view: View, sim: Any):
        self._view, self._sim = view, sim
        self._cameras: dict[int, list[Any]] = {}  # by the scene's environment

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """Colours (3 k, height, width) uint8 of k cameras, one camera after the other, and distances (k, height, width) uint16
        in units of 1/1024 metre; 0 where there is nothing."""
        env = self._sim._env
        if id(env) not in self._cameras:
            _coarsen_realsense(env)
            self._cameras[id(env)] = [_camera(env, self._view, name) for name in self._view.cameras]
        env.scene.sub_scenes[0].update_render()
        colours, distances = [], []
        for camera in self._cameras[id(env)]:
            camera.take_picture()
            colours.append(camera.get_picture("Color")[..., :3].transpose(2, 0, 1))
            distances.append(-camera.get_picture("PositionSegmentation")[..., 2].astype(np.float32) / 1000 * UNITS)  # millimetres, z < 0
        return np.concatenate(colours), np.stack(distances).clip(0, 65535).round().astype(np.uint16)


def coarser(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, grain: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh with one vertex for all those of a cube of `grain` metres: their mean place and direction.

    Vertices and normals (m, 3) float32, triangles (n, 3) uint32, there and back; triangles that have shrunk to a line are left out.
    """
    _, cube = np.unique(np.round(vertices / grain).astype(np.int64), axis=0, return_inverse=True)
    cube = cube.ravel()
    sums = np.stack([np.bincount(cube, column) for column in np.concatenate([vertices, normals], axis=1).T], axis=1)
    places, directions = sums[:, :3] / np.bincount(cube)[:, None], sums[:, 3:]
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    corners = cube[triangles]
    first = corners.argmin(axis=1)[:, None]  # the smallest comes first, so that a triangle's turned copies are the same
    corners = np.unique(np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1), axis=0)
    kept = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return places.astype(np.float32), corners[kept].astype(np.uint32), directions.astype(np.float32)


def _coarsen_realsense(env: Any) -> None:
    """Draw the hand's RealSense, where there is one, with a fiftieth of its triangles: without a GPU most of a frame's time is theirs."""
    import sapien

    link = env.agent.robot.links_map.get(REALSENSE)
    if link is None:
        return
    entity = link._objs[0].entity
    fine, coarse = entity.find_component_by_type(sapien.render.RenderBodyComponent), sapien.render.RenderBodyComponent()
    for shape in fine.render_shapes:
        for part in shape.parts:
            vertices, triangles, normals = coarser(part.vertices, part.triangles, part.get_vertex_normal(), GRAIN)
            untextured = np.zeros((len(vertices), 2), np.float32)
            drawn = sapien.render.RenderShapeTriangleMesh(vertices, triangles, normals, untextured, part.material)
            drawn.local_pose = shape.local_pose
            coarse.attach(drawn)
    entity.remove_component(fine)
    entity.add_component(coarse)


def _camera(env: Any, view: View, name: str) -> Any:
    """A camera of this name, in the scene."""
    import sapien
    from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS, set_shader_pack

    set_shader_pack(PREBUILT_SHADER_CONFIGS["minimal"])  # colours as bytes, places in millimetres: ManiSkill's choice for observations
    camera = sapien.render.RenderCameraComponent(view.width, view.height)
    mast = name.startswith("mast")
    camera.set_fovy(np.pi / 3 if mast else np.pi / 2, compute_x=True)
    camera.near, camera.far = (0.1, 10.0) if mast else (0.01, 100.0)
    links = env.agent.robot.links_map
    if name == "base":
        config, holder = env._default_sensor_configs[0], sapien.Entity()
        holder.add_component(camera)
        holder.set_pose(config.pose.sp)
        env.scene.sub_scenes[0].add_entity(holder)
        return camera
    place, turn = ([0, 0, MAST], MAST_TURNS[int(name[-1]) - 1]) if mast else HAND
    camera.set_local_pose(sapien.Pose(place, turn))
    links["mobile_base" if mast else "panda_hand"]._objs[0].entity.add_component(camera)
    return camera
