"""The standard deviations of a fit that holds parameters at estimates of a diagnosis: they count how well these are known."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from estimators.core.fisher_information import information, information_of_covariance, sizes_of
from estimators.core.fit import Fit
from estimators.core.jacobian_factor import factor
from estimators.core.linearisation import at_fit
from rtac_jax.measurement import Recording


def counting_held(fit: Fit, recording: Recording, deviations: Mapping[str, float]) -> Fit:
    """Return a fit whose standard deviations count those of what it holds, which were estimated too.

    Were a held torque exact, it would fix the scale of the inertia and of all other torques as no measurement can. To first order
    the estimates follow what is held by S = -F^-1 G, with F the information on them and G that on them and on what is held; the
    covariance grows by S times that of what is held times S'. What is held counts as uncorrelated with the residual of this fit.

    Args:
        fit: of output error.
        recording: that was fitted.
        deviations: standard deviations of the parameters that are held, by name.

    Source: Murphy and Topel, J. Business and Economic Statistics 3 (1985), estimation in two steps.
    """
    held = {name: std for name, std in deviations.items() if name in fit.model.fixed and std > 0 and np.isfinite(std)}
    names = fit.information.names
    if not held or not names:
        return fit
    released = dataclasses.replace(fit, model=fit.model.release(*held))
    at = at_fit(released, recording)
    known = information(np.asarray(factor(at.unknowns, at.arguments)), at.arguments.space, at.unknowns)
    if known.parts is None:
        return fit
    whole = known.parts.sum(axis=0)
    free = [known.names.index(name) for name in names]
    beside = [known.names.index(name) for name in held]
    follow = fit.information.own_covariance @ whole[np.ix_(free, beside)]
    from_held = (follow * np.square(list(held.values()))) @ follow.T
    size = sizes_of(at.arguments.space, at.unknowns)[free]
    counted = information_of_covariance(fit.information.own_covariance + from_held, names, size)
    return dataclasses.replace(
        fit,
        information=dataclasses.replace(
            counted, parts=fit.information.parts, scores=fit.information.scores, own=fit.information.own_covariance
        ),
        held=held,
    )
