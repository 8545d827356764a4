"""Attributes that have a better name now, and stay for one release under the old one."""

import warnings
from typing import Any


def renamed(old: str, new: str) -> Any:
    """Return a property that gives the attribute `new` and says once at each place that `old` is its name no more."""

    def get(self: object) -> Any:
        warnings.warn(f"{type(self).__name__}.{old} is called {new} now.", DeprecationWarning, stacklevel=2)
        return getattr(self, new)

    return property(get, doc=f"Return `{new}`, by the old name.")
