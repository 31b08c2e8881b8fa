"""Figures show what their data says; videos, contact sheets and pages are what they claim, with or without a display."""
import base64
import dataclasses
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from pdkit import page, plots, stats, video
from pdkit.decorator import DecoratorConfig
from pdkit.demos.format import Demos
from pdkit.errors import PdkitError
from pdkit.evaluate import timed
from pdkit.files import ROOT
from pdkit.tasks import get_task
from pdkit.tasks.spec import TaskSpec


class Counter:
    """A simulator whose observation counts steps; solved from step 3 on; its picture is as bright as the count."""

    def __init__(self, render=False):
        self.ready, self.closed = render, False
        Counter.last = self

    def reset(self, seed):
        self.count, self.actions = 0, []
        return np.array([0.0, seed], np.float32)

    def step(self, action):
        self.count += 1
        self.actions.append(action)
        return np.array([self.count, 0], np.float32), self.count >= 3

    def render(self):
        if not self.ready:
            raise PdkitError("no pictures")
        return np.full((60, 80, 3), 20 * self.count, np.uint8)

    def close(self):
        self.closed = True


COUNTER = TaskSpec("Counter", "adroit", 2, 1, 7, "none", "from step 3 on", True, Counter)


def actor(windows):
    return np.full((len(windows), 1, 1), 0.5, np.float32)


@pytest.fixture
def clip():
    return video.record(COUNTER, actor, 5, window=2, stride=2, label="base")


def metrics(steps=(1000, 2000, 3000, 4000)):
    frame = pd.DataFrame({"step": steps, "seconds": [40.0 * (i + 1) for i in range(len(steps))]})
    frame["gate"] = np.minimum(frame.step / 3000, 1)
    frame["train_success"] = 0.5
    frame["success_once"] = [np.nan, 0.6, np.nan, 0.9][: len(steps)]
    frame["success_at_end"] = [np.nan, 0.5, np.nan, 0.8][: len(steps)]
    return frame


# ---- figures ---------------------------------------------------------------------------------------------------------

def line(figure, label):
    return next(x for x in figure.axes[0].lines if x.get_label().startswith(label)).get_xydata()


def test_learning_curve_shows_evaluations_base_and_recorded_runs():
    recorded = pd.concat([metrics().assign(seed=s, success_once=s / 10) for s in (1, 2)])
    figure = plots.learning_curve(metrics(), base=stats.wilson(40, 100), recorded=recorded, budget=8000)
    ax = figure.axes[0]
    assert line(figure, "decorated, solved at any step").tolist() == [[2000, 0.6], [4000, 0.9]]
    assert line(figure, "decorated, solved at the end").tolist() == [[2000, 0.5], [4000, 0.8]]
    assert line(figure, "gate")[:, 1].tolist() == pytest.approx([1 / 3, 2 / 3, 1, 1])
    greys = [x.get_ydata()[0] for x in ax.lines if to_hex(x.get_color()) == plots.COLORS["recorded"]]
    assert greys == pytest.approx([0.1, 0.2])
    band = ax.patches[0].get_extents().transformed(ax.transData.inverted())
    assert (band.y0, band.y1) == pytest.approx((stats.wilson(40, 100).low, stats.wilson(40, 100).high))
    assert ax.get_xlim()[1] >= 8000
    assert figure.png().startswith(b"\x89PNG")


def test_minutes_stand_where_they_were_reached():
    figure = plots.learning_curve(metrics())  # 40 s for each 1,000 steps: minute 1 at step 1,500
    top = figure.axes[0].child_axes[0]
    ticks = dict(zip([t.get_text() for t in top.get_xticklabels()], top.get_xticks(), strict=True))
    assert ticks["1"] == pytest.approx(1500) and ticks["2"] == pytest.approx(3000)


def test_learning_curve_of_a_run_without_evaluations():
    rows = metrics()[["step", "seconds", "gate"]]
    assert plots.learning_curve(rows).png()
    with pytest.raises(PdkitError, match="seconds"):
        plots.learning_curve(rows.drop(columns="seconds"))


def test_paired_figure_counts_cells():
    seeds = np.arange(40)
    base = pd.DataFrame({"seed": seeds, "success_once": seeds < 15})
    other = pd.DataFrame({"seed": seeds[::-1], "success_once": seeds[::-1] >= 10})  # another order
    figure = plots.paired_figure(stats.paired(base, other), base, other)
    cells = [to_hex(p.get_facecolor()) for p in figure.axes[1].patches]
    counts = {name: cells.count(plots.COLORS[name]) for name in ("both", "gained", "lost", "neither")}
    assert counts == {"both": 5, "gained": 25, "lost": 10, "neither": 0}
    texts = [t.get_text() for t in figure.axes[1].get_legend().get_texts()]
    assert any("gained (25)" in t for t in texts) and any("lost (10)" in t for t in texts)


