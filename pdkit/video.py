"""Episodes to look at: frames, contact sheets, videos, and how large a residual is along the way.

Pictures are an extra everywhere. `try_render` tells, without any risk to the caller, whether a task can be drawn here
and chooses MuJoCo's backend; a lesson that cannot draw prints the sentence it returns and goes on.
"""
from __future__ import annotations

import base64
import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd

from .decorated import Decorated
from .decorator import compose, scaled
from .errors import PdkitError
from .evaluate import Actor, ask
from .files import atomic_file
from .machine import MUJOCO_DRAWS
from .pixels.cameras import CAMERAS
from .plots import COLORS, Picture, blank, styled
from .policies import Policy
from .tasks.spec import TaskSpec

SWITCH = "PDKIT_RENDER"  # environment variable: "off" turns all pictures off
EMBED_BYTES = 500_000  # largest video put into a page or a notebook
FPS = 30


@dataclass(frozen=True)
class Clip:
    """One episode of one policy."""

    task: str
    seed: int
    success: np.ndarray  # (T,) bool, judged after each step
    frames: list[np.ndarray] = field(default_factory=list)  # uint8 (height, width, 3); the first is the start
    steps: list[int] = field(default_factory=list)  # the step after which each frame was taken, 0 for the first
    label: str = ""  # the policy's name

    @property
    def length(self) -> int:
        return len(self.success)

    @property
    def first_success(self) -> int | None:
        """The step (counted from 1) after which the task was first solved, None if it never was."""
        return int(np.argmax(self.success)) + 1 if self.success.any() else None

    @property
    def outcome(self) -> str:
        """What happened, in words."""
        return f"solved at step {self.first_success}" if self.success.any() else "not solved"

    def solved_by(self, step: int) -> bool:
        """Whether the task had been solved by then."""
        return self.first_success is not None and step >= self.first_success


# ---- whether pictures can be drawn ---------------------------------------------------------------------------------

def try_render(spec: TaskSpec) -> str | None:
    """None if episodes of this task can be drawn here, else one sentence that says why not.

    The first call for MuJoCo or SAPIEN draws a picture in a process of its own, so that a crash of a graphics driver cannot
    take the caller with it. For MuJoCo it also sets MUJOCO_GL to a backend that works. Of other simulators one is asked for a picture.
    """
    if os.environ.get(SWITCH, "").lower() in ("off", "0", "no"):
        return f"Pictures are turned off ({SWITCH}=off); everything else runs the same."
    if spec.plan_view:
        return None
    return _try_mujoco() if spec.suite == "adroit" else _try_sapien() if spec.suite == "maniskill" else _try_own(spec)


@functools.cache
def _try_mujoco() -> str | None:
    chosen = os.environ.get("MUJOCO_GL", "")
    others = ("egl", "osmesa") if sys.platform.startswith("linux") else ("",)
    reason = ""
    for backend in dict.fromkeys((chosen, *others) if chosen else others):
        environment = os.environ | ({"MUJOCO_GL": backend} if backend else {})
        try:
            done = subprocess.run([sys.executable, "-W", "ignore", "-c", MUJOCO_DRAWS], env=environment, capture_output=True,
                                  text=True, timeout=120)
        except subprocess.TimeoutExpired:
            reason = reason or f"{backend or 'the default backend'} did not answer"
            continue
        if done.returncode == 0 and "draws" in done.stdout:
            if backend:
                os.environ["MUJOCO_GL"] = backend
            return None
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        reason = reason or f"{backend or 'the default backend'}: {last[:120]}"
    return (f"No pictures: MuJoCo cannot draw here ({reason}); `pdkit doctor` names the package that is missing. "
            "Everything else runs the same.")


def _try_sapien() -> str | None:
    from .tasks.maniskill_headless import render_device

    if render_device():
        return None
    return ("No pictures: ManiSkill needs a working Vulkan driver to draw, and there is none; `pdkit doctor` tells how "
            "to get one. Everything else runs the same.")


