"""Where a linear fit begins: poles from the linearised model or a search over spectra, noise from a long autoregression."""

from collections.abc import Sequence

import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Complex128, Float

from estimators._linear_predictor import Rows
from estimators._linear_structure import Structure

Pair = tuple[float, float]  # a_0 [rad^2/s^2] and a_1 [rad/s] of s^2 + a_1 s + a_0

_DAMPING = (0.02, 0.07, 0.25, 0.9)
_SPACING = 1.07  # of natural frequencies tried
_MOST_LINES = 256
_LARGEST_REFLECTION = 0.98


def pole_pairs(poles: Complex128[np.ndarray, " pole"]) -> list[Pair]:
    """Pairs of stable poles as coefficients; of an odd number of real ones the last is paired with one ten times as fast.

    Raises:
        ValueError: a pole is not in the left half plane.
    """
    unstable = [p for p in poles if p.real >= 0]
    if unstable:
        raise ValueError(
            f"start: has a pole at {unstable[0]:.4g}, and a fit cannot begin at an unstable model; give a stable one, or leave "
            "it out."
        )
    oscillating = [p for p in poles if p.imag > 0]
    real = sorted(p.real for p in poles if p.imag == 0)
    if len(real) % 2:
        real.insert(0, 10 * real[0])
    return [(float(abs(p) ** 2), float(-2 * p.real)) for p in oscillating] + [
        (float(p * q), float(-p - q)) for p, q in zip(real[::2], real[1::2], strict=True)
    ]


def next_pair(
    signal: Float[np.ndarray, " sample"],
    output: Float[np.ndarray, " sample"],
    interval: float,
    intersample: str,
    known: Sequence[Pair],
    candidates: Sequence[Pair],
    *,
    direct: bool,
) -> Pair:
    """The pair of poles that explains most of the output's spectrum beside the known ones.

    Each trial solves linear least squares for the numerator and for the transient, which over a finite record has the same
    denominator.

    Args:
        direct: whether the input goes straight into the output too.

    Source: Pintelon and Schoukens, System Identification (2012), section 2.6, for the transient in the spectrum.
    """
    into, out = np.fft.rfft(signal), np.fft.rfft(output)
    strongest = np.argsort(-np.abs(out[1:]))[:_MOST_LINES]
    lines = 1 + np.sort(strongest)
    omega = 2 * np.pi * lines / (len(output) * interval)
    phase = 0.5 * omega * interval
    hold = {"zoh": np.sinc(phase / np.pi) * np.exp(-1j * phase), "foh": np.sinc(phase / np.pi) ** 2}
    u, y = into[lines] * hold.get(intersample, 1.0), out[lines]
    size = np.linalg.norm(u) / max(float(np.linalg.norm(y)), 1e-300)

    def columns(pairs: Sequence[Pair]) -> np.ndarray:
        a0, a1 = np.array(pairs).T[:, :, None]
        s = 1j * omega
        section = a0 / (s * s + a1 * s + a0)
        slope = s / np.sqrt(a0) * section
        # [pair column line]: numerator b and c, and the same two of the transient
        found = np.stack([section * u / size, slope * u / size, section + 0j, slope + 0j], axis=1)
        return np.concatenate([np.real(found), np.imag(found)], axis=2)

    target = np.concatenate([y.real, y.imag])
    beside = [columns(known).reshape(-1, len(target))] if known else []
    if direct:
        sampled = into[lines]  # what goes straight through is not held
        beside.append(np.concatenate([sampled.real, sampled.imag])[None] / size)
    fixed = np.linalg.qr(np.concatenate(beside).T)[0] if beside else None
    if fixed is not None:
        target = target - fixed @ (fixed.T @ target)
    # Beyond half the sampling rate lie the aliases, which a held input cannot tell from what is below.
    last = min(2 * float(omega[-1]), np.pi / interval)
    count = int(np.ceil(np.log(2 * last / omega[0]) / np.log(_SPACING)))
    rates = np.minimum(0.5 * omega[0] * _SPACING ** np.arange(count), last)
    trials = [*candidates, *((float(w * w), float(2 * z * w)) for z in _DAMPING for w in rates)]
    gains = []
    for first in range(0, len(trials), 100):
        part = columns(trials[first : first + 100])
        if fixed is not None:
            part = part - (part @ fixed) @ fixed.T
        gram = part @ part.transpose(0, 2, 1)
        toward = part @ target
        ridge = 1e-10 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(4) + 1e-300 * np.eye(4)
        gains.append(np.einsum("tc,tc->t", toward, np.linalg.solve(gram + ridge, toward[:, :, None])[:, :, 0]))
    return trials[int(np.argmax(np.concatenate(gains)))]


