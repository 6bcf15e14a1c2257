"""Settings of the whole test suite."""

from __future__ import annotations

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))
settings.register_profile("cpdeform", deadline=None, derandomize=True)
settings.load_profile("cpdeform")