def test_other_figures_draw_and_refuse_nonsense():
    rng = np.random.default_rng(0)
    trace = pd.DataFrame({"step": [1, 2, 3], "base": 0.3, "residual": 0.05, "success": [False, True, True]})
    figure = plots.residual_figure(trace, bound=0.1)
    assert [t.get_text() for t in figure.axes[0].texts] == ["solved at step 2"]
    centres = np.array([[-1.0, 0, 0], [1.0, 0, 0]])
    actions = np.concatenate([rng.normal(c, 0.05, (k, 3)) for c, k in zip(centres, (30, 10), strict=True)])
    bars = [p.get_height() for p in plots.bins_figure(actions, centres).axes[1].patches]
    assert bars == pytest.approx([0.75, 0.25])
    with pytest.raises(PdkitError, match="fit together"):
        plots.bins_figure(actions, centres[:, :2])
    history = pd.DataFrame({"iteration": [1, 2], "seconds": [1, 2], "loss": [2.0, 1.0], "success_once": [0.1, 0.5]})
    assert [a.get_title(loc="left") for a in plots.loss_curves(history).axes] == ["loss", "success"]
    lengths = np.array([5, 9])
    actions = rng.uniform(-1, 1, (14, 28))
    demos = Demos("Door", "agent", "", "", rng.random((16, 39)), actions, np.arange(14) > 3, lengths, lengths)
    assert plots.demo_figure(demos).png()
    assert plots.rates_figure({"a": stats.wilson(1, 9), "b": stats.wilson(9, 9)}).png()
    with pytest.raises(PdkitError, match="every row"):
        plots.loss_curves(history.iloc[:0])


def test_figures_leave_the_callers_style_alone():
    before = dict(mpl.rcParams)
    plots.rates_figure({"a": stats.wilson(1, 9)})
    assert dict(mpl.rcParams) == before


# ---- recording and videos --------------------------------------------------------------------------------------------

