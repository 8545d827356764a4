"""Closed form: equations (5) and (6) of the paper, on filtered and differentiated measurements."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.signal import welch

from estimators._noise import filled, noise_levels
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording, Signal, central_difference, zero_phase_lowpass

Values = Float[np.ndarray, " sample"]

RATIOS = {"total_mass": "(M+m)/k", "cart_viscous.coefficient": "v/k", "cart_coulomb.level": "d/k"}
_FREE = ("total_mass", "cart_viscous.coefficient", "cart_coulomb.level")
_FORCED = ("eccentric_moment", "torque_constant", "arm_viscous.positive", "arm_viscous.negative")


@dataclasses.dataclass(frozen=True)
class Estimates:
    """One quantity, estimated from each experiment by itself and from all together.

    Attributes:
        names: of the experiments.
        each: the estimate from each experiment.
        value: the mean of those, as in the paper's Table 1.
        std: standard deviation of the mean over experiments, joined with the share of noise in the regressors, which
            biases all experiments alike and so does not show in their scatter.
        pooled: the estimate from all experiments stacked.
        unit: SI unit.
    """

    names: tuple[str, ...]
    each: Float[np.ndarray, " experiment"]
    value: float
    std: float
    pooled: float
    unit: str

    @property
    def consistency(self) -> float:
        """Standard deviation over experiments divided by the mean; the paper trusts a model when all are below 0.3."""
        if len(self.each) < 2 or self.value == 0:
            return float("nan")
        return float(np.std(self.each, ddof=1) / abs(self.value))


@dataclasses.dataclass(frozen=True)
class ClosedForm:
    """Result of `least_squares`.

    Attributes:
        model: the model with these estimates.
        ratios: (M+m)/k, v/k and d/k from free oscillation, Table 1(a).
        estimates: parameters in SI units, by name; Table 1(b) and (c).
        cutoff: of the low-pass filter, per experiment [Hz].
        reaction: whether the arm's reaction was part of the free-oscillation regressors.
        skipped: why an experiment was not used, by name.
    """

    model: RTAC
    ratios: Mapping[str, Estimates]
    estimates: Mapping[str, Estimates]
    cutoff: Mapping[str, float]
    reaction: bool
    skipped: Mapping[str, str]

    def __str__(self) -> str:
        lines = [f"{'':28s} {'mean':>12s} {'std':>10s} {'std.dev./mean':>14s}  unit"]
        for name, found in {**self.ratios, **self.estimates}.items():
            share = "" if np.isnan(found.consistency) else f"{100 * found.consistency:.2f} %"
            lines.append(f"{name:28s} {found.value:12.5g} {found.std:10.2g} {share:>14s}  {found.unit}")
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Signals:
    """Filtered signals of one experiment on its interior samples."""

    name: str
    q: Values
    dq: Values
    ddq: Values
    angle: Values
    omega: Values
    domega: Values
    current: Values
    force: Values
    dry: Values  # the sign of dq, filtered like everything else
    arm_free: bool
    has_arm: bool
    share: float  # of noise in the power of the cart's acceleration


def least_squares(
    model: RTAC, recording: Recording, *, cutoff: float | None = None, reaction: bool = False, near_zero: float = 0.05
) -> ClosedForm:
    """Closed-form estimates: free oscillation first, then, with those known, forced oscillation.

    Args:
        model: gives the constants known beforehand (its fixed parameters) and which parameters there are.
        cutoff: of the ninth-order zero-phase Chebyshev filter [Hz]; by default where each spectrum sinks into the noise.
        reaction: in free oscillation, solve the arm's equation too instead of neglecting its reaction as the paper does.
        near_zero: samples slower than this share of the rms velocity are left out, because the sign of a filtered
            velocity is wrong there.

    Returns:
        Estimates per experiment and together. A stage without suitable experiments leaves the model's values.

    Source: paper, equations (5) and (6), section 4.2.
    """
    skipped: dict[str, str] = {}
    used: dict[str, float] = {}
    levels = noise_levels(recording.experiments)
    ready = []
    for experiment in recording.experiments:
        if experiment.kind == "rest":
            continue
        try:
            limit = cutoff if cutoff is not None else _choose_cutoff(experiment, levels)
            ready.append(_prepare(experiment, limit, levels))
            used[experiment.name] = limit
        except ValueError as error:
            skipped[experiment.name] = str(error)
    scaled = any(np.any(signals.force) for signals in ready)
    free = [s for s in ready if np.any(s.q) and not np.any(s.current) and bool(np.any(s.force)) == scaled]
    model, ratios, estimates = _free_stage(model, free, scaled=scaled, reaction=reaction, near_zero=near_zero)
    forced = [s for s in ready if np.any(s.current) and s.has_arm and s.arm_free]
    model, more = _forced_stage(model, forced)
    return ClosedForm(model, ratios, estimates | more, used, reaction, skipped)


def _prepare(experiment: Experiment, cutoff: float, levels: Mapping[str, float]) -> _Signals:
    """Filter all signals alike, differentiate, and leave out the ends, where the filter has transients."""
    dt = experiment.sample_time
    count = experiment.samples
    zero = np.zeros(count)

    def smooth(values: Values | None) -> Values:
        return zero if values is None else zero_phase_lowpass(filled(values), sample_time=dt, cutoff=cutoff)

    def channel(signals: Mapping[str, Any], key: str) -> Values | None:
        return signals[key].values if key in signals else None

    raw_q = channel(experiment.outputs, "cart_position")
    if raw_q is None and experiment.cart == "free":
        raise ValueError(f"experiment {experiment.name}: no cart_position, so the closed form cannot use it.")
    q = smooth(raw_q)
    raw_angle = channel(experiment.outputs, "arm_angle")
    raw_omega = channel(experiment.outputs, "arm_velocity")
    current, force = (smooth(_around_samples(experiment.inputs.get(key))) for key in ("current", "disturbance_force"))
    inner = slice(1, -1)
    if raw_angle is not None:
        angle = smooth(raw_angle)
        omega = np.gradient(angle, dt)
        domega = _second_difference(angle, dt)
    elif raw_omega is not None:
        omega = smooth(raw_omega)
        first = experiment.initial_arm_angle or 0.0
        angle = first + np.concatenate([[0.0], np.cumsum(0.5 * dt * (omega[1:] + omega[:-1]))])
        domega = central_difference(omega, sample_time=dt)
    else:
        angle, omega, domega = zero + (experiment.initial_arm_angle or 0.0), zero, zero[inner]
    # The filter's slowest pole takes 37 / cutoff to sink to 1e-6; of a short experiment a tenth at each end must do.
    ends = int(np.ceil(max(1.5 / (cutoff * dt), min(37.0 / (cutoff * dt), 0.1 * count))))
    keep = slice(ends, count - 2 - ends)
    if count - 2 - 2 * ends < 8:
        raise ValueError(f"experiment {experiment.name}: too short for a filter at {cutoff:.3g} Hz; raise the cutoff.")
    velocity = np.gradient(q, dt)
    # The equations hold for signals that are all filtered alike, and the sign jumps too fast to pass the filter whole.
    dry = smooth(np.sign(velocity)) if np.any(q) else zero
    return _Signals(
        name=experiment.name,
        q=q[inner][keep],
        dq=central_difference(q, sample_time=dt)[keep],
        ddq=_second_difference(q, dt)[keep],
        angle=angle[inner][keep],
        omega=omega[inner][keep],
        domega=domega[keep],
        current=current[inner][keep],
        force=force[inner][keep],
        dry=dry[inner][keep],
        arm_free=experiment.arm == "free",
        has_arm=raw_angle is not None or raw_omega is not None,
        share=_noise_share(_second_difference(q, dt)[keep], levels.get("cart_position", 0.0), dt, cutoff),
    )


def _noise_share(acceleration: Values, level: float, dt: float, cutoff: float) -> float:
    """Power of white noise of this level, twice differentiated up to the cutoff, in that of the acceleration."""
    power = float(np.mean(acceleration**2))
    noise = 2 * dt * level**2 * (2 * np.pi) ** 4 * cutoff**5 / 5
    return float(min(noise / power, 1.0)) if power > 0 else 0.0


def _around_samples(signal: Signal | None) -> Values | None:
    """The input as it acts around each sample: a held one is the mean of the values before and after."""
    if signal is None or signal.intersample != "zoh":
        return None if signal is None else signal.values
    before = np.concatenate([signal.values[:1], signal.values[:-1]])
    return 0.5 * (before + signal.values)


def _second_difference(values: Values, dt: float) -> Float[np.ndarray, " inner"]:
    return (values[2:] - 2 * values[1:-1] + values[:-2]) / dt**2


def _choose_cutoff(experiment: Experiment, levels: Mapping[str, float]) -> float:
    """The widest band in which the noise of the accelerations stays below a thousandth of their power.

    Noise in a regressor biases its coefficient towards zero by just that share; a narrower filter costs little, because
    the equations hold for signals that are all filtered alike.
    """
    dt = experiment.sample_time
    widest, narrowest = 0.33 / dt, 0.02 / dt
    for channel, order in (("cart_position", 2), ("arm_velocity", 1), ("arm_angle", 2)):
        if channel not in experiment.outputs or np.ptp(values := filled(experiment.outputs[channel].values)) == 0:
            continue
        length = min(len(values), 1024)
        frequency, density = welch(values, fs=1 / dt, window="blackmanharris", nperseg=length, detrend="constant")
        noise = 2 * dt * levels[channel] ** 2
        weight = (2 * np.pi * frequency) ** (2 * order)
        signal = np.cumsum(np.where(density > 4 * noise, density - noise, 0.0) * weight)
        good = np.nonzero(noise * np.cumsum(weight) <= 1e-3 * signal)[0]
        dominant = frequency[1:][np.argmax(density[1 : max(3, len(density) // 3)])]
        narrowest = max(narrowest, 1.5 * dominant) if channel == "cart_position" else narrowest
        widest = min(widest, frequency[good[-1]] if len(good) else 0.0)
    return float(np.clip(widest, min(narrowest, 0.33 / dt), 0.33 / dt))


def _free_stage(
    model: RTAC, ready: Sequence[_Signals], *, scaled: bool, reaction: bool, near_zero: float
) -> tuple[RTAC, dict[str, Estimates], dict[str, Estimates]]:
    """Equation (5): (M+m)/k, v/k, d/k; with a known disturbance force also k."""
    if not ready:
        return model, {}, {}
    names = [name for name in _FREE if name in model.parameters]

    def system(s: _Signals) -> tuple[np.ndarray, np.ndarray]:
        columns = {"total_mass": s.ddq, "cart_viscous.coefficient": s.dq, "cart_coulomb.level": s.dry}
        matrix = np.stack([columns[name] for name in names], axis=1)
        moving = np.abs(s.dq) > near_zero * np.sqrt(np.mean(s.dq**2))
        target = -s.q
        if scaled:
            matrix, target = np.column_stack([matrix, s.q]), s.force
        elif reaction and s.has_arm and s.arm_free:
            moment = float(np.asarray(model["eccentric_moment"])) / float(np.asarray(model["spring_stiffness"]))
            target = target - moment * (s.domega * np.cos(s.angle) - s.omega**2 * np.sin(s.angle))
        elif reaction and s.arm_free:
            # An arm without a sensor follows its equation without torque: J theta'' = -me q'' cos theta.
            lighter = float(np.asarray(model.body.coupling())) ** 2 * np.cos(s.angle) ** 2
            matrix[:, 0] = matrix[:, 0] * (1 - lighter)
        return matrix[moving], target[moving]

    values, pooled = _solve_each([system(s) for s in ready])
    labels = tuple(s.name for s in ready)
    share = float(np.mean([s.share for s in ready]))
    units = {"total_mass": "s^2", "cart_viscous.coefficient": "s", "cart_coulomb.level": "m"}
    if scaled:
        stiffness, stiff_pooled = values[:, -1], float(pooled[-1])
        ratio_values, ratio_pooled = values[:, :-1] / stiffness[:, None], pooled[:-1] / stiff_pooled
    else:
        ratio_values, ratio_pooled = values, pooled
        mass = float(np.asarray(model["total_mass"]))
        if "spring_stiffness" in model.fixed and "total_mass" not in model.fixed:
            stiff_pooled = float(np.asarray(model["spring_stiffness"]))
            stiffness = np.full(len(values), stiff_pooled)
        else:
            stiffness, stiff_pooled = mass / values[:, 0], mass / float(pooled[0])
    ratios = {
        RATIOS[name]: _summary(labels, ratio_values[:, i], ratio_pooled[i], units[name], share)
        for i, name in enumerate(names)
    }
    estimates = {"spring_stiffness": _summary(labels, stiffness, stiff_pooled, "N/m", share)}
    for i, name in enumerate(names):
        unit = model.parameters[name].unit
        estimates[name] = _summary(labels, ratio_values[:, i] * stiffness, ratio_pooled[i] * stiff_pooled, unit, share)
    estimates = {name: found for name, found in estimates.items() if name in model.free}
    return _place(model, estimates), ratios, estimates


def _forced_stage(model: RTAC, ready: Sequence[_Signals]) -> tuple[RTAC, dict[str, Estimates]]:
    """Equation (6): me, K_m, K_v1, K_v2 from both equations of motion, each weighted by its own residual."""
    names = [name for name in _FORCED if name in model.free]
    if not ready or not names:
        return model, {}
    value = {name: float(np.asarray(model[name])) for name in model.parameters}

    def blocks(s: _Signals) -> list[tuple[np.ndarray, np.ndarray]]:
        swing = s.domega * np.cos(s.angle) - s.omega**2 * np.sin(s.angle)
        zero = np.zeros_like(s.q)
        cart = {"eccentric_moment": swing}
        arm = {
            "eccentric_moment": s.ddq * np.cos(s.angle),
            "torque_constant": -s.current,
            "arm_viscous.positive": np.where(s.omega > 0, s.omega, 0.0),
            "arm_viscous.negative": np.where(s.omega < 0, s.omega, 0.0),
        }
        on_cart = (
            s.force - value["spring_stiffness"] * s.q - value["total_mass"] * s.ddq
            - value.get("cart_viscous.coefficient", 0.0) * s.dq - value.get("cart_coulomb.level", 0.0) * s.dry
        )  # fmt: skip
        on_arm = -value["arm_inertia"] * s.domega
        for name, known in arm.items():
            if name not in names and name in value:
                on_arm = on_arm - value[name] * known
        rows = []
        if np.any(s.q):
            rows.append((np.stack([cart.get(name, zero) for name in names], axis=1), on_cart))
        rows.append((np.stack([arm[name] for name in names], axis=1), on_arm))
        return rows

    systems = [blocks(s) for s in ready]

    def stacked(weights: Mapping[int, Sequence[float]]) -> list[tuple[np.ndarray, np.ndarray]]:
        result = []
        for rows in systems:
            weighted = [(w * m, w * t) for w, (m, t) in zip(weights[len(rows)], rows, strict=True)]
            result.append((np.concatenate([m for m, _ in weighted]), np.concatenate([t for _, t in weighted])))
        return result

    weights: dict[int, Sequence[float]] = {2: (1.0, 1.0), 1: (1.0,)}
    _, pooled = _solve_each(stacked(weights))
    for size in (1, 2):
        of_size = [rows for rows in systems if len(rows) == size]
        if of_size:
            weights[size] = [
                1.0 / max(np.sqrt(np.mean([np.mean((r[i][1] - r[i][0] @ pooled) ** 2) for r in of_size])), 1e-300)
                for i in range(size)
            ]
    found, pooled = _solve_each(stacked(weights))
    labels = tuple(s.name for s in ready)
    share = float(np.mean([s.share for s in ready]))
    estimates = {
        name: _summary(labels, found[:, i], pooled[i], model.parameters[name].unit, share)
        for i, name in enumerate(names)
    }
    return _place(model, estimates), estimates


def _solve_each(systems: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    def solve(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
        size = np.sqrt(np.mean(matrix**2, axis=0))
        size = np.where(size > 0, size, 1.0)
        return np.linalg.lstsq(matrix / size, target, rcond=1e-10)[0] / size

    each = np.array([solve(*system) for system in systems])
    return each, solve(*(np.concatenate(parts) for parts in zip(*systems, strict=True)))


def _summary(names: tuple[str, ...], each: np.ndarray, pooled: float, unit: str, share: float) -> Estimates:
    scatter = float(np.std(each, ddof=1) / np.sqrt(len(each))) if len(each) > 1 else float("nan")
    std = float(np.hypot(scatter, share * abs(np.mean(each))))
    return Estimates(names, np.asarray(each), float(np.mean(each)), std, float(pooled), unit)


def _place(model: RTAC, estimates: Mapping[str, Estimates]) -> RTAC:
    """The model with these estimates, moved inside the bounds where the data put one outside."""
    values = {}
    for name, found in estimates.items():
        lower, upper = model.parameters[name].bounds
        best = found.pooled
        before = float(np.asarray(model[name]))
        if not np.isfinite(best) or (name in {"total_mass", "spring_stiffness"} and best <= 0):
            best = before
        values[name] = float(np.clip(best, lower if np.isfinite(lower) else -np.inf, upper))
    if values.get("eccentric_moment") == 0.0:
        values["eccentric_moment"] = 0.1 * float(np.asarray(model["eccentric_moment"]))
    return model.with_values(values)
