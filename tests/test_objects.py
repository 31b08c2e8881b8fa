"""What lesson 14 measures and draws: objects, how strange they are, and success object by object."""
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from pdkit import check, plots_objects, stats
from pdkit import object_analysis as analysis
from pdkit.demos import sources
from pdkit.errors import PdkitError
from pdkit.object_shapes import parts
from pdkit.tasks.chair_assets import chairs
from pdkit.tasks.faucet_assets import faucets
from pdkit.tasks.partnet import Model, UrdfWriter


def test_shapes_lie_where_the_joints_put_them():
    urdf = UrdfWriter("thing")
    urdf.link("base")
    urdf.box("foot", (0.2, 0.4, 0.1), (0, 0, 0.05))
    urdf.link("arm")
    urdf.box("lever", (0.3, 0.02, 0.02), (0.15, 0, 0))
    urdf.link("tip")
    urdf.sphere("ball", 0.1, (0.3, 0, 0))
    urdf.joint("turn", "revolute", "base", "arm", (0, 0, 1.0), (0, 0, np.pi / 2), limits=(0, 1))
    urdf.joint("tilt", "fixed", "arm", "tip", (0, 0, 0), (0, -np.pi / 2, 0))
    foot, lever, ball = parts(Model("thing", urdf.text()))
    assert [part.name for part in (foot, lever, ball)] == ["foot", "lever", "ball"] and lever.link == "arm"
    assert foot.triangles.shape == (12, 3, 3)
    spans = [(part.triangles.reshape(-1, 3).min(0), part.triangles.reshape(-1, 3).max(0)) for part in (foot, lever, ball)]
    assert np.allclose(spans[0], [(-0.1, -0.2, 0), (0.1, 0.2, 0.1)], atol=1e-5)
    assert np.allclose(spans[1], [(-0.01, 0, 0.99), (0.01, 0.3, 1.01)], atol=1e-5)  # it points along y
    assert np.allclose(np.mean(spans[2], axis=0), (0, 0, 1.3), atol=0.02)  # tilted up, at the end of the arm


