"""A plan of PushChair's floor, drawn from an observation: it needs no graphics driver, and says all that the task is about."""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from .chair_body import CLOSE

SIZE = 256  # pixels a side
REACH = 2.4  # metres from the target to an edge of the picture
SEAT, TORSO = 0.36, (0.2, 0.3)  # metres: a seat's edge; the torso's depth and width


@lru_cache(maxsize=1)
def _canvas() -> tuple[Any, dict[str, Any]]:
    """A figure with the target and, by name, what moves on it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Polygon

    figure = Figure(figsize=(1, 1), dpi=SIZE)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-REACH, REACH), ylim=(-REACH, REACH), xticks=(), yticks=())
    axes.add_patch(Circle((0, 0), CLOSE, color="tab:red", alpha=0.5, lw=0))
    corner = np.zeros((4, 2))
    things = dict(seat=axes.add_patch(Polygon(corner, color="tab:blue", alpha=0.8, lw=0)), back=axes.plot([], [], color="navy", lw=1)[0],
                  torso=axes.add_patch(Polygon(corner, color="dimgrey")), nose=axes.plot([], [], color="white", lw=0.6)[0],
                  hands=axes.plot([], [], "o", color="tab:orange", ms=1.5)[0])
    return FigureCanvasAgg(figure), things


def _corners(place: np.ndarray, angle: float, depth: float, width: float) -> np.ndarray:
    """Corners (4, 2) of a rectangle that looks along `angle`: back right, back left, front left, front right."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    return np.array([place + x * depth / 2 * along + y * width / 2 * across for x, y in ((-1, -1), (-1, 1), (1, 1), (1, -1))])


def plan(observation: np.ndarray) -> np.ndarray:
    """The picture (256, 256, 3), uint8, for an observation (131,): target red, chair blue with its dark back, robot grey with
    orange finger tips. The chair is drawn as its root link is turned; a turn of the swivel is not shown."""
    canvas, things = _canvas()
    w, x, y, z = observation[47:51]
    facing = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - np.pi / 2
    seat, torso = _corners(observation[44:46], facing, SEAT, SEAT), _corners(observation[38:40], observation[40], *TORSO)
    things["seat"].set_xy(seat)
    things["back"].set_data(seat[:2].T)
    things["torso"].set_xy(torso)
    things["nose"].set_data(torso[2:].T)
    things["hands"].set_data(observation[107:119].reshape(4, 3)[:, :2].T)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
