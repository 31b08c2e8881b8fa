"""Visual observations: cameras, encoders, pictures along demonstrations, imitation from them, and the derived task online."""
import copy
import dataclasses
import json
import pickle
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from worlds import reach_demos

from pdkit import check, cli, pixel_analysis, plots_pixels, train, train_base, train_decorated
from pdkit.demos import Demos, sources
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.imitate import ImitateConfig
from pdkit.online import Trainer
from pdkit.pixels import learn, sapien_eyes
from pdkit.pixels import pictures as kept
from pdkit.pixels import sim as pixel_sim
from pdkit.pixels.cameras import VIEWS, View, view_of
from pdkit.pixels.encoders import Encoder, PlainConv, load_encoder, random_shift, save_encoder
from pdkit.pixels.learn import imitate_pixels, look_up, renormalise
from pdkit.pixels.pictures import draw, encoded, load_pictures, picture_file, pictures_of, save_pictures
from pdkit.pixels.sim import PixelSim, panels
from pdkit.pixels.task import encoder_of, pixel_spec, save_visual
from pdkit.policies import MLP, BeT, DiffusionPolicy, load_policy
from pdkit.probes import PROBES
from pdkit.profiles import online_config
from pdkit.runs import Run, origin
from pdkit.tasks import get_task
from pdkit.tasks.vector import VectorEnv
from pdkit.video import try_render

REACH = View("reach", ("above",), 64, 64, False, ((0, 2),), 0)  # the goal, numbers 2 and 3, is only seen


class Painted:
    """Eyes without a graphics driver: a bright square where the reach probe's goal is."""

    def __init__(self, view, sim):
        self.sim = sim

    def look(self):
        picture = np.zeros((3, 64, 64), np.uint8)
        x, y = (int(v) for v in 32 + 28 * self.sim.goal)
        picture[:, max(0, y - 3): y + 4, max(0, x - 3): x + 4] = 255
        return picture, np.empty((0, 64, 64), np.uint16)


class Side(Painted):
    """The lever probe's side, as the half of the picture that is bright."""

    def look(self):
        picture = np.zeros((3, 64, 64), np.uint8)
        picture[..., 40:] = 255 * (self.sim.side > 0)
        picture[..., :24] = 255 * (self.sim.side < 0)
        return picture, np.empty((0, 64, 64), np.uint16)


_SIDES = np.float32([[-1], [1]] * 6)
LEVER = Demos("lever", "scripted", "test", "-", _SIDES.repeat(2, axis=0), _SIDES, np.ones(12, bool), np.ones(12, np.int64), np.arange(12))


@pytest.fixture
def painted(monkeypatch):
    monkeypatch.setitem(pixel_sim.EYES, "probe", Painted)


def drawable(task):
    reason = try_render(get_task(task))
    if reason:
        pytest.skip(reason)


# ---- what is seen ----------------------------------------------------------------------------------------------------

def test_views_are_the_papers():
    assert {name: (v.height, v.width, v.channels, v.state_dim, v.shift) for name, v in VIEWS.items() if not name.endswith("Source")} == {
        "StackCube": (64, 64, 8, 32, 0), "PegInsertionSide": (64, 64, 8, 32, 0), "TurnFaucet": (64, 64, 8, 39, 2),
        "PushChair": (50, 125, 12, 68, 0), "Door": (128, 128, 3, 27, 4), "Pen": (128, 128, 3, 24, 4), "Hammer": (128, 128, 3, 26, 4),
        "Relocate": (128, 128, 3, 30, 4)}
    assert view_of("StackCube").bytes == 64 * 64 * 2 * (3 + 2) and view_of("Door").bytes == 49_152
    with pytest.raises(PdkitError, match="No cameras are set up for 'Doors'; choose one of"):
        view_of("Doors")


def test_the_robots_part_holds_no_object():
    for task, objects in {"StackCube": range(32, 55), "PegInsertionSide": range(32, 50), "PushChair": range(44, 107), "Door": range(27, 39),
                          "TurnFaucet": [39]}.items():
        numbers = view_of(task).robot(np.arange(get_task(task).obs_dim, dtype=np.float32)[None])[0]
        assert numbers[0] == 0 and not set(numbers) & set(objects) and len(set(numbers) | set(objects)) == get_task(task).obs_dim


def test_drawing_changes_nothing_and_simulations_share_a_context():
    """Two hands in one graphics context: each sees itself, as alone, and its trajectory is that of a simulation nobody draws."""
    drawable("Door")
    spec, plain, rng = get_task("Door"), get_task("Door").make(), np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (6, 28)).astype(np.float32)
    one, other = PixelSim(spec), PixelSim(spec)
    states, alone = [plain.reset(5)], [one.reset(5)]
    for action in actions:
        states.append(plain.step(action)[0])
        alone.append(one.step(action)[0])
    again, beside = [one.reset(5)], [other.reset(6)]
    for action in actions:
        again.append(one.step(action)[0])
        beside.append(other.step(-action)[0])
    for state, a, b in zip(states, alone, again, strict=True):
        assert a.rgb.shape == (3, 128, 128) and a.rgb.dtype == np.uint8 and a.depth.shape == (0, 128, 128)
        np.testing.assert_array_equal(a.state, state[:27])
        np.testing.assert_array_equal(a.rgb, b.rgb)
    assert (alone[0].rgb != alone[-1].rgb).any() and (alone[-1].rgb != beside[-1].rgb).mean() > 0.01
    assert alone[0].rgb[:, :16].mean() < 20 < 80 < alone[0].rgb[:, -16:].mean()  # the dark is above, the table below
    assert panels(alone[0].rgb).shape == (128, 128, 3)
    np.testing.assert_array_equal(panels(alone[0].rgb)[..., 2], alone[0].rgb[2])


