"""Arrays whose axes and places have names; xarray's where it is installed."""

import dataclasses
import importlib.util
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike


@dataclasses.dataclass(frozen=True, eq=False)
class Labelled:
    """An array with named axes.

    Attributes:
        values: the numbers.
        axes: a name for each axis.
        coordinates: what stands along each axis.
    """

    values: np.ndarray
    axes: tuple[str, ...]
    coordinates: Mapping[str, tuple[Any, ...]]

    def sel(self, **places: object) -> "Labelled":
        """Return the part at these places, such as `sel(parameter="spring_stiffness")`.

        Raises:
            KeyError: there is no such axis or place.
        """
        values, axes = self.values, list(self.axes)
        for axis, place in places.items():
            if axis not in axes:
                raise KeyError(f"there is no axis {axis!r}; there are {', '.join(axes)}.")
            known = self.coordinates[axis]
            if place not in known:
                raise KeyError(f"{axis}: there is no {place!r}; there are {', '.join(map(str, known))}.")
            values = np.asarray(np.take(values, known.index(place), axis=axes.index(axis)))
            axes.remove(axis)
        return Labelled(values, tuple(axes), {axis: self.coordinates[axis] for axis in axes})

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __float__(self) -> float:
        return float(self.values)


def dataset(variables: Mapping[str, Labelled]) -> Any:
    """Return an `xarray.Dataset` of these variables where xarray is installed, else the mapping itself."""
    if importlib.util.find_spec("xarray") is None:
        return dict(variables)
    import xarray  # type: ignore[import-not-found] - not among the dependencies

    coordinates = {axis: list(places) for one in variables.values() for axis, places in one.coordinates.items()}
    return xarray.Dataset({name: (one.axes, one.values) for name, one in variables.items()}, coords=coordinates)
