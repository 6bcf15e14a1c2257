"""Touches: a placement and a first motion in a few numbers, so that they can be drawn, judged and varied."""
