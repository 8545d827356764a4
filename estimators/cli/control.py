"""`rtac envelope` and `rtac control`: from many operating conditions to a controller."""

import itertools
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from estimators.cli.job import WRONG_USE, Job, job, progress, say, stop
from estimators.cli.options import File, Json, Out, Validation
from rtac_jax.measurement.atomic_write import replacing

_ORDERS = (2, 4)  # of nominal models that `control` tries: one mode, and the paper's two
_IMPORTANCE = (0.5, 1.0)  # powers of the responses' size by which P0 for `control` keeps closest where they are large
WeightOrder = Annotated[int, typer.Option(min=0, max=8, help="Poles and zeros of the uncertainty weight.")]
Band = Annotated[
    str | None,
    typer.Option(metavar="LOW,HIGH", help="Band in Hz; by default where all currents have energy.", show_default=False),
]


class Kind(StrEnum):
    """The structure of the uncertainty about the nominal model."""

    MULTIPLICATIVE_OUTPUT = "multiplicative_output"
    MULTIPLICATIVE_INPUT = "multiplicative_input"
    ADDITIVE = "additive"
    INVERSE_MULTIPLICATIVE = "inverse_multiplicative"


class Least(StrEnum):
    """The distance of the weight from what it covers that is made least."""

    MEAN = "mean"
    LARGEST = "largest"


class Method(StrEnum):
    """The estimator of the frequency response of a condition."""

    LOCAL = "local"
    PREDICTION_ERROR = "prediction-error"


