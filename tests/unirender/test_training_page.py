"""The page on training: shards that a stranger writes as it says are read back as they were."""

import re
from pathlib import Path

import numpy as np
import pytest
from synthetic_shards import own_picture

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.training.data.closed_form_check import doubt
from unirender.training.data.dataset import GroupDataset

PAGE = Path(__file__).resolve().parents[2] / "docs" / "training.md"


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
    assert (dataset.keys, dataset.resolution) == (("mug", "cup"), (16, 16))
    image, maps = pictures["cup"]
    found_image, found = dataset.stored(1, dataset.pairs(1)[0])
    np.testing.assert_allclose(found_image, image[..., :3], rtol=2e-3, atol=2e-3)  # half floats
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment", "mask"):
        expected = getattr(maps, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=2e-3, atol=2e-3, err_msg=name)


def test_pictures_that_are_no_pictures_of_their_maps_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is valid by itself: display values in place of linear ones; an exposure that the light has not."""
    picture, maps = own_picture(0)
    rgb, mask = picture[..., :3], picture[..., 3:]
    diffuse, specular = maps.require("diffuse", "specular").values()
    dim = maps.replace(diffuse=diffuse / 4, specular=specular / 4)
    wrong = {
        "display": (np.concatenate([srgb_encode(rgb / 4), mask], axis=-1), dim),
        "irradiance": (picture, maps.replace(diffuse=diffuse * np.float32(np.pi))),
        "unexposed": (np.concatenate([rgb / 2, mask], axis=-1), maps),
    }
    said = {}
    for name, own in {"right": (picture, maps), **wrong}.items():
        (tmp_path / name).mkdir()
        said[name] = doubt(GroupDataset(written(tmp_path / name, {"mug": own}, monkeypatch)))
    assert said.pop("right") is None
    assert all(said.values())
    assert "pictures are 0.5 times as bright as the closed form of their maps" in str(said["unexposed"])


def test_a_key_with_a_dot_is_not_taken_for_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the page says: WebDataset cuts keys at the first dot."""
    folder = written(tmp_path, {"a.1": own_picture(0), "a.2": own_picture(1)}, monkeypatch)
    with pytest.raises(UnirenderError, match=r"group a: unknown member '1\.json'"):
        GroupDataset(folder)
