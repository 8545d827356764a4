"""The truth of one repetition: a rig or a model with drawn parameters, and what an estimate should be."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from estimators.study.declarative import SpecError
from estimators.study.spec import Excitation, Hidden, StudySpec, parameter_names
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE
from rtac_jax.parameters import declarations
from rtac_jax.virtual_rig import Rig

FIELD_OF: Mapping[str, str] = {
    "total_mass": "total_mass",
    "spring_stiffness": "spring_stiffness",
    "cart_viscous.coefficient": "cart_viscous",
    "cart_coulomb.level": "cart_coulomb",
    "eccentric_moment": "eccentric_moment",
    "arm_inertia": "arm_inertia",
    "torque_constant": "torque_constant",
    "arm_viscous.positive": "arm_viscous_positive",
    "arm_viscous.negative": "arm_viscous_negative",
}
"""The parameters of the paper's model and the fields of the virtual rig that hold them."""

EFFECT_FIELD: Mapping[str, str] = {
    "cart_stribeck.level": "cart_stribeck",
    "cart_stribeck.velocity": "cart_stribeck_velocity",
    "cart_presliding.level": "cart_presliding",
    "cart_presliding.displacement": "cart_presliding_yield",
    "cart_asymmetric_friction.coefficient": "cart_asymmetry",
    "cart_quadratic_drag.coefficient": "cart_quadratic_drag",
    "cubic_spring.stiffness": "cubic_spring",
    "quadratic_spring.stiffness": "quadratic_spring",
    "hysteretic_spring.stiffness": "hysteresis_stiffness",
    "hysteretic_spring.yield_displacement": "hysteresis_yield",
    "force_offset.offset": "force_offset",
    "flexible_mode.mass": "flexible_mass",
    "flexible_mode.frequency": "flexible_frequency",
    "flexible_mode.damping": "flexible_damping",
    "end_stop.stiffness": "end_stop_stiffness",
    "end_stop.travel": "end_stop_travel",
    "arm_coulomb.level": "arm_coulomb",
    "arm_stribeck.level": "arm_stribeck",
    "arm_stribeck.velocity": "arm_stribeck_velocity",
    "arm_presliding.level": "arm_presliding",
    "arm_presliding.angle": "arm_presliding_yield",
    "arm_load_friction.fraction": "arm_load_friction",
    "arm_quadratic_drag.coefficient": "arm_quadratic_drag",
    "cogging.harmonic": "cogging_order",
    "second_cogging.harmonic": "second_cogging_order",
    "torque_ripple.harmonic": "torque_ripple_order",
    "cable_spring.stiffness": "cable_stiffness",
    "gravity_tilt.along": "tilt_along",
    "gravity_tilt.across": "tilt_across",
    "backlash.gap": "backlash",
    "backlash.rotor": "rotor_share",
    "flexible_shaft.rotor": "rotor_share",
    "input_delay.delay": "input_delay",
    "current_lag.time_constant": "current_lag",
    "current_offset.offset": "current_offset",
    "dead_zone.threshold": "dead_zone",
    "force_delay.delay": "force_delay",
    "force_lag.time_constant": "force_lag",
    "force_dead_zone.threshold": "force_dead_zone",
    "force_droop.droop": "force_droop",
    "torque_droop.droop": "torque_droop",
    "tacho_lag.time_constant": "tacho_lag",
    "tacho_delay.delay": "tacho_delay",
    "tacho_bias.bias": "tacho_bias",
    "tacho_ripple.harmonic": "tacho_ripple_order",
    "lvdt_lag.time_constant": "lvdt_lag",
    "lvdt_nonlinearity.cubic": "lvdt_cubic",
    "lvdt_offset.offset": "lvdt_offset",
    "lvdt_ripple.pitch": "lvdt_ripple_pitch",
    "encoder_offset.offset": "encoder_offset",
    "encoder_lag.time_constant": "encoder_lag",
    "encoder_ripple.harmonic": "encoder_ripple_order",
    "channel_delay.delay": "channel_delay",
}
"""The parameters of effects that one field of the virtual rig holds; of the others a study knows no bias."""

RATIOS: Mapping[str, str] = {"(M+m)/k": "total_mass", "v/k": "cart_viscous.coefficient", "d/k": "cart_coulomb.level"}
"""Table 1(a): what of the model is divided by the spring's stiffness."""


LINEARISED = tuple(name for name in FIELD_OF if name not in ("cart_coulomb.level", "torque_constant"))
"""The parameters of equation (4), from torque to position."""


class Streams(NamedTuple):
    """Independent random streams of one repetition; they depend on the study's seed and the repetition's number alone."""

    parameters: np.random.SeedSequence
    plans: np.random.SeedSequence
    noise: np.random.SeedSequence

    @classmethod
    def of(cls, seed: int, index: int) -> "Streams":
        """Return the streams of one repetition."""
        return cls(*(np.random.SeedSequence(seed, spawn_key=(index, part)) for part in range(3)))


def as_number(stream: np.random.SeedSequence) -> int:
    """Return a seed for what takes a whole number."""
    return int(stream.generate_state(1, np.uint64)[0])


class Truth(NamedTuple):
    """The truth of one repetition.

    Attributes:
        values: of the model's parameters by name, of ratios to the stiffness, and of the linearised model.
        source: the rig, or the model, that makes the data.
        hidden: what is hidden.
        excitation: what is played.
    """

    values: dict[str, float]
    source: Rig | RTAC
    hidden: Hidden
    excitation: Excitation


