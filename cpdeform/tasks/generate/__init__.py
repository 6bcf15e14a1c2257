"""Random goals for the scenes of tasks, reproducible from a seed."""
