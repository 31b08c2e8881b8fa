"""VINN: imitation by nearest neighbours, without a gradient step (Pari et al., 2021; facts.md 3.6; appendix B.5, G.2).

    d_i = |phi(o) - phi(o_i)|,   a = sum_i softmax(-d)_i a_i   over the k nearest observations o_i of the demonstrations

phi is the normalised observation ("raw"); or what the GPT of a trained Behavior Transformer makes of the window, at its last position; or
the scales and shifts by which the observations steer all blocks of a trained Diffusion Policy's U-Net (FiLM, through the layers that it has
for observations; the paper does not say which blocks, ours are all: they are the same at each diffusion step up to a constant, which
distances do not see). `skip` hides the first numbers of raw observations from the lookup: beside the features of a picture these are the
robot's state, and without them it is by the picture alone (Table 13; pdkit/pixels/learn.py makes such observations).

k = 1 copies the nearest action, as FISH does. `exclusion` adds FISH's buffer against getting stuck: a neighbour that comes up for more
than the `tolerance`-th time is passed over for the next nearest, and stays out until `exclusion` others have been put out after it (FISH:
3 and 1).

FISH carries that buffer from step to step. A policy here holds no state per episode, so the buffer is played through again from the
last `history` observations; what was chosen before them is forgotten. How large k is in the paper is not known: 5 is ours.
"""
from __future__ import annotations

from collections import Counter, deque
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError
from .base import Policy, load_policy
from .bet import BeT
from .bet_sac import BeTForSAC
from .diffusion import DiffusionPolicy

SPARE = 32  # neighbours more than asked for that are measured exactly: rows that matrix products may have put in another order
LENDERS: dict[str, type[Policy]] = {cls.kind: cls for cls in (BeT, BeTForSAC, DiffusionPolicy)}  # whose features can be used