def _try_own(spec: TaskSpec) -> str | None:
    try:
        with contextlib.closing(spec.make(render=True)) as sim:
            sim.reset(0)
            if (shape := np.shape(picture := sim.render()))[2:] != (3,):
                raise TypeError(f"render() gives {type(picture).__name__} of shape {shape}")
    except Exception as error:  # whatever someone's simulator raises
        return (f"No pictures: the simulator of {spec.name} draws none ({type(error).__name__}: {error}); for pictures make(render=True) "
                "gives one whose render() returns an (H, W, 3) array. Everything else runs the same.")
    return None


# ---- recording -------------------------------------------------------------------------------------------------------

def record(spec: TaskSpec, actor: Actor, seed: int, *, window: int = 1, steps: int | None = None, stride: int = 1,
           label: str = "", pictures: bool = True) -> Clip:
    """Run one whole episode from `seed` as `evaluate` does, keeping every `stride`-th frame and the last.

    `actor` maps windows (1, window, obs_dim) to action chunks (1, chunk, act_dim); `steps` is the limit if it is not
    the task's; without `pictures` no frame is drawn. Raises PdkitError where drawing does not work: ask `try_render`.
    """
    if stride < 1:
        raise PdkitError(f"stride counts steps between frames and must be at least 1, not {stride}.")
    sim, frames, taken, success = spec.make(render=pictures), [], [], []
    try:
        _aim(sim, spec.name)
        observation = sim.reset(seed)
        history, limit = np.repeat(observation[None], window, axis=0), steps or spec.max_episode_steps
        if pictures:
            frames, taken = [sim.render()], [0]
        while len(success) < limit:
            for action in np.clip(ask(actor, history[None], np.array([len(success)]))[0], -1, 1)[: limit - len(success)]:
                observation, solved = sim.step(action)
                success.append(solved)
                history = np.concatenate([history[1:], observation[None]])
                if pictures and (len(success) % stride == 0 or len(success) == limit):
                    frames.append(np.ascontiguousarray(sim.render()))
                    taken.append(len(success))
    finally:
        sim.close()
    return Clip(spec.name, int(seed), np.array(success, bool), frames, taken, label)


def record_all(spec: TaskSpec, policies: Mapping[str, Policy | Decorated], seed: int, *, steps: int | None = None,
               stride: int = 3) -> list[Clip]:
    """The same episode once for each policy, in their order, labelled with their names; random numbers they draw start anew."""
    clips = []
    for name, policy in policies.items():
        policy.reset(0)
        clips.append(record(spec, policy.act, seed, window=policy.window, steps=steps, stride=stride, label=name))
    return clips


def _aim(sim, task: str) -> None:
    """Give a MuJoCo environment that draws our camera, before its first picture."""
    renderer = getattr(getattr(sim, "_env", None), "mujoco_renderer", None)
    if renderer is not None and task in CAMERAS:
        renderer.default_cam_config = CAMERAS[task]


def trace(spec: TaskSpec, policy: Decorated, seed: int, *, steps: int | None = None) -> pd.DataFrame:
    """One row a step of the decorated policy's episode, for `plots.residual_figure`: step, base and residual (mean
    absolute size per action dimension, the residual times alpha), success."""
    rows = []

    def watched(windows: np.ndarray) -> np.ndarray:
        base, residual = policy.parts(windows)
        sizes = (np.abs(part).reshape(policy.chunk, -1).mean(1) for part in (base, scaled(policy.config, residual)))
        rows.extend({"base": b, "residual": r} for b, r in zip(*sizes, strict=True))
        return compose(policy.config, base, residual).reshape(1, policy.chunk, -1)

    policy.reset(0)
    clip = record(spec, watched, seed, window=policy.window, steps=steps, pictures=False)
    return pd.DataFrame(rows[: clip.length]).assign(step=np.arange(1, clip.length + 1), success=clip.success)


