"""Rendering with any subset of the maps that a renderer must be able to do without."""

import functools
import itertools

import numpy as np
import pytest
import torch
from synthetic_shards import sphere
from tiny_models import SIZE, make_batch, make_model, make_pipeline
from torch import Tensor

from unirender.diffusion.inference import infer_image
from unirender.diffusion.schedule import make_scheduler
from unirender.intrinsics import Intrinsics
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.losses.loss_function import DROPPABLE

GROWN = ("albedo", "normal", "roughness", "metallic", "mask")
SUBSETS = [
    (prior, known)
    for prior, counts in (("none", (1,)), ("split_sum", (0, 1)))
    for count in counts
    for known in itertools.combinations(DROPPABLE, count)
]


@functools.cache
def network(prior: str) -> tuple[DualStreamModel, Conditioning]:
    return make_model(physics_prior=prior)


def render(prior: str, known: tuple[str, ...], maps: dict[str, Tensor]) -> Tensor:
    model, conditioning = network(prior)
    given = torch.tensor([[name not in DROPPABLE or name in known for name in TRIPLETS]])
    return infer_image(model, conditioning, make_scheduler(), maps, given, generator=torch.Generator().manual_seed(0))


@functools.cache
def rendered_with(prior: str, known: tuple[str, ...]) -> Tensor:
    return render(prior, known, make_batch(1))


@pytest.mark.parametrize(("prior", "known"), SUBSETS)
def test_the_render_depends_on_the_known_maps_and_on_no_other(prior: str, known: tuple[str, ...]) -> None:
    maps, other = make_batch(1), make_batch(1, seed=7)
    image = rendered_with(prior, known)
    withheld = {name: other[name] for name in DROPPABLE if name not in known}
    assert torch.equal(render(prior, known, maps | withheld), image)
    for name in known:
        assert not torch.equal(render(prior, known, maps | {name: other[name]}), image), name
    different = [rendered_with(prior, subset) for subset in (DROPPABLE, ()) if subset != known]
    assert not any(torch.equal(image, x) for x in different)  # what is known is told, and used


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline()


def scene() -> Intrinsics:
    rng = np.random.default_rng(0)
    shape = sphere(SIZE, rng)
    mask = shape.require("mask")["mask"]
    return shape.replace(
        roughness=0.4 * mask, metallic=0.3 * mask, environment=rng.uniform(0, 2, (16, 32, 3)).astype(np.float32)
    )


def rendered(pipeline: UniRenderPipeline, intrinsics: Intrinsics, shadows: bool = True) -> np.ndarray:
    return pipeline.render(intrinsics, shadows=shadows, generator=torch.Generator().manual_seed(0))


def test_light_alone_is_light_with_what_follows_from_it(pipeline: UniRenderPipeline) -> None:
    """With s and d missing they are derived from the environment, each by itself."""
    given = scene()
    environment = given.require("environment")["environment"]
    derived = derived_light(given, environment, ("specular", "diffuse"), shadows=False)
    image = rendered(pipeline, given, shadows=False)
    for names in (("diffuse",), ("specular",), ("diffuse", "specular")):
        some = given.replace(**{name: derived[name] for name in names})
        assert np.array_equal(rendered(pipeline, some, shadows=False), image)
    brighter = given.replace(environment=(2 * environment).astype(np.float32))
    assert not np.allclose(rendered(pipeline, brighter, shadows=False), image)
    assert not np.allclose(rendered(pipeline, given.replace(diffuse=2 * derived["diffuse"]), shadows=False), image)


def test_without_albedo_the_closed_form_is_unknown_and_the_network_renders_alone(pipeline: UniRenderPipeline) -> None:
    given = scene()
    without = rendered(pipeline, given.replace(albedo=None))
    mask = given.require("mask")["mask"]
    assert without.shape == (SIZE, SIZE, 3)
    assert np.isfinite(without).all()
    assert 0 <= without.min() < without.max() <= 1
    assert not without[mask[..., 0] == 0].any()
    assert not np.allclose(without, rendered(pipeline, given))
    black = given.replace(albedo=np.zeros((SIZE, SIZE, 3), np.float32))
    assert not np.allclose(without, rendered(pipeline, black))  # unknown is not black


@pytest.mark.parametrize("missing", [("albedo",), ("specular", "diffuse", "environment")])
def test_at_another_size_no_pixel_is_above_its_coverage(pipeline: UniRenderPipeline, missing: tuple[str, ...]) -> None:
    """What the network adds outside the object is spread over its rim, and divided by a small coverage."""
    given = scene()
    doubled = given.replace(
        **{name: np.kron(value, np.ones((2, 2, 1), np.float32)) for name, value in given.maps.items() if name in GROWN}
    )
    image = rendered(pipeline, doubled.replace(**dict.fromkeys(missing)))
    assert image.min() >= 0
    assert (image <= doubled.require("mask")["mask"]).all()
