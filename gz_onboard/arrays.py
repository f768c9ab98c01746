"""Types of numpy arrays, for signatures; their docstrings give shape and unit."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
