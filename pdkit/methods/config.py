"""What single methods add to the configuration of the loop, one line a number, with its source."""
from __future__ import annotations

from dataclasses import dataclass

from ..errors import PdkitError, unknown

CRITIC_BACKBONES = ("mlp", "shared", "separate")


@dataclass(frozen=True)
class MethodConfig:
    """The methods named in a field's comment read it; the others refuse it (`registry.check_read`)."""

    lora: int = 8  # fine-tuning: rank of the adapters (the paper gives none); 0 trains all weights
    critic_backbone: str = "mlp"  # fine-tuning: what critics see the window through (pdkit/rl/gpt_critic.py; appendix F.5.1)
    # PPO (the paper gives no numbers; cleanrl's defaults for continuous control, see ppo.py)
    ppo_rollout: int = 256  # ppo: decisions of each environment between updates (cleanrl: 2,048 of one; here of 8 together)
    ppo_epochs: int = 10  # ppo: passes over a rollout
    ppo_minibatches: int = 32  # ppo: gradient steps a pass
    ppo_lr: float = 3e-4  # ppo: of policy and value function
    ppo_clip: float = 0.2  # ppo: how far ratio and value may gain from moving
    ppo_gae_lambda: float = 0.95  # ppo: 0 looks one step ahead, 1 to the end of the episode or rollout
    ppo_value_coef: float = 0.5  # ppo: weight of the value loss
    ppo_entropy_coef: float = 0.0  # ppo: weight of the entropy
    ppo_grad_clip: float = 0.5  # ppo: global norm of the whole gradient
    ppo_target_kl: float = 0.0  # ppo: no further passes over a rollout once the policy has moved this far; 0: always all
    ot_epsilon: float = 0.01  # rot, fish: entropic regularisation of Sinkhorn (ROT's code)
    ot_iterations: int = 100  # rot, fish: of Sinkhorn (ROT's code)
    ot_total: float = 10.0  # rot, fish: the first episode's rewards are scaled to sum to minus this (ROT's code)
    ot_demos: int = 10  # rot, fish: demonstrations that each episode is compared with, the first ones (ours: bounds the cost)
    ot_trunk: int = 50  # rot: width of the trunk (ROT's code)
    ot_renew_every: int = 10_000  # rot: steps between copies of the trunk that the reward uses (ROT's code)
    bc_weight: float = 0.03  # rot, fish: of the imitation loss where the Q-filter is fully on (their code)
    calql_offline_updates: int = 3_000  # calql: gradient steps before the first environment step (ours; original: 20,000)
    calql_data: str = "demos"  # calql: what they learn from: demonstrations, or "mixed" with rollouts of the base policy (appendix F.3)
    calql_rollouts: int = 50  # calql: how many (ours)
    calql_online: str = "sac"  # calql: critics online: plain SAC, or still conservative ("calql"; appendix F.3)
    calql_pretrained: bool = True  # calql: the transformer starts as imitated (setup E), or from random weights (D)
    calql_actions: int = 4  # calql: sampled actions of each kind (ours; original: 10)
    calql_weight: float = 1.0  # calql: of the conservative term (original)
    calql_scale: float = 10.0  # calql: rewards -1 and 0 count as so much larger ones in that term (original: -5 and 5)
    calql_max_target: bool = True  # calql: the best of the sampled actions in the target (original)
    dipo_steps: int = 20  # dipo: gradient steps in actions each time they are drawn (the original)
    dipo_lr: float = 0.03  # dipo: of these steps, by Adam: about how far one moves each number (the original)
    dipo_norm: float = 0.1  # dipo: norm that a batch's gradient is clipped to, for each number of an action (the original)
    dppo_steps: int = 4  # dppo: denoising steps that are fine-tuned, the last ones (DPPO: 10 of 20, and all 5 where it samples by DDIM)
    dppo_gamma: float = 0.99  # dppo: discount of the advantage for each step before the last (DPPO, Square)
    dppo_clip: float = 0.01  # dppo: clipping of the ratio at the last step (DPPO, Square)
    dppo_clip_first: float = 0.001  # dppo: ... at the noisiest fine-tuned one (DPPO, Square)
    dppo_clip_rate: float = 3.0  # dppo: of the exponential between them (DPPO, Square)
    dppo_sample_std: float = 0.1  # dppo: least standard deviation of the noise in a step when acting (DPPO, Square)
    dppo_log_prob_std: float = 0.1  # dppo: ... when probabilities are computed (DPPO, Square)
    dppo_value_lr: float = 1e-3  # dppo: of the value function; the policy's is ppo_lr (DPPO, Square)
    jsrl_episodes: int = 100  # jsrl: episodes of the base policy that give the first horizon (appendix B.5)
    jsrl_step: int = 10  # jsrl: steps that the guide gives up at a time (appendix B.5)
    jsrl_window: int = 3  # jsrl: evaluations in the moving mean (ours; the paper gives none)
    jsrl_tolerance: float = 0.1  # jsrl: how far below the best mean still counts as good (ours; the paper gives none)

    def __post_init__(self):
        if self.lora < 0:
            raise PdkitError(f"lora is a rank of 0 or more, not {self.lora}.")
        if min(self.ppo_rollout, self.ppo_epochs, self.ppo_minibatches) < 1 or min(self.ppo_lr, self.ppo_clip, self.ppo_grad_clip) <= 0:
            raise PdkitError("PPO needs ppo_rollout, ppo_epochs and ppo_minibatches of 1 or more, and ppo_lr, ppo_clip and ppo_grad_clip "
                             "above 0.")
        if not 0 <= self.ppo_gae_lambda <= 1 or min(self.ppo_value_coef, self.ppo_entropy_coef, self.ppo_target_kl) < 0:
            raise PdkitError("PPO needs ppo_gae_lambda in [0, 1], and ppo_value_coef, ppo_entropy_coef and ppo_target_kl of 0 or more.")
        if min(self.ot_iterations, self.ot_demos, self.ot_trunk, self.ot_renew_every) < 1 or self.ot_total <= 0 or self.bc_weight < 0:
            raise PdkitError("Optimal transport needs ot_iterations, ot_demos, ot_trunk and ot_renew_every of 1 or more, ot_total above 0 "
                             "and bc_weight of 0 or more.")
        for name, known in (("critic_backbone", CRITIC_BACKBONES), ("calql_data", ("demos", "mixed")), ("calql_online", ("sac", "calql"))):
            if getattr(self, name) not in known:
                raise unknown(name, getattr(self, name), known)
        if min(self.calql_actions, self.calql_rollouts) < 1 or min(self.calql_offline_updates, self.calql_weight) < 0 \
                or self.calql_scale <= 0:
            raise PdkitError("Cal-QL needs calql_actions and calql_rollouts of 1 or more, calql_offline_updates and calql_weight of 0 or "
                             "more, and calql_scale above 0.")
        if self.dipo_steps < 1 or min(self.dipo_lr, self.dipo_norm) <= 0:
            raise PdkitError("DIPO needs dipo_steps of 1 or more, and dipo_lr and dipo_norm above 0.")
        if min(self.dppo_steps, self.dppo_clip_first) <= 0 or self.dppo_clip < self.dppo_clip_first or not 0 < self.dppo_gamma <= 1 \
                or min(self.dppo_clip_rate, self.dppo_sample_std, self.dppo_log_prob_std, self.dppo_value_lr) <= 0:
            raise PdkitError("DPPO needs dppo_gamma in (0, 1], dppo_clip_first above 0 and at most dppo_clip, and dppo_steps, "
                             "dppo_clip_rate, dppo_sample_std, dppo_log_prob_std and dppo_value_lr above 0.")
        if min(self.jsrl_episodes, self.jsrl_step, self.jsrl_window) < 1 or self.jsrl_tolerance < 0:
            raise PdkitError("JSRL needs jsrl_episodes, jsrl_step and jsrl_window of 1 or more, and jsrl_tolerance of 0 or more.")