def test_a_coarser_mesh_keeps_its_shape():
    """A sphere of half a metre: fewer vertices, on the sphere, looking outwards; nothing shrunk to a line, no triangle twice."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    vertices, triangles, normals = sapien_eyes.coarser(sphere.vertices, sphere.faces, sphere.vertices, 0.05)
    assert len(triangles) < len(sphere.faces) / 5 and triangles.max() == len(vertices) - 1
    assert (vertices.dtype, triangles.dtype, normals.dtype) == (np.float32, np.uint32, np.float32)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.5, atol=0.01)
    np.testing.assert_allclose(normals, vertices / np.linalg.norm(vertices, axis=1, keepdims=True), atol=0.01)
    assert all(len(set(corners)) == 3 for corners in triangles.tolist()) and len(triangles) == len(
        {tuple(np.roll(corners, -corners.argmin())) for corners in triangles})  # none twice, turned or not
    assert trimesh.Trimesh(vertices, triangles).volume == pytest.approx(sphere.volume, rel=0.05)  # wound as before: inside is inside
    whole = sapien_eyes.coarser(sphere.vertices, sphere.faces, sphere.vertices, 1e-6)
    assert len(whole[0]) == len(sphere.vertices) and len(whole[1]) == len(sphere.faces)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide"])
def test_the_realsense_is_drawn_with_few_triangles(task, monkeypatch):
    """All cameras see next to what ManiSkill's own mesh shows, with a fiftieth of its triangles."""
    drawable("StackCube")
    spec, frames, triangles = get_task(task), [], []
    actions = np.random.default_rng(0).uniform(-1, 1, (6, spec.act_dim)).astype(np.float32)
    for _ in range(2):
        sim = PixelSim(spec)
        try:
            frames.append([sim.reset(3)] + [sim.step(action)[0] for action in actions])
            link = sim._sim._env.agent.robot.links_map[sapien_eyes.REALSENSE]._objs[0].entity
            (body,) = [c for c in link.components if type(c).__name__ == "RenderBodyComponent"]
            triangles.append(sum(len(part.triangles) for shape in body.render_shapes for part in shape.parts))
        finally:
            sim.close()
        monkeypatch.setattr(sapien_eyes, "_coarsen_realsense", lambda env: None)
    coarse, fine = ([np.stack([getattr(f, what) for f in run]).astype(int) for what in ("rgb", "depth")] for run in frames)
    assert triangles[1] > 400_000 and triangles[0] < triangles[1] / 40
    base, hand = slice(0, 3), slice(3, 6)
    assert (np.abs(coarse[0][:, base] - fine[0][:, base]) > 8).mean() < 0.002
    np.testing.assert_array_equal(coarse[0][:, hand], fine[0][:, hand])
    assert (np.abs(coarse[1] - fine[1]) > 10).mean() < 0.001  # a centimetre


