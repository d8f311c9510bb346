"""Arguments of a wrong type, as users see them: the tests' own checks of annotations would be first to refuse them.

So each case runs in a process without these, and what it prints is looked at.
"""

import re
import subprocess
import sys

import pytest

SCRIPT = """
import numpy as np
import torch
from diffusers.utils import logging
from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

logging.disable_progress_bar()
pipeline = UniRenderPipeline.from_pretrained()
mask = np.zeros((16, 24, 1), np.float32)
mask[4:-4, 4:-4] = 1
image = np.full((16, 24, 3), 0.5, np.float32)
decomposition = pipeline.decompose(image, mask)
light = np.ones((16, 32, 3), np.float32)
for case in %r:
    try:
        print(case, "->", "fine" if eval(case) is not None else "None")
    except Exception as error:
        print(case, "->", f"{type(error).__name__}: {error}")
"""
CASES = {
    "pipeline.decompose(image, mask, mode='sample', num_samples=2.5)": "num_samples: got 2.5, expected a whole number",
    "pipeline.decompose(image, mask, mode='sample', num_inference_steps='3')": "num_inference_steps: got '3', expected",
    "pipeline.decompose(image, mask, generator=3)": "generator: got 3, expected a torch.Generator",
    "pipeline.decompose(image, mask, size=64.0)": "size: got 64.0, expected a multiple of",
    "pipeline.decompose(image, mask, camera=36)": "camera: got 36, expected a unirender.camera.Camera",
    "pipeline.decompose(image, mask, material='')": "material: got '', expected 'scalar' or 'map'",
    "pipeline.decompose(np.full((16, 24, 3), 'a'), mask)": "image: got ndarray",
    "pipeline.edit(image, mask, metallic=np.zeros((16, 24, 3)))": "metallic: got shape (16, 24, 3), expected",
    "pipeline.edit(image, mask, roughness=np.zeros((16, 1)))": "roughness: got shape (16, 1), expected one number",
    "pipeline.edit(image, mask, roughness=[0.2, 0.3])": "roughness: got shape (2,), expected one number",
    "pipeline.edit(image, mask, metallic=np.zeros(0))": "metallic: got shape (0,), expected one number",
    "pipeline.edit(image, mask, metallic='gold')": "metallic: got str 'gold', expected numbers",
    "pipeline.render(decomposition)": "render: got Decomposition, expected unirender.intrinsics.Intrinsics",
    "pipeline.render(decomposition.intrinsics, derived=('shadow',))": "derived: got shadow, expected names out of",
    "pipeline.relight(image, 'sky.exr', mask)": "environment: got str 'sky.exr', expected numbers",
    "Camera('36')": "camera: got Camera(fov_deg='36'",
    "Camera(36, None)": "camera: got Camera(fov_deg=36, principal=None)",
    "Camera(36, 'ab')": "camera: got Camera(fov_deg=36, principal='ab')",
}
FINE = (
    "hash(Camera(36, [0.5, 0.4])) == hash(Camera(36, (0.5, 0.4)))",
    "pipeline.edit(image, mask, metallic=np.full((16, 24), 0.2), decomposition=decomposition)",
    "pipeline.edit(image, mask, metallic=np.array([0.2]), decomposition=decomposition)",
    "pipeline.decompose_batch(np.stack([image, image]), np.stack([mask, mask]))",
    "pipeline.decompose_batch(iter([image, image]), iter([mask, mask]))",
)


@pytest.fixture(scope="module")
def printed() -> dict[str, str]:
    script = SCRIPT % ([*CASES, *FINE],)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return dict(re.findall(r"^(.*) -> (.*)$", done.stdout, re.MULTILINE))


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_type_is_refused_in_words(case: str, printed: dict[str, str]) -> None:
    assert printed[case].startswith(f"UnirenderError: {CASES[case]}")


@pytest.mark.parametrize("case", FINE)
def test_what_can_be_understood_is_taken(case: str, printed: dict[str, str]) -> None:
    assert printed[case].startswith("fine")
