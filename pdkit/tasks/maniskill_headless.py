"""Building ManiSkill 3 environments on machines without a Vulkan driver, and asking whether this one can draw.

ManiSkill's `render_backend="none"` already leaves out render systems, visual shapes, cameras and lights. What remains
is that its loaders construct SAPIEN materials and textures, which need a Vulkan device: here they get inert stand-ins
while an environment is built. Physics is untouched, so the trajectories are the same with and without a driver.
"""
from __future__ import annotations

import gc
import itertools
import logging
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from typing import Any

from ..errors import PdkitError
from ..machine import SAPIEN_DRAWS

PICTURE = 256  # pixels a side of a rendered frame
_closings = itertools.count(1)


class _Inert:
    """Stands in for a SAPIEN material or texture: takes any arguments and attributes, and every `set_...` call."""

    def __init__(self, *args: Any, **kwargs: Any):
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set_"):
            return lambda *args, **kwargs: None
        raise AttributeError(name)


@contextmanager
def without_materials() -> Iterator[None]:
    """Within this block SAPIEN's materials and textures are inert objects that need no Vulkan device."""
    import sapien.pysapien
    import sapien.render
    import sapien.wrapper.urdf_loader

    modules = (sapien.render, sapien.pysapien.render, sapien.wrapper.urdf_loader)
    names = ("RenderMaterial", "RenderTexture2D")
    saved = [(module, name, getattr(module, name)) for module in modules for name in names]
    for module, name, _ in saved:
        setattr(module, name, _Inert)
    try:
        yield
    finally:
        for module, name, original in saved:
            setattr(module, name, original)


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what ManiSkill, SAPIEN and gymnasium warn about while importing and building: no user can act on it."""
    logger = logging.getLogger("mani_skill ")  # the trailing space is ManiSkill's
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import mani_skill  # noqa: F401  # sets the logger's level when first imported
        except ImportError as error:
            raise PdkitError(
                f"ManiSkill cannot be imported ({error}); run `./pd run` or `pip install -r environment.txt`."
            ) from error
        level = logger.level
        logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            logger.setLevel(level)


class _Young:
    """Stands in for `gc` where ManiSkill calls for a collection."""

    @staticmethod
    def collect() -> int:
        return gc.collect(1)


@contextmanager
def collecting_young() -> Iterator[None]:
    """Within this block ManiSkill searches recent objects alone for garbage. It searches whenever it builds or closes a scene, to free a
    GPU's memory; among the half million objects of torch and its like that is nine tenths of the time of either."""
    from mani_skill.envs import sapien_env

    sapien_env.gc = _Young
    try:
        yield
    finally:
        sapien_env.gc = gc


@lru_cache(maxsize=1)
def render_device() -> str | None:
    """The device SAPIEN can draw on, "cuda" or "cpu", or None: found once a process, by drawing in a subprocess."""
    try:
        done = subprocess.run([sys.executable, "-c", SAPIEN_DRAWS], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return None
    words = done.stdout.split()
    return words[-1] if done.returncode == 0 and "draws" in words else None


def require_rendering() -> str:
    """The device to draw on. Raises PdkitError that names the fix where ManiSkill scenes cannot be drawn."""
    device = render_device()
    if device is None:
        raise PdkitError(
            "ManiSkill scenes cannot be drawn here because SAPIEN finds no working Vulkan driver; go on without "
            "pictures, or install one (Debian 12: mesa-vulkan-drivers from bookworm-backports, as its stock version is "
            "too old; Ubuntu: mesa-vulkan-drivers; NVIDIA: the driver with its graphics libraries)."
        )
    return device


def close_env(env: Any) -> None:
    """Close an environment of `make_env`. Closed scenes are garbage among old objects (half a megabyte each): one closing in 25 searches
    these, too."""
    with nullcontext() if env.render_mode else collecting_young():
        env.close()
    if next(_closings) % 25 == 0:
        gc.collect()


Camera = tuple[tuple[float, float, float], tuple[float, float, float]]  # where it is and what it looks at, metres


def make_env(env_id: str, control_mode: str, camera: Camera | None = None, **kwargs: Any) -> Any:
    """A stock ManiSkill 3 environment, unwrapped (no time limit): state observations, sparse reward, and CPU physics unless
    `sim_backend` says otherwise.

    With a `camera` it can also draw what that sees (seconds to build); raises PdkitError where nothing can be drawn.
    """
    options = dict(obs_mode="state", reward_mode="sparse", control_mode=control_mode, sim_backend="cpu") | kwargs
    device = require_rendering() if camera else None
    with quiet():
        import gymnasium
        import mani_skill.envs  # noqa: F401  # registers the tasks
        from mani_skill.utils.sapien_utils import look_at

        if camera:
            view = dict(width=PICTURE, height=PICTURE, pose=look_at(*camera))
            drawing = dict(render_backend=device, render_mode="rgb_array", human_render_camera_configs=view)
            return gymnasium.make(env_id, **options, **drawing).unwrapped
        with without_materials(), collecting_young() if options["sim_backend"] == "cpu" else nullcontext():
            return gymnasium.make(env_id, render_backend="none", **options).unwrapped
