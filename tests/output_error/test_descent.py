"""The descent from one start: by what it knows another start again."""

import types

import numpy as np
import pytest

from estimators.output_error.descent import Descent, DescentEnd


@pytest.mark.parametrize(("apart", "same"), [(0.25, True), (0.35, False)])
def test_a_start_is_known_by_what_the_end_of_another_left(apart: float, same: bool) -> None:
    """Or by the noise, where that is more; a channel that nobody measured tells nothing."""
    end = DescentEnd.__new__(DescentEnd)
    object.__setattr__(end, "deviation", np.array([1e-4, 1.0, 2e-2]))
    begun, present = np.zeros((5, 3, 2)), np.ones((5, 3, 2))
    present[:, 1] = 0.0
    run = Descent.__new__(Descent)
    run.data, run.followed = types.SimpleNamespace(present=present), [(begun, end)]
    other = begun + apart * np.array([1e-4, 0.0, 2e-2])[:, None]
    assert (run._followed(other, np.array([1e-5, 1.0, 1e-3])) is end) == same
    assert run._followed(other, np.array([2e-4, 1.0, 4e-2])) is end
