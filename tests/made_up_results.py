"""Comparisons, diagnoses and improvements made by hand, for pictures and files."""

import dataclasses

import numpy as np

from estimators.core.fisher_information import information_of
from estimators.core.fit import Fit, Parameter
from estimators.core.results import RESULTS
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.diagnosis.learned_force import LearnedForce
from estimators.diagnosis.model_extension import PredictedGain
from estimators.misspecification.adequacy import AdequacyTest
from estimators.misspecification.residual_maps import Place
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.latent_force import LatentForce
from estimators.validation.simulation_error import Compared, Comparison, Trace
from rtac_jax import RTAC

NOISE = {"cart_position": 2e-5, "arm_velocity": 0.05, "arm_angle": 1e-3}
SIZE = {"cart_position": 8e-3, "arm_velocity": 30.0, "arm_angle": 1.5}


FIT = Fit(
    RTAC.paper(), RESULTS.successful, information_of(np.eye(1), ("total_mass",), np.ones(1)), NOISE, NOISE, {}, (),
    {"agreed": 1, "starts": 1},
)  # fmt: skip


def trace(experiment, channel, error, *, samples=600, driven=True, seed=0):
    """A decaying oscillation whose simulation is off by so many times the noise."""
    random = np.random.default_rng([seed, len(experiment), ord(channel[4])])
    time = 0.005 * np.arange(samples)
    truth = SIZE[channel] * np.exp(-0.4 * time) * np.cos(10.4 * time)
    wrong = np.sqrt(2) * error * NOISE[channel] * np.sin(37.4 * time)
    measured = truth + NOISE[channel] * random.standard_normal(samples)
    current = np.sin(9 * time) if driven else np.zeros(samples)
    used = np.arange(samples) >= 0
    return Trace(experiment, channel, time, measured, truth + wrong, current, used, NOISE[channel])


def compared(label, error, *, channels=("cart_position", "arm_velocity"), names=("free_1", "forced_1"), **options):
    traces = [
        trace(name, channel, error / (1 + place), driven=name.startswith("forced"), seed=place, **options)
        for place, name in enumerate(names)
        for channel in channels
    ]
    return Compared(label, RTAC.paper(), tuple(traces), {name: np.zeros(4) for name in names}, {})


def candidate(name, score, **more):
    return Candidate(
        name, score, max(score + 9.0, 0.0), float(np.exp(-max(score, 0.0) / 2)), 0.0123, "kg", True, **more
    )


def curve(port, variable, reach, score=80.0):
    at = np.linspace(-reach, reach, 12)
    return ForceCurve(
        port, variable, score, at, 0.05 * (at / reach) ** 3, np.full(12, 0.004), score + 90.0, score + 78.0,
        1e-9 if score > 20 else 0.5, np.eye(12)[:3], np.ones(3),
    )  # fmt: skip


CURVES = (
    curve("cart", "cart_position", 0.012),
    curve("cart", "cart_velocity", 0.1, 30.0),
    curve("cart", "arm_angle", np.pi, -5.0),
    curve("arm", "arm_velocity", 40.0, -20.0),
)
ARM_CURVES = tuple(
    curve("arm", variable, reach, score)
    for variable, reach, score in (
        ("arm_velocity", 40.0, 90.0),
        ("arm_angle", np.pi, 25.0),
        ("cart_velocity", 0.1, -5.0),
        ("cart_position", 0.012, -6.0),
    )
)
OTHERS = tuple(
    candidate(name, -9.0 - i) for i, name in enumerate(("tacho_bias", "cogging", "dead_zone", "current_lag"))
)


def latent(port="cart"):
    """Half of the force in the second experiment, which is the shorter one."""
    force = np.sin(0.05 * np.arange(900))[:, None] * np.array([0.01, 0.05])
    force[600:, 1] = np.nan
    rms = {"free_1": 0.007, "forced_1": 0.035}
    return LatentForce(port, tuple(rms), force, np.full((900, 2), 0.004), (0.02, 0.001), rms, 10.4, 900.0)


