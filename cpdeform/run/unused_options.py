"""Options that are set and have no effect."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from cpdeform.planning.strategy import Strategy
from cpdeform.run.flags import FLAGS
from cpdeform.run.origins import Origin


def warn_about_optimizer(strategy: Strategy, name: str, *, origins: Mapping[str, str]) -> None:
    """Tell of options of the optimizer that a strategy does not use.

    Args:
        strategy: The strategy.
        name: Its name.
        origins: Where each value of the configuration comes from, see `cpdeform.run.origins`.
    """
    given = [path for path, origin in origins.items() if path.startswith("optimizer.") and origin == Origin.GIVEN.value]
    if strategy.takes_optimizer or not given:
        return
    flags = ", ".join(FLAGS.get(path, f"--set {path}") for path in given)
    warnings.warn(
        f"{flags}: no effect, since the strategy {name} has iterations of its own. Set its options, see docs/strategies.md: "
        "--set strategy_options.NAME=VALUE.",
        UserWarning,
        stacklevel=3,
    )
