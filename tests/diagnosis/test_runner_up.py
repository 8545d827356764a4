"""A runner-up in the place of what predictions one sample ahead prefer, where simulations of held-out experiments ask for it."""

import dataclasses

import made_up_results
import numpy as np
import pytest
from made_up_results import compared
from small_experiments import forced

import estimators as est
import rtac_jax as rtac
from estimators.core.fit import Parameter
from estimators.diagnosis import runner_up
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.policy import STANDARD
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, EncoderLag

LAGS = ("encoder_lag", "current_lag", "input_delay")
CLASSES = {name: CATALOGUE[name] for name in (*LAGS, "arm_coulomb", "cogging")}
LATE = {"time_constant": Parameter(8e-3, 1e-4, "s")}


def refitted(name: str, gain: float, parameters: dict[str, Parameter]) -> est.Candidate:
    return dataclasses.replace(
        made_up_results.candidate(name, gain), refitted=True, bic_gain=gain, parameters=parameters
    )


ENCODER, CURRENT = refitted("encoder_lag", 1845.0, LATE), refitted("current_lag", 1726.0, LATE)
DELAY = refitted("input_delay", 1656.0, {"delay": Parameter(8e-3, 1e-4, "s")})
WEAK = refitted("cogging", 176.0, {n: Parameter(1e-3, 1e-4, "N m") for n in ("sine", "cosine", "harmonic")})
FIRST = dataclasses.replace(
    made_up_results.diagnosis("missing"), effects=(ENCODER,), candidates=(ENCODER, DELAY, WEAK, CURRENT)
)


BOTH = ["current_lag", "input_delay"]


@pytest.mark.parametrize(
    ("before", "after", "asked", "taken"),
    [
        (19.0, {"current_lag": 1.03, "input_delay": 1.6}, BOTH, "current_lag"),
        (19.0, {"current_lag": 8.0, "input_delay": 6.0}, BOTH, "input_delay"),
        (90.0, {"current_lag": 30.0, "input_delay": 20.0}, BOTH, None),
        (19.0, {"current_lag": None, "input_delay": 12.0}, BOTH, None),
        (4.0, {"current_lag": 1.03, "input_delay": 1.2}, BOTH, "current_lag"),
        (1.9, {"current_lag": 0.9}, [], None),
    ],
)
def test_it_is_taken_where_most_of_the_error_falls(
    before: float, after: dict[str, float | None], asked: list[str], taken: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The closest first, none that gained little, and none that stays far off; not where the simulation follows already."""
    fit = dataclasses.replace(made_up_results.FIT, model=rtac.RTAC.paper() + EncoderLag(8e-3))
    last = Added(fit, compared("+ encoder_lag", before), "simulated")
    tried = []

    def with_it(
        last: Added, given_up: list[str], several: list[rtac.effects.Effect], label: str, *_: object, **__: object
    ) -> Added | None:
        (effect,) = several
        assert (given_up, label) == (["encoder_lag"], f"+ {effect.id}")
        tried.append(effect.id)
        left = after[effect.id]
        return None if left is None else Added(fit, compared(label, left), "simulated")

    monkeypatch.setattr(runner_up, "extended_without", with_it)
    nothing = rtac.Recording((forced(),), {})
    found = runner_up.runner_up(last, [ENCODER], [FIRST], CLASSES, nothing, nothing, policy=STANDARD, progress=False)
    assert tried == asked
    assert (found and found.taken.id) == taken


def multisine(samples: int, highest: float, rms: float, random: np.random.Generator) -> np.ndarray:
    """Return a current with all lines from 0.3 Hz to the highest, at random phases, sampled at 250 Hz and rounded to mA."""
    frequencies = np.fft.rfftfreq(samples, 0.004)
    within = (frequencies >= 0.3) & (frequencies <= highest)
    current = np.fft.irfft(np.where(within, np.exp(2j * np.pi * random.random(len(frequencies))), 0), samples)
    return np.round(current * rms / current.std(), 3)


@pytest.mark.slow
def test_a_lag_of_the_current_behind_dry_friction_is_no_lag_of_the_encoder() -> None:
    """A drive that only an encoder shows; with friction still missing predictions like a lag of the encoder as well.

    It may be named first and exchanged, left out once the lag of the current is beside it, or not be named at all.
    """
    rig = virtual_rig.Rig(
        arm_inertia=1.2e-3, torque_constant=0.07, arm_viscous_positive=1.5e-3, arm_viscous_negative=1.5e-3, arm_coulomb=6e-3,
        current_lag=8e-3, encoder=True, angle_noise=1e-6,
    )  # fmt: skip
    random, count, shown = np.random.default_rng(14), 2 * np.pi / 4000, []
    for number, (seconds, rms, highest) in enumerate([(6, 0.4, 8), (10, 0.6, 12), (5, 0.3, 6), (8, 0.5, 15)]):
        current = multisine(250 * seconds, highest, rms, random)
        plan = virtual_rig.Plan(f"run{number}", "forced", seconds, 0.004, cart="clamped", current=current)
        whole = virtual_rig.record(rig, [plan], seed=14)
        angle = whole.experiments[0].outputs["arm_angle"]
        counted = dataclasses.replace(angle, values=count * np.round(angle.values / count))
        shown.append(dataclasses.replace(whole.experiments[0], outputs={"arm_angle": counted}))
    recording = dataclasses.replace(whole, experiments=tuple(shown))
    several = [CATALOGUE[name] for name in ("arm_coulomb", "arm_stribeck", *LAGS)]
    found = est.improve(rtac.RTAC.from_rig(recording), recording, candidates=several, progress=False)
    assert {c.id for c in found.added} == {"arm_coulomb", "current_lag"}, str(found)
    assert found.mended == "adequate"
    assert found.final.parameters["current_lag.time_constant"].value == pytest.approx(8e-3, rel=0.01)
    assert found.final.parameters["arm_coulomb.level"].value == pytest.approx(6e-3, rel=0.01)
    first = {c.id for c in found.diagnoses[0].effects}
    told = any(what in found.ending for what in ("takes the place of encoder_lag", "encoder_lag is left out again"))
    assert told == ("encoder_lag" in first), "what goes again is told, and nothing else"
