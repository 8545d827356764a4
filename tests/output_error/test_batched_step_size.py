"""Step sizes of many models at once are those of each alone."""

import numpy as np

from estimators.output_error.batched_step_size import stable_substeps
from rtac_jax import RTAC, Excitation, virtual_rig
from rtac_jax.effects import FlexibleMode
from rtac_jax.simulation import substeps_for


def test_they_are_those_of_each_model_alone():
    """Of two structures, soft and stiff, at two sample times, more models than are computed at once."""
    paper = RTAC.paper()
    models = [paper.with_values({"spring_stiffness": k}) for k in np.geomspace(50.0, 5e6, 35)]
    models += [paper + FlexibleMode(0.1, rate, 0.05) for rate in (60.0, 6000.0)]
    plans = virtual_rig.standard_plans(seed=1, sample_time=0.01, duration=1.0, free=1, forced=0, rest=0)
    short = virtual_rig.standard_plans(seed=1, sample_time=0.002, duration=1.0, free=1, forced=0, rest=0)
    excitations = [Excitation.in_numpy([(plans, short)[n % 2][0].to_simulate()]) for n in range(len(models))]
    found = stable_substeps(models, excitations, stability=0.5)
    assert found == [substeps_for(m, e, stability=0.5) for m, e in zip(models, excitations, strict=True)]
    assert min(found) == 1
    assert max(found) > 16
