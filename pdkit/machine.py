"""What this machine can do, asked without importing anything that may be broken: standard library only, for `pdkit doctor` too."""
from __future__ import annotations

import os
from pathlib import Path


def cores() -> int:
    """How many cores this process may use, or, where the system does not tell, how many there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def load_average() -> float:
    """How many processes wanted a processor in the last minute, on average; those of this run among them."""
    return os.getloadavg()[0]


def cpu_has_bf16() -> bool:
    """Whether the CPU multiplies bfloat16 matrices itself, as Linux tells; False where it does not tell (a Mac)."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return any(flag in text for flag in ("avx512_bf16", "amx_bf16"))


# Draws a ball with the backend in MUJOCO_GL.
MUJOCO_DRAWS = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 3"/><geom size=".5"/></worldbody></mujoco>')
data = mujoco.MjData(model); mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64); renderer.update_scene(data)
assert renderer.render().std() > 1, "the picture is empty"
print("draws")
"""

# Draws a box on the first device that can, and prints the device's name. Run in a process of its own, because SAPIEN may
# crash instead of raising where there is no driver.
SAPIEN_DRAWS = """
import sapien
reason = "the picture is empty"
for name in ("cuda", "cpu"):
    try:
        scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(sapien.Device(name))])
        scene.set_ambient_light([1, 1, 1])
        builder = scene.create_actor_builder()
        builder.add_box_visual(half_size=[0.3] * 3)
        builder.build_kinematic().set_pose(sapien.Pose([1, 0, 0]))
        camera = scene.add_camera("camera", 64, 64, 1.0, 0.01, 10.0)
        scene.update_render()
        camera.take_picture()
        if camera.get_picture("Color").std() > 0.01:
            print("draws on", name)
            break
    except RuntimeError as error:
        reason = error
else:
    raise SystemExit(f"SAPIEN finds no device that draws: {reason}")
"""
