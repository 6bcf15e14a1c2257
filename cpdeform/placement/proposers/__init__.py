"""Proposers: the ways of taking hold of a body, one file each."""
