"""Does a quantity drift, or is it bounded? Windowed means of a series, a regression, and a robust standard error."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

WINDOWS = 16
BLOCKS = 4
SIGNIFICANT = 5.0
SMALLEST_SERIES = 8 * WINDOWS


@dataclass(frozen=True)
class Trend:
    """The trend of a series: `slope` per unit of time, its standard error, the drift slope·duration, and the band.

    `band` is the width (largest − smallest) of the series about the trend. `significant`: the slope exceeds
    SIGNIFICANT standard errors and has the same sign in every block of the run.
    """

    slope: float
    standard_error: float
    drift: float
    band: float
    significant: bool


def trend(t: Float[np.ndarray, " N"], series: Float[np.ndarray, " N"]) -> Trend:
    """The trend of `series` at the times `t`, by regression of windowed means on time."""
    times, means = windowed_means(t, series)
    slope, error = regression(times, means)
    duration = float(t[-1] - t[0])
    residual = series - slope * (t - t[0])
    blocks = [regression(*part)[0] for part in zip(np.split(times, BLOCKS), np.split(means, BLOCKS), strict=True)]
    consistent = bool(np.all(np.sign(blocks) == np.sign(slope)))
    return Trend(
        slope=slope,
        standard_error=error,
        drift=slope * duration,
        band=float(np.ptp(residual)),
        significant=consistent and abs(slope) > SIGNIFICANT * error,
    )


def windowed_means(t, series) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means over WINDOWS equal pieces, with the weight exp(−1/(s(1 − s))): a quasi-periodic oscillation
    averages out faster than any power of the window's length (weighted Birkhoff averages)."""
    size = len(series) // WINDOWS
    s = (np.arange(size) + 0.5) / size
    weight = np.exp(-1.0 / (s * (1.0 - s)))
    weight /= weight.sum()
    pieces = np.asarray(series)[: size * WINDOWS].reshape(WINDOWS, size)
    start = np.asarray(t)[: size * WINDOWS].reshape(WINDOWS, size)
    return start @ weight, pieces @ weight


def regression(times, means) -> tuple[float, float]:
    """(slope, standard error): least squares, the larger of the ordinary and the Newey–West standard error."""
    x = times - times.mean()
    sxx = x @ x
    slope = x @ means / sxx
    residual = means - means.mean() - slope * x
    count = len(x)
    score = x * residual
    lags = int(np.ceil(count ** (1 / 3)))
    variance = score @ score
    for lag in range(1, lags + 1):
        variance += 2 * (1 - lag / (lags + 1)) * (score[lag:] @ score[:-lag])
    robust = np.sqrt(max(variance, 0.0) * count / (count - 2)) / sxx
    ordinary = np.sqrt(residual @ residual / (count - 2) / sxx)
    return float(slope), float(max(robust, ordinary))
