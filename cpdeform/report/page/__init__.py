"""The page of a run: one HTML file with everything in it, or served live while the run goes on."""

from __future__ import annotations