def places(worst=9.0, experiments=2, at=("frequency", "arm_velocity", 0)):
    """Innovations that are largest in one part; without a choice at low frequency, in the second of three channels."""
    kinds = {
        "experiment": [f"forced_{n + 1}" for n in range(experiments)],
        "time": [f"quarter {n + 1} of each experiment" for n in range(4)],
        "frequency": ["0 to 23.3 rad/s", "23.3 to 69.8 rad/s", "69.8 to 209 rad/s", "209 to 628 rad/s"],
        "cart_position": [f"|cart_position| {0.002 * n:.2g} to {0.002 * (n + 1):.2g}" for n in range(4)],
        "arm_velocity": [f"|arm_velocity| {8.0 * n:.2g} to {8.0 * (n + 1):.2g}" for n in range(4)],
    }
    found = [
        Place(kind, label, channel, worst if (kind, channel, part) == at else 1.0, 1.2, part)
        for kind, labels in kinds.items()
        for part, label in enumerate(labels)
        for channel in NOISE
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda place: -place.excess))


def diagnosis(verdict="missing", *, curves=CURVES, others=OTHERS, additions=(), missing=None, where=None):
    parameters = {"mass": Parameter(0.09, 0.001, "kg")}
    first = candidate(
        "flexible_mode", 1200.0, refitted=True, bic_gain=900.0, error_reduction=1.0, parameters=parameters
    )
    second = candidate("cubic_spring", 1100.0, refitted=True, bic_gain=895.0, error_reduction=0.97)
    if verdict == "ambiguous":
        first = dataclasses.replace(first, confusable_with=(second.id,))
        second = dataclasses.replace(second, confusable_with=(first.id,))
    effects = {"missing": (first,), "ambiguous": (first, second)}.get(verdict, ())
    best = max(curves, key=lambda c: c.score, default=None)
    tests = (
        ()
        if best is None
        else (AdequacyTest("static force", 12 * best.p_value, best.excess, 0.002, "of the best curve"),)
    )
    return Diagnosis(
        verdict,
        effects,
        additions,
        (*effects, *others),
        tests,
        (),
        1.0,
        curves,
        (missing or latent(),) if verdict == "unknown" else (),
        places() if where is None else where,
        (),
        0.1,
        0.1,
        "In plain words.",
        1.0,
    )


def alike(count, correlation):
    """Candidates of which the second looks like the accepted one, and no others like each other."""
    names = [f"effect_{n}" for n in range(count)]
    table = {name: dict.fromkeys((*names, "flexible_mode"), 0.1) for name in names}
    table[names[1]]["flexible_mode"] = correlation
    return tuple(candidate(name, 50.0 - n, correlation=table[name]) for n, name in enumerate(names))


LEARNED = LearnedForce(
    "cart", "cart_position", np.linspace(-0.012, 0.014, 12), 0.05 * np.linspace(-1, 1, 12) ** 3, np.full(12, 0.002),
    {"forced_1": 0.2}, ("force on the cart [N] = (2e+04 N/m^3) q^3",),
)  # fmt: skip
PREDICTED = PredictedGain(
    "flexible_mode", 140.0, {"cart_position": 1.6, "arm_velocity": 1.3}, {"cart_position": 1.1, "arm_velocity": 1.2}
)


def improvement(steps=2, verdict=None, errors=(30.0, 3.0, 0.3), predicted_gains=()):
    labels = ["base", "+ flexible_mode", "+ flexible_mode, cogging"][:steps]
    errors = errors[:steps]
    models = tuple(compared(label, error) for label, error in zip(labels, errors, strict=True))
    found = diagnosis(verdict or ("missing" if steps > 1 else "adequate"))
    return Improvement(
        (FIT,) * steps, (found,), (0,), found.effects[: min(steps - 1, 1)] + OTHERS[1 : steps - 1], found.verdict,
        Comparison(models), Comparison(models), (), False, predicted_gains, "Stopped.", 1.0,
    )  # fmt: skip
