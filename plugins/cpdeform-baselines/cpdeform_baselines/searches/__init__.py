"""Searches over contact plans: strategies with their placers."""
