"""The closed form on recordings from the independent simulator: Table 1, its bias, and what each option is good for."""

import dataclasses

import numpy as np
import pytest
from closed_form_truth import RIG, TRUTH, every, recorded

import estimators as est
import rtac_jax as rtac
from estimators.closed_form.regressors import automatic_cutoff
from estimators.core.sensor_noise import noise_levels
from rtac_jax import virtual_rig


def error(found: est.ClosedForm, name: str) -> float:
    return every(found)[name].value / TRUTH[name] - 1


@pytest.fixture(scope="module")
def quiet() -> rtac.Recording:
    """Sensor noise only."""
    return recorded(1)


@pytest.fixture(scope="module")
def disturbed() -> rtac.Recording:
    """Random forces and torques under the multisines and square waves of all other recordings."""
    return recorded(2, force=2.5e-3, torque=8e-4)


@pytest.fixture(scope="module")
def model(quiet: rtac.Recording) -> rtac.RTAC:
    return rtac.RTAC.from_rig(quiet)


@pytest.fixture(scope="module")
def as_in_paper(quiet: rtac.Recording, model: rtac.RTAC) -> est.ClosedForm:
    return est.least_squares(model, quiet)


@pytest.fixture(scope="module")
def weak(quiet: rtac.Recording, model: rtac.RTAC) -> est.ClosedForm:
    return est.least_squares(model, quiet, weak=True)


def decays(count: int, noise: float, dt: float = 0.002) -> rtac.Recording:
    """Viscous oscillators in closed form, the arm locked; mass and stiffness as in section 4.2."""
    random = np.random.default_rng(17)
    time = dt * np.arange(round(5.0 / dt))
    rate = RIG.cart_viscous / (2 * RIG.total_mass)
    damped = np.sqrt(RIG.spring_stiffness / RIG.total_mass - rate**2)
    shape = np.exp(-rate * time) * (np.cos(damped * time) + rate / damped * np.sin(damped * time))
    experiments = tuple(
        rtac.Experiment.of(
            f"free_{i}", kind="free", sample_time=dt, arm="locked", initial_arm_angle=0.0,
            cart_position=q * shape + noise * random.normal(size=len(time)),
        )
        for i, q in enumerate(np.linspace(0.006, 0.015, count))
    )  # fmt: skip
    return rtac.Recording(experiments, rig={"total_mass": RIG.total_mass})


def test_weak_form_without_noise_gives_the_truth() -> None:
    recording = decays(3, 0.0)
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    found = est.least_squares(model, recording, weak=True)
    assert found.ratios["(M+m)/k"].pooled == pytest.approx(TRUTH["(M+m)/k"], rel=1e-6)
    assert found.ratios["v/k"].pooled == pytest.approx(TRUTH["v/k"], rel=1e-6)


@pytest.mark.slow
def test_with_noise_closed_form_and_output_error_agree_within_their_deviations() -> None:
    recording = decays(6, 2e-6)
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    closed = est.least_squares(model, recording, weak=True).estimates
    fit = est.output_error(model, recording, progress=False, starts=1).parameters
    for name, truth in {
        "spring_stiffness": RIG.spring_stiffness,
        "cart_viscous.coefficient": RIG.cart_viscous,
    }.items():
        assert abs(fit[name].value - truth) < 4 * fit[name].std, name
        assert abs(closed[name].value - fit[name].value) < 4 * np.hypot(closed[name].std, fit[name].std), name


def test_forced_runs_alone_give_stiffness_and_friction_too(quiet: rtac.Recording, model: rtac.RTAC) -> None:
    forced = rtac.Recording(tuple(e for e in quiet.experiments if e.kind != "free"), rig=quiet.rig)
    found = est.least_squares(model.with_values({"spring_stiffness": 100.0}), forced, weak=True)
    assert not found.ratios
    assert found.estimates["spring_stiffness"].pooled == pytest.approx(RIG.spring_stiffness, rel=0.005)
    assert found.estimates["cart_coulomb.level"].pooled == pytest.approx(RIG.cart_coulomb, rel=0.05)


