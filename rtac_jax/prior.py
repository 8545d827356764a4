"""Prior knowledge of a constant: its value, and how sure that is."""

import equinox as eqx

from rtac_jax.parameters import Scalar, as_value


class Prior(eqx.Module):
    """The knowledge of a constant from a measurement of its own, as of a mass that was weighed: Gaussian.

    Attributes:
        mean: the value that was measured, SI units.
        std: its standard deviation.
    """

    mean: Scalar = eqx.field(converter=as_value)
    std: Scalar = eqx.field(converter=as_value)
