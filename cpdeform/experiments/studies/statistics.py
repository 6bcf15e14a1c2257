"""Means and rank correlations with bootstrap intervals."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.95
RESAMPLES = 9999
SEED = 0
"""Of the resamples: the same figures give the same interval."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A figure with its interval.

    Attributes:
        value: The figure; nan where there is nothing to compute it from.
        low: Lower end of the 95% interval; nan where there are too few values for one.
        high: Upper end.
        count: Number of values.
    """

    value: float
    low: float
    high: float
    count: int

    @property
    def known(self) -> bool:
        """Whether there are values enough for an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def text(self, pattern: str) -> str:
        """The figure and its interval, each in a format such as ``.3f``: ``0.412 [0.398, 0.430]``."""
        if not math.isfinite(self.value):
            return "-"
        return f"{self.value:{pattern}} [{self.low:{pattern}}, {self.high:{pattern}}]" if self.known else f"{self.value:{pattern}}"

    def excludes_zero(self) -> bool:
        """Whether the interval is known and zero lies outside of it."""
        return self.known and (self.low > 0.0 or self.high < 0.0)


def as_number(value: float | None) -> float:
    """A figure of a row: nan for one that is not known, which means leave out."""
    return math.nan if value is None else float(value)


def mean(values: Sequence[float]) -> Interval:
    """Mean with its bootstrap interval (percentiles of the means of resamples [1]_).

    Args:
        values: Independent values, such as one a seed; those that are not finite do not count.

    References:
        .. [1] Efron, Tibshirani, "An Introduction to the Bootstrap", 1993.
    """
    from scipy.stats import bootstrap

    known = np.array([value for value in values if math.isfinite(value)])
    value = float(known.mean()) if len(known) else math.nan
    if len(known) < 2:
        return Interval(value, math.nan, math.nan, len(known))
    if float(np.ptp(known)) == 0.0:
        return Interval(value, value, value, len(known))
    found = bootstrap(
        (known,), np.mean, confidence_level=LEVEL, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(SEED)
    ).confidence_interval
    return Interval(value, float(found.low), float(found.high), len(known))


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> Interval:
    """Spearman's rank correlation of pairs, with its bootstrap interval over pairs.

    Args:
        first: Values.
        second: As many; pairs that are not finite do not count.
    """
    pairs = np.array([(x, y) for x, y in zip(first, second, strict=True) if math.isfinite(x) and math.isfinite(y)])
    if len(pairs) < 3:
        return Interval(math.nan, math.nan, math.nan, len(pairs))

    generator = np.random.default_rng(SEED)
    value = float(_spearman(pairs[np.newaxis])[0])
    drawn = _spearman(pairs[generator.integers(len(pairs), size=(RESAMPLES // 4, len(pairs)))])
    known = drawn[np.isfinite(drawn)]
    if not len(known):
        return Interval(value, math.nan, math.nan, len(pairs))
    low, high = np.quantile(known, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return Interval(value, float(low), float(high), len(pairs))


def _spearman(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rank correlations (R,) of samples (R, n, 2) of pairs; nan where all values are equal."""
    from scipy.stats import rankdata

    ranks = rankdata(samples, axis=1)
    ranks -= ranks.mean(axis=1, keepdims=True)
    spread = np.sqrt(np.square(ranks).sum(axis=1).prod(axis=1))
    products = ranks.prod(axis=2).sum(axis=1)
    return np.asarray(np.divide(products, spread, out=np.full_like(spread, np.nan), where=spread > 0.0))
