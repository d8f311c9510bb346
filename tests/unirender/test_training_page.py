"""The page on training: shards that a stranger writes as it says are read back as they were."""

import re
from pathlib import Path

import numpy as np
import pytest
from synthetic_shards import sphere

from unirender.composite import composite
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.surface_light import diffuse_light, specular_light
from unirender.training.data import GroupDataset

PAGE = Path(__file__).resolve().parents[2] / "docs" / "training.md"
SIZE = 16


def own_picture(seed: int) -> tuple[np.ndarray, Intrinsics]:
    """A ball with roughness and metallic maps: its picture (h, w, 4) and all maps."""
    rng = np.random.default_rng(seed)
    shape = sphere(SIZE, rng)
    albedo, normal, mask = shape.require("albedo", "normal", "mask").values()
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, SIZE, dtype=np.float32)[:, None], (SIZE, SIZE, 1)) * mask
    environment = rng.uniform(0, 2, (16, 32, 3)).astype(np.float32)
    light = {"diffuse": diffuse_light(normal, environment), "specular": specular_light(normal, 0.5, environment)}
    maps = shape.replace(roughness=ramp, metallic=ramp[::-1], environment=environment, **light)
    image = composite(albedo, ramp[::-1], light["diffuse"], light["specular"]) * mask
    return np.concatenate([image, mask], axis=-1), maps


def written(folder: Path, pictures: dict[str, tuple[np.ndarray, Intrinsics]], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the page's Python writes."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = (block for block in blocks if "mine/shard" in block)
    (folder / "mine").mkdir()
    monkeypatch.chdir(folder)
    exec(code, {"pictures": pictures})
    return folder / "mine"


def test_own_renders_are_read_back_as_they_were(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = {"mug": own_picture(0), "cup": own_picture(1)}
    dataset = GroupDataset(written(tmp_path, pictures, monkeypatch))
    assert (dataset.keys, dataset.resolution) == (("mug", "cup"), (SIZE, SIZE))
    image, maps = pictures["cup"]
    found_image, found = dataset.stored(1, dataset.pairs(1)[0])
    np.testing.assert_allclose(found_image, image[..., :3], rtol=2e-3, atol=2e-3)  # half floats
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment", "mask"):
        expected = getattr(maps, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=2e-3, atol=2e-3, err_msg=name)


def test_a_key_with_a_dot_is_not_taken_for_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the page says: WebDataset cuts keys at the first dot."""
    folder = written(tmp_path, {"a.1": own_picture(0), "a.2": own_picture(1)}, monkeypatch)
    with pytest.raises(UnirenderError, match=r"group a: unknown member '1\.json'"):
        GroupDataset(folder)
