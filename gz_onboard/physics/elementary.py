"""Elementary functions for effects, of floats and of numpy arrays alike; numpy is imported only where one comes."""

from __future__ import annotations

import math
from typing import Any

NUMBER = float, int  # a union in its place is made anew at each call, which takes longer than the function
STANDSTILL = 0.1  # m/s, or rad/s of a shaft: below it friction fades, so that nothing jumps where the sign changes


def exp(x: Any) -> Any:
    """e to the power of `x`."""
    if isinstance(x, NUMBER):
        return math.exp(x)
    import numpy as np

    return np.exp(x)


def sin(x: Any) -> Any:
    """The sine of `x` [rad]."""
    if isinstance(x, NUMBER):
        return math.sin(x)
    import numpy as np

    return np.sin(x)


def cos(x: Any) -> Any:
    """The cosine of `x` [rad]."""
    if isinstance(x, NUMBER):
        return math.cos(x)
    import numpy as np

    return np.cos(x)


def sqrt(x: Any) -> Any:
    """The square root of `x`."""
    if isinstance(x, NUMBER):
        return math.sqrt(x)
    import numpy as np

    return np.sqrt(x)


def asinh(x: Any) -> Any:
    """The inverse hyperbolic sine of `x`."""
    if isinstance(x, NUMBER):
        return math.asinh(x)
    import numpy as np

    return np.arcsinh(x)


def direction(speed: Any) -> Any:
    """The sign of `speed` [m/s or rad/s], smooth around standstill: what friction acts with."""
    return speed / (speed * speed + STANDSTILL * STANDSTILL) ** 0.5
