"""Rivals of contact points discovery: searches over contact plans, and reinforcement learning."""