def true_for(spec: StudySpec, index: int) -> Truth:
    """Draw the truth of this repetition.

    Raises:
        ValueError: the drawn values are impossible; the message names the field.
    """
    random = np.random.default_rng(Streams.of(spec.seed, index).parameters)
    excitation = spec.excitation[index % len(spec.excitation)]
    several = spec.plant.hidden or (Hidden(),)
    hidden = several[(index // len(spec.excitation)) % len(several)]
    if spec.plant.distribution == "uniform":
        deviations = random.uniform(-spec.plant.spread, spec.plant.spread, len(FIELD_OF))
    else:
        deviations = spec.plant.spread * random.standard_normal(len(FIELD_OF))
    factors = dict(zip(FIELD_OF, 1 + deviations, strict=True))
    given = {name: _drawn(value, random) for name, value in {**spec.plant.values, **hidden.values}.items()}
    if spec.plant.truth == "virtual_rig":
        return _true_rig(spec, factors, given, hidden, excitation)
    model, values = _true_model(spec, factors, given)
    return Truth(values | _derived(values), model, hidden, excitation)


def _drawn(value: object, random: np.random.Generator) -> Any:
    return float(random.uniform(*value)) if isinstance(value, tuple) else value


def _true_rig(
    spec: StudySpec, factors: dict[str, float], given: dict[str, Any], hidden: Hidden, excitation: Excitation
) -> Truth:
    paper, noise = Rig(), spec.noise
    spread = {field: getattr(paper, field) * float(factors[name]) for name, field in FIELD_OF.items()}
    sensors: dict[str, Any] = {
        "position_noise": noise.position, "velocity_noise": noise.velocity, "angle_noise": noise.angle,
        "noise_correlation": noise.correlation, "force_noise": noise.force, "torque_noise": noise.torque,
        "quantisation_bits": noise.bits or None, "encoder": noise.encoder,
    }  # fmt: skip
    rig = dataclasses.replace(paper, **(spread | sensors | given))
    fields = {**FIELD_OF, **{n: EFFECT_FIELD[n] for n in parameter_names(spec.model.effects) if n in EFFECT_FIELD}}
    values = {name: float(getattr(rig, field)) for name, field in fields.items()}
    # A stop that a rig lacks is infinitely far away; how stiff it is then says nothing.
    absent = {name.partition(".")[0] for name, value in values.items() if not math.isfinite(value)}
    values = {name: value for name, value in values.items() if name.partition(".")[0] not in absent}
    return Truth(values | _derived(values), rig, hidden, excitation)


@functools.cache
def the_paper() -> tuple[RTAC, dict[str, float]]:
    """Return the paper's model and its values by name."""
    paper = RTAC.paper()
    return paper, {name: float(value) for name, value in paper.values.items()}


def _true_model(spec: StudySpec, factors: dict[str, float], given: dict[str, Any]) -> tuple[RTAC, dict[str, float]]:
    """Return the model, and the values of its parameters by name, read of it once and not in every repetition."""
    model, paper = the_paper()
    for effect in spec.model.effects:
        own = {name: given.get(f"{effect}.{name}") for name in declarations(CATALOGUE[effect])}
        missing = [name for name, value in own.items() if value is None]
        if missing:
            raise SpecError(f"plant.values: the model makes the data, so give a value of {effect}.{missing[0]}.")
        model = model + CATALOGUE[effect](**own)
    drawn = {name: paper[name] * float(factor) for name, factor in factors.items()} | given
    # What is as in the paper stands in the model already; an array of JAX takes ten microseconds to make.
    other = {name: value for name, value in drawn.items() if value != paper.get(name)}
    return model.with_values(other), {name: float(value) for name, value in {**paper, **drawn}.items()}


def small_motion(
    values: Mapping[str, float],
) -> tuple[Float[np.ndarray, "state state"], Float[np.ndarray, "state state"]]:
    """Return E and F of E x' = F x for small motions about theta = 0 without dry friction: equation (4).

    The states are the cart's position and velocity and the arm's velocity:
    (M+m) q'' + v q' + k q + me w' = 0 and J w' + K_v w + me q'' = 0.
    """
    moment, drag = values["eccentric_moment"], 0.5 * (values["arm_viscous.positive"] + values["arm_viscous.negative"])
    inertias = [[1.0, 0.0, 0.0], [0.0, values["total_mass"], moment], [0.0, moment, values["arm_inertia"]]]
    damping = values["cart_viscous.coefficient"]
    forces = [[0.0, 1.0, 0.0], [-values["spring_stiffness"], -damping, 0.0], [0.0, 0.0, -drag]]
    return np.array(inertias), np.array(forces)


def _derived(values: Mapping[str, float]) -> dict[str, float]:
    """Return ratios of Table 1(a), and the resonance of small motions about theta = 0 without dry friction: equation (4)."""
    ratios = {name: values[of] / values["spring_stiffness"] for name, of in RATIOS.items()}
    inertias, forces = small_motion(values)
    poles = np.linalg.eigvals(np.linalg.solve(inertias, forces))
    pair = poles[np.argmax(poles.imag)]
    return ratios | {"natural frequency": float(abs(pair)), "damping ratio": float(-pair.real / abs(pair))}
