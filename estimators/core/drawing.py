"""Drawing of results, without any result knowing a picture."""

from typing import Any


def draw(result: object, *arguments: object) -> Any:
    """Draw the picture of a result: what its `plot` method returns.

    The pictures and matplotlib are imported here, at the first picture, and nowhere else in what computes.

    Raises:
        TypeError: no picture is registered for results of this type.
    """
    from estimators import plots

    return plots.draw(result, *arguments)
