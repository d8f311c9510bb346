"""A rendered group through the whole reader, every augmentation at once, against Mitsuba on the augmented scene."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from unirender.exr import channels_rgb, read_exr_bytes
from unirender.light.exposure import exposure_factor
from unirender.light.symmetries import mirror, permute_channels, quarter_turn, turn_rotation
from unirender.training.augmentations.augment import Draw, mix_lights
from unirender.training.data.dataset import GroupDataset
from unirender_reference.dataset import render_group
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.plan import plan_groups
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject, make_object
from unirender_reference.shards import RenderedGroup, write_shard

SPP = 1024
DRAWN = Draw(
    lights=(1, 0),
    weights=np.array([[0.3, 0.5, 0.4], [0.8, 0.5, 0.6]], np.float32),
    roughness_index=0,
    metallic=0.3,
    order=(2, 0, 1),
    turns=1,
    mirror=True,
    exposure_target=0.8,
)
LIMIT = 0.03  # relative L2 error of a buffer (measured 0.018: noise of a group at SPP, the turned light resampled)
CONFIG = DatasetConfig(objects=1, pairs=6, resolution=24, vary="basis", out=Path("unused"), seed=3, spp=SPP)


@pytest.fixture(scope="module")
def group() -> RenderedGroup:
    return render_group(CONFIG, plan_groups(CONFIG)[0])


@pytest.fixture(scope="module")
def dataset(group: RenderedGroup, tmp_path_factory: pytest.TempPathFactory) -> GroupDataset:
    folder = tmp_path_factory.mktemp("rendered")
    write_shard(folder / "shard-000000.tar", [(group.key, group.members)])
    return GroupDataset(folder)


@pytest.fixture(scope="module")
def truth(group: RenderedGroup, dataset: GroupDataset) -> dict[str, np.ndarray]:
    """Buffers of the augmented scene: the moved object of permuted colour under the mixed, moved light."""
    environments = [channels_rgb(read_exr_bytes(group.members[f"l{i}.environment.exr"])[0]) for i in DRAWN.lights]
    light = mix_lights({"environment": np.stack(environments)}, DRAWN.weights)
    environment = permute_channels(mirror(quarter_turn(light, DRAWN.turns)), DRAWN.order)["environment"]
    moved = Renderer(
        _moved(make_object(plan_groups(CONFIG)[0].object_seed, CONFIG.split)), resolution=CONFIG.resolution
    )
    maps = {name: value for name, value in moved.geometry(SPP, 1).require("albedo", "normal", "mask").items()}
    roughness = dataset.pairs(0)[0].roughness
    buffers = {
        "image": moved.image(environment, roughness, DRAWN.metallic, SPP, 2).mean[..., :3],
        "diffuse": moved.diffuse(environment, SPP, 3).mean,
        "specular": moved.specular(environment, roughness, SPP, 4).mean,
    }
    assert DRAWN.exposure_target is not None
    factor = exposure_factor(buffers["diffuse"], maps["mask"], DRAWN.exposure_target)
    return maps | {name: value * factor for name, value in buffers.items()}


def _moved(obj: MeshObject) -> MeshObject:
    """The object as the draw moves it: turned, then mirrored, its colour channels permuted."""
    matrix = (np.diag([-1.0, 1.0, 1.0]) @ turn_rotation(DRAWN.turns)).astype(np.float32)
    return dataclasses.replace(
        obj,
        vertices=obj.vertices @ matrix.T,
        normals=obj.normals @ matrix.T,
        faces=np.ascontiguousarray(obj.faces[:, ::-1]),
        albedo=np.ascontiguousarray(obj.albedo[..., list(DRAWN.order)]),
    )


def errors(dataset: GroupDataset, drawn: Draw, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Relative L2 error of each map over the pixels covered in both."""
    maps = dataset.augmented(0, None, drawn)
    inside = (maps["mask"] > 0.99) & (truth["mask"] > 0.99)
    return {
        name: float(np.linalg.norm((maps[name] - value) * inside) / np.linalg.norm(value * inside))
        for name, value in truth.items()
    }


def test_all_augmentations_at_once(dataset: GroupDataset, truth: dict[str, np.ndarray]) -> None:
    found = errors(dataset, DRAWN, truth)
    assert all(error < LIMIT for error in found.values()), found


@pytest.mark.parametrize(
    ("change", "seen_in"),
    [
        ({"lights": (0, 1)}, ("image", "diffuse", "specular")),
        ({"metallic": 0.6}, ("image",)),
        ({"order": (0, 1, 2)}, ("image", "albedo")),
        ({"turns": 3}, ("image", "normal", "diffuse", "specular")),
        ({"mirror": False}, ("image", "normal", "diffuse", "specular")),
        ({"exposure_target": 0.7}, ("image", "diffuse", "specular")),
    ],
)
def test_another_draw_is_another_scene(
    dataset: GroupDataset, truth: dict[str, np.ndarray], change: dict, seen_in: tuple[str, ...]
) -> None:
    found = errors(dataset, dataclasses.replace(DRAWN, **change), truth)
    assert all(found[name] > 1.5 * LIMIT for name in seen_in), " ".join(f"{n} {e:.3f}" for n, e in found.items())
