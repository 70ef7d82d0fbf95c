"""Names for arrays in signatures; their docstring says the shape."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = np.ndarray[Any, np.dtype[Any]]  # of a dtype that follows the input
Integers = NDArray[np.int64]


def to_tensor(values: Any) -> Any:
    """Values as a torch tensor; tensors are returned unchanged.

    Args:
        values: (…, y, x) tensor, or NumPy array of any strides.
    """
    import torch

    if isinstance(values, torch.Tensor):
        return values
    return torch.as_tensor(np.ascontiguousarray(values))
