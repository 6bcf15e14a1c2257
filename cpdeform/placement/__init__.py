"""Placers: where to put the tools before their motion is optimised."""
