"""Operating conditions of a recording as signals for a linear fit, refused where nothing can be learned from them."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from estimators.frequency_response.angle_reconstruction import arm_angles
from estimators.linear.model_sets import Scale, Structure
from estimators.linear.predictor import Signals
from estimators.linear.stages import Raw
from rtac_jax import RTAC
from rtac_jax.excitation import coefficients
from rtac_jax.measurement import INPUTS, OUTPUTS, Experiment, Recording, Signal, filled

_STRIDE = 256  # lengths are rounded up to multiples of this, so that near lengths share compiled functions
_VANISHES = 1e-9  # of the largest line of the spectrum, or of the input that was not compensated


def conditions(
    recording: Recording,
    *,
    input: str,
    output: str,
    compensate: bool,
    detrend: bool,
    angles: Mapping[str, Float64[np.ndarray, " sample"]] | None,
    model: RTAC | None,
) -> tuple[list[Experiment], list[Raw], list[float | None], list[np.ndarray]]:
    """Return forced experiments, their signals, their mean arm angles, and where the output was measured.

    Raises:
        ValueError: nothing is forced, a channel is missing or constant, or the input vanishes.
    """
    for option, name, known in (("input", input, INPUTS), ("output", output, OUTPUTS)):
        if name not in known:
            raise ValueError(f"{option}: there is no channel {name!r}; use one of {', '.join(known)}.")
    forced = [e for e in recording if e.kind == "forced"]
    if not forced:
        raise ValueError("the recording has no forced experiment; a response needs an input.")
    turned = arm_angles(recording, [e.name for e in forced], angles, model) if compensate else {}
    found, means, present = [], [], []
    for e in forced:
        place = f"/experiments/{e.name}"
        if input not in e.inputs or output not in e.outputs:
            raise ValueError(
                f"{place}: has no {input if input not in e.inputs else output}; leave it out or record it."
            )
        u, y = e.inputs[input].values, e.outputs[output].values
        here = np.isfinite(y)
        for channel, values in ((input, u), (output, y[here])):
            if len(values) == 0 or np.ptp(values) == 0:
                raise ValueError(f"{place}: {channel} is constant, so it shows no response; leave the experiment out.")
        theta = turned.get(e.name)
        x = u
        if theta is not None:
            cosine = np.cos(theta)
            if e.inputs[input].intersample == "zoh":
                # The input is held while the arm turns on: the mean over the interval.
                cosine = 0.5 * (cosine + np.append(cosine[1:], cosine[-1]))
            x = u * cosine
        if np.sqrt(np.mean(x**2)) <= _VANISHES * np.sqrt(np.mean(u**2)):
            raise ValueError(
                f"{place}: the excitation vanishes where cos(theta) multiplies it; start the arm elsewhere, or set "
                "compensate=False."
            )
        y = filled(y)
        if detrend:
            x, y = x - np.mean(x), y - np.mean(y[here])
        found.append(Raw(np.asarray(x), np.asarray(y), e.sample_time, str(e.inputs[input].intersample)))
        start = e.initial_arm_angle
        means.append(start if theta is None else float(np.mean(theta)))
        present.append(here)
    return forced, found, means, present


def require_enough(
    structure: Structure, names: Sequence[str], raw: Sequence[Raw], present: Sequence[np.ndarray]
) -> None:
    """Refuse conditions that cannot determine the unknowns.

    Raises:
        ValueError: samples are fewer than unknowns, or the input has too few frequencies for G.
    """
    for name, one, here in zip(names, raw, present, strict=True):
        count = int(np.sum(here))
        if count <= structure.count:
            raise ValueError(
                f"/experiments/{name}: has {count} samples of the output, but {structure.count} unknowns need at least "
                f"{structure.count + 1}; record for longer, or lower modes or noise_order."
            )
        size = np.abs(np.fft.rfft(one.input))
        # A line gives two numbers, the mean one.
        lines = 2 * int(np.sum(size[1:] > _VANISHES * np.max(size))) + int(size[0] > _VANISHES * np.max(size))
        if lines < structure.dynamics:
            raise ValueError(
                f"/experiments/{name}: the excitation has power at {(lines + 1) // 2} frequencies only, which determine "
                f"{lines} of the {structure.dynamics} parameters of G; excite more, or lower modes or zeros."
            )


def stacked(raw: Sequence[Raw], present: Sequence[np.ndarray]) -> Signals:
    """Stack all conditions, padded to one length."""
    longest = -(-max(len(one.output) for one in raw) // _STRIDE) * _STRIDE
    parts = [coefficients(Signal(one.input, "A", one.intersample)) for one in raw]
    powers = max(part.shape[1] for part in parts)
    into = np.zeros((len(raw), longest, powers))
    out, here = np.zeros((len(raw), longest)), np.zeros((len(raw), longest))
    for row, (one, part, mask) in enumerate(zip(raw, parts, present, strict=True)):
        into[row, : len(part), : part.shape[1]] = part
        out[row, : len(mask)] = np.where(mask, one.output, 0.0)
        here[row, : len(mask)] = mask
    size = np.array([np.sqrt(np.mean(one.output[mask] ** 2)) for one, mask in zip(raw, present, strict=True)])
    drive = np.array([np.sqrt(np.mean(one.input**2)) for one in raw])
    return Signals(
        jnp.asarray(into), jnp.asarray(out), jnp.asarray(here), jnp.asarray([one.interval for one in raw]),
        Scale(jnp.asarray(size), jnp.asarray(size / drive), jnp.asarray(size)), not all(np.all(mask) for mask in present),
    )  # fmt: skip