def with_poles(structure: Structure, pairs: Sequence[Sequence[Pair]]) -> Float[np.ndarray, "condition unknown"]:
    """Unknowns with these pairs for each condition, and all else zero."""
    theta = np.zeros((len(pairs), structure.count))
    for row, each in zip(theta, pairs, strict=True):
        a0, a1 = np.array(each).T
        row[: structure.modes] = 0.5 * np.log(a0)
        row[structure.modes : 2 * structure.modes] = np.log(a1)
    return theta


def with_residues(
    structure: Structure, theta: Float[np.ndarray, "condition unknown"], at: Rows
) -> Float[np.ndarray, "condition unknown"]:
    """Numerators and starts by linear least squares; `at` is where these are zero."""
    linear = np.r_[2 * structure.modes : structure.dynamics, structure.dynamics + structure.noise : structure.count]
    found = theta.copy()
    for number, (error, jacobian) in enumerate(zip(np.asarray(at.error), np.asarray(at.jacobian), strict=True)):
        found[number, linear] = np.linalg.lstsq(jacobian[:, linear], -error, rcond=1e-10)[0]
    return found


def noise_starts(
    structure: Structure,
    errors: Float[np.ndarray, "condition sample"],
    present: Float[np.ndarray, "condition sample"],
    denominators: Float[np.ndarray, "condition order"],
) -> list[Float[np.ndarray, "condition noise"]]:
    """Places to begin for H, from the errors of the simulation.

    For Box-Jenkins by Hannan and Rissanen's regression on the residuals of a long autoregression; for ARMAX, whose D is
    given by G, once with H nearly 1 and once with C nearly 1.
    """
    count = structure.noise
    if structure.kind == "box_jenkins":
        found = [_hannan_rissanen(e[p > 0], structure.noise_order) for e, p in zip(errors, present, strict=True)]
        return [np.stack(found)]
    like = []
    for row in denominators:
        like.append(reflections(row)[:count])
        like[-1] = np.concatenate([like[-1], np.zeros(count - len(like[-1]))])
    return [np.stack(like), np.zeros((len(errors), count))]


def reflections(coefficients: Float[np.ndarray, " order"]) -> Float[np.ndarray, " order"]:
    """Inverse of `monic`; roots on or outside the unit circle are mirrored into it first.

    Source: Barndorff-Nielsen and Schou, J. Multivariate Analysis 3 (1973).
    """
    roots = np.roots(np.append(1.0, coefficients))
    outside = np.abs(roots) >= 1
    roots[outside] = 0.98 / np.conj(roots[outside])
    current = np.real(np.poly(roots))[1:]
    found = np.zeros(len(coefficients))
    current = np.concatenate([current, np.zeros(len(coefficients) - len(current))])
    for place in range(len(coefficients) - 1, -1, -1):
        k = float(np.clip(current[-1], -_LARGEST_REFLECTION, _LARGEST_REFLECTION))
        found[place] = np.arctanh(k)
        current = (current[:-1] - k * current[:-1][::-1]) / (1 - k * k)
    return found


def autocovariance(values: Float[np.ndarray, " sample"], lags: int) -> Float[np.ndarray, " lag"]:
    """Sum of products at lags 0 ... `lags`, over the number of values."""
    spectrum = np.fft.rfft(values, scipy.fft.next_fast_len(len(values) + lags, real=True))
    length = scipy.fft.next_fast_len(len(values) + lags, real=True)
    return np.fft.irfft(np.abs(spectrum) ** 2, length)[: lags + 1] / len(values)


def autoregression(covariance: Float[np.ndarray, " lag"], order: int) -> Float[np.ndarray, " order"]:
    """Coefficients of q^-1 ... of the stable autoregression with this autocovariance (Yule and Walker)."""
    return -scipy.linalg.solve_toeplitz(covariance[:order], covariance[1 : order + 1])


def _hannan_rissanen(errors: Float[np.ndarray, " sample"], order: int) -> Float[np.ndarray, " noise"]:
    long = int(min(max(10, 4 * order), len(errors) // 4))
    whitening = np.append(1.0, autoregression(autocovariance(errors, long), long))
    fresh = np.convolve(errors, whitening)[: len(errors)]
    first = long + order
    past = [errors[first - i : len(errors) - i] for i in range(1, order + 1)]
    past += [fresh[first - i : len(errors) - i] for i in range(1, order + 1)]
    found = np.linalg.lstsq(np.stack(past, axis=1), errors[first:], rcond=1e-8)[0]
    return np.concatenate([reflections(found[order:]), reflections(-found[:order])])