def test_record_keeps_every_step_and_the_right_frames(clip):
    assert clip.success.tolist() == [False, False, True, True, True, True, True]
    assert (clip.length, clip.first_success, clip.outcome) == (7, 3, "solved at step 3")
    assert clip.steps == [0, 2, 4, 6, 7] and [f[0, 0, 0] // 20 for f in clip.frames] == clip.steps
    assert Counter.last.closed


def test_record_gives_the_policy_its_window_and_plays_whole_chunks():
    seen = []

    def chunked(windows):
        seen.append(windows[0, :, 0].tolist())
        return np.array([[[0.1], [2.0], [-3.0]]], np.float32)

    clip = video.record(COUNTER, chunked, 9, window=3, steps=5, pictures=False)
    assert seen == [[0, 0, 0], [1, 2, 3]] and clip.length == 5 and clip.frames == []
    # Clipped, and cut at the limit.
    assert [float(a[0]) for a in Counter.last.actions] == pytest.approx([0.1, 1, -1, 0.1, 1])


def test_record_tells_a_policy_the_time_that_asks_for_it():
    """Such as JSRL's, whose guide takes the first steps."""
    seen = []

    @timed
    def act(windows, elapsed):
        seen.append(elapsed.tolist())
        return np.zeros((1, 2, 1), np.float32)

    video.record(COUNTER, act, 9, steps=5, pictures=False)
    assert seen == [[0], [2], [4]]


def test_trace_has_a_row_for_each_step_of_a_chunk():
    parts = np.array([[0.1, -0.2, 0.3]]), np.array([[1.0, 0.0, -0.5]])
    policy = SimpleNamespace(parts=lambda w: parts, reset=lambda s: None, window=1, chunk=3, config=DecoratorConfig(alpha=0.5))
    rows = video.trace(COUNTER, policy, 1, steps=4)
    assert rows.step.tolist() == [1, 2, 3, 4] and rows.base.tolist() == pytest.approx([0.1, 0.2, 0.3, 0.1])
    assert rows.residual.tolist() == pytest.approx([0.5, 0, 0.25, 0.5]) and rows.success.tolist() == [False, False, True, True]


def test_never_solved(clip):
    failed = video.Clip("Counter", 1, np.zeros(4, bool), clip.frames[:2], [0, 4])
    assert (failed.first_success, failed.outcome, failed.solved_by(99)) == (None, "not solved", False)


def test_a_sheet_shows_each_episode_at_steps_of_its_own_where_lengths_differ(clip):
    frames = [clip.frames[0]] * 21
    long, short = (video.Clip("Counter", 1, np.zeros(steps, bool), frames[: steps + 1], list(range(steps + 1))) for steps in (20, 4))
    alike, own = ([ax.texts[0].get_text() for ax in video.contact_sheet([long, short], columns=3, alike=same).axes]
                  for same in (True, False))
    assert alike == ["0", "10", "20", "0", "4", "4"] and own == ["0", "10", "20", "0", "2", "4"]


def test_contact_sheet_marks_success(clip):
    figure = video.contact_sheet([clip, clip], columns=4, labels=["base", "decorated"])
    axes = np.array(figure.axes).reshape(2, 4)
    titles = [row[0].get_title(loc="left") for row in axes]
    assert titles == ["base  seed 5: solved at step 3", "decorated  seed 5: solved at step 3"]
    for ax in axes[0]:
        green = to_hex(ax.spines["left"].get_edgecolor()) == plots.COLORS["gained"]
        assert green == (int(ax.texts[0].get_text()) >= 3)
    assert axes[0, 0].texts[0].get_text() == "0" and axes[0, -1].texts[0].get_text() == "7"
    with pytest.raises(PdkitError, match="frames"):
        video.contact_sheet([])


def test_side_by_side_pads_and_marks(clip):
    short = video.Clip("Counter", 1, np.zeros(2, bool), clip.frames[:2], [0, 2], "other")
    frames = video.side_by_side(clip, short)
    assert len(frames) == len(clip.frames) and frames[0].shape == (60, 160, 3)
    corner = tuple(frames[-1][0, 0])
    assert to_hex(np.array(corner) / 255) == plots.COLORS["gained"] and tuple(frames[-1][0, -1]) != corner
    assert (frames[-1][:, 80:] == frames[1][:, 80:]).all()


class Still:
    """A policy that always decides the same and remembers its resets."""

    window, act = 2, staticmethod(actor)

    def __init__(self):
        self.resets = []

    def reset(self, seed):
        self.resets.append(seed)


def test_one_episode_of_several_policies_is_a_sheet_and_a_film(tmp_path, monkeypatch):
    import IPython.display
    import mediapy

    policies, shown = {"before": Still(), "after": Still()}, []
    clips = video.record_all(COUNTER, policies, 5, steps=6, stride=2)
    assert [(c.label, c.seed, c.steps) for c in clips] == [("before", 5, [0, 2, 4, 6]), ("after", 5, [0, 2, 4, 6])]
    assert all(policy.resets == [0] for policy in policies.values())
    tag = video.film(clips, tmp_path / "two.mp4", 'one "episode"')
    assert tag.startswith("<video ") and "&quot;episode&quot;" in tag and mediapy.read_video(tmp_path / "two.mp4").shape == (4, 60, 160, 3)
    monkeypatch.setattr(IPython.display, "display", shown.append)
    video.show(clips, tmp_path / "episode")
    assert (tmp_path / "episode.png").exists() and isinstance(shown[0], plots.Picture)
    assert "before, after: the same episode" in shown[1].data
    monkeypatch.setattr(video, "write_video", lambda *a, **k: None)
    assert video.film(clips, tmp_path / "none.mp4") == ""
    video.show(clips, tmp_path / "episode")
    assert len(shown) == 3  # the sheet alone


def test_video_is_small_h264_and_reads_back(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (61, 81, 3)).astype(np.uint8) for _ in range(60)]  # noise: the worst case; odd sizes
    path = video.write_video(frames, tmp_path / "v.mp4", limit=60_000)
    assert 0 < path.stat().st_size < 150_000 and b"ftyp" in path.read_bytes()[:16] and b"avc1" in path.read_bytes()
    import mediapy

    assert mediapy.read_video(path).shape == (60, 60, 80, 3)
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]
    with pytest.raises(PdkitError, match="at least one frame"):
        video.write_video([], tmp_path / "w.mp4")


def test_no_encoder_is_a_sentence(tmp_path, monkeypatch, capsys):
    import imageio_ffmpeg

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: (_ for _ in ()).throw(RuntimeError("no ffmpeg")))
    assert video.write_video([np.zeros((4, 4, 3), np.uint8)], tmp_path / "v.mp4") is None
    assert "No video" in capsys.readouterr().out


# ---- whether pictures can be drawn -----------------------------------------------------------------------------------

