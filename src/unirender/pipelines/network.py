"""The network as a function of numpy arrays: `[s s c]` at the model's own size s, in both directions."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unirender.camera import Camera
from unirender.diffusion.sampling import infer_attributes, infer_image
from unirender.intrinsics import MAPS, Intrinsics
from unirender.models.conditioning import TRIPLETS, Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.priors import Maps
from unirender.pipelines.settings import Sampling


@dataclass(frozen=True)
class Overflow:
    """Values of an HDR map above the brightest that the network was taught; they enter as they are.

    Attributes:
        count: how many.
        share: of the map's values.
        x_max: the bound, radiance in display units.
    """

    count: int
    share: float
    x_max: float

    def __str__(self) -> str:
        return (
            f"values above {self.x_max:g}, the brightest that the network was taught: {self.count} ({self.share:.2%})"
        )


@dataclass(frozen=True)
class Network:
    """A dual-stream model with what it needs to be asked.

    Attributes:
        model: the two streams.
        conditioning: maps <-> latents.
        scheduler: of diffusers, with `prediction_type="sample"`.
        size: pixels along each side.
        progress: wraps the iteration over timesteps.
    """

    model: DualStreamModel
    conditioning: Conditioning
    scheduler: Any
    size: int
    progress: Callable[[Iterable[Any]], Iterable[Any]]

    def attributes(
        self, image_linear: Float[np.ndarray, "s s 3"], mask: Float[np.ndarray, "s s 1"], camera: Camera, how: Sampling
    ) -> list[dict[str, np.ndarray]]:
        """Inverse rendering of a premultiplied linear image: the maps of each sample, in physical units."""
        maps = infer_attributes(
            self.model,
            self.conditioning,
            self.scheduler,
            self._tensor(image_linear).expand(how.count, -1, -1, -1),
            self._tensor(mask).expand(how.count, -1, -1, -1),
            steps=how.steps,
            generator=how.generator,
            camera=camera,
            progress=self.progress,
        )
        arrays = {name: value.permute(0, 2, 3, 1).float().cpu().numpy() for name, value in maps.items()}
        return [{name: value[i] for name, value in arrays.items()} for i in range(how.count)]

    def image(self, intrinsics: Intrinsics, how: Sampling) -> Float[np.ndarray, "s s 3"]:
        """Rendering: the premultiplied linear image in [0, 1], samples averaged in linear light."""
        maps, given = self._maps(intrinsics)
        image = infer_image(
            self.model,
            self.conditioning,
            self.scheduler,
            {name: value.expand(how.count, -1, -1, -1) for name, value in maps.items()},
            given.expand(how.count, -1),
            steps=how.steps,
            generator=how.generator,
            camera=intrinsics.camera,
            progress=self.progress,
        )
        return image.mean(dim=0).permute(1, 2, 0).float().cpu().numpy()

    def overflow(self, intrinsics: Intrinsics) -> dict[str, Overflow]:
        """The HDR maps that exceed the curve through which they enter the network, by name; {}: none does."""
        found: dict[str, Overflow] = {}
        for name, curve in self.conditioning.packing.curves.items():
            value = getattr(intrinsics, name)
            if value is not None and (count := curve.overflow(value)):
                found[name] = Overflow(count, count / value.size, curve.x_max)
        return found

    def _maps(self, intrinsics: Intrinsics) -> tuple[Maps, torch.Tensor]:
        """Tensors of all maps (zeros for the unknown) and which of the six pictures are given."""
        size = (self.size, self.size)
        shapes = {"environment": (*self.conditioning.packing.environment_size, 3)}
        maps: Maps = {}
        for name, channels in MAPS.items():
            value = getattr(intrinsics, name)
            unknown = np.zeros(shapes.get(name, (*size, channels)), np.float32)
            maps[name] = self._tensor(unknown if value is None else value)
        given = [name == "material" or getattr(intrinsics, name) is not None for name in TRIPLETS]
        return maps, torch.tensor([given], device=self.model.device)

    def _tensor(self, array: Float[np.ndarray, "h w c"]) -> torch.Tensor:
        copy = np.array(np.moveaxis(array, -1, 0), dtype=np.float32, order="C")  # torch takes no read-only memory
        return torch.from_numpy(copy)[None].to(self.model.device)
