"""Sweeps: many jobs in a directory, done by any number of workers on any number of machines."""
