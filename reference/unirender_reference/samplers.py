"""Random numbers for our own kernels."""

from typing import Any

from unirender_reference.backend import mitsuba


def stratified_sampler(samples: int, lanes: int, seed: int) -> Any:
    """A Mitsuba sampler for `lanes` lanes, each `samples` in a row well spread; a number that makes a grid (4, 9, ...).

    Equal seeds draw equal samples.
    """
    mi = mitsuba()
    import drjit as dr  # after Mitsuba's backend is chosen

    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)
    sampler.seed(dr.opaque(mi.UInt32, seed), lanes)  # a literal would compile a kernel for every seed
    return sampler
