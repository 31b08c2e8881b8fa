"""Reinforcement learning: networks, replay and SAC."""