def envelope(
    file: File,
    order: Annotated[int, typer.Option(min=1, max=12, help="Poles of the nominal model.")] = 4,
    weight_order: WeightOrder = 2,
    kind: Annotated[Kind, typer.Option(help="What the uncertainty does to the nominal model.")] = (
        Kind.MULTIPLICATIVE_OUTPUT
    ),
    method: Annotated[
        Method,
        typer.Option(
            help="Responses by local polynomials, or of linear models with half as many modes as P0 has poles."
        ),
    ] = Method.LOCAL,
    minimise: Annotated[
        Least, typer.Option(help="The distance of the weight from what it covers, in dB, that is made least.")
    ] = Least.MEAN,
    band: Band = None,
    validation: Validation = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Fit one linear model and an uncertainty weight that cover all operating conditions."""
    between = _band(band)
    with job(file, validation, out, json) as work:
        from estimators.reporting import envelope as texts

        modes = (order + 1) // 2 if method is Method.PREDICTION_ERROR else None
        used, (found,) = _enveloped(work, between, [order], weight_order, kind.value, minimise.value, modes=modes)
        conditions, sources = texts.conditions_table(found, used.responses), texts.sources_table(found)
        models, said = texts.models_table(found), texts.remarks(found, used)
        linear = [] if used.models is None else texts.models_said(used.models)
        fitted, beside = _closed_form_beside(work, found)
        say(found, *beside, *said[1:], *linear, conditions, sources)  # the envelope states its coverage itself
        work.write_json(texts.envelope_dict(found, used, seconds=work.seconds, fitted=fitted))
        if work.folder is None:
            return
        from estimators.plots import plot_envelope, plot_responses
        from estimators.plots.envelope import finding
        from estimators.reporting.summary import of_envelope

        found.save_mat(work.folder / "envelope.mat")
        figures = {"envelope": plot_envelope(found, fitted), "responses": plot_responses(used.responses)}
        captions = {
            "envelope": "Top: every condition and the nominal model. Below: how far each condition lies from it and the "
            "weight above them; |W| < 1 (0 dB) is where a controller may act. Bottom: what the distance comes from.",
            "responses": "Frequency responses from current times cos(theta) to cart position, with the least certain one's "
            "95 % band.",
        }
        sections = [
            ("Envelope", [f"{finding(found)}.", *beside, *said]),
            ("Figures", _shown(figures, captions)),
            ("Nominal model and weight", [models]),
            ("Where the gaps come from", [sources]),
            ("Conditions", [conditions]),
        ]
        if used.models is not None:
            from estimators.plots import plot_prediction_error

            figures["linear_models"] = plot_prediction_error(used.models)
            shown = _shown(
                {"linear_models": figures["linear_models"]}, {"linear_models": "The models and their residuals."}
            )
            sections.insert(2, ("Linear models of the conditions", [*linear, *shown]))
        bullets = of_envelope(found, [] if fitted is None or fitted.agrees else beside, file=work.file)
        work.write_report(f"Envelope of {work.file}", figures, sections, split=_sides(found), summary=bullets)


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
    torque_limit: Annotated[float, typer.Option(metavar="NM", help="Of the motor, in N m.")] = 0.1,
    band: Band = None,
    validation: Validation = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Design an H-infinity controller for the envelope, and try it on the fitted nonlinear model."""
    between = _band(band)
    for name, value in (("--displacement", displacement), ("--torque-limit", torque_limit)):
        if not 0 < value < float("inf"):
            stop(WRONG_USE, f"{name} is {value:g}; give a positive number.")
    with job(file, validation, out, json) as work:
        import estimators as est
        from estimators.controller.design import with_arm_spring
        from estimators.controller.outcome import honesty, outcome
        from estimators.reporting import control as texts
        from estimators.reporting import envelope as envelope_texts
        from estimators.reporting import report
        from estimators.reporting.summary import of_control
        from estimators.uncertainty.fitted_model import fitted_in_envelope

        orders = _ORDERS if order is None else (order,)
        used, found = _enveloped(work, between, orders, weight_order, "multiplicative_output", for_control=True)
        sample_time = work.recording[used.responses[0].name].sample_time
        fit = work.fitted(work.model())
        made = est.control(
            fit, found, used.responses, sample_time=sample_time, displacement=1e-3 * displacement,
            torque_limit=torque_limit,
        )  # fmt: skip
        trained, tested = work.compared(fit)
        errors, parameters = report.error_table(trained, tested), report.parameter_table(fit)
        fitted = fitted_in_envelope(fit.model, made.covered, response=with_arm_spring(fit.model, made.actuation))
        said, honest, loops = outcome(made), [*honesty(made), texts.WEIGHTED], texts.design_table(made)
        say(*said, *fitted.sentences(), *honest, loops, texts.controller_table(made), errors)
        known = report.fit_dict(fit, train=trained, validation=tested, seconds=work.seconds)["parameters"]
        work.write_json(texts.design_dict(made, known, seconds=work.seconds, fitted=fitted))
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
            "envelope": plot_envelope(made.covered, fitted),
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
        sections = [
            ("Controller", said),
            ("What is guaranteed and what is not", honest),
            ("Open and closed loop", [loops, *_shown(figures, captions)]),
            ("The controller", [texts.controller_table(made)]),
            (
                "The envelope",
                [
                    *fitted.sentences(),
                    *envelope_texts.remarks(made.covered, used),
                    envelope_texts.models_table(made.covered),
                ],
            ),
            ("The nonlinear model", ["It was fitted to the same recording.", errors, parameters]),
        ]
        bullets = of_control(made, [] if fitted.agrees else fitted.sentences())
        title, sides = f"Controller for {work.file}", _sides(made.covered)
        work.write_report(title, figures, sections, split=sides, summary=bullets, traces=tested or trained)


def _enveloped(
    work: Job,
    band: tuple[float, float] | None,
    orders: Sequence[int],
    weight_order: int,
    kind: str,
    minimise: str = "mean",
    *,
    modes: int | None = None,
    for_control: bool = False,
) -> tuple[Any, list[Any]]:
    """Return responses, and envelopes of each order; one that cannot be is left out as long as another can.

    For control the nominal model keeps closest to the responses where they are large, as limited torque does nothing
    elsewhere, a little or much; and unless they were named, none is held out: a held-out condition raises the weight at all
    frequencies alike, which costs more than what could then be said of new ones.
    """
    import numpy as np

    import estimators as est
    from estimators.uncertainty.condition_selection import usable_conditions

    used = usable_conditions(work.recording, band=band, modes=modes, progress=progress())
    apart = set(work.held_out.names) if work.held_out is not None else set()
    held = [i for i, one in enumerate(used.responses) if one.name in apart]
    if work.names is None and (for_control or len(used.responses) - len(held) < 2):
        held = []  # of few conditions none can be spared
    fitted = [i for i in range(len(used.responses)) if i not in held]
    size = np.exp(np.mean(np.log(np.abs(used.responses.response[fitted])), axis=0))
    importances = [(size / np.max(size)) ** power for power in _IMPORTANCE] if for_control else [None]
    found, refusals = [], []
    for order, importance in itertools.product(orders, importances):
        try:
            one = est.envelope(
                used.responses, kind=kind, order_nominal=order, order_weight=weight_order, held_out=held,
                importance=importance, minimise=minimise, progress=progress(),
            )  # fmt: skip
            found.append(one)
        except ValueError as error:
            refusals.append(error)
    if not found:
        raise refusals[0]
    return used, found


def _closed_form_beside(work: Job, found: Any) -> tuple[Any, list[str]]:
    """Return the model fitted in closed form beside an envelope, and what is to be said of it; None where none can be fitted.

    The closed form takes milliseconds and is consistent in its weak form; `control` has the fit by output error.
    """
    import estimators as est
    from estimators.uncertainty.fitted_model import fitted_in_envelope

    try:
        fitted = fitted_in_envelope(est.least_squares(work.model(), work.train, weak=True).model, found)
    except (ValueError, ArithmeticError) as error:
        return None, [f"The envelope was held against no fitted model: {error}"]
    return fitted, fitted.sentences()


def _sides(found: Any) -> tuple[list[str], list[str]]:
    """Return the conditions that were fitted, and those held out."""
    pairs = list(zip(found.names, found.held_out, strict=True))
    return [name for name, held in pairs if not held], [name for name, held in pairs if held]


def _band(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low, high = 0.0, 0.0
    if not 0 < low < high < float("inf"):
        stop(WRONG_USE, f"--band is {text!r}; give two frequencies in Hz, such as 0.6,8.")
    return low, high


def _save_mat(path: Path, content: dict[str, Any]) -> None:
    import scipy.io

    with replacing(path) as temporary:
        scipy.io.savemat(temporary, content, appendmat=False)


def _shown(figures: dict[str, Any], captions: dict[str, str]) -> list[Any]:
    from estimators.reporting.html import Shown

    return [Shown(figure, captions[name]) for name, figure in figures.items()]
