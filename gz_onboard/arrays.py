"""Types of numpy arrays for signatures, whose docstrings give shape and unit."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
