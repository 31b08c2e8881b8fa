"""Demonstrations: the file format, the scripted experts and where files come from."""
from __future__ import annotations

from .format import Demos, from_episodes, load_demos, save_demos

__all__ = ["Demos", "from_episodes", "load_demos", "save_demos"]
