"""numpy's arrays as Dr.Jit's: those of other sizes and at other addresses run the kernels compiled for the first.

Dr.Jit maps numpy's memory. What does not begin at a multiple of `ALIGNMENT` is read by other instructions, in a kernel
of its own. An array of vectors is taken apart with its length as a constant of the kernel.
"""

from typing import Any

import numpy as np
from jaxtyping import Shaped

from unirender_reference.backend import mitsuba

ALIGNMENT = 64  # bytes: a vector of AVX-512


def aligned(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """A copy whose memory begins at a multiple of `ALIGNMENT`."""
    memory = np.empty(array.nbytes + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    copy = memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def components(rows: Shaped[np.ndarray, "n k"]) -> list[Any]:
    """The k components, each a `mi.Float` of n values, that vectors, points or colours are made of."""
    mi = mitsuba()
    return [mi.Float(aligned(column.astype(np.float32))) for column in rows.T]
