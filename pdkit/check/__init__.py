"""Checks of the exercises in the notebooks: each takes the student's function and names the likely mistake.

A check prints one line and returns whether the exercise is solved; it never raises, so that an unsolved notebook runs to
its end, unless `strict` is set (for grading): then what is wrong is a PdkitError.
"""
from .imitation import best_of, ddim_step, first_success, focal_loss, shift
from .learning import action_ascent, actors_value, conservative, corridor_values, cosines, gate, lookup, temperature_step
from .results import interquartile_mean, object_mean, ranking

__all__ = ["action_ascent", "actors_value", "best_of", "conservative", "corridor_values", "cosines", "ddim_step", "first_success",
           "focal_loss", "gate", "interquartile_mean", "lookup", "object_mean", "ranking", "shift", "temperature_step"]
