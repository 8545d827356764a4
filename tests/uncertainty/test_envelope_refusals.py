"""Families of plants of which no envelope can be made: each is refused in one sentence that names the place and the mend."""

import control as ct
import numpy as np
import pytest
from plant_families import OMEGA, draw, responses

import estimators as est

PLANTS = responses(draw(6, seed=12))


def cover(plants=PLANTS, **options):
    return est.envelope(plants, **{"omega": OMEGA, **options})


UNSTABLE = ct.tf([1.0], [1.0, -0.5, 10.0], name="rolling")
INTEGRATOR = ct.ss([[0.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0.0, name="turning")
SYSTEMS = draw(3, seed=13)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cover(PLANTS[:1]), "1 condition is left to fit"),
        (lambda: cover(held_out=range(5)), "1 condition is left to fit"),
        (lambda: cover(held_out=[6]), "held_out: there is no condition 6; there are 6: condition_1, "),
        (lambda: cover(held_out=["seven"]), "held_out: there is no condition 'seven'"),
        (lambda: cover(minimise="most"), "minimise: is 'most'"),
        (lambda: cover(nominal=UNSTABLE), r"nominal: has a pole at 0.25"),
        (lambda: cover(nominal=ct.tf([1.0], [1.0, 0.5], 0.01)), "nominal: is a discrete-time system"),
        (lambda: cover(order_weight=0, within_db=3.0), "order_weight: a weight of order 0 covers the profile only"),
        (lambda: cover(kind="feedback"), "kind: is 'feedback'"),
        (lambda: cover(np.abs(PLANTS).astype(complex)), "are all real, as magnitudes are"),
        (
            lambda: est.envelope(SYSTEMS, omega=OMEGA, std=np.ones((2, 100))),
            r"std: has shape \(2, 100\); give one for each",
        ),
        (
            lambda: cover(
                np.concatenate([PLANTS, np.where(np.arange(100) == 50, 20, 1) * PLANTS[:1]]), held_out=["condition_7"]
            ),
            r"held_out: condition_7 lies [\d.]+ times outside the weight of those that were fitted, which lifts it by [\d.]+ dB",
        ),
        (lambda: est.envelope([*SYSTEMS, ct.tf([1.0], [1.0, -0.5, 10.0])], omega=OMEGA), r"^condition_4: has a pole"),
        (lambda: cover(order_nominal=0), "order_nominal, order_weight: are 0 and 2"),
        (lambda: cover(zeros=5), "zeros: is 5"),
        (lambda: cover(confidence=1.0), "confidence: is 1"),
        (lambda: cover(importance=np.zeros(100)), "importance: give 100 positive"),
        (lambda: cover(np.where(OMEGA > 50, 0, PLANTS)), "a plant is zero at a frequency"),
        (lambda: cover(np.where(OMEGA > 50, np.nan, PLANTS)), "condition_1: has a response that is not finite"),
        (lambda: cover(np.tile(PLANTS[:1], (3, 1))), "all conditions equal the nominal model"),
        (lambda: cover(omega=OMEGA[:50]), "omega: give the 100 frequencies"),
        (lambda: cover(omega=OMEGA[::-1]), "omega: must be positive and increasing"),
        (lambda: est.envelope(SYSTEMS), "omega: give the frequencies"),
        (lambda: est.envelope([*SYSTEMS, ct.frd(PLANTS[0], OMEGA)], omega=OMEGA), "give only FRD, or only"),
        (lambda: est.envelope([ct.frd(PLANTS[0], OMEGA), ct.frd(PLANTS[1, :50], OMEGA[:50])]), "has other frequencies"),
        (lambda: est.envelope([ct.tf([1.0], [1.0, 0.5], 0.1)] * 2, omega=OMEGA), "discrete-time"),
        (lambda: est.envelope([ct.rss(2, 2, 1)] * 2, omega=OMEGA), "choose one of each"),
        (lambda: est.envelope([*SYSTEMS, UNSTABLE], omega=OMEGA), r"rolling: has a pole at 0\.25[+-]3\.152j"),
        (
            lambda: est.envelope([*SYSTEMS, INTEGRATOR], omega=OMEGA, kind="additive"),
            r"turning: has a pole at 0\+0j.* integrates",
        ),
        (lambda: est.envelope(SYSTEMS, omega=OMEGA).covers([UNSTABLE]), r"rolling: has a pole at 0\.25"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