def test_a_clamped_cart_gives_torque_constant_and_friction_of_the_arm() -> None:
    plans = [
        dataclasses.replace(p, cart="clamped", initial_position=0.0)
        for p in virtual_rig.standard_plans(seed=3, sample_time=0.005, duration=6.0, free=0, forced=4, rest=1)
        if p.kind == "forced"
    ]
    recording = virtual_rig.record(RIG, plans, seed=4)
    arm_only = rtac.Recording(
        tuple(
            dataclasses.replace(e, outputs={c: s for c, s in e.outputs.items() if c != "cart_position"})
            for e in recording.experiments
        ),
        rig={"arm_inertia": RIG.arm_inertia},
    )
    found = est.least_squares(rtac.RTAC.from_rig(arm_only), arm_only, weak=True)
    for name in ("torque_constant", "arm_viscous.positive", "arm_viscous.negative"):
        assert found.estimates[name].pooled == pytest.approx(TRUTH[name], rel=0.005), name


# -- with sensor noise: which option helps -------------------------------------------------------------------------------


def test_weak_form_removes_the_bias_of_the_papers_estimates(as_in_paper: est.ClosedForm, weak: est.ClosedForm) -> None:
    """Noise in the regressors and the stuck end of a decay put 15 % on v and take 5 % off d; the weak form loses neither."""
    assert error(as_in_paper, "v/k") > 0.1
    assert error(as_in_paper, "d/k") < -0.04
    for name in TRUTH:
        assert abs(error(weak, name)) < 0.005, name
        assert every(weak)[name].consistency < 1.05 * every(as_in_paper)[name].consistency, name
    within = [abs(every(weak)[n].value - t) < 3 * every(weak)[n].std for n, t in TRUTH.items()]
    assert np.mean(within) > 0.8, dict(zip(TRUTH, within, strict=True))


@pytest.mark.parametrize("every", [2, 5])
def test_a_position_that_is_read_at_some_samples_only_gives_the_same(
    quiet: rtac.Recording, model: rtac.RTAC, weak: est.ClosedForm, every: int
) -> None:
    """Straight lines from one to the next would take from the tops of its oscillation, and from the eccentric moment."""

    def read(one: rtac.Experiment) -> rtac.Experiment:
        position = one.outputs["cart_position"]
        values = np.where(np.arange(one.samples) % every == 0, position.values, np.nan)
        return dataclasses.replace(
            one, outputs={**one.outputs, "cart_position": dataclasses.replace(position, values=values)}
        )

    seldom = dataclasses.replace(quiet, experiments=tuple(map(read, quiet.experiments)))
    found = est.least_squares(model, seldom, weak=True)
    for name in ("eccentric_moment", "spring_stiffness", "torque_constant", "arm_viscous.positive"):
        one, whole = found.estimates[name], weak.estimates[name]
        assert abs(one.value - whole.value) < 2 * np.hypot(one.std, whole.std)
        assert abs(one.value / whole.value - 1) < 5e-3


def test_what_the_paper_does_not_write_of_is_needed(
    quiet: rtac.Recording, model: rtac.RTAC, as_in_paper: est.ClosedForm
) -> None:
    """With the stuck end of each decay among the samples, dry friction is taken for viscous."""
    literal = est.least_squares(model, quiet, **est.AS_IN_PAPER)
    for name in ("v/k", "d/k"):
        assert abs(error(literal, name)) > 3 * abs(error(as_in_paper, name)), name
    for name in ("(M+m)/k", "torque_constant"):
        assert abs(error(literal, name)) < 0.01, name


def test_the_arms_reaction_moves_the_mass_and_helps(
    quiet: rtac.Recording, model: rtac.RTAC, weak: est.ClosedForm
) -> None:
    without = est.least_squares(model, quiet, weak=True, reaction=False)
    assert -0.01 < error(without, "(M+m)/k") < -0.003  # the arm takes up to epsilon^2 = 1 % from the mass
    assert abs(error(weak, "(M+m)/k")) < 0.05 * abs(error(without, "(M+m)/k"))
    assert every(weak)["(M+m)/k"].consistency < 0.2 * every(without)["(M+m)/k"].consistency


def test_leaving_out_slow_stretches_helps(quiet: rtac.Recording, model: rtac.RTAC, weak: est.ClosedForm) -> None:
    """Where the cart sticks, the sign of its velocity is noise."""
    everything = est.least_squares(model, quiet, weak=True, near_zero=0.0)
    for name in ("v/k", "d/k"):
        assert every(everything)[name].consistency > 2 * every(weak)[name].consistency, name