def contrasts(spec: TaskSpec, base: Policy, decorated: Decorated, seeds: Sequence[int], count: int = 1, *,
              tries: int = 6, steps: int | None = None, stride: int = 3, name: str = "decorated") -> list[tuple[Clip, Clip]]:
    """Up to `count` pairs of episodes from `seeds` that the base fails and the decorated policy, labelled `name`, solves, with frames.

    Each is run again, alone: matrix products round differently for one lane than for fifty, and a contact can turn that
    into another outcome, so an episode that now comes out otherwise is passed over (at most `tries` are run).
    """
    pairs: list[tuple[Clip, Clip]] = []
    for seed in seeds[:tries]:
        if len(pairs) == count:
            break
        (failed,) = record_all(spec, {"base": base}, seed, steps=steps, stride=stride)
        if failed.success.any():
            continue
        (solved,) = record_all(spec, {name: decorated}, seed, steps=steps, stride=stride)
        if solved.success.any():
            pairs.append((failed, solved))
    return pairs


# ---- contact sheets and videos ---------------------------------------------------------------------------------------

@styled
def contact_sheet(clips: Sequence[Clip], columns: int = 8, labels: Sequence[str] | None = None, alike: bool = True) -> Picture:
    """One row an episode, `columns` frames, the last at the end, at the same steps in all rows or, not `alike`, at steps of the row's own
    (where lengths differ much, a short episode would have but one frame); green: solved by then.

    Frames stand closer until a while after the last first success, because little happens later.
    """
    if not clips or not all(clip.frames for clip in clips):
        raise PdkitError("A contact sheet needs at least one recorded episode with frames.")

    def wanted(clips: Sequence[Clip]) -> list[float]:
        length = max(clip.length for clip in clips)
        focus = min(length, int(1.5 * max((clip.first_success or 0 for clip in clips), default=0)) or length)
        return [*np.linspace(0, focus, columns - (focus < length)), *([length] if focus < length else [])]

    height, width = clips[0].frames[0].shape[:2]
    thumb, title = 1.35 * height / width, 0.24  # inches
    total = (thumb + title) * len(clips)
    figure, axes = blank(len(clips), columns, (1.35 * columns, total), layout=None)
    figure.subplots_adjust(0.003, 0.03 / total, 0.997, 1 - title / total, wspace=0.02, hspace=title / thumb)
    for row, clip in enumerate(clips):
        for ax, step in zip(axes[row], wanted(clips if alike else [clip]), strict=True):
            i = int(np.abs(np.array(clip.steps) - step).argmin())
            _thumbnail(ax, clip.frames[i], clip.steps[i], clip.solved_by(clip.steps[i]))
        name = labels[row] if labels else clip.label
        text = f"{name}  seed {clip.seed}: {clip.outcome}".strip()
        color = COLORS["gained" if clip.success.any() else "lost"]
        axes[row, 0].set_title(text, fontsize=9, color=color, pad=3)
    return figure


def _thumbnail(ax, frame: np.ndarray, step: int, solved: bool) -> None:
    ax.imshow(frame)
    ax.grid(False)
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set(visible=True, linewidth=2.5 if solved else 0.8, color=COLORS["gained"] if solved else "#999999")
    ax.text(0.03, 0.04, str(step), transform=ax.transAxes, color="white", fontsize=7.5,
            bbox={"facecolor": "black", "alpha": 0.55, "pad": 1.5, "lw": 0})


