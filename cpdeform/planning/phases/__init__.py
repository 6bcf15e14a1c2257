"""Phases: the steps from proposals to the plan of a stage, one file each."""
