"""The members of a group: everything that is rendered of an object under its lights, encoded.

`shared.exr` holds albedo, normal and mask (with the object's own maps also roughness and metallic). A light has
`l0.environment.exr`, `l0.diffuse.exr`, `l0.r030.specular.exr` and `l0.m050_r030.exr` (the image; percent); with the
object's own maps `l0.maps.specular.exr` and `l0.maps.exr`. `json` says the rest, and the roughness and metallic of each
picture by name: nobody has to take them from a file's.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import HALF_MAX, exr_bytes, image_channels, intrinsics_channels
from unirender.intrinsics import Intrinsics
from unirender_reference.dataset_config import GRID, MOST_SPP, DatasetConfig
from unirender_reference.lights import Light
from unirender_reference.passes import Estimate, derive_seed
from unirender_reference.plan import GroupPlan, LightPlan
from unirender_reference.render import Renderer, SceneSpec, renderer_provenance, scene_hashes, shared_scene_hash
from unirender_reference.shards import FloorCount

GEOMETRY_SPP = 64  # multi-jittered: coverage to about 1/64

Pair = tuple[int, int] | None  # (roughness, metallic) in percent; None: the object's own maps
Attributes = Mapping[str, str]


@dataclass(frozen=True)
class Floor:
    """What a buffer took: samples per pixel, the noise floor reached (dB), whether that is surely the one asked for."""

    spp: int
    floor_db: float
    reached: bool


class GroupMembers:
    """A group in the making.

    Attributes:
        members: the encoded files by name.
        floors: what each buffer reached of the noise floor, by member without its suffix; empty without a floor.
        negative_pixels: pixels of the pictures with a channel below 0: interpolation can do that, a render cannot.
    """

    def __init__(self, config: DatasetConfig, plan: GroupPlan, renderer: Renderer) -> None:
        self.config = config
        self.plan = plan
        self.renderer = renderer
        self.members: dict[str, bytes] = {}
        self.floors: dict[str, Floor] = {}
        self.negative_pixels = 0
        seed = derive_seed(plan.render_seed, "shared")
        own_maps = config.materials == "maps"
        self.geometry = renderer.geometry(GEOMETRY_SPP, seed, (None, None) if own_maps else None)
        assert self.geometry.mask is not None
        self.mask = self.geometry.mask
        self.header = {**renderer_provenance(renderer), "spp": str(config.spp), "seed": str(plan.render_seed)}

    def render(self, lights: Sequence[Light], factors: Sequence[float]) -> None:
        """Fills `members`; `factors` are the lights' exposures."""
        scenes = [self._scenes(light, own) for light, own in zip(lights, self.plan.lights, strict=True)]
        shared = {**self.header, "spp": str(GEOMETRY_SPP)}
        shared["scene"] = shared_scene_hash(value for hashes in scenes for value in hashes.values())
        self.members["shared.exr"] = exr_bytes(intrinsics_channels(self.geometry), attributes=shared)
        records = [
            self._light(i, light, factor, own, hashes)
            for i, (light, factor, own, hashes) in enumerate(
                zip(lights, factors, self.plan.lights, scenes, strict=True)
            )
        ]
        self.members["json"] = json.dumps(self._record(records), sort_keys=True).encode()

    def floor_count(self) -> FloorCount | None:
        """How far the group got; None without a noise floor."""
        if not self.floors:
            return None
        floors = self.floors.values()
        lowest = min(floor.floor_db for floor in floors)
        return FloorCount(len(floors), sum(floor.reached for floor in floors), lowest)

    def _scenes(self, light: Light, plan: LightPlan) -> dict[Pair, str]:
        """The scene hash of each picture under a light."""
        pairs: tuple[Pair, ...] = plan.pairs or (None,)
        obj, camera, resolution = self.renderer.obj, self.renderer.camera, self.config.resolution
        specs = [SceneSpec(obj, light, *_material(pair), camera, resolution, plan.exposure_seed) for pair in pairs]
        return dict(zip(pairs, scene_hashes(specs), strict=True))

    def _light(
        self, i: int, light: Light, factor: float, plan: LightPlan, scenes: Mapping[Pair, str]
    ) -> dict[str, Any]:
        """Renders everything under one light; returns what the group's json says of it."""
        renderer = self.renderer
        environment = (light.environment * np.float32(factor)).astype(np.float32)
        attributes = {**self.header, "light": light.name, "exposure_factor": repr(factor)}
        lit = {**attributes, "scene": shared_scene_hash(scenes.values())}
        self.members[f"l{i}.environment.exr"] = exr_bytes(image_channels(environment), half=False, attributes=lit)
        seed = derive_seed(self.plan.render_seed, "light", i)
        self._render(f"l{i}.diffuse", "diffuse", lambda *how: renderer.diffuse(environment, *how), seed, lit)
        for r in dict.fromkeys(pair and pair[0] for pair in scenes):
            own = [scene for pair, scene in scenes.items() if pair is None or pair[0] == r]
            self._render(
                f"l{i}.{specular_name(r)}",
                "specular",
                lambda *how, r=r: renderer.specular(environment, None if r is None else r / 100, *how),
                derive_seed(seed, "maps" if r is None else r),
                {**attributes, **_percents(roughness=r), "scene": shared_scene_hash(own)},
            )
        if self.config.vary == "sweep":
            self._sweep(i, environment, seed, attributes, scenes)
        else:
            for pair, scene in scenes.items():
                self._render(
                    f"l{i}.{picture_name(pair)}",
                    "image",
                    lambda spp, seed, batches, pair=pair: renderer.image(
                        environment, *_material(pair), spp, seed, batches=batches
                    ),
                    derive_seed(seed, *(pair or ("image maps",))),
                    {**attributes, **_material_attributes(pair), "scene": scene},
                )
        return {
            "name": light.name,
            "seed": plan.seed,
            "exposure_factor": factor,
            "exposure_seed": plan.exposure_seed,
            "pairs": [_pair_record(i, pair) for pair in scenes],
            "provenance": dict(light.provenance),
        }

    def _sweep(
        self,
        i: int,
        environment: Float[np.ndarray, "h w 3"],
        seed: int,
        attributes: Attributes,
        scenes: Mapping[Pair, str],
    ) -> None:
        """All pictures of the grid, from renders at a few metallic values; the others are marked as interpolated.

        The header of a render has its samples per pixel, that of an interpolated picture those of a render as noisy.
        """
        from unirender_reference.sweep import render_sweep

        grid = [value / 100 for value in GRID]
        sweep = render_sweep(self.renderer, environment, grid, grid, self.config.spp, seed, batches=1)
        nodes = dict(zip(sweep.node_values, sweep.node_spp, strict=True))
        for pair, scene in scenes.items():
            assert pair is not None
            r, m = pair
            own = {**attributes, **_material_attributes(pair), "scene": scene}
            if m / 100 in nodes:
                own["spp"] = str(nodes[m / 100])
            else:
                own["interpolated"] = "from metallic " + " ".join(f"{node:g}" for node in nodes)
            mean = sweep.estimate(GRID.index(r), GRID.index(m)).mean
            self._encode(f"l{i}.{picture_name(pair)}", "image", mean, own)

    def _render(
        self, name: str, kind: str, render: Callable[[int, int, int], Estimate], seed: int, attributes: Attributes
    ) -> None:
        """Adds a buffer, sampled up to the noise floor if there is one; `render` takes (spp, seed, batches)."""
        config, own = self.config, dict(attributes)
        if config.noise_floor is None:
            mean = render(config.spp, seed, 1).mean
        else:
            from unirender_reference.noise import FLOOR_BATCHES, render_to_floor

            found = render_to_floor(
                lambda spp, seed: render(spp, seed, FLOOR_BATCHES),
                self.mask,
                config.noise_floor,
                premultiplied=kind == "image",
                spp=config.spp,
                max_spp=MOST_SPP,
                seed=seed,
            )
            mean = found.estimate.mean
            self.floors[name] = Floor(found.spp, round(found.floor_db, 2), found.reached)
            own |= {"spp": str(found.spp), "noise_floor": f"{found.floor_db:.2f}"}
        self._encode(name, kind, mean, own)

    def _encode(self, name: str, kind: str, mean: Float[np.ndarray, "h w c"], attributes: Attributes) -> None:
        """Adds a buffer as a member: an image as it is, s and d where the object is.

        Raises:
            UnirenderError: it has a value that files of half precision do not hold.
        """
        if (peak := float(mean.max())) > HALF_MAX:
            scene = f"{self.renderer.obj.name} under the light {attributes['light']}"
            raise UnirenderError(
                f"dataset: {name} of {scene} reaches {peak:.3g}, half precision ends at {HALF_MAX:g}; give fewer rows "
                "as --light-height, which spreads a sun over more of the sky, or take the file out of --lights"
            )
        own = dict(attributes)
        if self.config.denoise:
            from unirender_reference.denoise import denoise, marking

            assert self.geometry.normal is not None
            albedo = self.geometry.albedo if kind == "image" else None
            # interpolated pictures can be slightly negative by their noise, which the network does not take
            mean = denoise(np.maximum(mean, 0), albedo, self.geometry.normal, self.mask, premultiplied=kind == "image")
            own |= marking()
        if kind == "image":
            self.negative_pixels += int((mean[..., :3].astype(np.float16) < 0).any(axis=-1).sum())
            channels = image_channels(mean)
        else:
            channels = intrinsics_channels(Intrinsics().replace(**{kind: np.where(self.mask > 0, mean, 0)}))
        self.members[f"{name}.exr"] = exr_bytes(channels, attributes=own)

    def _record(self, lights: list[dict[str, Any]]) -> dict[str, Any]:
        """The group's json."""
        config, plan, renderer = self.config, self.plan, self.renderer
        record: dict[str, Any] = {
            **self.header,
            "family": renderer.obj.family,
            "vary": config.vary,
            "shares": plan.shares,
            "camera": {"fov_deg": renderer.camera.fov_deg, "principal": list(renderer.camera.principal)},
            "coverage": round(float(self.mask.mean()), 6),
            "lights": lights,
            "nan_pixels": renderer.counters.nan_pixels,
            "object_provenance": dict(renderer.obj.provenance),
        }
        if config.vary == "sweep":
            record["negative_pixels"] = self.negative_pixels
        if plan.mesh is not None:
            record["file"] = plan.mesh.name
        if config.materials == "maps":
            record["materials"] = "maps"
        if config.noise_floor is not None:
            floors = {name: dataclasses.asdict(floor) for name, floor in self.floors.items()}
            record["noise_floor"] = {"asked_db": config.noise_floor, "buffers": floors}
        if config.denoise:
            from unirender_reference.denoise import marking

            record |= marking()
        return record


