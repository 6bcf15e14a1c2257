"""Tests of the installed package, or of another build of it."""

from __future__ import annotations

import os
import sys

# `make sanitize` puts a build first on the path. The hook of an editable install would find the usual one before it.
if os.environ.get("CPDEFORM_NATIVE_BUILD"):
    sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "ScikitBuildRedirectingFinder"]
    sys.path.insert(0, os.environ["CPDEFORM_NATIVE_BUILD"])