@pytest.mark.parametrize("weak", [False, True])
def test_a_cart_that_never_slides_leaves_the_arm_to_tell(quiet: rtac.Recording, model: rtac.RTAC, weak: bool) -> None:
    found = est.least_squares(model, quiet, weak=weak, near_zero=1e9)
    assert not found.ratios
    for name in ("torque_constant", "arm_viscous.positive"):
        assert abs(error(found, name)) < 0.1, name


def test_automatic_cutoff_helps_against_a_wide_filter(
    quiet: rtac.Recording, model: rtac.RTAC, as_in_paper: est.ClosedForm
) -> None:
    wide = est.least_squares(model, quiet, cutoff=60.0)
    levels = noise_levels(quiet.experiments)
    assert all(2.0 < automatic_cutoff(e, levels) < 60.0 for e in quiet.experiments if e.kind == "free")
    for name in ("(M+m)/k", "v/k", "d/k"):
        assert abs(error(wide, name)) > 3 * abs(error(as_in_paper, name)), name


def test_weighting_by_residuals_is_as_good_as_none_and_by_inertias_hurts(
    quiet: rtac.Recording, model: rtac.RTAC
) -> None:
    """me shows almost only in the cart's equation; made accelerations of, the arm's noise drowns it."""
    found = {w: est.least_squares(model, quiet, weak=True, weighting=w) for w in ("residual", "inertia", "none")}
    scatter = {w: every(f)["eccentric_moment"].consistency for w, f in found.items()}
    assert scatter["residual"] < 1.1 * scatter["none"], scatter
    assert scatter["inertia"] > 2 * scatter["residual"], scatter


# -- with random forces and torques, as the scatter of Table 1 asks -------------------------------------------------------


def test_means_come_within_two_deviations_with_instruments(disturbed: rtac.Recording) -> None:
    """With fast currents K_v of plain least squares is a fifth too small; instruments mend it at the price of scatter."""
    model = rtac.RTAC.from_rig(disturbed)
    plain = every(est.least_squares(model, disturbed))
    found = every(est.least_squares(model, disturbed, weak=True, instruments=True))
    sigmas = {n: (found[n].value - t) / found[n].std for n, t in TRUTH.items()}
    assert max(abs(s) for s in sigmas.values()) < 2.0, sigmas
    for name in ("arm_viscous.positive", "arm_viscous.negative"):
        assert plain[name].value < 0.9 * TRUTH[name]
        # Of a single run it is a quotient of two uncertain numbers; of all together it is steadier than their mean.
        assert abs(found[name].pooled / TRUTH[name] - 1) < 0.6 * abs(plain[name].pooled / TRUTH[name] - 1)
    worst = max(abs(plain[n].value - t) / plain[n].std for n, t in TRUTH.items())
    assert worst > 3.0


@pytest.mark.slow
def test_instruments_keep_the_means_within_two_deviations_over_many_recordings() -> None:
    sigmas = []
    for seed in range(10, 22):
        recording = recorded(seed, force=2.5e-3, torque=8e-4)
        found = every(est.least_squares(rtac.RTAC.from_rig(recording), recording, weak=True, instruments=True))
        sigmas.append([(found[n].value - t) / found[n].std for n, t in TRUTH.items()])
    inside = np.mean(np.abs(sigmas) < 2.0)
    assert inside > 0.85, np.round(sigmas, 1)


# -- what is printed -----------------------------------------------------------------------------------------------------


def test_table_1_has_the_papers_form(as_in_paper: est.ClosedForm, disturbed: rtac.Recording) -> None:
    text = str(as_in_paper)
    assert [text.index(part) for part in ("(a) free", "(b) forced", "(c) parameters")] == sorted(
        text.index(part) for part in ("(a) free", "(b) forced", "(c) parameters")
    )
    for part in ("10 experiments", "20 experiments", "Std.dev. / Mean", "(M+m)/k [s^2]", "K_v2 [N m s/rad]", "epsilon"):
        assert part in text
    assert as_in_paper.consistent
    assert "Consistent by the paper's rule: all standard deviations" in text
    several = as_in_paper.ratios["v/k"]
    single = dataclasses.replace(several, names=several.names[:1], each=several.each[:1])
    one_free = str(dataclasses.replace(as_in_paper, ratios={**as_in_paper.ratios, "v/k": single}))
    assert "the other standard deviations are below 30 % of their means." in one_free
    assert "Of v/k nothing is said: one experiment has no scatter." in one_free
    loose = est.least_squares(rtac.RTAC.from_rig(disturbed), disturbed)
    assert not loose.consistent
    assert "Not consistent by the paper's rule of 30 %: K_v1" in str(loose)


