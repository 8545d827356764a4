"""Initialisation of a linear fit: poles from the linearised model or a search over spectra, noise from a long autoregression."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from jaxtyping import Complex128, Float

from estimators.core.correlation import autocovariance
from estimators.linear.model_sets import Structure
from estimators.linear.predictor import Rows

Pair = tuple[float, float]  # a_0 [rad^2/s^2] and a_1 [rad/s] of s^2 + a_1 s + a_0
Lines = Float[np.ndarray, " line"]
ComplexLines = Complex128[np.ndarray, " line"]
ComplexColumns = Complex128[np.ndarray, "pair 4 line"]

_DAMPING = (0.02, 0.07, 0.25, 0.9)
_SPACING = 1.07  # of natural frequencies tried
_MOST_LINES = 256
_LARGEST_REFLECTION = 0.98


def pole_pairs(poles: Complex128[np.ndarray, " pole"]) -> list[Pair]:
    """Return pairs of stable poles as coefficients.

    Of an odd number of real ones the fastest is paired with one ten times as fast.

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
    """Return the pair of poles that explains most of the output's spectrum beside the known ones.

    Each trial solves linear least squares for the numerator and for the transient, which over a finite record has the same
    denominator.

    Args:
        signal: the input.
        output: measured, with gaps bridged.
        interval: between samples [s].
        intersample: how the input runs between samples, "zoh", "foh" or "bl".
        known: pairs that the model has already.
        candidates: pairs to be tried beside those of the search.
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

    # Beyond half the sampling rate lie the aliases, which a held input cannot tell from what is below.
    last = min(2 * float(omega[-1]), np.pi / interval)
    count = int(np.ceil(np.log(2 * last / omega[0]) / np.log(_SPACING)))
    rates = np.minimum(0.5 * omega[0] * _SPACING ** np.arange(count), last)
    grid = [np.stack([rates**2, 2 * damping * rates], axis=1) for damping in _DAMPING]
    trials = np.concatenate([np.reshape(candidates, (-1, 2)), *grid])
    into_each = u / size
    beside = [_columns(np.array(known), omega, into_each).reshape(-1, len(omega))] if known else []
    if direct:
        beside.append(into[lines][None] / size)  # what goes straight through is not held
    gains = _explained(trials, omega, into_each, y, np.concatenate(beside) if beside else None)
    a0, a1 = trials[int(np.argmax(gains))].tolist()
    return a0, a1


def _columns(pairs: Float[np.ndarray, "pair 2"], omega: Lines, into: ComplexLines) -> ComplexColumns:
    """Return, for each pair of poles, the numerator's columns for c and b and the same two of the transient."""
    a0, a1 = pairs.T[:, :, None]
    section = a0 / (a0 - omega**2 + 1j * a1 * omega)
    slope = 1j * omega / np.sqrt(a0) * section
    return np.stack([section * into, slope * into, section, slope], axis=1)


def _explained(
    pairs: Float[np.ndarray, "pair 2"],
    omega: Lines,
    into: ComplexLines,
    target: ComplexLines,
    beside: Complex128[np.ndarray, "known line"] | None,
) -> Float[np.ndarray, " pair"]:
    """Return the square of the target that `_columns` of each pair explain with real factors, beside the known columns.

    The columns themselves are never formed: their products are sums over lines of the section's real part, imaginary part and
    square with weights that do not depend on the pair.
    """
    a0, a1 = pairs.T[:, :, None]
    rest, damping = a0 - omega**2, a1 * omega
    below = a0 / (rest**2 + damping**2)
    real, imag = rest * below, -damping * below
    rate = np.sqrt(a0[:, 0])
    weights = np.stack(
        [
            np.abs(into) ** 2, omega**2 * np.abs(into) ** 2, np.ones_like(omega), omega**2,
            np.real(into), omega**2 * np.real(into), omega * np.imag(into),
        ],
        axis=1,
    )  # fmt: skip
    cc, bb, tt, ss, ct, bs, cs = ((real**2 + imag**2) @ weights).T
    cs = cs / rate
    bb, ss, bs = bb / rate**2, ss / rate**2, bs / rate**2
    none = np.zeros_like(cc)
    gram = np.array([[cc, none, ct, cs], [none, bb, -cs, bs], [ct, -cs, tt, none], [cs, bs, none, ss]])
    gram = gram.transpose(2, 0, 1)
    scale = np.trace(gram, axis1=1, axis2=2)

    def toward(columns: Complex128[np.ndarray, "column line"]) -> Float[np.ndarray, "pair 4 column"]:
        driven = np.conj(into) * columns
        found = [
            part
            for each in (driven, columns)
            for part in (
                real @ np.real(each).T + imag @ np.imag(each).T,
                (real @ (omega * np.imag(each)).T - imag @ (omega * np.real(each)).T) / rate[:, None],
            )
        ]
        return np.stack(found, axis=1)

    aim = toward(target[None])[:, :, 0]
    if beside is not None:
        stacked = np.concatenate([np.real(beside), np.imag(beside)], axis=1)
        basis = np.linalg.qr(stacked.T)[0].T
        fixed = basis[:, : len(omega)] + 1j * basis[:, len(omega) :]
        along = toward(fixed)
        gram = gram - along @ along.transpose(0, 2, 1)
        aim = aim - along @ np.real(np.conj(fixed) @ target)
    ridge = (1e-10 * scale + 1e-300)[:, None, None] * np.eye(4)
    return np.einsum("tc,tc->t", aim, np.linalg.solve(gram + ridge, aim[:, :, None])[:, :, 0])


def with_poles(structure: Structure, pairs: Sequence[Sequence[Pair]]) -> Float[np.ndarray, "condition unknown"]:
    """Return unknowns with these pairs for each condition, and all else zero."""
    theta = np.zeros((len(pairs), structure.count))
    for row, each in zip(theta, pairs, strict=True):
        a0, a1 = np.array(each).T
        row[: structure.modes] = 0.5 * np.log(a0)
        row[structure.modes : 2 * structure.modes] = np.log(a1)
    return theta


def with_residues(
    structure: Structure, theta: Float[np.ndarray, "condition unknown"], at: Rows
) -> Float[np.ndarray, "condition unknown"]:
    """Solve for numerators and starts by linear least squares; `at` is where these are zero."""
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
    """Return starting values of H, from the errors of the simulation.

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
    """Invert `monic`; roots on or outside the unit circle are mirrored into it first.

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


def autoregression(covariance: Float[np.ndarray, " lag"], order: int) -> Float[np.ndarray, " order"]:
    """Return the coefficients of q^-1 ... of the stable autoregression with this autocovariance (Yule and Walker)."""
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
