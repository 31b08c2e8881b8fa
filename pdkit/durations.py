"""How long work will take, told before it begins."""
from __future__ import annotations

from .online_config import OnlineConfig

# Measured on two cores while evaluations run beside the training: a gradient step on 256 transitions in bfloat16 (networks
# of 3 x 256), which takes 1.4 times as long in float32, and a primitive step with simulator and base policy.
SECONDS_AN_UPDATE, SECONDS_A_STEP = 0.017, 0.0008


def expected_minutes(config: OnlineConfig, episodes: int) -> float:
    """Minutes that training and the two final evaluations of `episodes` take: a rough guide for two recent cores."""
    size = config.batch / 256 * config.sac.hidden / 256 * config.sac.layers / 3
    critics = 1 + 3 / 8 * (config.sac.num_critics - 2)  # ten cost four times two
    an_update = SECONDS_AN_UPDATE * max(size, 0.1) * critics * (1 if config.sac.bf16 else 1.4)
    updates = config.utd * (config.total_steps - config.warmup_steps)
    during = 0 if config.eval_workers or not config.eval_every else config.eval_episodes * config.total_steps // config.eval_every
    return (updates * an_update + (config.total_steps + 250 * during) * SECONDS_A_STEP) / 60 + evaluation_minutes(episodes)


def evaluation_minutes(episodes: int) -> float:
    """Minutes that the two final evaluations of `episodes` take, and the start; as rough."""
    return 2 * episodes * 250 * SECONDS_A_STEP / 60 + 0.4


def duration(minutes: float) -> str:
    """`minutes` in words, as exact as an estimate deserves."""
    if minutes < 1:
        return "less than a minute"
    if minutes < 1.5:
        return "about a minute"
    return f"about {minutes:.0f} minutes" if minutes < 90 else f"about {minutes / 60:.0f} hours"