def test_the_printout_says_that_v_and_d_are_biased_and_shows_the_weak_form(quiet: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(quiet)
    found, weak = est.least_squares(model, quiet), est.least_squares(model, quiet, weak=True)
    text = str(found)
    assert "v and d are biased here" in text
    assert found.weak is not None
    for name, one in every(weak).items():
        assert every(found.weak)[name].value == pytest.approx(one.value, rel=1e-12), name
    row = next(line for line in text.splitlines() if line.startswith("v/k "))
    assert f"{weak.ratios['v/k'].value:.4g}" in row
    # What is said of the bias is so: v is 8 to 17 % too large, several of its stated deviations, and the weak form is not.
    assert 0.05 < error(found, "v/k") < 0.2
    assert error(found, "v/k") * TRUTH["v/k"] > 3 * found.ratios["v/k"].std
    assert abs(error(weak, "v/k")) < 0.3 * error(found, "v/k")
    assert "biased" not in str(weak)
    assert weak.weak is None


@pytest.mark.parametrize(("pooled", "shown"), [(-3.25, "-3.25"), (0.0, "0"), (np.nan, None)])
def test_an_estimate_that_no_model_can_have_stands_in_the_table_as_it_is(
    as_in_paper: est.ClosedForm, pooled: float, shown: str | None
) -> None:
    """In place of the model's own stiffness, which nobody estimated."""
    odd = dataclasses.replace(as_in_paper.estimates["torque_constant"], pooled=pooled, unit="N/m")
    found = dataclasses.replace(as_in_paper, estimates={**as_in_paper.estimates, "spring_stiffness": odd})
    (row,) = [line for line in str(found).splitlines() if line.startswith("Spring stiffness")]
    assert row.split()[-2] == (shown or f"{float(found.model['spring_stiffness']):.5g}")


def test_table_1_as_a_picture(as_in_paper: est.ClosedForm) -> None:
    figure = as_in_paper.plot()
    assert "paper's rule of 30 %" in figure.get_suptitle()
    assert all(axes.get_xlabel() or axes.get_ylabel() for axes in figure.axes)


def test_a_recording_of_rests_gives_no_estimates_and_says_so(quiet: rtac.Recording, model: rtac.RTAC) -> None:
    rest = rtac.Recording(tuple(e for e in quiet.experiments if e.kind == "rest"), rig=quiet.rig)
    found = est.least_squares(model, rest)
    assert not found.estimates
    assert "no experiment that serves" in str(found)
    with pytest.raises(ValueError, match="nothing to draw"):
        found.plot()


def test_no_ratios_to_a_stiffness_that_is_not_there(as_in_paper: est.ClosedForm) -> None:
    ratios = {**as_in_paper.ratios, "(M+m)/k": dataclasses.replace(as_in_paper.ratios["(M+m)/k"], value=-4.1)}
    text = str(dataclasses.replace(as_in_paper, ratios=ratios))
    assert "(a) free oscillation: the data show no spring" in text
    assert "the data show no spring" not in str(as_in_paper)


def test_short_experiments_are_skipped_with_the_reason(quiet: rtac.Recording, model: rtac.RTAC) -> None:
    short = rtac.Recording(tuple(e.cut(0, 60, e.name) for e in quiet.experiments[:2]), rig=quiet.rig)
    assert "record for longer" in est.least_squares(model, short, weak=True).skipped["free_1"]
    assert "raise the cutoff" in est.least_squares(model, short, cutoff=5.0).skipped["free_1"]


def test_options_that_do_not_go_together_are_refused(quiet: rtac.Recording, model: rtac.RTAC) -> None:
    with pytest.raises(ValueError, match="weak form has none"):
        est.least_squares(model, quiet, weak=True, cutoff=10.0)
    with pytest.raises(ValueError, match="add weak=True"):
        est.least_squares(model, quiet, instruments=True)


def test_what_the_equations_do_not_have_is_said(quiet: rtac.Recording, model: rtac.RTAC) -> None:
    assert "Equations (5) and (6) have no" not in str(est.least_squares(model, quiet))
    more = model + rtac.effects.CurrentLag(0.01) + rtac.effects.TachoBias(0.1)
    assert "Equations (5) and (6) have no current_lag, tacho_bias:" in str(est.least_squares(more, quiet))
