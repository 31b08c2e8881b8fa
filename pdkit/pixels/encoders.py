"""From pictures to features: PlainConv as the paper's code has it (facts.md 2.2), and the random shift that it is trained with.

    64 x 64     convolutions 3 x 3 to 16, 32, 64, 128 channels, each with a ReLU and halved by max pooling
    50 x 125    to 16, 16, 32, 64, 128 channels, the last one 1 x 1 and not halved
    128 x 128   one stage more than for 64 x 64: 16, 16, 32, 64, 128. The paper's encoder for Adroit is not known; this is ours
    then        a 1 x 1 convolution to 128 channels (for 50 x 125 the one above), and a linear layer with a ReLU to 256 features

It starts without biases, as ManiSkill's PlainConv does (haosulab/ManiSkill, examples/baselines/diffusion_policy; the paper's own file
was not at hand), and with He's weights (He et al. 2015), which is ours: each layer keeps the spread of what it is given. With PyTorch's
own weights and biases features vary by two or three ten-thousandths around constants, and a policy that imitates for hundreds of
gradient steps learns everything but to look (data/RESULTS.md, "Pixels").

Colours come in as bytes, distances in 1/1024 metre; the network sees both divided by their units.
"""
from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ..errors import PdkitError
from ..files import atomic_folder, read_json, sha256, write_json
from .cameras import View
from .sapien_eyes import UNITS

FEATURES = 256
FORMAT = "pdkit-encoder-1"
STAGES = {(64, 64): (16, 32, 64, 128), (50, 125): (16, 16, 32, 64), (128, 128): (16, 16, 32, 64, 128)}  # each halves the picture


class PlainConv(nn.Module):
    """Pictures (B, channels, height, width), scaled, to features (B, 256) of 0 and above. Raises PdkitError for another size."""

    def __init__(self, channels: int, height: int, width: int):
        super().__init__()
        if (height, width) not in STAGES:
            raise PdkitError(f"There is no encoder for pictures of {height} x {width}; there are ones for "
                             f"{', '.join(f'{h} x {w}' for h, w in STAGES)}.")
        layers: list[nn.Module] = []
        for width_out in STAGES[height, width]:
            layers += [nn.Conv2d(channels, width_out, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
            channels, height, width = width_out, height // 2, width // 2
        self.conv = nn.Sequential(*layers, nn.Conv2d(channels, 128, 1), nn.ReLU(), nn.Flatten())
        self.fc = nn.Linear(128 * height * width, FEATURES)
        for layer in (*self.conv, self.fc):
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        self.to(memory_format=torch.channels_last)  # convolutions take half the time so on a CPU

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.fc(self.conv(pictures.contiguous(memory_format=torch.channels_last))))


class Encoder(nn.Module):
    """The encoder of a view, from pictures as they are kept to features."""

    def __init__(self, view: View):
        super().__init__()
        self.view = view
        self.net = PlainConv(view.channels, view.height, view.width)

    @property
    def checksum(self) -> str:
        """Of its weights."""
        return hashlib.sha256(b"".join(p.detach().numpy().tobytes() for p in self.parameters())).hexdigest()

    def forward(self, rgb: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        """Features (B, 256) of colours (B, 3 k, height, width), bytes, and distances (B, k, height, width) in 1/1024 metre, or
        (B, 0, height, width) without."""
        return self.net(torch.cat([rgb.float() / 255, depth.float() / UNITS], dim=1))

    @torch.inference_mode()
    def encode(self, rgb: np.ndarray, depth: np.ndarray, batch: int = 64) -> np.ndarray:
        """The same for arrays of any number of frames, float32."""
        parts = [self(torch.from_numpy(rgb[i: i + batch]), torch.from_numpy(depth[i: i + batch].astype(np.int32)))
                 for i in range(0, len(rgb), batch)]
        return torch.cat(parts).float().numpy()


def check_square(height: int, width: int) -> None:
    """Raises PdkitError for pictures that `random_shift` cannot move."""
    if height != width:
        raise PdkitError(f"Random shift is for square pictures, not {height} x {width}; set random_shift=0.")


def random_shift(pictures: torch.Tensor, pad: int, generator: torch.Generator) -> torch.Tensor:
    """Pictures (B, C, H, W), each moved by whole pixels, up to `pad` in either direction; what is bared repeats the edge.

    One shift a picture, the same for all its channels (Kostrikov et al. 2020; Yarats et al. 2021). It is for square pictures, as in the
    paper's code: raises PdkitError for others.
    """
    batch, _, height, width = pictures.shape
    check_square(height, width)
    moves = torch.randint(-pad, pad + 1, (batch, 2, 1), generator=generator).to(pictures.device)
    along, each = (torch.arange(count, device=pictures.device) for count in (height, batch))
    rows, columns = ((along + moves[:, axis]).clamp(0, height - 1) for axis in (0, 1))
    return pictures[each[:, None, None], :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def save_encoder(encoder: Encoder, folder: str | Path, info: dict[str, Any] | None = None) -> None:
    """Write weights.safetensors in bfloat16 (to which `imitate_pixels` rounds), and encoder.json with what it sees and their checksum."""
    from safetensors.torch import save_file

    with atomic_folder(folder) as temporary:
        weights = temporary / "weights.safetensors"
        save_file({name: tensor.detach().bfloat16().contiguous() for name, tensor in encoder.state_dict().items()}, weights)
        write_json(temporary / "encoder.json", {"format": FORMAT, "view": asdict(encoder.view), "weights_sha256": sha256(weights),
                                                "info": info or {}})


def load_encoder(folder: str | Path) -> Encoder:
    """The encoder saved in `folder`, frozen. Raises PdkitError when a part is missing, altered, foreign or does not fit."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    folder = Path(folder)
    card, weights = read_json(folder / "encoder.json"), folder / "weights.safetensors"
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise PdkitError(f"{folder}/encoder.json is not a {FORMAT} file; it was written by something else or another version.")
    if not weights.exists() or sha256(weights) != card.get("weights_sha256"):
        raise PdkitError(f"{weights} is missing, truncated or altered; restore it or train it again with `pdkit train base --pixels`.")
    try:
        values = card["view"]
        view = View(**values | {"cameras": tuple(values["cameras"]), "state": tuple(map(tuple, values["state"]))})
        encoder = Encoder(view)
        encoder.load_state_dict({name: tensor.float() for name, tensor in load_file(weights).items()})
    except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
        raise PdkitError(f"{folder} does not hold the encoder that its encoder.json describes ({type(error).__name__}); train it "
                         "again.") from error
    return encoder.eval().requires_grad_(False)
