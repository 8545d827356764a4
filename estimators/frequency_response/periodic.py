"""Best linear approximation from whole periods: noise between the harmonics, distortion on those left out."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64

from estimators.frequency_response.local_polynomial import local_transient

_EXCITED = 1e-6  # of the largest harmonic, from which a harmonic counts as excited
_NEIGHBOURS = 14
_PERIODIC = 1e-6  # of its root mean square, by which a periodic input may differ from period to period
_SILENT = 0.2  # of what is not zero, which may be zero in another period
_DETECTORS = 8  # harmonics left out, nearest to a line, that tell its distortion

Curve = Float64[np.ndarray, "_frequency"]  # each condition has its own lines


class Lines(NamedTuple):
    """A response at the lines of one experiment; see `FrequencyResponse`."""

    frequency: Curve
    response: Complex128[np.ndarray, "_frequency"]
    std: Curve
    noise_std: Curve
    odd: Curve | None
    even: Curve | None
    coherence: Curve
    freedom: int


def periodic_response(
    place: str,
    into: Float64[np.ndarray, " sample"],
    out: Float64[np.ndarray, " sample"],
    played: Float64[np.ndarray, " sample"],
    *,
    period: int,
    sample_time: float,
    degree: int = 2,
    band: tuple[float | int, float | int] | None = None,
) -> Lines:
    """Estimate the response at the excited harmonics; `played` is the periodic input that tells which these are.

    Transients are taken off by the lines between the harmonics, so both transient and steady state are used. What those
    lines leave is noise. At harmonics that were not excited a periodic distortion is left over: even ones show
    nonlinearities of even order, odd ones those of odd order, which reach the excited odd lines as well.

    Raises:
        ValueError: no harmonic of the band is excited.

    Source: Pintelon and Schoukens (2012), System Identification, chapters 4 and 7.
    """
    periods = len(into) // period
    cut = slice(len(into) - periods * period, None)
    u, y = np.fft.rfft(into[cut]), np.fft.rfft(out[cut])
    size = np.abs(np.fft.rfft(played[cut]))[::periods]
    step = 2 * np.pi / (period * sample_time)
    harmonics = np.arange(1, (period - 1) // 2 + 1)
    excited = size[1 : len(harmonics) + 1] > _EXCITED * np.max(size[1:])
    if band is None:
        low, high = harmonics[excited][[0, -1]]
    else:
        low, high = 2 * np.pi * band[0] / step - 1e-9, 2 * np.pi * band[1] / step + 1e-9
    inside = (harmonics >= low) & (harmonics <= high)
    on = harmonics[inside & excited]
    if not len(on):
        raise ValueError(f"{place}: the excitation vanishes on every harmonic of the band; change band or period.")

    lines = on * periods
    neighbours = min(_NEIGHBOURS, max(degree + 3, 2 * (periods - 1) * len(harmonics) // 4))
    options = {"periods": periods, "neighbours": neighbours, "degree": degree}
    of_y, of_u = local_transient(y, lines, **options), local_transient(u, lines, **options)
    clean = u[lines] - of_u.smooth
    response = (y[lines] - of_y.smooth) / clean
    left = of_y.left - response[:, None] * of_u.left
    noise = np.sqrt(np.sum(np.abs(left) ** 2, axis=1) / of_y.freedom)
    noise_std = noise * np.sqrt(of_y.factor) / np.abs(clean)

    levels: dict[int, np.ndarray | None] = {0: None, 1: None}
    for parity in (0, 1):
        off = harmonics[inside & ~excited & (harmonics % 2 == parity)]
        if len(off) < 2:
            continue
        places = off * periods
        y_off, u_off = local_transient(y, places, **options), local_transient(u, places, **options)
        follows = np.interp(off, on, response.real) + 1j * np.interp(off, on, response.imag)
        extra = np.abs(y[places] - y_off.smooth - follows * (u[places] - u_off.smooth)) ** 2
        extra -= y_off.factor * np.sum(np.abs(y_off.left) ** 2, axis=1) / y_off.freedom
        nearest = np.argsort(np.abs(off[None, :] - on[:, None]), axis=1)[:, :_DETECTORS]
        levels[parity] = np.sqrt(np.maximum(np.mean(extra[nearest], axis=1), 0.0)) / np.abs(clean)
    odd, even = levels[1], levels[0]
    only_odd = bool(np.all(on % 2 == 1))
    # Nonlinearities of even order turn odd harmonics into even ones, so they do not reach an odd line.
    reaching = [level for level in ((odd,) if only_odd else (odd, even)) if level is not None]
    std = np.sqrt(noise_std**2 + sum((level**2 for level in reaching), np.zeros_like(noise_std)))
    followed = np.abs(response * clean) ** 2
    coherence = followed / (followed + np.abs(clean) ** 2 * std**2)
    return Lines(on * step, response, std, noise_std, odd, even, coherence, of_y.freedom)


def repeated_input(values: Float64[np.ndarray, " sample"], period: int) -> Float64[np.ndarray, " sample"] | None:
    """Return the signal that repeats with this period; None where nothing does.

    Samples that are zero may be left out of some periods, as the current is where the arm has no grip.
    """
    if not 1 < period <= len(values) // 2:
        return None
    rows = np.resize(values, (-(-len(values) // period), period))  # the last row ends in the first samples once more
    known = np.arange(rows.size).reshape(rows.shape) < len(values)
    largest = np.argmax(np.abs(rows) * known, axis=0)
    once = rows[largest, np.arange(period)]
    off = np.abs(rows - once) > _PERIODIC * np.sqrt(np.mean(values**2))
    silent = (rows == 0) & off & known
    if np.any(off & known & ~silent) or np.sum(silent) > _SILENT * np.count_nonzero(values):
        return None
    return np.resize(once, len(values))