def picture_name(pair: Pair) -> str:
    """How a picture's member is called: `m050_r030` at roughness 0.3, metallic 0.5; `maps` with the object's own."""
    return "maps" if pair is None else f"m{pair[1]:03d}_r{pair[0]:03d}"


def specular_name(roughness: int | None) -> str:
    """How the s of a roughness (percent) is called: `r030.specular`; `maps.specular` with the object's own."""
    return "maps.specular" if roughness is None else f"r{roughness:03d}.specular"


def _pair_record(i: int, pair: Pair) -> dict[str, Any]:
    """A picture under light `i` as the group's json has it; roughness and metallic are None with the object's own."""
    roughness, metallic = _material(pair)
    return {
        "roughness": roughness,
        "metallic": metallic,
        "member": f"l{i}.{picture_name(pair)}.exr",
        "specular": f"l{i}.{specular_name(pair and pair[0])}.exr",
    }


def _material_attributes(pair: Pair) -> dict[str, str]:
    """The header attributes of a picture."""
    return {} if pair is None else _percents(roughness=pair[0], metallic=pair[1])


def _percents(**values: int | None) -> dict[str, str]:
    """Header attributes in [0, 1] from percents; without those that are maps."""
    return {name: f"{value / 100:g}" for name, value in values.items() if value is not None}


def _material(pair: Pair) -> tuple[float | None, float | None]:
    """(roughness, metallic) of a picture."""
    return (None, None) if pair is None else (pair[0] / 100, pair[1] / 100)
