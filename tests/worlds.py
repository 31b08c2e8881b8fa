"""What several test modules build probes' policies and demonstrations with."""
import numpy as np
import torch

from pdkit.demos import Demos
from pdkit.probes import PROBES, ProbeBase


def reach_demos(num=20, aim=(0.0, 0.0), first_seed=0, spec=PROBES["reach"]):
    """Demonstrations of the reach probe by the controller that goes straight to the goal, missed by `aim`; until solved or over."""
    episodes = []
    for seed in range(first_seed, first_seed + num):
        sim = spec.make()
        observations, actions, success = [sim.reset(seed)], [], []
        while len(actions) < spec.max_episode_steps and not any(success):
            o = observations[-1]
            actions.append(np.clip((o[2:] + np.array(aim) - o[:2]) * 2.5, -1, 1).astype(np.float32))
            o, solved = sim.step(actions[-1])
            observations.append(o)
            success.append(solved)
        episodes.append((np.stack(observations), np.stack(actions), np.array(success), seed))
    observations, actions, success, seeds = zip(*episodes, strict=True)  # not from_episodes: the registry does not know probes
    return Demos("reach", "scripted", "test", "-", np.concatenate(observations), np.concatenate(actions), np.concatenate(success),
                 np.array([len(a) for a in actions]), np.array(seeds))


class TwoAtOnce(ProbeBase):
    """A probe's base policy that decides on two actions at once: the second repeats the first."""

    chunk = 2

    def forward(self, windows):
        return super().forward(windows).repeat(1, 2, 1)


def clone(kind, demos, config, iterations=300, lr=3e-3, seed=0):
    """A policy class trained on demonstrations of a probe, whole trajectories cut into windows."""
    from pdkit.imitate import Windows

    torch.manual_seed(seed)
    policy = kind({"obs_dim": 4, "act_dim": 2} | config)
    policy.fit_statistics(demos.observations, demos.actions)
    windows, generator = Windows(demos, policy.window, True, policy.horizon), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(policy.parameters(), lr=lr)
    policy.train()
    for _ in range(iterations):
        loss = policy.loss(*windows.sample(64, generator))["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return policy.eval()


def reach_trainer(method, base, demos=None, spec=PROBES["reach"], **changes):
    """The trainer of a method on the reach probe, at a scale of seconds; `changes` by flat name, over the method's own."""
    from pdkit.methods import METHODS
    from pdkit.methods.registry import make_trainer
    from pdkit.online_config import OnlineConfig
    from pdkit.profiles import build

    values = dict(
        task="reach", seed=0, method=method, total_steps=3000, num_envs=4, env_workers=0, eval_workers=0, warmup_steps=500, utd=0.5,
        batch=64, n_step=3, on_success="terminate", success_tail=0, gamma=0.9, eval_every=0, log_every=0, checkpoint_every=0,
        demo_fraction=0.0, hidden=32, layers=2, actor_lr=3e-3, critic_lr=3e-3, tau=0.05, average=0.95, bf16=False, actor_every=1)
    return make_trainer(build(OnlineConfig, values | METHODS[method].changes | changes), base, demos, spec)