def annotated(clip: Clip) -> list[np.ndarray]:
    """The frames with the policy's name, the step, a bar of time, and a green border once the task was solved."""
    green = tuple(int(255 * c) for c in mpl.colors.to_rgb(COLORS["gained"]))
    frames = []
    for frame, step in zip(clip.frames, clip.steps, strict=True):
        picture = np.ascontiguousarray(frame).copy()
        height, width = picture.shape[:2]
        if clip.solved_by(step):
            for edge in (picture[:5], picture[-5:], picture[:, :5], picture[:, -5:]):
                edge[...] = green
        picture[-5:, : max(1, width * step // max(1, clip.length))] = green if clip.solved_by(step) else (230, 230, 230)
        frames.append(_write(picture, f"{clip.label}  step {step}".strip(), (8, 6)))
    return frames


def _write(picture: np.ndarray, text: str, at: tuple[int, int]) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    font = ImageFont.truetype(mpl.font_manager.findfont("DejaVu Sans"), max(10, picture.shape[0] // 18))
    ImageDraw.Draw(image).text(at, text, fill="white", font=font, stroke_width=2, stroke_fill="black")
    return np.asarray(image)


def side_by_side(*clips: Clip) -> list[np.ndarray]:
    """Annotated frames of several episodes next to each other; one that ends early keeps its last frame."""
    if not clips or not all(clip.frames for clip in clips):
        raise PdkitError("A video needs at least one recorded episode with frames.")
    columns = [annotated(clip) for clip in clips]
    return [np.hstack([c[min(i, len(c) - 1)] for c in columns]) for i in range(max(map(len, columns)))]


def write_video(frames: Sequence[np.ndarray], path: str | Path, *, fps: float = FPS,
                limit: int = EMBED_BYTES) -> Path | None:
    """Write frames (height, width, 3) as an H.264 MP4 of at most about `limit` bytes, at a lower quality if need be.

    A path that ends in .webp gets an animated picture of half the size and one quality, whatever the limit, for pages that show no videos.
    Returns the path, or None where no encoder works: a video is an extra, like every picture.
    """
    path = Path(path)
    if not len(frames):
        raise PdkitError("A video needs at least one frame.")
    if path.suffix == ".webp":
        return _write_webp(frames, path, fps)
    import mediapy

    height, width = (n - n % 2 for n in frames[0].shape[:2])  # H.264 halves the colour planes
    frames = [frame[:height, :width] for frame in frames]
    try:
        import imageio_ffmpeg

        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
        for crf in (25, 31, 37, 43):
            with atomic_file(path) as temporary:
                mediapy.write_video(temporary, frames, fps=fps, crf=crf)
            if path.stat().st_size <= limit:
                break
    except (RuntimeError, ImportError) as error:
        print(f"No video: the encoder did not work ({str(error).splitlines()[0][:120]}).")
        return None
    return path


def _write_webp(frames: Sequence[np.ndarray], path: Path, fps: float) -> Path:
    from PIL import Image

    pictures = [Image.fromarray(frame).resize((frame.shape[1] // 2, frame.shape[0] // 2)) for frame in frames]
    with atomic_file(path) as temporary:
        pictures[0].save(temporary, "WEBP", save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0, quality=20,
                         method=6)
    return path


def video_tag(path: str | Path, caption: str = "") -> str:
    """HTML that plays a video with its bytes inside: for a page, or for a notebook as `HTML(video_tag(path))`."""
    from html import escape

    data = base64.b64encode(Path(path).read_bytes()).decode()
    return (f'<video controls loop muted playsinline style="max-width:100%" title="{escape(caption, quote=True)}" '
            f'src="data:video/mp4;base64,{data}"></video>')


def film(clips: Sequence[Clip], path: str | Path, caption: str = "", *, fps: int = 20) -> str:
    """Write episodes next to each other as one MP4, and return the HTML that plays it (`video_tag`); "" where no encoder works."""
    written = write_video(side_by_side(*clips), path, fps=fps)
    return video_tag(written, caption) if written else ""


def show(clips: Sequence[Clip], path: str | Path, caption: str = "", *, columns: int = 8, alike: bool = True) -> None:
    """In a notebook: episodes as a contact sheet (`alike`: see there), and below it as a film side by side; kept as PATH.png and PATH.mp4.
    """
    from IPython.display import HTML, display

    path = Path(path)
    sheet = contact_sheet(clips, columns, alike=alike)
    sheet.savefig(path.with_suffix(".png"))
    display(sheet)
    if tag := film(clips, path.with_suffix(".mp4"), caption or ", ".join(clip.label for clip in clips) + ": the same episode"):
        display(HTML(tag))
