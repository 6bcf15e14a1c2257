"""Data sets of plans: generated goals, the plans that reach for them, and trajectories for those who learn from them."""
