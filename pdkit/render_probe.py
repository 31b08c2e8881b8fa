"""The script that tells whether SAPIEN can draw here. Standard library only: `pdkit doctor` uses it on a broken installation too."""

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
