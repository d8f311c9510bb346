"""What the pipeline returns, and how predictions become `Intrinsics`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.pipelines.editing import constant_map, masked_mean
from unirender.pipelines.framing import Frame, unit_normal

PREDICTED = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment")


@dataclass(frozen=True)
class Decomposition:
    """What a picture was taken apart into.

    Attributes:
        intrinsics: all maps at the picture's size, the light at the model's, the mask as given.
        roughness: coverage-weighted mean over the object.
        metallic: the same.
        std: per map, standard deviation over the samples; None in mode `mean` or with one sample.
        samples: each sample's intrinsics, where there are several; `intrinsics` is their mean.
    """

    intrinsics: Intrinsics
    roughness: float
    metallic: float
    std: dict[str, np.ndarray] | None = None
    samples: tuple[Intrinsics, ...] = ()


@dataclass(frozen=True)
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

    @property
    def coarse_share(self) -> float:
        """Share of the object's pixels where the predicted light is too coarse."""
        if self.coarse is None:
            return 0.0
        return float(self.coarse[self.intrinsics.require("mask")["mask"] > 0].mean())


@dataclass(frozen=True)
class MaterialRule:
    """How predicted metallic and roughness are read.

    Attributes:
        kind: `scalar`, one number to an object, or `map`.
        lines: by name, slope and offset of what replaces a predicted value (`unirender.training.calibrate`); one that
            is missing stays as predicted.
    """

    kind: str
    lines: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def read(
        self, name: str, value: Float[np.ndarray, "h w 1"], mask: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "h w 1"]:
        """The map of a quantity, in [0, 1]; 0 outside the mask."""
        value = np.clip(value, 0, 1)
        read = constant_map(masked_mean(value, mask), mask) if self.kind == "scalar" else value
        if name not in self.lines:
            return read
        slope, offset = self.lines[name]
        return constant_map(np.clip(slope * read + offset, 0, 1), mask)


def check_calibration(lines: Mapping[str, Sequence[float]] | None) -> dict[str, list[float]] | None:
    """The lines of a `MaterialRule`, as a checkpoint's configuration holds them.

    Raises:
        UnirenderError: an unknown name, or a line that is no slope >= 0 and offset.
    """
    if lines is None:
        return None
    for name, line in lines.items():
        if name not in ("roughness", "metallic") or len(line) != 2 or not np.isfinite(line).all() or line[0] < 0:
            raise UnirenderError(
                f"calibration: got {name!r}: {list(line)}, expected 'roughness' or 'metallic' with a slope of 0 or "
                "more and an offset"
            )
    return {name: [float(value) for value in line] for name, line in lines.items()}


def predicted_intrinsics(
    maps: dict[str, np.ndarray],
    frame: Frame,
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    material: MaterialRule,
) -> Intrinsics:
    """One prediction `[s s c]` at the picture's size: unit normals, 0 outside the mask, materials by their rule."""
    sized = {name: frame.leave_map(maps[name], mask) for name in PREDICTED if name != "environment"}
    sized["normal"] = unit_normal(sized["normal"])
    sized |= {name: material.read(name, sized[name], mask) for name in ("roughness", "metallic")}
    return Intrinsics(**sized, environment=maps["environment"], mask=mask, camera=camera)


def combine(samples: tuple[Intrinsics, ...]) -> Decomposition:
    """The mean and spread of samples; normals are averaged and made unit again."""
    mean = samples[0]
    std: dict[str, np.ndarray] | None = None
    if len(samples) > 1:
        stacks = {name: np.stack([getattr(sample, name) for sample in samples]) for name in PREDICTED}
        averages = {name: stack.mean(axis=0) for name, stack in stacks.items()}
        mean = mean.replace(**averages | {"normal": unit_normal(averages["normal"])})
        std = {name: stack.std(axis=0) for name, stack in stacks.items()}
    maps = mean.require("roughness", "metallic", "mask")
    roughness, metallic = (masked_mean(maps[name], maps["mask"]) for name in ("roughness", "metallic"))
    return Decomposition(mean, roughness, metallic, std, samples if len(samples) > 1 else ())