class VINN(Policy):
    """Config: obs_dim, act_dim, k, exclusion (0: none), tolerance, history, skip (0: nothing is hidden), representation ("raw", or the
    folder of a trained bet or diffusion, which is replaced by its kind and configuration; its GPT, or FiLM layers, are part of this
    policy's weights), rows (of the library; 0 before `remember`)."""

    kind = "vinn"
    learns = False
    defaults: dict[str, Any] = dict(k=5, exclusion=0, tolerance=1, history=20, skip=0, representation="raw", rows=0)
    least = dict(exclusion=0, skip=0, rows=0)
    made = ("rows",)  # by `remember`

    def __init__(self, config: dict[str, Any]):
        super().__init__(config | {"representation": "raw"})
        c = self.config
        if c["exclusion"] and c["k"] != 1:
            raise PdkitError(f"VINN's exclusion buffer chooses one neighbour; set k=1 (now {c['k']}) or exclusion=0.")
        trained = self._representation(config.get("representation", "raw"))
        if c["skip"] and (trained or c["skip"] >= c["obs_dim"]):
            raise PdkitError(f"VINN's skip leaves out some of raw observations ({c['obs_dim']} numbers), not {c['skip']} of "
                             f"{'a trained policy' if trained else 'them'}.")
        self.gpt: nn.Module | None = trained.gpt if isinstance(trained, BeT) else None
        self.film: nn.Linear | None = trained.film() if isinstance(trained, DiffusionPolicy) else None
        self.obs_encoder: nn.Module | None = trained.obs_encoder if isinstance(trained, DiffusionPolicy) else None
        if trained:
            seen = trained.seen_scale() if isinstance(trained, DiffusionPolicy) else trained.normalizer
            self.normalizer.load_state_dict(seen.state_dict())
        self.looks = trained.window if trained else 1  # observations that make one feature
        self.window = self.looks + (c["history"] if c["exclusion"] else 0)
        self.feature_dim = self.film.out_features if self.film else trained.config["features"] if trained else c["obs_dim"] - c["skip"]
        self.register_buffer("library", torch.zeros(c["rows"], self.feature_dim))
        self.register_buffer("actions", torch.zeros(c["rows"], c["act_dim"]))
        self._kept: tuple[Any, torch.Tensor, torch.Tensor] | None = None  # of _in_double
        self.requires_grad_(False).eval()

    def _representation(self, given: Any) -> Policy | None:
        """The policy whose features are used: new from its kind and configuration (weights follow), or read from its folder."""
        kinds = " or ".join(LENDERS)
        if given == "raw":
            return None
        if isinstance(given, dict) and given.get("kind") in LENDERS:
            trained = LENDERS[given["kind"]]({name: value for name, value in given.items() if name != "kind"})
        elif isinstance(given, str):
            trained = load_policy(given)
        else:
            raise PdkitError(f"VINN's representation is raw, or the folder of a trained policy of kind {kinds}, not {given!r}.")
        if type(trained) not in LENDERS.values():
            raise PdkitError(f"VINN takes the features of a policy of kind {kinds}, not {trained.kind}; train one with `pdkit train base`.")
        if (trained.config["obs_dim"], trained.config["act_dim"]) != (self.config["obs_dim"], self.config["act_dim"]):
            raise PdkitError("VINN's representation was trained for other observations or actions; give one of the same task.")
        self.config["representation"] = {"kind": trained.kind} | trained.config
        return trained

    def train(self, mode: bool = True) -> VINN:
        """Nothing is trained; the features stay those of evaluation (no dropout)."""
        return super().train(False)

    def fit_statistics(self, observations, actions, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim); a trained representation keeps its own."""
        if self.config["representation"] == "raw":
            self.normalizer.fit(observations)

    @torch.no_grad()
    def remember(self, windows: torch.Tensor, actions: torch.Tensor) -> None:
        """Make the library: windows (N, window, obs_dim), and the actions (N, act_dim) taken at their last observation."""
        if len(windows) < max(self.config["k"], self.config["exclusion"] + 1):
            raise PdkitError(f"VINN needs at least as many demonstrated steps as neighbours, not {len(windows)}; use more demonstrations.")
        self.library = torch.cat([self.features(part) for part in windows.to(self.library.device).split(1024)])
        self.actions, self._kept = actions.to(self.library.device).clone(), None
        self.config["rows"] = len(windows)

    def features(self, windows: torch.Tensor) -> torch.Tensor:
        """phi (N, feature_dim) of windows (N, at least `looks`, obs_dim)."""
        seen = self.normalizer(windows[:, -self.looks:])
        if self.film is not None:
            return self.film(F.mish(self.obs_encoder(seen.flatten(1)))).float()
        return seen[:, -1, self.config["skip"]:] if self.gpt is None else self.gpt(seen)[:, -1].float()

    def _in_double(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The library in double precision, and half of its rows' squares: made at the first look and kept, as the library lies still."""
        state = (self.library.data_ptr(), self.library._version, self.library.device)
        if self._kept is None or self._kept[0] != state:
            rows = self.library.double()
            self._kept = state, rows, rows.square().sum(dim=1) / 2
        return self._kept[1:]

    def _nearest(self, features: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Distances and rows (N, k) of the nearest of the library, nearest first."""
        if not len(self.library):
            raise PdkitError("This VINN has no demonstrations to look up; make one with `pdkit train base TASK --policy vinn`.")
        # Matrix products find the likely ones many times faster in a large library. Which of these are nearest is decided without:
        # the rounding of a product would not be 0 at a demonstrated observation.
        rows, squares = self._in_double()
        # |phi - phi_i|^2 / 2, but for |phi|^2 / 2, which is the same for all rows
        halves = torch.addmm(squares, features.double(), rows.T, alpha=-1)
        likely = halves.topk(min(k + SPARE, len(self.library)), dim=1, largest=False).indices
        exact = torch.cdist(features[:, None], self.library[likely], compute_mode="donot_use_mm_for_euclid_dist")[:, 0]
        distance, order = exact.topk(k, dim=1, largest=False)
        return distance, likely.gather(1, order)

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        if self.config["exclusion"]:
            return self.actions[self._choose(windows)][:, None]
        distance, rows = self._nearest(self.features(windows), self.config["k"])
        return (torch.softmax(-distance, dim=1)[..., None] * self.actions[rows]).sum(dim=1, keepdim=True)

    def _choose(self, windows: torch.Tensor) -> torch.Tensor:
        """Rows (N,) of the library after the exclusion buffer of each window has been played through."""
        past = windows.shape[1] - self.looks
        steps = windows.unfold(1, self.looks, 1).transpose(2, 3)  # (N, past + 1, looks, obs_dim)
        # Beside those in the buffer, the ones that a decision itself puts out have to be passed over.
        enough = min(self.config["exclusion"] + 1 + SPARE, len(self.library))
        nearest = self._nearest(self.features(steps.flatten(0, 1)), enough)[1].view(len(windows), past + 1, -1)
        # Before an episode's start its first observation repeats: no decision was made there.
        repeats = (windows == windows[:, :1]).all(dim=2).long().cumprod(dim=1).sum(dim=1)
        starts = (repeats - self.looks).clamp(0, past)
        chosen = [self._play(rows[start:]) for rows, start in zip(nearest.tolist(), starts.tolist(), strict=True)]
        return torch.tensor(chosen, device=windows.device)

    def _play(self, decisions: list[list[int]]) -> int:
        """The last choice of a sequence of decisions, each the nearest rows in order; where all are out, the farthest of them."""
        out: deque[int] = deque(maxlen=self.config["exclusion"])
        seen: Counter[int] = Counter()
        choice = -1
        for rows in decisions:
            choice = rows[-1]
            for row in rows:
                if row in out:
                    continue
                seen[row] += 1
                if seen[row] <= self.config["tolerance"]:
                    choice = row
                    break
                seen[row] = 0
                out.append(row)
        return choice
