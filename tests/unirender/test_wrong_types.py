"""Arguments of a wrong type, as users see them: the tests' own checks of annotations would be first to refuse them.

So each case runs in a process without these, and what it prints is looked at.
"""

import re
import subprocess
import sys

import pytest

SCRIPT = """
from dataclasses import replace
import numpy as np
import torch
from diffusers.utils import logging
from unirender.camera import Camera
from unirender.color import display_slope, image_srgb, srgb_decode, unpremultiply
from unirender.composite import composite_image
from unirender.light.exposure import exposure_factor
from unirender.exr import read_exr, write_exr
from unirender.files import map_picture, read_result, write_png, write_result
from unirender.intrinsics import Intrinsics
from unirender.pictures import Picture, read_picture
from PIL import Image
from unirender.light.environment import rotate_environment, sample_environment
from unirender.light.for_mitsuba import has_bright_pole
from unirender.light.resampling import resample_environment
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.scene_export import export_scene
from unirender.light.surface_light import diffuse_light, specular_light
from unirender_evaluation import BenchConfig, Variant, read_results, score
from unirender_evaluation.scoring import score_maps
from unirender_evaluation.suites.suite import load_suite
from unirender_reference.denoise import denoise
from unirender_reference.effects import render_effects
from unirender_reference.lights import Light, light_pool, load_light, make_light
from unirender_reference.lights.light import area_resampled
from unirender_reference.meshes import load_mesh
from unirender_reference.multiview import orbit, pose_towards
from unirender_reference.optimize.files.folder import read_views
from unirender_reference.optimize.views import View
from unirender_reference.passes import derive_seed
from unirender_reference.render import Renderer, SceneSpec, render_sample
from unirender_reference.shade import shade, shade_gradients
from unirender_reference.shapes import make_object

logging.disable_progress_bar()
pipeline = UniRenderPipeline.from_pretrained()
mask = np.zeros((16, 24, 1), np.float32)
mask[4:-4, 4:-4] = 1
image = np.full((16, 24, 3), 0.5, np.float32)
decomposition = pipeline.decompose(image, mask)
light = np.ones((16, 32, 3), np.float32)
sky = Light('a', light)
renderer = Renderer(make_object(1, 'train'), resolution=8)
maps, bytes_8 = decomposition.intrinsics, (200 * light).astype(np.uint8)
photograph = Image.fromarray(bytes_8)
for case in %r:
    try:
        print(case, "->", "fine" if eval(case) is not None else "None")
    except Exception as error:
        print(case, "->", f"{type(error).__name__}: {error}")
"""
CASES = {
    "pipeline.decompose(image, mask, mode='sample', num_samples=2.5)": "num_samples: got 2.5, expected a whole number",
    "pipeline.decompose(image, mask, mode='sample', num_inference_steps='3')": "num_inference_steps: got '3', expected",
    "Camera.from_focal(500, 500, 640, 480)": "center: got 480, expected (x, y) in pixels; sides are height, width",
    "pipeline.decompose(image, mask, generator=3)": "generator: got 3, expected a torch.Generator",
    "pipeline.decompose(image, mask, generator=[3])": "generator: got 3, expected a torch.Generator",
    "pipeline.decompose(image, mask, mode='sample', num_samples=True)": "num_samples: got True, expected a whole",
    "pipeline.decompose(image, mask, num_inference_steps=True)": "num_inference_steps: got True, expected 1 to",
    "pipeline.decompose(image, mask, closed='no')": "closed: got 'no', expected True or False",
    "pipeline.decompose(image, mask, flat='no')": "flat: got 'no', expected True or False",
    "pipeline.decompose(image, mask, tile=1)": "tile: got 1, expected True or False",
    "pipeline.edit(image, mask, metallic=1.0, anchored='no')": "anchored: got 'no', expected True or False",
    "pipeline.relight(image, light, mask, shadows=None)": "shadows: got None, expected True or False",
    "pipeline.render(maps, shadows='no')": "shadows: got 'no', expected True or False",
    "pipeline.decompose(image, mask, size=64.0)": "size: got 64.0, expected a multiple of",
    "pipeline.decompose(image, mask, camera=36)": "camera: got 36, expected a unirender.camera.Camera",
    "pipeline.decompose(image, mask, material='')": "material: got '', expected 'scalar' or 'map'",
    "pipeline.decompose(np.full((16, 24, 3), 'a'), mask)": "image: got ndarray",
    "pipeline.edit(image, mask, metallic=np.zeros((16, 24, 3)))": "metallic: got shape (16, 24, 3), expected",
    "pipeline.edit(image, mask, metallic=np.zeros(0))": "metallic: got shape (0,), expected one number",
    "pipeline.edit(image, mask, roughness=True)": "roughness: got True, expected one number in [0, 1], or a map",
    "pipeline.edit(image, mask, metallic=np.bool_(1))": "metallic: got True, expected one number in [0, 1], or a map",
    "pipeline.decompose(image.astype(np.uint16), mask)": "image: got uint16 values, expected floats in [0, 1]; divide",
    "pipeline.overflow(decomposition)": "render: got Decomposition, expected unirender.intrinsics.Intrinsics; it",
    "shade(maps, sky)": "environment: got Light, expected numbers; it has some as its `environment`",
    "Intrinsics(albedo=np.full((2, 2, 3), '0.5'))": "albedo: got ndarray of <U3 values, expected numbers",
    "pipeline.decompose(Picture(image, mask, 'a.png'))": "image: got a Picture, expected its image_srgb, and its mask",
    "write_result(3, maps, {})": "folder: got int 3, expected a path",
    "export_scene('not_made', maps, overwrite='no')": "overwrite: got 'no', expected True or False",
    "light_pool('docs/_static', 'train', turn='no')": "turn: got 'no', expected True or False",
    "display_slope(image, 'sRGB')": "space: got 'sRGB', expected 'srgb' or 'linear'",
    "write_png('not_made.png', np.nan * image)": "picture: got NaN or infinite values, expected display values",
    "load_light('docs/_static/example.png', photograph='no')": "photograph: got 'no', expected True or False",
    "load_light('docs/_static/example.png', normalise=None)": "normalise: got None, expected True or False",
    "score(maps, maps, Variant(space='sRGB'))": "variant: got space 'sRGB', expected one of srgb, linear",
    "score(decomposition, decomposition)": "score: got Decomposition, expected unirender.intrinsics.Intrinsics; it has",
    "pipeline.edit(image, mask, metallic='0.2')": "metallic: got str '0.2', expected numbers",
    "pipeline.render(decomposition)": "render: got Decomposition, expected unirender.intrinsics.Intrinsics; it has one",
    "export_scene(maps, 'scene')": "folder: got Intrinsics Intrinsics(albedo",
    "export_scene('not_made', None)": "export: got NoneType, expected unirender.intrinsics.Intrinsics; are arguments",
    "write_result('not_made', image, {})": "result: got ndarray, expected unirender.intrinsics.Intrinsics",
    "read_result(None)": "path: got NoneType None, expected a path as text or pathlib.Path",
    "read_picture(b'a.png')": "path: got bytes b'a.png', expected a path",
    "read_exr('a\\0b')": "path: got str 'a\\x00b', expected a path",
    "write_exr({}, 'a.exr')": "path: got dict {}, expected a path",
    "write_exr('not_made.exr', image)": "EXR channels: got ndarray, expected collections.abc.Mapping; are arguments",
    "write_png('not_made.png', bytes_8)": "picture: got uint8 values, expected floats whose white is 1; divide by 255",
    "map_picture('light', image)": "map: got 'light', expected one of albedo,",
    "srgb_decode(bytes_8)": "display values: got uint8 values, expected floats whose white is 1; divide by 255",
    "image_srgb(None)": "image: got NoneType None, expected numbers",
    "unpremultiply(image, (255 * mask).astype(np.uint8))": "mask: got uint8 values, expected floats whose white is 1;",
    "unpremultiply(image, mask[..., 0])": "mask: got shape (16, 24) for an image of (16, 24, 3), expected",
    "composite_image(image)": "composite: got ndarray, expected unirender.intrinsics.Intrinsics",
    "load_light(None)": "light: got NoneType None, expected a path",
    "load_mesh(3)": "mesh: got int 3, expected a path",
    "load_suite(None)": "suite: got NoneType None, expected a path",
    "read_views(maps)": "views: got Intrinsics Intrinsics(albedo",
    "read_results(3)": "path: got int 3, expected a path",
    "render_sample(light, 4)": "scene: got ndarray, expected unirender_reference.scene_spec.SceneSpec",
    "Renderer(light)": "renderer: got ndarray, expected unirender_reference.shapes.mesh_object.MeshObject",
    "score_maps(decomposition, maps)": "prediction: got Decomposition, expected unirender.intrinsics.Intrinsics; it",
    "score(maps, maps, 3)": "score: protocol: got int, expected unirender_evaluation.metrics.Variant",
    "score(image, image, mask=mask, lpips=3)": "score: got lpips=3, expected a list of names: lpips=['vgg']",
    "maps.require('light')": "intrinsics: there is no map 'light', expected some of albedo,",
    "Camera.parse(None)": "camera: got None, expected a text like",
    "pipeline.relight(image, 'sky.exr', mask)": "environment: got the path 'sky.exr', expected radiance [eh ew 3]",
    "pipeline.relight(image, photograph, mask)": "environment: got Image of uint8 values, expected linear radiance as",
    "Intrinsics(environment=bytes_8.tolist())": "environment: got list of int64 values, expected linear radiance as",
    "Intrinsics(diffuse=bytes_8)": "diffuse: got ndarray of uint8 values, expected linear radiance as floats; read a",
    "diffuse_light(maps.normal, bytes_8)": "environment: got ndarray of uint8 values, expected linear radiance as",
    "diffuse_light(maps.normal, np.ones((16, 32, 4)))": "environment: got shape (16, 32, 4), expected a lat-long map",
    "specular_light(maps.normal, 2.0, light)": "roughness: got values in [2, 2], expected [0, 1]",
    "specular_light(maps.normal, maps.roughness[..., 0], light)": "roughness: got shape (16, 24), expected one number",
    "specular_light(maps.normal[None], 0.5, light)": "normal: got shape (1, 16, 24, 3), expected finite normals of one",
    "specular_light(np.nan * maps.normal, 0.5, light)": "normal: got shape (16, 24, 3), expected finite normals of one",
    "specular_light(maps.normal, 0.5, light, None, mask[:4, :, 0] > 0)": "where: got shape (4, 24), expected (16, 24)",
    "rotate_environment(light, 2 * np.eye(3))": "rotation: got [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]],",
    "rotate_environment(light, np.eye(4))": "rotation: got [[1.0, 0.0, 0.0, 0.0], ",
    "sample_environment(light, 2 * maps.normal)": "directions: got lengths from 0 to 2, expected unit vectors",
    "rotate_environment(bytes_8, np.eye(3))": "environment: got ndarray of uint8 values, expected linear radiance as",
    "renderer.image(None, 0.5, 0.5, 16)": "environment: got shape (), expected a lat-long map",
    "renderer.diffuse(bytes_8, 16)": "environment: got ndarray of uint8 values, expected linear radiance as floats",
    "renderer.specular(light, '0.5', 16)": "roughness: got '0.5', expected a value in [0, 1]",
    "renderer.image(light, 0.5, 0.5, 64.0)": "spp: got 64.0, expected a whole number of samples",
    "renderer.image(light, 0.5, 0.5, 16, pose=np.eye(4)[:3])": "pose: the pose is no rotation and position; expected",
    "renderer.image(light, 0.5, 0.5, 16, pose=np.insert(np.eye(4)[:3], 3, [0, 0, 4, 1], 0))": "pose: the pose is no",
    "renderer.image(light, 0.5, 0.5, 16, pose='front')": "pose: got str 'front', expected numbers",
    "renderer.image(light, 0.5, 0.5, 16, seed=1.0)": "seed: got 1.0, expected a whole number",
    "shade(maps, light, seed=None)": "seed: got None, expected a whole number",
    "Renderer(renderer.obj, resolution=8.5)": "resolution: got 8.5, expected a whole number of pixels",
    "make_light('a', 'train')": "make_light: got seed 'a', split 'train'; expected seed >= 0",
    "Light('a', light.tolist())": "light: got name 'a' and an environment of type list, expected a text and a",
    "replace(renderer.obj, albedo=0.5)": "train-000001: got albedo 0.5, expected a numpy array",
    "replace(renderer.obj, normals=None)": "train-000001: got normals None, expected a numpy array",
    "renderer.obj.turned(np.eye(4))": "train-000001: got [[1.0, 0.0, 0.0, 0.0], ",
    "View(image, mask, 36, np.eye(4))": "view: got camera 36, expected a unirender.camera.Camera",
    "View([1], mask, Camera(), np.eye(4))": "view: got image (1,), mask (16, 24, 1); expected (h, w, 3) and (h, w, 1)",
    "has_bright_pole(light[..., :2])": "environment: got shape (16, 32, 2), expected a lat-long map",
    "resample_environment(light, 16)": "environment: got size 16, expected a lat-long map of at least 2 x 2 texels",
    "shade(maps, photograph)": "environment: got Image of uint8 values, expected linear radiance as floats; read a",
    "shade_gradients(maps, image, bytes_8)": "environment: got ndarray of uint8 values, expected linear radiance as",
    "shade(maps, light[:2])": "environment: got shape (2, 32, 3), expected a lat-long map [height, width, 3]",
    "pipeline.relight(image, light[:2], mask)": "environment: got shape (2, 32, 3), expected a lat-long map [height,",
    "Intrinsics(environment=light[:1])": "environment: got shape (1, 32, 3), expected a lat-long map of at least 2",
    "Intrinsics(albedo='x')": "albedo: got str 'x', expected numbers",
    "Intrinsics(albedo=[[[1, 2, 3]], [[1]]])": "albedo: got list [[[1, 2, 3]], [[1]]], expected numbers",
    "Intrinsics(camera='x')": "camera: got 'x', expected a unirender.camera.Camera",
    "shade(maps, light, spp=2.5)": "spp: got 2.5, expected a whole number of samples",
    "shade(maps, light, geometry='x')": "geometry: got 'x', expected an object",
    "render_sample(SceneSpec(renderer.obj, make_light(1, 'train'), 0.5, 0.0, resolution=8), '64')": "spp: got '64'",
    "render_effects(renderer, light, 0.5, 0.5, 16, depth=2.5)": "depth: got 2.5, expected a whole number from 2",
    "denoise(image, image[:8], image, mask)": "denoise: got a picture of (16, 24) pixels and guides of {'albedo': (8,",
    "orbit(2.5, Camera())": "orbit: got 2.5 cameras, expected a whole number of at least 1",
    "pose_towards(0, 0, 'front')": "pose: got str, expected unirender.camera.Camera",
    "area_resampled(bytes_8, (8, 16))": "light: got ndarray of uint8 values, expected linear radiance as floats",
    "area_resampled(light[..., 0], (8, 16))": "light: got a picture of shape (16, 32), expected finite radiance of",
    "exposure_factor(image, mask[:4], 0.7)": "exposure: got a mask of (4, 24) pixels, expected (16, 24), d's size",
    "shade(None, light)": "shade: got NoneType, expected unirender.intrinsics.Intrinsics",
    "shade_gradients(maps, [[1.0]], light)": "shade_gradients: got an image gradient of shape (1, 1), expected finite",
    "shade_gradients(maps, 'x', light)": "image gradient: got str 'x', expected numbers",
    "shade_gradients(maps, image, light, wrt='gloss')": "shade_gradients: got wrt=('gloss',), expected some of albedo,",
    "SceneSpec(renderer.obj, make_light(1, 'train'), 'a', 0.0)": "scene: got roughness 'a', expected a",
    "SceneSpec('ball', make_light(1, 'train'), 0.5, 0.0)": "scene: got obj 'ball', expected MeshObject",
    "SceneSpec(renderer.obj, light, 0.5, 0.0)": "scene: got light [16, 32, 3] in [1, 1], expected Light; load_light",
    "BenchConfig(out='results')": "benchmark: got out='results', expected pathlib.Path",
    "BenchConfig(methods='trivial')": "benchmark: got methods='trivial', expected tuple[str, ...]",
    "BenchConfig(method=(Camera,))": "benchmark: got method=(<class 'unirender.camera.Camera'>,), expected tuple[str,",
    "BenchConfig(predictions={'a': 'b'})": "benchmark: got predictions={'a': 'b'}, expected dict[str, pathlib.Path]",
    "BenchConfig(variants=('masked',))": "benchmark: got variants=('masked',), expected tuple[unirender_evaluation.",
    "score(renderer.image(light, 0.5, 0.5, 16), image, mask=mask)": "score: the prediction is Estimate, expected an",
    "score(np.dstack([image, mask]), image, mask=mask)": "score: the prediction is float32 of shape (16, 24, 4), exp",
    "make_object('a', 'train')": "make_object: got seed 'a', split 'train'; expected seed >= 0",
    "UniRenderPipeline.from_pretrained(123)": "checkpoint: got 123, expected the path of a pipeline folder",
    "pipeline.render(maps, derived='shadow')": "derived: got shadow, expected names out of",
    "pipeline.edit(image, mask, metallic=1.0, decomposition=maps)": "decomposition: got Intrinsics, expected the",
    "Camera(200)": "field of view: got 200 degrees, expected a vertical angle between 0 and 180",
    "Camera('36')": "camera: got Camera(fov_deg='36'",
    "Camera(36, None)": "camera: got Camera(fov_deg=36, principal=None)",
    "Camera(36, 'ab')": "camera: got Camera(fov_deg=36, principal='ab')",
}
FINE = (
    "pipeline.render(maps, derived='diffuse')",
    "pipeline.render(maps.replace(environment=0 * light))",
    "shade_gradients(maps, np.zeros((16, 24, 3)).tolist(), light, spp=1, wrt='albedo').albedo",
    "rotate_environment(light.astype(np.float64), np.eye(3))",
    "hash(Camera(36, [0.5, 0.4])) == hash(Camera(36, (0.5, 0.4))) or None",
    "derive_seed(np.int64(1), 'image') == derive_seed(1, 'image') or None",
    "pipeline.edit(image, mask, metallic=np.full((16, 24), 0.2), decomposition=decomposition)",
    "pipeline.edit(image, mask, metallic=np.array([0.2]), decomposition=decomposition)",
    "pipeline.decompose_batch(np.stack([image, image]), np.stack([mask, mask]))",
    "pipeline.decompose_batch(iter([image, image]), iter([mask, mask]))",
    "unpremultiply(np.stack([image, image]), mask)",
    "unpremultiply(image, (mask > 0.5).astype(np.uint8))",
    "pipeline.edit(image, mask, metallic=mask > 0.5, decomposition=decomposition)",
    "score(image, image, 'masked', mask=mask > 0.5)",
)


def test_a_wrong_type_is_refused_in_words(subtests: pytest.Subtests) -> None:
    """All in one process, which takes seconds to begin; what can be understood is taken."""
    script = SCRIPT % ([*CASES, *FINE],)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    printed = dict(re.findall(r"^(.*) -> (.*)$", done.stdout, re.MULTILINE))
    for case in [*CASES, *FINE]:
        with subtests.test(case):
            assert printed[case].startswith(f"UnirenderError: {CASES[case]}" if case in CASES else "fine")