class Lens:
    """Stands for SAPIEN's camera: what it sees is how far off its place on the robot is."""

    def __init__(self, width, height):
        self.size, self.holder = (height, width), None

    def set_fovy(self, angle, compute_x):
        self.fovy = np.rad2deg(angle)

    def set_local_pose(self, pose):
        self.pose = pose

    def take_picture(self):
        self.taken = True

    def get_picture(self, name):
        distance = {"holder": 1000, "panda_hand": 250, "mobile_base": 2000}[self.holder]
        pixel = {"Color": [distance // 10, 7, 9, 255], "PositionSegmentation": [50, 60, -distance, 3]}[name]
        assert self.taken
        return np.broadcast_to(np.array(pixel, np.uint8 if name == "Color" else np.int16), (*self.size, 4))


@pytest.mark.parametrize(("task", "seen", "angles"), [("StackCube", [1000, 250], [90, 90]), ("PushChair", [2000] * 3, [60] * 3)])
def test_maniskill_cameras_without_a_graphics_driver(task, seen, angles, monkeypatch):
    """Which camera is where, in which order, how much it sees, and the unit of its distances (facts.md 2.2: 1/1024 m)."""
    import mani_skill.render.shaders as shaders
    import sapien

    lenses, packs = [], []

    def holding(name):
        return SimpleNamespace(add_component=lambda lens: setattr(lens, "holder", name) or lenses.append(lens), set_pose=lambda pose: None)

    monkeypatch.setattr(sapien.render, "RenderCameraComponent", Lens)
    monkeypatch.setattr(sapien, "Entity", lambda: holding("holder"))
    monkeypatch.setattr(shaders, "set_shader_pack", packs.append)
    monkeypatch.setattr(sapien_eyes, "_coarsen_realsense", lambda env: None)
    links = {name: SimpleNamespace(_objs=[SimpleNamespace(entity=holding(name))]) for name in ("mobile_base", "panda_hand")}
    scene = SimpleNamespace(sub_scenes=[SimpleNamespace(update_render=lambda: None, add_entity=lambda holder: None)])
    env = SimpleNamespace(agent=SimpleNamespace(robot=SimpleNamespace(links_map=links)), scene=scene,
                          _default_sensor_configs=[SimpleNamespace(pose=SimpleNamespace(sp=None))])
    view, eyes = view_of(task), sapien_eyes.SapienEyes(view_of(task), SimpleNamespace(_env=env))
    for _ in range(2):  # the cameras are placed once
        colours, distances = eyes.look()
    assert [lens.fovy for lens in lenses] == pytest.approx(angles) and len(packs) == len(angles)
    assert colours.shape == (3 * len(seen), view.height, view.width) and distances.shape == (len(seen), view.height, view.width)
    assert [int(d[0, 0]) for d in distances] == [round(mm / 1000 * 1024) for mm in seen] and (distances == distances[:, :1, :1]).all()
    assert colours[:, 0, 0].tolist() == [number for mm in seen for number in (mm // 10 % 256, 7, 9)]
    if task == "PushChair":  # on a mast of 1.5 m, a third of a turn apart, looking down by 45 degrees
        ahead = [lens.pose.to_transformation_matrix()[:3, 0] for lens in lenses]
        assert all(lens.pose.p.tolist() == [0, 0, 1.5] for lens in lenses)
        np.testing.assert_allclose([v[2] for v in ahead], -np.sqrt(0.5), atol=1e-5)
        np.testing.assert_allclose(np.sort(np.diff(np.sort([np.arctan2(v[1], v[0]) for v in ahead]))), 2 * np.pi / 3, atol=1e-4)
    else:  # in the frame of the hand, whose z runs along the fingers: there it looks
        np.testing.assert_allclose(lenses[1].pose.to_transformation_matrix()[:3, 0], [0, 0, 1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide", "TurnFaucet", "PushChair"])
def test_maniskill_cameras(task):
    """Shapes, distances in metres that look like a table's, and the trajectory of a simulation nobody draws."""
    drawable("StackCube")
    spec, plain, view = get_task(task), get_task(task).make(), view_of(task)
    sim = PixelSim(spec)
    try:
        state, frame = plain.reset(3), sim.reset(3)
        for action in np.random.default_rng(0).uniform(-1, 1, (4, spec.act_dim)).astype(np.float32):
            state, frame = plain.step(action)[0], sim.step(action)[0]
        k = len(view.cameras)
        assert frame.rgb.shape == (3 * k, view.height, view.width) and frame.depth.shape == (k, view.height, view.width)
        assert frame.rgb.dtype == np.uint8 and frame.depth.dtype == np.uint16
        np.testing.assert_array_equal(frame.state, view.robot(state))
        middle = np.median(frame.depth / 1024, axis=(1, 2))
        assert (middle > 0.1).all() and (middle < 5).all(), middle
        assert all(frame.rgb[3 * i: 3 * i + 3].std() > 5 for i in range(k))
    finally:
        sim.close()
        plain.close()


# ---- encoders --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("size", "channels", "flat", "weights"), [
    # 3x3 convolutions, the 1x1, the linear layer, biases included
    ((64, 64), 8, 2048, 16 * 73 + 32 * 145 + 64 * 289 + 128 * 577 + 128 * 129 + 256 * 2049),
    ((50, 125), 12, 2688, 16 * 109 + 16 * 145 + 32 * 145 + 64 * 289 + 128 * 65 + 256 * 2689),
    ((128, 128), 3, 2048, 16 * 28 + 16 * 145 + 32 * 145 + 64 * 289 + 128 * 577 + 128 * 129 + 256 * 2049),
])
def test_plain_conv(size, channels, flat, weights):
    net = PlainConv(channels, *size)
    assert net.fc.in_features == flat and sum(p.numel() for p in net.parameters()) == weights
    features = net(torch.rand(2, channels, *size))
    assert features.shape == (2, 256) and (features >= 0).all()


def test_a_new_encoder_tells_pictures_apart():
    """With PyTorch's own weights and biases features hardly vary around what biases make of any picture."""
    torch.manual_seed(0)
    side = np.random.default_rng(0).uniform(0, 1, (40, 1, 4, 4)).repeat(32, axis=2).repeat(32, axis=3)  # smooth, as pictures are
    pictures = torch.from_numpy(np.broadcast_to(side, (40, 3, 128, 128)).astype(np.float32))
    net = PlainConv(3, 128, 128)
    with torch.no_grad():
        features, black = net(pictures), net(torch.zeros(1, 3, 128, 128))
    live = (features > 0).any(dim=0)
    assert live.sum() > 100 and features[:, live].std(dim=0).median() > 0.1 and (black == 0).all()


def test_no_encoder_for_other_sizes():
    with pytest.raises(PdkitError, match="no encoder for pictures of 32 x 64; there are ones for 64 x 64, 50 x 125, 128 x 128"):
        PlainConv(3, 32, 64)


def test_colours_and_metres_are_what_the_network_sees():
    encoder = Encoder(view_of("StackCube"))
    encoder.net = torch.nn.Identity()
    seen = encoder(torch.full((1, 6, 64, 64), 255, dtype=torch.uint8), torch.full((1, 2, 64, 64), 2048))
    assert seen.shape == (1, 8, 64, 64) and (seen[:, :6] == 1).all() and (seen[:, 6:] == 2).all()


def test_encoding_in_batches():
    encoder = Encoder(REACH).eval()
    rgb = np.random.default_rng(0).integers(0, 255, (5, 3, 64, 64), np.uint8)
    whole, parts = (encoder.encode(rgb, np.empty((5, 0, 64, 64), np.uint16), batch) for batch in (5, 2))
    np.testing.assert_allclose(whole, parts, atol=1e-5)
    assert whole.shape == (5, 256) and whole.dtype == np.float32


def test_random_shift_moves_whole_pictures_by_whole_pixels():
    pictures = torch.arange(40 * 2 * 8 * 8).view(40, 2, 8, 8)
    shifted = random_shift(pictures, 2, torch.Generator().manual_seed(0))
    assert shifted.shape == pictures.shape and shifted.dtype == pictures.dtype
    padded = torch.nn.functional.pad(pictures.float(), (2, 2, 2, 2), "replicate").long()
    moves = []
    for before, after in zip(padded, shifted, strict=True):
        found = [(y, x) for y in range(5) for x in range(5) if torch.equal(before[:, y: y + 8, x: x + 8], after)]
        assert len(found) == 1  # the same move for both channels
        moves += found
    assert {y for y, _ in moves} == {x for _, x in moves} == set(range(5)) and len(set(moves)) > 10  # a move of its own for each picture
    with pytest.raises(PdkitError, match="square"):
        random_shift(torch.zeros(1, 3, 50, 125), 2, torch.Generator())


def test_encoder_on_disk(tmp_path):
    encoder = Encoder(view_of("TurnFaucet"))
    save_encoder(encoder, tmp_path / "e", {"task": "TurnFaucet"})
    again = load_encoder(tmp_path / "e")
    assert again.view == encoder.view and not again.training and not any(p.requires_grad for p in again.parameters())
    for name, tensor in encoder.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor.bfloat16().float())
    weights = tmp_path / "e" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\0")
    with pytest.raises(PdkitError, match="altered"):
        load_encoder(tmp_path / "e")
    (tmp_path / "e" / "encoder.json").write_text("{}")
    with pytest.raises(PdkitError, match="not a pdkit-encoder-1 file"):
        load_encoder(tmp_path / "e")
    assert encoder_of(tmp_path) is None


# ---- pictures along demonstrations -----------------------------------------------------------------------------------

def test_replaying_door_gives_its_pictures(tmp_path, monkeypatch):
    drawable("Door")
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    demos = sources.bundled("Door").first(1)
    pictures = pictures_of(demos)
    assert pictures.rgb.shape == (len(demos.observations), 3, 128, 128)
    sim = PixelSim(get_task("Door"))
    np.testing.assert_array_equal(pictures.rgb[0], sim.reset(int(demos.seeds[0])).rgb)
    np.testing.assert_array_equal(pictures.rgb[1], sim.step(demos.actions[0])[0].rgb)
    monkeypatch.setattr(kept, "draw", None)  # not drawn a second time
    np.testing.assert_array_equal(pictures_of(demos).rgb, pictures.rgb)


def test_a_replay_that_comes_out_otherwise_is_refused(painted):
    demos = reach_demos(2)
    assert len(draw(demos, spec=PROBES["reach"], view=REACH).rgb) == len(demos.observations)
    success = demos.success.copy()
    success[-1] = ~success[-1]
    with pytest.raises(PdkitError, match="Demonstration 1 of reach does not replay"):
        draw(dataclasses.replace(demos, success=success), spec=PROBES["reach"], view=REACH)
    with pytest.raises(PdkitError, match="have no seeds"):
        draw(dataclasses.replace(demos, seeds=np.array([0, -1])), spec=PROBES["reach"], view=REACH)


def test_kept_pictures_are_checked(tmp_path, monkeypatch):
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    demos = sources.bundled("Door").first(1)
    path, count = picture_file(demos), len(demos.observations)
    pictures = kept.Pictures(np.zeros((count, 3, 128, 128), np.uint8), np.zeros((count, 0, 128, 128), np.uint16))
    save_pictures(pictures, demos, path)
    assert load_pictures(demos, path).depth.shape == (count, 0, 128, 128)
    with pytest.raises(PdkitError, match="of other demonstrations or cameras"):
        load_pictures(dataclasses.replace(demos, actions=-demos.actions), path)
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card | {"view": card["view"] | {"width": 64}}))
    with pytest.raises(PdkitError, match="of other demonstrations or cameras"):
        load_pictures(demos, path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(PdkitError, match="truncated or altered"):
        load_pictures(demos, path)
    path.with_suffix(".json").unlink()  # whoever wrote the pictures died before their card: they are drawn anew
    monkeypatch.setattr(kept, "draw", lambda demos, progress: pictures)
    assert len(pictures_of(demos).rgb) == count and load_pictures(demos, path)


def test_encoded_demonstrations_show_state_then_features(painted):
    demos = reach_demos(2)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    encoder = Encoder(REACH).eval()
    seen = encoded(demos, pictures, encoder)
    assert seen.observations.shape == (len(demos.observations), 258)
    np.testing.assert_array_equal(seen.observations[:, :2], demos.observations[:, :2])
    np.testing.assert_allclose(seen.observations[:, 2:], encoder.encode(pictures.rgb, pictures.depth), atol=1e-6)
    sim = pixel_spec(PROBES["reach"], encoder).make()  # the derived task shows the very same
    np.testing.assert_allclose(sim.reset(int(demos.seeds[0])), seen.observations[0], atol=1e-6)
    np.testing.assert_allclose(sim.step(demos.actions[0])[0], seen.observations[1], atol=1e-6)
    assert sim.render().shape == (128, 128, 3)
    with pytest.raises(PdkitError, match="need as many pictures"):
        encoded(demos.first(1), pictures, encoder)


# ---- imitation -------------------------------------------------------------------------------------------------------

SMALL = {"window": 1, "horizon": 2, "chunk": 1, "dims": [16, 32], "groups": 4, "embed": 16, "prediction": "v_prediction"}  # diffusion


@pytest.mark.parametrize(("kind", "config"), [(MLP, {}), (BeT, {"window": 3, "embed": 32, "layers": 1, "bins": 4}),
                                              (DiffusionPolicy, SMALL | {"own_scale": True, "window": 2})])
def test_renormalising_keeps_the_policy(kind, config):
    rng = np.random.default_rng(0)
    policy = kind({"obs_dim": 6, "act_dim": 2, **config}).eval()
    observations = rng.normal(3, 2, (50, 6)).astype(np.float32)
    policy.fit_statistics(observations * 0.1, rng.uniform(-1, 1, (50, 2)).astype(np.float32))
    windows = rng.normal(3, 2, (7, policy.window, 6)).astype(np.float32)
    policy.reset(0)
    before = policy.act(windows)
    for seen in (observations * 0.7 - 1, observations):  # the second time from a scale that was already changed
        renormalise(policy, seen)
        policy.reset(0)
        np.testing.assert_allclose(policy.act(windows), before, atol=1e-4)
    np.testing.assert_allclose(policy.normalizer.mean.numpy(), observations.mean(0), atol=1e-5)


def test_only_some_policies_see():
    with pytest.raises(PdkitError, match="together with mlp, bet or diffusion, not rnn"):
        imitate_pixels("rnn", reach_demos(1), None, ImitateConfig(), spec=PROBES["reach"], view=REACH)


@pytest.fixture(scope="module")
def sighted():
    """An MLP that sees the reach probe's goal, hardly trained, its encoder, and the demonstrations as encoded."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(pixel_sim.EYES, "probe", Painted)
        demos = reach_demos(8)
        pictures = draw(demos, spec=PROBES["reach"], view=REACH)
        config = ImitateConfig(iterations=2, batch=8, eval_episodes=0, bf16=False)
        policy, encoder, _ = imitate_pixels("mlp", demos, pictures, config, {"hidden": 16}, spec=PROBES["reach"], view=REACH)
        return policy, encoder, encoded(demos, pictures, encoder)


def test_pictures_are_shifted_while_a_policy_learns_from_them(monkeypatch):
    monkeypatch.setitem(pixel_sim.EYES, "probe", Painted)
    demos, shifts, sevens, moved = reach_demos(2), [], [], dataclasses.replace(REACH, shift=3)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    config = ImitateConfig(iterations=3, batch=8, eval_episodes=0, bf16=False)
    monkeypatch.setattr(learn, "random_shift", lambda seen, pad, generator: shifts.append(pad) or torch.full_like(seen, 7))
    forward = Encoder.forward
    monkeypatch.setattr(Encoder, "forward", lambda self, rgb, depth: sevens.append(bool((rgb == 7).all())) or forward(self, rgb, depth))
    for view, shift, shifted in ((REACH, None, 0), (moved, 0, 0), (moved, None, 3), (REACH, 2, 2)):
        shifts.clear(), sevens.clear()
        imitate_pixels("mlp", demos, pictures, config, {"hidden": 16}, spec=PROBES["reach"], view=view, shift=shift)
        assert shifts == 3 * [shifted] * (shifted > 0) and sum(sevens) == 3 * (shifted > 0)  # what is shifted is what is seen


def test_the_weights_of_an_encoder_decay_as_the_policys_do(monkeypatch):
    monkeypatch.setitem(pixel_sim.EYES, "probe", Painted)
    demos, made = reach_demos(2), []
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    make = learn.make_optimizer
    monkeypatch.setattr(learn, "make_optimizer", lambda *given: made.append(make(*given)) or made[-1])
    config = ImitateConfig(iterations=1, batch=8, eval_episodes=0, bf16=False, weight_decay=0.3)
    _, encoder, _ = imitate_pixels("mlp", demos, pictures, config, {"hidden": 16}, spec=PROBES["reach"], view=REACH)
    group = made[0].param_groups[-1]
    assert group["weight_decay"] == 0.3 and sum(p.numel() for p in group["params"]) == sum(p.numel() for p in encoder.parameters())


def test_an_interrupted_training_from_pictures_goes_on_to_the_same_policy_and_encoder(tmp_path, monkeypatch):
    monkeypatch.setitem(pixel_sim.EYES, "probe", Painted)
    demos = reach_demos(2)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    config = ImitateConfig(iterations=4, batch=8, eval_every=2, eval_episodes=0, bf16=False)

    def train(run=None, progress=None):
        return imitate_pixels("mlp", demos, pictures, config, {"hidden": 16}, spec=PROBES["reach"], view=REACH, shift=2, run=run,
                              progress=progress)

    def interrupt(row):
        raise KeyboardInterrupt

    *whole, history = train()
    with pytest.raises(KeyboardInterrupt):
        train(Run(tmp_path, "base", {}), interrupt)
    torch.manual_seed(99)
    *again, rows = train(Run(tmp_path, "base", {}))
    assert [row["loss"] for row in rows] == [row["loss"] for row in history]
    for one, other in zip(whole, again, strict=True):
        assert all(torch.equal(value, one.state_dict()[name]) for name, value in other.state_dict().items())


def test_what_imitation_leaves(sighted):
    policy, encoder, seen = sighted
    np.testing.assert_allclose(policy.normalizer.mean.numpy(), seen.observations.mean(0), atol=1e-4)  # of the features too
    assert all(torch.equal(p, p.bfloat16().float()) for p in (*policy.parameters(), *encoder.parameters()))
    assert not any(p.requires_grad for p in encoder.parameters()) and not policy.training


@pytest.mark.parametrize(("kind", "config", "settings"), [
    ("mlp", {"hidden": 16}, {}), ("diffusion", SMALL, {"ema_power": 0.75, "iterations": 90, "eval_every": 30})])
def test_what_only_pictures_show_is_learned(monkeypatch, kind, config, settings):
    """The lever must be pulled to the side on which the picture is bright; the robot's state is empty."""
    monkeypatch.setitem(pixel_sim.EYES, "probe", Side)
    demos, view = LEVER, View("lever", ("front",), 64, 64, False, ((0, 0),), 2)
    pictures = draw(demos, spec=PROBES["lever"], view=view)
    training = ImitateConfig(**{"iterations": 60, "batch": 16, "lr": 3e-3, "eval_every": 60, "eval_episodes": 8, "bf16": False, **settings})
    policy, encoder, history = imitate_pixels(kind, demos, pictures, training, config, spec=PROBES["lever"], view=view)
    np.testing.assert_allclose(policy.normalizer.mean.numpy(), encoded(demos, pictures, encoder).observations.mean(0), atol=1e-4)
    assert history[-1]["success_once"] == 1.0, history  # blind, half


def test_nearest_neighbours_by_the_picture_alone(monkeypatch):
    """The lever again, through an encoder that nobody trained. The state beside the picture tells the side, too; it is not looked at."""
    monkeypatch.setitem(pixel_sim.EYES, "probe", Side)
    demos, view, spec = LEVER, View("lever", ("front",), 64, 64, False, ((0, 1),), 0), PROBES["lever"]
    torch.manual_seed(0)
    encoder = Encoder(view).eval().requires_grad_(False)
    pictures = draw(demos, spec=spec, view=view)
    policy, (row,) = look_up(demos, pictures, encoder, ImitateConfig(eval_episodes=8), dict(k=1, skip=1), spec=spec)
    assert row["success_once"] == 1.0 and policy.library.shape == (12, 256)
    seen = encoded(demos, pictures, encoder).observations
    changed = seen.copy()
    changed[:, 0] = 1e3
    assert np.array_equal(policy.act(seen[:, None]), policy.act(changed[:, None]))
    assert torch.allclose(policy.library, policy.normalizer(torch.from_numpy(seen[::2]))[:, 1:], atol=1e-6)
    with pytest.raises(PdkitError, match="leaves out some of raw observations .257 numbers., not 257"):
        look_up(demos, pictures, encoder, ImitateConfig(eval_episodes=0), dict(skip=257), spec=spec)


def test_checkpoints_do_not_change_the_training_of_a_diffusion_policy(painted):
    """Its loss draws noise; what makes a checkpoint must draw nothing."""
    demos = reach_demos(4)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    often, once = (imitate_pixels("diffusion", demos, pictures, ImitateConfig(iterations=3, batch=4, eval_every=every, eval_episodes=0),
                                  SMALL | {"window": 2, "horizon": 4, "chunk": 2}, spec=PROBES["reach"], view=REACH)[0] for every in (1, 3))
    assert all(torch.equal(one, other) for one, other in zip(often.parameters(), once.parameters(), strict=True))


def test_a_visual_diffusion_policy_goes_on(painted, tmp_path):
    """On disk, with a network of its own for the last steps (DPPO), and under the decorator it acts as it did."""
    demos = reach_demos(4)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    config = SMALL | {"window": 2, "horizon": 4, "chunk": 2}
    policy, encoder, _ = imitate_pixels("diffusion", demos, pictures, ImitateConfig(iterations=2, batch=4, eval_episodes=0), config,
                                        spec=PROBES["reach"], view=REACH)
    seen = encoded(demos, pictures, encoder)
    save_visual(policy, encoder, tmp_path / "v", {"task": "reach"})
    spec, windows, actions = pixel_spec(PROBES["reach"], encoder_of(tmp_path / "v")), seen.observations[:6].reshape(3, 2, -1), []
    for each in (policy, load_policy(tmp_path / "v"), policy.with_late(2)):
        each.reset(0)
        actions.append(each.act(windows))
    np.testing.assert_allclose(actions[1:], [actions[0]] * 2, atol=1e-5)
    values = online_config("StackCube", "smoke", 0, total_steps=120, warmup_steps=40, H=80, num_envs=2, batch=16, utd=0.5, eval_every=120,
                           eval_episodes=2, log_every=60, checkpoint_every=120, alpha_scale=(), train_limit=0, bf16=False, n_step=2)
    trainer = Trainer(values, policy, seen, spec=spec)
    decorated = trainer.train()
    assert trainer.step >= 120 and decorated.act(windows).shape == (3, 2, 2)


def test_a_visual_policy_on_disk(sighted, tmp_path):
    policy, encoder, seen = sighted
    save_visual(policy, encoder, tmp_path / "v", {"task": "reach"})
    again, eyes = load_policy(tmp_path / "v"), encoder_of(tmp_path / "v")
    windows = seen.observations[:5, None]
    np.testing.assert_array_equal(again.act(windows), policy.act(windows))
    assert torch.equal(eyes.net.fc.weight, encoder.net.fc.weight)
    assert (tmp_path / "v" / "encoder" / "weights.safetensors").stat().st_size < 1.4e6  # two bytes a weight


def test_averaged_weights_are_those_of_policy_and_encoder(painted):
    """With an average that remembers, what is kept is not what training ended with."""
    demos = reach_demos(8)
    pictures = draw(demos, spec=PROBES["reach"], view=REACH)
    plain, averaged = (imitate_pixels("mlp", demos, pictures, ImitateConfig(iterations=6, batch=8, eval_episodes=0, ema_power=power),
                                      {"hidden": 16}, spec=PROBES["reach"], view=REACH) for power in (0.0, 0.75))
    for one, other in zip(plain[:2], averaged[:2], strict=True):  # policy, encoder
        assert not torch.equal(list(one.parameters())[-2], list(other.parameters())[-2])  # the first also holds the features' scale


# ---- online ----------------------------------------------------------------------------------------------------------

def test_the_derived_task_is_one_like_any_other(sighted, tmp_path, painted):
    """It pickles for the workers; a run stopped and resumed is the run that was not; no picture is in the buffer."""
    policy, encoder, seen = sighted
    spec = pixel_spec(PROBES["reach"], encoder)
    assert (spec.name, spec.obs_dim) == ("reach-pixels", 258)
    assert pickle.loads(pickle.dumps(spec)).make().reset(3).shape == (258,)
    config = online_config("StackCube", "smoke", 0, total_steps=160, warmup_steps=40, H=80, num_envs=2, batch=16, utd=0.5, eval_every=80,
                           eval_episodes=2, log_every=40, checkpoint_every=80, alpha_scale=(), train_limit=0, bf16=False, n_step=2)
    whole = Trainer(config, policy, seen, spec=spec)
    whole.train()
    assert whole.replay.rows.shape[1] == 2 * 258 + 3 * 2 + 2 and whole.demos.size == len(seen.actions)

    def stop(trainer):
        if trainer.step >= 120:
            raise KeyboardInterrupt

    run = Run(tmp_path / "r", "decorated", {})
    with pytest.raises(KeyboardInterrupt):
        Trainer(config, policy, seen, spec=spec).train(run, stop)
    resumed = Trainer(config, policy, seen, spec=spec)
    resumed.train(run)
    assert torch.equal(resumed.replay.rows, whole.replay.rows)
    for name, tensor in whole.agent.actor.state_dict().items():
        assert torch.equal(tensor, resumed.agent.actor.state_dict()[name])


def test_workers_see_the_same():
    """Drawn and encoded in another process, Door gives the same observations."""
    drawable("Door")
    spec = pixel_spec(get_task("Door"), Encoder(view_of("Door")).eval())
    actions, results = np.random.default_rng(0).uniform(-1, 1, (3, 1, 1, 28)), []
    for workers in (0, 1):
        with VectorEnv(spec, 1, lambda lane: 4, workers=workers) as envs:
            results.append([envs.reset(), *(envs.step(a).windows for a in actions)])
    np.testing.assert_array_equal(*results)
    assert spec.obs_dim == 27 + 256 and spec.joints == 27


def test_from_the_command_line(monkeypatch, tmp_path, capsys):
    """Draw, imitate, decorate, evaluate: Door in the smallest version."""
    drawable("Door")
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["pdkit", *words])
        return cli.main(list(words))

    base, runs = str(tmp_path / "b"), str(tmp_path / "t")
    assert call("train", "base", "Door", "--policy", "mlp", "--pixels", "--num-demos", "1", "--out", base, "--set", "iterations=3",
                "batch=8", "eval_episodes=0", "hidden=32", "random_shift=2") == 0
    assert call("train", "decorated", "Door", "--profile", "smoke", "--base", base, "--episodes", "1", "--out", runs, "--set",
                "total_steps=300", "warmup_steps=120", "eval_every=0", "num_envs=1") == 0
    assert "env_steps 300" in capsys.readouterr().out
    trained = tmp_path / "t" / "Door-smoke-seed0" / "decorated"
    assert encoder_of(trained).view == view_of("Door")
    assert call("train", "decorated", "Door", "--pixels", "--base", "data/checkpoints/Door/base") == 2
    assert "no visual policy in data/checkpoints/Door/base" in capsys.readouterr().err
    assert call("demos", "--pixels") == 2


# ---- what notebook 15 measures ---------------------------------------------------------------------------------------

def test_what_a_buffer_weighs():
    """Door, 1,000 transitions: two frames of 128 x 128 x 3 bytes, or of 256 floats, and 27 joints of four bytes with either."""
    door = view_of("Door")
    assert pixel_analysis.buffer_bytes(door, 1_000, False) == 2_000 * (49_152 + 108)
    assert pixel_analysis.buffer_bytes(door, 1_000, True) == 2_000 * (1_024 + 108)
    table = pixel_analysis.memory(["Door", "PushChair"], 1_000)
    assert table.times.tolist() == pytest.approx([49_260 / 1_132, (50 * 125 * 15 + 272) / (1_024 + 272)])
    assert plots_pixels.memory_figure(table, 1_000).png()


class Told(torch.nn.Module):
    """An encoder whose features are the mean of the picture and its square."""

    view = REACH

    def encode(self, rgb, depth):
        mean = rgb.mean(axis=(1, 2, 3))[:, None].astype(np.float32)
        return np.concatenate([mean, mean**2], axis=1)


def _levels(demos):
    """A picture for each observation: everywhere 50 + 50 times the number at place 2."""
    level = (50 + 50 * demos.observations[:, 2]).astype(np.uint8)
    return kept.Pictures(np.broadcast_to(level[:, None, None, None], (len(level), 3, 4, 4)), np.empty((len(level), 0, 4, 4), np.uint16))


def test_what_a_picture_is_worth():
    """A policy that returns the first feature is right with its own picture, wrong with another's and off by all of it with a black one."""
    demos = reach_demos(3)
    pictures = _levels(demos)
    own = pictures.rgb[:, 0, 0, 0].astype(np.float32)
    starts = np.concatenate([[0], np.cumsum(demos.lengths + 1)])
    acted = np.concatenate([own[a: b - 1] for a, b in zip(starts, starts[1:], strict=False)])
    demos = dataclasses.replace(demos, actions=np.stack([acted, acted], axis=1))

    class Copy:
        window = 1

        def act(self, windows):
            return windows[:, :, 2:3].repeat(2, axis=2)

    worth = pixel_analysis.errors(Copy(), Told(), demos, pictures)
    goals = own[starts[:-1]]
    others = np.repeat(goals[[1, 2, 0]] - goals, demos.lengths)
    assert worth["its own"] == 0 and worth["another episode's"] == pytest.approx(np.sqrt((others**2).mean()), rel=1e-4)
    assert worth["black"] == pytest.approx(np.sqrt((acted**2).mean()), rel=1e-5)
    assert worth["the average"] == pytest.approx(np.sqrt(((own.mean() - acted) ** 2).mean()), rel=1e-4)


def test_a_probe_tells_what_the_features_hold():
    demos = reach_demos(12)
    pictures = _levels(demos)
    assert pixel_analysis.probe(Told(), demos, pictures, slice(2, 3), 8) > 0.99
    assert pixel_analysis.probe(Told(), demos, pictures, slice(3, 4), 8) < 0.6  # the goal's other coordinate is not in the picture
    with pytest.raises(PdkitError, match="1 to 11 of them, not on 12"):
        pixel_analysis.probe(Told(), demos, pictures, slice(2, 3), 12)


def test_blindfolded_the_features_stand_still(sighted):
    policy, _, seen = sighted
    states = np.random.default_rng(0).normal(size=(4, 1, 4)).astype(np.float32)
    expected = np.concatenate([states[:, :, :2], np.tile(seen.observations[:, 2:].mean(0), (4, 1, 1))], axis=2).astype(np.float32)
    np.testing.assert_allclose(pixel_analysis.blindfolded(policy, REACH)(states), policy.act(expected), atol=1e-4)


def test_the_exercise(capsys):
    assert check.shift(pixel_analysis.shifted)
    wrong = {lambda p, d, r: np.roll(p, (d, r), (0, 1)): "np.roll", lambda p, d, r: pixel_analysis.shifted(p, -d, -r): "other way",
             lambda p, d, r: pixel_analysis.shifted(p, r, d): "exchanged", lambda p, d, r: p[1:]: "size must stay"}
    for answer, hint in wrong.items():
        assert not check.shift(answer) and hint in capsys.readouterr().out


def test_figures_of_views_and_shifts():
    frames = {"StackCube": pixel_sim.Frame(np.zeros((6, 64, 64), np.uint8), np.zeros((2, 64, 64), np.uint16), np.zeros(32)),
              "Door": pixel_sim.Frame(np.zeros((3, 128, 128), np.uint8), np.zeros((0, 128, 128), np.uint16), np.zeros(27))}
    assert plots_pixels.views_figure(frames).png()
    picture = np.zeros((8, 8, 3), np.uint8)
    assert plots_pixels.shift_figure(picture, [picture, picture], 2).png()
    curves = pd.DataFrame({"recipe": "a", "seed": [0, 0, 1, 1], "step": [10, 20, 12, 20], "train_success": [0.5, np.nan, 0.7, np.nan],
                           "success_once": [np.nan, 1.0, np.nan, 0.9]})
    figure = plots_pixels.training_figure(curves, {"a": "A", "b": "none"}, base=0.4)
    line, squares = figure.axes[0].lines[:2]
    assert figure.png() and line.get_xydata().tolist() == [[11, 0.6]] and line.get_label() == "A, 2 seeds"  # the mean of both
    assert squares.get_xydata()[-1].tolist() == [20, 0.95]


# ---- what is refused before anything is drawn -----------------------------------------------------------------------

@pytest.mark.parametrize(("words", "message"), [
    (["base", "Door", "--policy", "cnn", "--pixels"], "kinds mlp, bet, diffusion and vinn"),
    (["base", "Door", "--policy", "vinn", "--pixels"], "--set encoder=FOLDER"),
    (["base", "Door", "--policy", "mlp", "--pixels", "--set", "encoder=x"], "trains its own encoder"),
    (["base", "Door", "--policy", "vinn", "--pixels", "--set", "encoder=data/checkpoints/Door/base"], "no encoder in data"),
    (["base", "Pen", "--policy", "vinn", "--pixels", "--set", "encoder=data/checkpoints/Door/pixels/base"], "robot of Door, not of Pen"),
    (["base", "Door", "--policy", "vinn", "--pixels", "--set", "encoder=data/checkpoints/Door/pixels/base", "skip=283"], "leaves out some"),
    (["base", "Door", "--policy", "diffusion", "--pixels", "--set", "own_scale=False"], "Unknown field"),
    (["base", "Door", "--policy", "diffusion", "--pixels", "--set", "horizon=7"], "multiple of"),
    (["base", "Door", "--policy", "mlp", "--pixels", "--set", "random_shift=-1"], "whole number"),
    (["base", "Door", "--policy", "mlp", "--pixels", "--set", "random_shift=0.5"], "whole number"),
    (["base", "PushChair", "--policy", "mlp", "--pixels", "--set", "random_shift=2"], "square pictures, not 50 x 125; set random_shift=0"),
    (["decorated", "Pen", "--pixels", "--base", str(DATA / "checkpoints" / "Door" / "pixels" / "base")], "robot of Door, not of Pen")])
def test_a_bad_command_draws_nothing(monkeypatch, words, message):
    for command in (train_base, train_decorated):
        monkeypatch.setattr(command, "pictures_of", lambda *given: pytest.fail("pictures were drawn"))
    with pytest.raises(PdkitError, match=message):
        train.main(words)


def test_the_encoder_is_part_of_what_a_run_starts_from():
    encoder = load_encoder(DATA / "checkpoints" / "Door" / "pixels" / "base" / "encoder")
    card = {"weights_sha256": "x"}
    assert "encoder" not in origin(card, None)
    other = copy.deepcopy(encoder)
    next(other.parameters()).data += 1
    assert origin(card, None, encoder) != origin(card, None, other) and origin(card, None, encoder)["encoder"] == encoder.checksum