def test_meshes_of_a_users_object_are_drawn(tmp_path):
    (tmp_path / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = '<robot name="x"><link name="a"><visual name="knob-1"><origin xyz="0 0 2"/><geometry>' \
           '<mesh filename="cube.obj" scale="2 2 2"/></geometry></visual></link></robot>'
    (part,) = parts(Model("x", text, tmp_path / "mobility.urdf"))
    assert part.name == "knob" and np.allclose(part.triangles[0], [(0, 0, 2), (2, 0, 2), (0, 2, 2)])


@pytest.mark.parametrize("task", analysis.NOVEL)
def test_the_object_of_an_episode_is_the_simulators(task):
    source, novel = analysis.both(task)
    for spec in (source, novel):
        sim, models = spec.make(), analysis.objects(spec.name)
        seeds = range(1_000_000, 1_000_008)
        for seed in seeds:
            sim.reset(seed)
            there = sim.models[sim._model] if task == "TurnFaucet" else sim._env.chairs[0]
            assert there.model.name == models[analysis.object_of(spec.name, seed)].name
        sim.close()
    names = [{model.name for model in analysis.objects(spec.name)} for spec in (source, novel)]
    assert not names[0] & names[1] and len(names[1]) == 3
    assert {f.model.name for f in faucets(True)} | {c.model.name for c in chairs("novel")} >= names[1]


def test_a_task_without_novel_objects_is_refused():
    with pytest.raises(PdkitError, match="TurnFaucet or PushChair"):
        analysis.both("StackCube")


def test_strangeness_is_a_distance_in_standard_deviations():
    demos, part = sources.bundled("TurnFaucet"), analysis.OF_THE_OBJECT["TurnFaucet"]
    shown = np.stack([episode["observations"][0] for episode in demos.episodes()])
    assert np.allclose(analysis.strangeness(demos, shown, "TurnFaucet"), 0)
    moved = shown[:1].copy()
    moved[0, part] += 10 * shown[:, part].std(axis=0)
    (far,) = analysis.strangeness(demos, moved, "TurnFaucet")
    assert 6 < far < 14  # the nearest may be another one than where it was moved from
    robot = shown[:1].copy()
    robot[0, :32] += 5
    assert np.allclose(analysis.strangeness(demos, robot, "TurnFaucet"), 0)  # the robot's own numbers do not count


def test_starts_are_the_episodes_first_observations():
    source, novel = analysis.both("PushChair")
    first = analysis.starts(novel, [1_000_000, 1_000_001])
    sim = novel.make()
    assert first.shape == (2, 131) and np.array_equal(first[1], sim.reset(1_000_001))
    sim.close()


class Still:
    """A policy that does nothing."""

    window, chunk = 1, 1

    def __init__(self, act_dim):
        self.act_dim = act_dim

    def reset(self, seed):
        pass

    def act(self, windows):
        return np.zeros((len(windows), 1, self.act_dim), np.float32)


def test_episodes_are_told_apart_by_object():
    table = analysis.by_object({"still": Still(7)}, "TurnFaucet", 4, limit=3)
    assert len(table) == 8 and set(table.objects) == {"source", "novel"} and not table.success_once.any()
    for row in table.itertuples():
        task = "TurnFaucet" if row.objects == "novel" else "TurnFaucetSource"
        assert row.object == analysis.objects(task)[analysis.object_of(task, row.seed)].name
    assert analysis.summary(table).episodes.sum() == 8


def test_what_is_left_starts_at_all_of_it_and_counts_down():
    observations = np.zeros((3, 40), np.float32)
    observations[:, 32], observations[:, 39] = 2.0, (2.0, 0.5, -0.1)
    assert np.allclose(analysis._left(observations, "TurnFaucet"), [1, 0.25, 0])
    chairs_at = np.zeros((1, 131), np.float32)
    chairs_at[0, 44:46] = 3, 4
    assert analysis._left(chairs_at, "PushChair") == 5
    left = analysis.paths(Still(7), analysis.both("TurnFaucet")[1], [1_000_000, 1_000_001], "TurnFaucet", limit=5)
    assert left.shape == (2, 5) and np.allclose(left, 1, atol=0.02)


def episodes(base, novel, lifted):
    rows = []
    for policy, kind, outcomes in (("base", "source", base), ("base", "novel", novel), ("decorated", "novel", lifted)):
        seeds = np.arange(len(outcomes))
        rows.append(pd.DataFrame(dict(policy=policy, objects=kind, object=[f"{kind}-{s % 2}" for s in seeds], seed=seeds,
                                      success_once=np.array(outcomes, bool), success_at_end=np.array(outcomes, bool), length=9)))
    return pd.concat(rows, ignore_index=True)


def test_verdict_follows_its_rule():
    many, few, none, half = [1] * 36 + [0] * 4, [1] * 8 + [0] * 32, [0] * 40, [1] * 20 + [0] * 20
    assert analysis.verdict(episodes(many, few, many), "base", "decorated")[0] == "reproduced"
    assert analysis.verdict(episodes(many, few, few), "base", "decorated")[0] == "partly"  # a gap, and no gain
    assert analysis.verdict(episodes(half, half, many), "base", "decorated")[0] == "partly"  # a gain, and no gap
    assert analysis.verdict(episodes(few, many, many), "base", "decorated")[0] == "not"
    slight = [1] * 7 + [0] * 33  # a gap that chance explains, and a loss
    assert analysis.verdict(episodes(few, slight, [0] * 36 + [1] * 4), "base", "decorated")[0] == "not"
    assert analysis.verdict(episodes(none, none, none), "base", "decorated")[0] == "untested"
    _, reasons = analysis.verdict(episodes(many, few, many), "base", "decorated")
    assert "-70 points, intervals apart" in reasons[0] and "+70 points" in reasons[1]


def test_each_object_counts_once_and_few_objects_say_little():
    interval = analysis.over_objects([0.4, 0.5, 0.6])
    half = 4.302653 * 0.1 / np.sqrt(3)  # Student's t with two degrees of freedom
    assert np.allclose([interval.value, interval.low, interval.high], [0.5, 0.5 - half, 0.5 + half], atol=1e-5)
    assert analysis.over_objects([0.0, 1.0]).low == 0 and analysis.over_objects([0.0, 1.0]).high == 1
    with pytest.raises(PdkitError, match="at least two"):
        analysis.over_objects([0.5])


def test_pictures_show_the_objects_and_the_rates():
    figure = plots_objects.objects_figure({"source": analysis.objects("TurnFaucetSource")[:2], "novel": analysis.objects("TurnFaucet")[:1]})
    titles = [ax.get_title(loc="center") for ax in figure.axes]
    assert titles == ["ours-0\nsource", "ours-1\nsource", "ours-10\nnovel"]
    table = analysis.summary(episodes([1] * 8 + [0] * 2, [1, 0] * 5, [1] * 10))
    totals = {("base", "novel"): stats.wilson(5, 10)}
    source, novel = plots_objects.by_object_figure(table, totals).axes
    assert [label.get_text() for label in novel.get_xticklabels()] == ["novel-0", "novel-1"]
    assert source.get_title(loc="left") == "source objects" and len(novel.containers) == 2
    drawn = plots_objects.paths_figure({"base": np.ones((3, 4))}, "left", chunk=2)
    assert list(drawn.axes[0].lines[0].get_xdata()) == [0, 2, 4, 6]
    lines = plots_objects.strangeness_figure({"source": np.arange(4.0), "novel": np.arange(5.0)}).axes[0].lines
    assert len(lines) == 2 and lines[1].get_xdata()[-1] == 4
    assert to_rgb(lines[1].get_color()) == to_rgb(plots_objects.KINDS["novel"])


def test_exercise_names_the_likely_mistake(capsys):
    def solution(successes, objects):
        return np.mean([successes[objects == name].mean() for name in np.unique(objects)])

    assert check.object_mean(solution)
    assert not check.object_mean(lambda successes, objects: successes.mean()) and "mean over episodes" in capsys.readouterr().out
    with pytest.raises(PdkitError, match="to be written"):
        check.object_mean(lambda successes, objects: (_ for _ in ()).throw(NotImplementedError()), strict=True)
