"""Names of array types: what an element is. Shapes are said where the arrays are."""

from typing import Any

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]
Long = npt.NDArray[np.int64]
Bits = npt.NDArray[np.uint32]
Byte = npt.NDArray[np.uint8]
Short = npt.NDArray[np.int16]
Array = npt.NDArray[Any]
