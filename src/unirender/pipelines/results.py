"""What the pipeline returns, and how predictions become `Intrinsics`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from unirender.blocks import by_rows
from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import constant_map, masked_mean, unit_normal
from unirender.pipelines.revealed_light import agreeing_light
from unirender.shown import in_short

PREDICTED = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment")


@dataclass(frozen=True, eq=False)
class Decomposition:
    """What a picture was taken apart into.

    Attributes:
        intrinsics: all maps at the picture's size, the light at the model's, the mask as given. Where the decomposition
            is closed, the light is the one that agrees with its s and d (`unirender.pipelines.revealed_light`).
        roughness: coverage-weighted mean over the object.
        metallic: the same.
        std: per map, standard deviation over the samples, whose number N is the denominator: sqrt((N - 1) / N) of the
            unbiased one. None in mode `mean` or with one sample.
        samples: each sample's intrinsics, where there are several, with its light as the network predicts it;
            `intrinsics` is their mean, but for the light: the mean of theirs, about which `std` is, is `network_light`.
        network_light: the light as the network predicts it, [eh ew 3], which its own renderings of these maps are told:
            a mean in log radiance, and so darker than s and d say. None: it is the light of `intrinsics`.
        agreeing_light: the light that `intrinsics` got in its place. Where you have put another one there, that one
            counts (`with_network_light`).
        thumbnail: of the picture (`unirender.pipelines.framing.thumbnail`), by which it is known again; or None.
        made_with: looks, tile, material, closed and flat, by name; None: not known.
    """

    intrinsics: Intrinsics
    roughness: float
    metallic: float
    std: dict[str, np.ndarray] | None = None
    samples: tuple[Intrinsics, ...] = ()
    network_light: Float[np.ndarray, "eh ew 3"] | None = None
    agreeing_light: Float[np.ndarray, "eh ew 3"] | None = None
    thumbnail: Float[np.ndarray, "th tw 3"] | None = None
    made_with: Mapping[str, Any] | None = None

    def __repr__(self) -> str:
        samples = f"{len(self.samples)} samples, " if self.samples else ""
        return (
            f"Decomposition(roughness={self.roughness:.3g}, metallic={self.metallic:.3g}, {samples}{self.intrinsics}, "
            f"made_with={self.made_with})"
        )

    @property
    def with_network_light(self) -> Intrinsics:
        """The maps, closed or not, with the network's own light, from which edits and relightings start."""
        theirs = self.intrinsics.environment is not self.agreeing_light
        return self.intrinsics if theirs else self.intrinsics.replace(environment=self.network_light)

    @property
    def own_agreeing_light(self) -> Float[np.ndarray, "eh ew 3"] | None:
        """The light that agrees with s and d, unless you have put another one in its place."""
        return self.agreeing_light if self.intrinsics.environment is self.agreeing_light else None


@dataclass(frozen=True, eq=False)
class EditResult:
    """An edited picture.

    Attributes:
        image_linear: premultiplied, linear, >= 0; an anchored edit may exceed display white.
        intrinsics: the edited maps.
        decomposition: of the input.
        bounded: share of the specular values whose change was bounded: there the predicted light is too coarse to say.
        coarse: where its texels are wider than the lobe, so that s shows no sharper reflection than before
            (`unirender.pipelines.editing.too_coarse`); None where the roughness was not edited.
    """

    image_linear: Float[np.ndarray, "h w 3"]
    intrinsics: Intrinsics
    decomposition: Decomposition
    bounded: float = 0.0
    coarse: Bool[np.ndarray, "h w 1"] | None = None

    def __repr__(self) -> str:
        return (
            f"EditResult(image_linear {in_short(self.image_linear)}, bounded={self.bounded:.3g}, "
            f"coarse_share={self.coarse_share:.3g}, {self.intrinsics})"
        )

    @property
    def coarse_share(self) -> float:
        """Share of the object's pixels where the predicted light is too coarse."""
        if self.coarse is None:
            return 0.0
        return float(self.coarse[self.intrinsics.require("mask")["mask"] > 0].mean())


def predicted_intrinsics(
    maps: dict[str, np.ndarray], frame: Frame, mask: Float[np.ndarray, "h w 1"], camera: Camera, material: str
) -> Intrinsics:
    """One prediction `[s s c]` at the picture's size: unit normals, 0 outside the mask, scalar materials if asked.

    What is covered and outside the frame's square gets the mean of the materials, and 0 of the other maps.
    """
    sized = dict(frame.leave_maps({name: maps[name] for name in PREDICTED if name != "environment"}, mask))
    sized["normal"] = unit_normal(sized["normal"])
    seen = frame.seen(mask)
    unseen = (mask > 0) & (seen == 0)
    for name in ("roughness", "metallic"):
        value = np.clip(sized[name], 0, 1)
        mean = constant_map(masked_mean(value, seen), mask)
        sized[name] = mean if material == "scalar" else np.where(unseen, mean, value)
    return Intrinsics(**sized, environment=maps["environment"], mask=mask, camera=camera)


def with_agreeing_light(found: Decomposition) -> Decomposition:
    """The decomposition with the light that agrees with its s and d, beside the one that the network predicts."""
    maps = found.intrinsics
    light, agreeing = maps.environment, agreeing_light(maps)
    if agreeing is light:  # nothing of the surface is seen
        return found
    return replace(found, intrinsics=maps.replace(environment=agreeing), network_light=light, agreeing_light=agreeing)


def combine(samples: tuple[Intrinsics, ...]) -> Decomposition:
    """The mean and spread of samples; normals are averaged and made unit again."""
    mean = samples[0]
    std: dict[str, np.ndarray] | None = None
    if len(samples) > 1:
        maps = {name: [getattr(sample, name) for sample in samples] for name in PREDICTED}
        averages = {name: by_rows(_mean, *values) for name, values in maps.items()}
        mean = mean.replace(**averages | {"normal": unit_normal(averages["normal"])})
        std = {name: by_rows(_spread, *values) for name, values in maps.items()}
    own = mean.require("roughness", "metallic", "mask")
    roughness, metallic = (masked_mean(own[name], own["mask"]) for name in ("roughness", "metallic"))
    return Decomposition(mean, roughness, metallic, std, samples if len(samples) > 1 else ())


def _mean(*values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    return np.stack(values).mean(axis=0)


def _spread(*values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    return np.stack(values).std(axis=0)
