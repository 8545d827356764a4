"""`rtac control`: from many operating conditions to a controller."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.captions import shown
from estimators.cli.conditions import Band, WeightOrder, band_of, enveloped, sides
from estimators.cli.job import job
from estimators.cli.limits import TorqueLimit, positive
from estimators.cli.models import any_fit, seen
from estimators.cli.options import Effects, File, Json, Model, Out, Save, Validation
from estimators.cli.report_page import write_json, write_report
from rtac_jax.measurement.atomic_write import replacing

if TYPE_CHECKING:
    from estimators.validation.simulation_error import Comparison

_FOLLOWS = 50.0  # fit [%] below which a simulation goes its own way
_ORDERS = (2, 4)  # of nominal models that `control` tries: one mode, and the paper's two


def control(
    file: File,
    order: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=12,
            show_default=False,
            help="Poles of the nominal model; by default 2 and 4 are tried, and the best controller is kept.",
        ),
    ] = None,
    weight_order: WeightOrder = 2,
    displacement: Annotated[
        float, typer.Option(metavar="MM", help="From which the cart is to be brought to rest, in mm.")
    ] = 15.0,
    torque_limit: TorqueLimit = 0.1,
    band: Band = None,
    validation: Validation = None,
    model: Model = None,
    effects: Effects = None,
    save: Save = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Design an H-infinity controller for the envelope, and try it on the fitted nonlinear model."""
    between = band_of(band)
    positive({"--displacement": displacement, "--torque-limit": torque_limit})
    with job(file, validation, out, json, save) as work:
        import estimators as est
        from estimators.controller.design import with_arm_spring
        from estimators.controller.outcome import honesty, outcome
        from estimators.reporting import control as texts
        from estimators.reporting import envelope as envelope_texts
        from estimators.reporting import report
        from estimators.reporting import tables as _tables
        from estimators.reporting.summary import of_control
        from estimators.uncertainty.fitted_model import fitted_in_envelope

        orders = _ORDERS if order is None else (order,)
        used, found = enveloped(work, between, orders, weight_order, "multiplicative_output", for_control=True)
        sample_time = work.recording[used.responses[0].name].sample_time
        fit = any_fit(work, model, effects)
        made = est.control(
            fit, found, used.responses, sample_time=sample_time, displacement=1e-3 * displacement,
            torque_limit=torque_limit,
        )  # fmt: skip
        split = covered, apart = sides(made.covered)
        if work.held_out is not None and not apart:
            known = seen(fit, work.held_out)
            unknown = ", ".join(name for name in work.held_out.names if name not in known)
            work.split_said = " ".join(
                [
                    *([f"Held out of the nonlinear fit: {unknown}."] if unknown else []),
                    *(
                        [f"The fit was made of {', '.join(known)} too, so its error there is too good."]
                        if known
                        else []
                    ),
                    f"The envelope covers all conditions: {', '.join(covered)}.",
                ]
            )
        whose = f"It was fitted to {'the same' if seen(fit, work.recording) else 'another'} recording."
        trained, tested = work.compared(fit)
        errors, parameters = _tables.error_table(trained, tested), _tables.parameter_table(fit)
        sprung = with_arm_spring(fit.model, made.actuation)
        fitted = fitted_in_envelope(fit.model, made.covered, with_spring=sprung, nothing=made.nothing)
        work.save(made, save)
        doubt = _does_not_follow(tested or trained)
        said, honest, loops = (
            [*doubt, *outcome(made)],
            [work.remark, *honesty(made), texts.WEIGHTED],
            texts.design_table(made),
        )
        work.say(*said, *fitted.sentences(), *honest, loops, texts.controller_table(made), errors)
        known = report.fit_dict(fit, train=trained, validation=tested, seconds=work.seconds)["parameters"]
        write_json(work, texts.design_dict(made, known, seconds=work.seconds, fitted=fitted))
        if work.folder is None:
            return
        from estimators.plots import (
            plot_batch,
            plot_bode,
            plot_closed_loop,
            plot_envelope,
            plot_margins,
            plot_poles_zeros,
            plot_synthesis,
        )

        _save_mat(work.folder / "controller.mat", texts.design_mat(made))
        figures = {
            "closed_loop": plot_closed_loop(made.free, {"closed loop": made.closed}),
            "batch": plot_batch(made.off, free=made.off_free, within=made.within),
            "synthesis": plot_synthesis(made.synthesis),
            "margins": plot_margins(made.margins),
            "envelope": plot_envelope(made.covered, fitted=fitted),
            "bode": plot_bode(fit, used.responses),
            "poles": plot_poles_zeros(fit),
        }
        captions = {
            "closed_loop": "The fitted nonlinear model, sampled controller, limited torque, noisy sensors.",
            "batch": "Plants whose parameters are each up to 15 % off, with and without the controller.",
            "synthesis": "S, T and C S of the nominal loop, under what the weights allow.",
            "margins": "Below 1 robust stability, or performance, holds for every linear plant of the envelope.",
            "envelope": "What the controller was designed for: the conditions with the electric spring on the arm.",
            "bode": "The fitted model, linearised without dry friction and without the spring, over the measured responses.",
            "poles": "Poles and zeros of the fitted model, from current to cart position.",
        }
        models = envelope_texts.models_table(made.covered)
        sections = [
            ("Controller", said),
            ("What is guaranteed and what is not", honest),
            ("Open and closed loop", [loops, *shown(figures, **captions)]),
            ("The controller", [texts.controller_table(made)]),
            ("The envelope", [*fitted.sentences(), *envelope_texts.remarks(made.covered, used), models]),
            ("The nonlinear model", [whose, errors, parameters]),
        ]
        bullets = of_control(made, [] if fitted.agrees else fitted.sentences())
        title = f"Controller for {work.file}"
        write_report(work, title, figures, sections, split=split, summary=bullets, traces=tested or trained)


def _does_not_follow(compared: "Comparison") -> list[str]:
    """Say where a model, as one of another rig, leaves more than half of what was measured."""
    far = {c: e for c, e in compared.models[-1].errors.items() if e.fit_percent < _FOLLOWS}
    if not far:
        return []
    each = ", ".join(f"{c} {e.fit_percent:.3g} % ({e.rms_over_noise:.3g} times the noise)" for c, e in far.items())
    return [
        f"The model does not follow this recording: of the fit of its simulation there is {each}. A controller is tried on a rig "
        "that this one is not; fit the model to it first."
    ]


def _save_mat(path: Path, content: dict[str, Any]) -> None:
    import scipy.io

    with replacing(path) as temporary:
        scipy.io.savemat(temporary, content, appendmat=False)
