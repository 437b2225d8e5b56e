"""Averages over blocks of time."""

import numpy as np


def block_means(values: np.ndarray, length: int) -> np.ndarray:
    """Averages over blocks of this many samples, (N, ...) -> (N // length, ...); what is left at
    the end is dropped."""
    blocks = len(values) // length
    by_block = values[: blocks * length].reshape(blocks, length, *values.shape[1:])
    # Faster than `mean`, which takes the few samples of a block one by one.
    return np.einsum("bl...->b...", by_block.astype(float, copy=False)) / length
