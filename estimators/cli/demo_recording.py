"""The recording of `rtac demo`: the paper's rig with a second structural mode that the paper's model leaves out."""

from rtac_jax.measurement import Recording
from rtac_jax.virtual_rig import Rig, record, standard_plans

HIDDEN = "flexible_mode"
"""The effect that the loop should name."""

SEED = 20


def demo_rig() -> Rig:
    """Return the rig of Table 1 of the paper, with the peak at 37.4 rad/s of its section 5.3."""
    return Rig(
        flexible_mass=0.12,
        flexible_frequency=37.4,
        flexible_damping=0.03,
        position_noise=2e-6,
        quantisation_bits=16,
    )


def demo_recording(*, duration: float = 4.0, seed: int = SEED) -> Recording:
    """Record two free decays, four forced runs and one rest at 200 Hz."""
    plans = standard_plans(seed=seed, sample_time=0.005, duration=duration, free=2, forced=4, rest=1)
    return record(demo_rig(), plans, seed=seed)
