"""Our model as a benchmark method, and what identifies its checkpoint."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.decompositions import Decompositions
from unirender_evaluation.methods.method import Image, Mask


@dataclass(eq=False, repr=False)
class PipelineMethod:
    """Our model as a benchmark method.

    Attributes:
        pipeline: a `UniRenderPipeline`.
        name: of the row.
        weights: sha256 of the checkpoint.
        mode: "mean" (one step) or "sample".
        anchored: edits and relighting carry over what the decomposition could not explain.
        steps: denoising steps of "sample".
        samples: averaged per prediction in "sample".
        seed: of the generator; every call starts from it.
        closed: albedo, s and d are changed so that their rendering is the picture.
        looks: at each picture that is taken apart.
        flat: the albedo is made even between its edges.
        device: where the pipeline runs: another one rounds otherwise.
        decompositions: shared with another row of the same pipeline and mode.
    """

    pipeline: Any
    name: str
    weights: str
    _: KW_ONLY
    mode: str = "mean"
    anchored: bool = False
    steps: int = 1
    samples: int = 1
    seed: int = 0
    closed: bool = True
    looks: int = 1
    flat: bool = False
    device: str = "cpu"
    decompositions: Decompositions[Any] = field(default_factory=Decompositions[Any])

    @property
    def config(self) -> dict[str, Any]:
        return {
            "pipeline": "unirender",
            "weights": self.weights,
            "mode": self.mode,
            "anchored": self.anchored,
            "closed": self.closed,
            "steps": self.steps,
            "samples": self.samples,
            "seed": self.seed,
            "device": self.device,
            **({"looks": self.looks} if self.looks > 1 else {}),
            **({"flat": True} if self.flat else {}),
        }

    def _options(self) -> dict[str, Any]:
        import torch

        if self.mode == "mean":
            return {"mode": "mean"}
        generator = torch.Generator().manual_seed(self.seed)
        return {
            "mode": self.mode,
            "num_inference_steps": self.steps,
            "num_samples": self.samples,
            "generator": generator,
        }

    def _decomposition(self, image_srgb: Image, mask: Mask, camera: Camera) -> Any:
        """Of a picture, computed once: the rows that share it differ in what they do with it."""
        options = {**self._options(), "closed": self.closed, "looks": self.looks, "flat": self.flat}
        make = partial(self.pipeline.decompose, image_srgb, mask=mask, camera=camera, **options)
        return self.decompositions.of(image_srgb, mask, camera, make)[0]

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return self._decomposition(image_srgb, mask, camera).intrinsics

    def edit(self, image_srgb: Image, mask: Mask, camera: Camera, **material: float) -> Image:
        found = self._decomposition(image_srgb, mask, camera)
        options = {**self._options(), "anchored": self.anchored, "decomposition": found, **material}
        return self.pipeline.edit(image_srgb, mask=mask, camera=camera, **options).image_linear

    def relight(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        environment: Any = None,
        specular: Any = None,
        diffuse: Any = None,
    ) -> Image:
        found = self._decomposition(image_srgb, mask, camera)
        options = {**self._options(), "anchored": self.anchored, "decomposition": found, "exposure": "keep"}
        light = {"specular": specular, "diffuse": diffuse}
        return self.pipeline.relight(image_srgb, environment, mask=mask, camera=camera, **light, **options).image_linear

    def render(self, intrinsics: Intrinsics) -> Image:
        return self.pipeline.render(intrinsics, **self._options())


class LazyPipeline:
    """A pipeline that is loaded when it is first asked something: a run that has nothing to do loads nothing."""

    def __init__(self, load: Callable[[], Any]) -> None:
        self._load = load
        self._pipeline: Any = None

    def __getattr__(self, name: str) -> Any:
        if self._pipeline is None:
            self._pipeline = self._load()
        return getattr(self._pipeline, name)
