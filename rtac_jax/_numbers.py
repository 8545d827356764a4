"""Types of what the equations compute with: numbers of Python, of NumPy and of JAX, which may be traced."""

import numpy as np
from jaxtyping import Array

Number = Array | np.ndarray | np.floating | np.integer | float | int
"""One number, or an array of them with one for each trajectory."""
State = tuple[Array, ...]
"""The state of a rig, one array for each: the rigid body's four, then those of the effects; all of one shape."""
