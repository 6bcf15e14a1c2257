"""Reinforcement learning on the tasks: stable-baselines3, and a first-order learner."""
