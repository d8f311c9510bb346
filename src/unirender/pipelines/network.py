"""The network as a function of numpy arrays: `[s s c]` at one size s, in both directions, several at once."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unirender.camera import Camera
from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.errors import UnirenderError
from unirender.intrinsics import MAPS, Intrinsics
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS
from unirender.pipelines.looks import LOOKS, mean_of_looks
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
        size: s, pixels along each side: the model's own, or another multiple of what it needs.
        device: that computes; the weights may wait elsewhere (diffusers' offloading).
        progress: wraps the iteration over timesteps.
    """

    model: DualStreamModel
    conditioning: Conditioning
    scheduler: Any
    size: int
    device: torch.device
    progress: Callable[[Iterable[Any]], Iterable[Any]]

    @torch.no_grad()
    def attributes(
        self,
        images: Sequence[Float[np.ndarray, "s s 3"]],
        masks: Sequence[Float[np.ndarray, "s s 1"]],
        cameras: Sequence[Camera],
        how: Sampling,
    ) -> list[list[dict[str, np.ndarray]]]:
        """Inverse rendering of premultiplied linear images, all in one batch.

        Returns:
            For each image the maps of each sample, or the mean of its looks, in physical units.
        """
        looks = LOOKS[: how.looks]
        pictures = [{"image": image, "mask": mask} for image, mask in zip(images, masks, strict=True)]
        seen = [look.of(picture) for picture in pictures for look in looks]
        maps = infer_attributes(
            self.model,
            self.conditioning,
            self.scheduler,
            _batch([own["image"] for own in seen], how.count, self.device),
            _batch([own["mask"] for own in seen], how.count, self.device),
            steps=how.steps,
            generator=how.generators(len(images)),
            camera=_repeat([look.camera(camera) for camera in cameras for look in looks], how.count),
            progress=self.progress,
            step_end=how.step_end,
        )
        arrays = {name: value.permute(0, 2, 3, 1).float().cpu().numpy() for name, value in maps.items()}
        rows = [{name: value[i] for name, value in arrays.items()} for i in range(len(seen) * how.count)]
        each = how.looks * how.count  # one of them is 1
        found = [rows[i * each : (i + 1) * each] for i in range(len(images))]
        return found if how.looks == 1 else [[mean_of_looks(own, self.conditioning.packing)] for own in found]

    @torch.no_grad()
    def images(
        self, scenes: Sequence[Intrinsics], how: Sampling, derived: Sequence[Collection[str]] | None = None
    ) -> list[Float[np.ndarray, "s s 3"]]:
        """Rendering, all scenes in one batch: premultiplied linear images in [0, 1], samples averaged in linear light.

        Args:
            scenes: at the network's size.
            how: steps, samples and noise.
            derived: for each scene, which of its maps were derived from its light, without shadows; None: none.

        Raises:
            UnirenderError: the network's picture is not finite.
        """
        flags = [[name in own for name in TRIPLETS] for own in derived or [()] * len(scenes)]
        image = infer_image(
            self.model,
            self.conditioning,
            self.scheduler,
            {name: _batch([self._map(scene, name) for scene in scenes], how.count, self.device) for name in MAPS},
            torch.tensor(_repeat([_given(scene) for scene in scenes], how.count), device=self.device),
            steps=how.steps,
            generator=how.generators(len(scenes)),
            camera=_repeat([scene.camera for scene in scenes], how.count),
            progress=self.progress,
            derived=torch.tensor(_repeat(flags, how.count), device=self.device),
            step_end=how.step_end,
        )
        means = image.unflatten(0, (len(scenes), how.count)).mean(dim=1)
        pictures = means.permute(0, 2, 3, 1).float().cpu().numpy()
        if wrong := int(np.count_nonzero(~np.isfinite(pictures))):
            raise UnirenderError(
                f"rendering: {wrong} of {pictures.size} values of the network's picture are NaN or infinite, expected "
                "finite ones; compute in float32 (torch_dtype, --dtype), or load the checkpoint again"
            )
        return list(pictures)

    def overflow(self, intrinsics: Intrinsics) -> dict[str, Overflow]:
        """The HDR maps that exceed the curve through which they enter the network, by name; {}: none does."""
        found: dict[str, Overflow] = {}
        for name, curve in self.conditioning.packing.curves.items():
            value = getattr(intrinsics, name)
            if value is not None and (count := curve.overflow(value)):
                found[name] = Overflow(count, count / value.size, curve.x_max)
        return found

    def _map(self, scene: Intrinsics, name: str) -> Float[np.ndarray, "h w c"]:
        """A map of a scene; zeros for an unknown one."""
        value = getattr(scene, name)
        if value is not None:
            return value
        rows, columns = self.conditioning.packing.environment_size if name == "environment" else (self.size, self.size)
        return np.zeros((rows, columns, MAPS[name]), np.float32)


def _batch(
    arrays: Sequence[Float[np.ndarray, "h w c"]], count: int, device: torch.device
) -> Float[torch.Tensor, "b c h w"]:
    """Each array `count` times in a row, on a device."""
    stack = np.stack([np.moveaxis(array, -1, 0) for array in arrays])
    tensor = torch.from_numpy(np.ascontiguousarray(stack, dtype=np.float32)).to(device)
    return tensor.repeat_interleave(count, dim=0)


def _given(scene: Intrinsics) -> list[bool]:
    """Which of the six pictures are known."""
    return [name == "material" or getattr(scene, name) is not None for name in TRIPLETS]


def _repeat(values: Sequence[Any], count: int) -> list[Any]:
    """Each value `count` times in a row."""
    return [value for value in values for _ in range(count)]
