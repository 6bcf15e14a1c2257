"""The connection to a Ray cluster; imported only where Ray is asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import ray

from cpdeform.core.errors import InputError


def connect(address: str | None, *, option: str = "--address") -> bool:
    """Connect this process to a cluster, unless it is connected already.

    Args:
        address: Of the cluster, e.g. ``"auto"`` or ``"10.0.0.1:6379"``; None for that of ``RAY_ADDRESS``, else a new one here.
        option: What the user gave it by, for the error.

    Returns:
        Whether it was this call that connected, so that the caller has to end it with `ray.shutdown`.

    Raises:
        InputError: No cluster answers.
    """
    if ray.is_initialized():
        return False
    try:
        with contextlib.redirect_stdout(None):
            dashboard = False if address is None else None
            ray.init(address=address, log_to_driver=False, logging_level="warning", include_dashboard=dashboard)
    except (ConnectionError, ValueError, RuntimeError) as error:
        came = "none that answers" if address is None else f"{address}, which does not answer"
        raise InputError(option, came=came, expected=f"the address of a Ray cluster ({str(error).splitlines()[0]})") from error
    return True


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[None]:
    """A connection while the block runs; see `connect`."""
    own = connect(address)
    try:
        yield
    finally:
        if own:
            ray.shutdown()
