"""`rtac envelope`: one linear model and an uncertainty weight for many operating conditions."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.captions import shown
from estimators.cli.conditions import Band, WeightOrder, band_of, enveloped, sides
from estimators.cli.job import Job, job
from estimators.cli.models import model_or_fit
from estimators.cli.options import Effects, File, Json, Model, Out, Save, Validation
from estimators.cli.report_page import write_json, write_report

if TYPE_CHECKING:
    from estimators.uncertainty.condition_selection import UsableConditions
    from estimators.uncertainty.envelope import Envelope


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
    model: Model = None,
    effects: Effects = None,
    save: Save = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Fit one linear model and an uncertainty weight that cover all operating conditions."""
    between = band_of(band)
    with job(file, validation, out, json, save) as work:
        from estimators.reporting import envelope as texts

        modes = (order + 1) // 2 if method is Method.PREDICTION_ERROR else None
        used, (found,) = enveloped(work, between, [order], weight_order, kind.value, minimise.value, modes=modes)
        conditions, sources = texts.conditions_table(found, used.responses), texts.sources_table(found)
        models, said = texts.models_table(found), texts.remarks(found, used)
        linear = [] if used.models is None else texts.models_said(used.models)
        check, fitted, beside = _closed_form(work, found, used) if model is None else _of_file(found, model, effects)
        work.save(found, save)
        work.say(found, *beside, *said[1:], *linear, conditions, sources)  # the envelope states its coverage itself
        write_json(work, texts.envelope_dict(found, used, seconds=work.seconds, closed_form=check, fitted=fitted))
        if work.folder is None:
            return
        from estimators.plots import plot_envelope, plot_responses
        from estimators.plots.envelope import finding
        from estimators.reporting.summary import of_envelope

        found.save_mat(work.folder / "envelope.mat")
        figures = {"envelope": plot_envelope(found, check), "responses": plot_responses(used.responses)}
        captions = {
            "envelope": "Top: every condition and the nominal model. Below: how far each condition lies from it and the "
            "weight above them; |W| < 1 (0 dB) is where a controller may act. Bottom: what the distance comes from.",
            "responses": "Frequency responses from current times cos(theta) to cart position, with the least certain one's "
            "95 % band.",
        }
        sections = [
            ("Envelope", [f"{finding(found)}.", *beside, *said]),
            ("Figures", shown(figures, **captions)),
            ("Nominal model and weight", [models]),
            ("Where the model errors come from", [sources]),
            ("Conditions", [conditions]),
        ]
        if used.models is not None:
            from estimators.plots import plot_prediction_error

            figures["linear_models"] = plot_prediction_error(used.models)
            pictured = shown(figures, linear_models="The models and their residuals.")
            sections.insert(2, ("Linear models of the conditions", [*linear, *pictured]))
        bullets = of_envelope(found, [] if fitted is None or fitted.agrees else beside, file=work.file)
        write_report(work, f"Envelope of {work.file}", figures, sections, split=sides(found), summary=bullets)


def _of_file(found: "Envelope", path: Path, effects: Path | None) -> tuple[None, Any, list[str]]:
    """Return the fitted model of a file beside an envelope, and what is to be said of both; in place of `_closed_form`."""
    from estimators.uncertainty.fitted_model import fitted_in_envelope
    from rtac_jax import RTAC

    held = model_or_fit(path, effects)
    try:
        fitted = fitted_in_envelope(held if isinstance(held, RTAC) else held.model, found)
    except (ValueError, ArithmeticError) as error:
        return None, None, [f"The model of {path.name} cannot be held against the envelope: {error}"]
    return None, fitted, fitted.sentences()


def _closed_form(work: Job, found: "Envelope", used: "UsableConditions") -> tuple[Any, Any, list[str]]:
    """Return the closed form beside an envelope, where the nominal model meets it, and what is to be said of both.

    The closed form takes milliseconds and is consistent in its weak form; `control` has the fit by output error.

    Returns:
        None for both where there is no closed form, and why there is none.
    """
    from estimators.uncertainty.closed_form_check import closed_form_check
    from estimators.uncertainty.fitted_model import fitted_in_envelope

    try:
        check = closed_form_check(work.recording, found, used.responses)
        fitted = fitted_in_envelope(check.model, found)
    except (ValueError, ArithmeticError) as error:
        return None, None, [f"The closed form cannot be held against the envelope: {error}"]
    return check, fitted, [check.words, *([] if fitted.agrees else fitted.sentences())]
