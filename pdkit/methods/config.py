"""What single methods add to the configuration of the loop, one line a number, with its source."""
from __future__ import annotations

from dataclasses import dataclass

from ..errors import PdkitError


@dataclass(frozen=True)
class MethodConfig:
    """Only the method named in a comment reads its fields."""

    lora: int = 8  # fine-tuning: rank of the adapters (the paper gives none); 0 trains all weights

    def __post_init__(self):
        if self.lora < 0:
            raise PdkitError(f"lora is a rank of 0 or more, not {self.lora}.")