@pytest.fixture
def fresh_probe(monkeypatch):
    monkeypatch.delenv(video.SWITCH, raising=False)
    video._try_mujoco.cache_clear()
    yield monkeypatch
    video._try_mujoco.cache_clear()


def test_pictures_can_be_turned_off(monkeypatch):
    monkeypatch.setenv(video.SWITCH, "off")
    assert "turned off" in video.try_render(get_task("Door")) and "turned off" in video.try_render(get_task("StackCube"))


def test_a_crashing_driver_is_a_sentence(fresh_probe):
    fresh_probe.setattr(video, "MUJOCO_DRAWS", "import os; os.kill(os.getpid(), 11)")
    reason = video.try_render(get_task("Door"))
    assert reason.startswith("No pictures: MuJoCo cannot draw here") and "doctor" in reason and "\n" not in reason


def test_the_backend_that_works_is_chosen(fresh_probe):
    fresh_probe.setenv("MUJOCO_GL", "broken")
    fresh_probe.setattr(video.sys, "platform", "linux")
    fresh_probe.setattr(video, "MUJOCO_DRAWS", "import os; assert os.environ['MUJOCO_GL'] == 'osmesa'; print('draws')")
    assert video.try_render(get_task("Door")) is None and os.environ["MUJOCO_GL"] == "osmesa"


def test_door_is_drawn_where_it_can_be(tmp_path):
    """In a process of its own, so that this one never loads a graphics driver."""
    if reason := video.try_render(get_task("Door")):
        pytest.skip(reason)
    code = ("import numpy as np; from pdkit import video; from pdkit.tasks import get_task\n"
            "spec = get_task('Door'); act = lambda w: np.zeros((1, 1, 28), np.float32)\n"
            "clip = video.record(spec, act, 1, steps=4, stride=2); assert len(clip.frames) == 3\n"
            "assert clip.frames[0].std() > 20 and (clip.frames[0] != clip.frames[-1]).any()\n")
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, cwd=ROOT, timeout=120)


# ---- the page --------------------------------------------------------------------------------------------------------

def test_page_is_one_file_escaped_and_whole(tmp_path):
    evil = "<script>alert('x')</script> & \"quotes\""
    film = video.write_video([np.zeros((8, 8, 3), np.uint8)] * 3, tmp_path / "v.mp4")
    parts = [evil, page.numbers([(evil, evil, evil)]), page.figure(plots.rates_figure({"a": stats.wilson(1, 2)}), evil),
             page.video(film, evil), page.table({evil: evil, "x": 1 / 3}), page.table([{"a": evil}]), page.code(evil)]
    path = page.write_page(tmp_path / "page.html", evil, [page.Section(evil, parts)])
    text = path.read_text()
    assert "<script" not in text and text.count("&lt;script&gt;") >= 10 and text.rstrip().endswith("</html>")
    assert not re.search(r"(src|href)=[\"'](?!data:)", text) and "http" not in text
    pictures = re.findall(r"data:image/png;base64,([^\"]+)", text)
    assert len(pictures) == 1 and base64.b64decode(pictures[0]).startswith(b"\x89PNG")
    assert base64.b64decode(re.search(r"data:video/mp4;base64,([^\"]+)", text)[1]) == film.read_bytes()
    assert "0.3333" in text and 'name="viewport"' in text


def test_page_names_a_missing_file(tmp_path):
    with pytest.raises(PdkitError, match="none.png"):
        page.figure(tmp_path / "none.png")
    (tmp_path / "a.png").write_text("text")
    with pytest.raises(PdkitError, match="no PNG|is not a PNG"):
        page.figure(tmp_path / "a.png")


def test_a_simulator_of_ones_own_is_asked_for_a_picture(monkeypatch):
    monkeypatch.delenv(video.SWITCH, raising=False)
    closed = []

    class Mute:
        def reset(self, seed):
            return np.zeros(2)

        def close(self):
            closed.append(self)

    class Draws(Mute):
        def __init__(self, render=False, picture=np.zeros((4, 4, 3), np.uint8)):  # noqa: B008
            assert render
            self.render = lambda: picture

    spec = dataclasses.replace(get_task("Door"), name="mine", suite="mine", make=Mute)
    assert "the simulator of mine draws none (TypeError" in video.try_render(spec)
    assert video.try_render(dataclasses.replace(spec, make=Draws)) is None
    assert "AttributeError" in video.try_render(dataclasses.replace(spec, make=lambda render: Mute()))
    for picture in (None, np.zeros((4, 4))):
        assert "TypeError: render() gives" in video.try_render(dataclasses.replace(spec, make=lambda render, p=picture: Draws(render, p)))
    assert len(closed) == 4
