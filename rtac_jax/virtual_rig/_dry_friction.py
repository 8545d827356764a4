"""How much dry friction each trajectory of a batch has: by level, speed, way and load."""

import numpy as np

from ._effects import Act, Batch

DRY = (("cart_coulomb", "cart_stribeck"), ("arm_coulomb", "arm_stribeck", "arm_load_friction"))
"""What makes cart and arm rub, by what `friction_bound` says; without any of it a body is not looked at."""


def friction_bound(batch: Batch) -> Act | None:
    """Fill `batch.limit` with d and tau_c; return what must renew it in each step, if anything."""
    coulomb = batch.step * np.stack([batch.column("cart_coulomb"), batch.column("arm_coulomb")])
    batch.limit[:] = coulomb
    sloped = batch.rows("friction_slope") is not None
    stribeck = batch.rows("cart_stribeck") is not None or batch.rows("arm_stribeck") is not None
    loaded = batch.rows("arm_load_friction") is not None
    if not (sloped or stribeck or loaded):
        return None
    extra = batch.step * np.stack([batch.column("cart_stribeck"), batch.column("arm_stribeck")])
    scale = np.stack([batch.column("cart_stribeck_velocity"), batch.column("arm_stribeck_velocity")])
    slope = batch.column("friction_slope") / batch.column("friction_reference")
    load = batch.column("arm_load_friction")

    def act() -> None:
        batch.limit[:] = coulomb
        if sloped:
            batch.limit[0] *= np.maximum(1 + slope * batch.position[0], 0.0)
        if stribeck:
            batch.limit[:] += extra * np.exp(-np.square(batch.predicted / scale))
        if loaded:
            batch.limit[1] += load * np.abs(batch.motor)

    return act
