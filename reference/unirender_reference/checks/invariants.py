"""What holds in every scene: linearity in the light, and the same radiance from another variant of Mitsuba."""

import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference import backend, materials
from unirender_reference.checks.outcome import BATCHES, Check, against_estimate, bounded
from unirender_reference.passes import Counters, Estimate, derive_seed, mean_estimate, render_passes
from unirender_reference.render import IMAGE_DEPTH, Renderer
from unirender_reference.scene import load_scene
from unirender_reference.shapes import MeshObject, make_object

SIZE = 24
SPP = 256
CONCAVE = 1  # seed of a procedural object with cavities
SCALE = 4.0  # a power of two: rounding scales along
EXPOSURE_RTOL = 1e-6
SCALAR_SPP = 576
MATERIAL = (0.4, 0.6)  # roughness, metallic
TIMEOUT = 300.0


def exposure(seed: int) -> Check:
    """Equal samples under a light `SCALE` times as bright: the same picture times `SCALE`, up to rounding."""
    renderer, light = Renderer(concave(), resolution=SIZE), random_light(seed)
    dark, bright = (
        renderer.image((light * np.float32(scale)).astype(np.float32), *MATERIAL, 64, seed, batches=4).mean[..., :3]
        for scale in (1.0, SCALE)
    )
    error = np.abs(bright - SCALE * dark) / np.maximum(SCALE * dark, 1e-3)
    note = f"image({SCALE:g} L) = {SCALE:g} image(L), equal seeds"
    return bounded("exposure", "max relative error", float(error.max()), EXPOSURE_RTOL, note)


def superposition(seed: int) -> Check:
    """Image under A + image under B = image under A + B, with shadows and interreflection."""
    renderer = Renderer(concave(), resolution=SIZE)
    a, b = random_light(seed), random_light(seed + 1)
    lit = [
        renderer.image(light, *MATERIAL, SPP, derive_seed(seed, "superposition", index), batches=BATCHES)
        for index, light in enumerate((a, b, a + b))
    ]
    means, variances = [e.mean[..., :3] for e in lit], [e.variance[..., :3] for e in lit if e.variance is not None]
    mean, variance = means[0] + means[1], variances[0] + variances[1]
    mask, note = lit[0].mean[..., 3] > 0.5, "image(A) + image(B) = image(A + B)"
    return against_estimate("superposition", mean, variance, means[2], variances[2], mask, note)


def scalar_variant(seed: int) -> Check:
    """The scene of `llvm_ad_rgb`, edited in place, against `scalar_rgb` in another process, loaded at once."""
    light = random_light(seed)
    own = derive_seed(seed, "scalar-variant", 0)
    ours = Renderer(concave(), resolution=SIZE).image(light, *MATERIAL, SCALAR_SPP, own, batches=BATCHES)
    theirs = _in_scalar_process(seed)
    assert ours.variance is not None
    assert theirs.variance is not None
    mask, note = ours.mean[..., 3] > 0.5, f"{backend.mitsuba().variant()} against scalar_rgb"
    a, b = (ours.mean[..., :3], ours.variance[..., :3]), (theirs.mean[..., :3], theirs.variance[..., :3])
    return against_estimate("scalar-variant", a[0], a[1], b[0], b[1], mask, note)


def random_light(seed: int) -> Float[np.ndarray, "16 32 3"]:
    """Coloured noise with two bright texels."""
    rng = np.random.default_rng([seed, 1])
    light = rng.random((16, 32, 3)) * rng.uniform(0.3, 1, 3)
    light[rng.integers(3, 13, 2), rng.integers(32, size=2)] += rng.uniform(3, 8, (2, 3))
    return light.astype(np.float32)


def render_fresh(seed: int) -> Estimate:
    """The same scene, loaded with its material and light, under whatever variant this process runs."""
    bsdf = materials.principled_bsdf(concave().albedo, *MATERIAL)
    loaded = load_scene(concave(), bsdf, random_light(seed), Camera(), SIZE)
    own = derive_seed(seed, "scalar-variant", 1)
    passes = render_passes(loaded, IMAGE_DEPTH, SCALAR_SPP, own, BATCHES, Counters())
    return mean_estimate(*passes, BATCHES)


@functools.lru_cache(maxsize=2)
def _in_scalar_process(seed: int) -> Estimate:
    """The estimate of the same scene by `scalar_rgb`, which needs a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "scalar.npz"
        run = subprocess.run(
            [sys.executable, "-m", "unirender_reference.checks.invariants", str(seed), str(out)],
            env={**os.environ, backend.VARIANT_VARIABLE: "scalar_rgb"},
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        if run.returncode != 0:
            reason = run.stderr.strip().splitlines()[-1:] or ["no message"]
            raise UnirenderError(
                f"scalar_rgb: the process ended with status {run.returncode}: {reason[0]}; "
                "`unirender doctor` says what is installed"
            )
        with np.load(out) as arrays:
            return Estimate(arrays["mean"], arrays["variance"])


@functools.cache
def concave() -> MeshObject:
    """An object that shadows and lights itself: made bright, a tenth of its image and more has met it twice."""
    obj = make_object(CONCAVE, "train")
    return dataclasses.replace(obj, albedo=1 - (1 - obj.albedo) / 4)


if __name__ == "__main__":
    estimate = render_fresh(int(sys.argv[1]))
    assert estimate.variance is not None
    np.savez(sys.argv[2], mean=estimate.mean, variance=estimate.variance)
