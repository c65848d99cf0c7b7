"""Module that repeats the draws of `numerics::uniform`, so that golden files needn't contain random weights."""

import numpy


def scramble(x):
    x = x + numpy.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> numpy.uint64(30))) * numpy.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> numpy.uint64(27))) * numpy.uint64(0x94D049BB133111EB)
    return x ^ (x >> numpy.uint64(31))


def uniform(seed: int, purpose: int, count: int) -> numpy.ndarray:
    """Returns numbers in [0, 1) with 24 bits, as f64, for the counters 0, 1, ..."""
    with numpy.errstate(over="ignore"):
        start = scramble(numpy.uint64(seed) ^ (numpy.uint64(purpose) * numpy.uint64(0xD1B54A32D192ED03)))
        state = scramble(start ^ numpy.arange(count, dtype=numpy.uint64)) + numpy.uint64(0x9E3779B97F4A7C15)
        return (scramble(state) >> numpy.uint64(40)).astype(numpy.float64) / 2**24
