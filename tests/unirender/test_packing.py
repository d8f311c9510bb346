"""What shards may not hold is refused when they are packed, with shard, group and member; rounding is not refused."""

import functools
import io
import json
import re
import resource
import shutil
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from synthetic_shards import group_members, maps_members, write_shard

from unirender.errors import UnirenderError
from unirender.exr import read_exr_bytes
from unirender.training.augmentations.augment import DEFAULT_AUGMENTATION
from unirender.training.data.dataset import GroupDataset, make_batch
from unirender.training.data.derived import _derive
from unirender.training.data.groups import read_groups
from unirender.training.data.packing import Packer

Members = dict[str, bytes]
IMAGE = "l0.m050_r040.exr"


@functools.cache  # nobody changes them
def members(vary: str = "basis", size: int = 16) -> Members:
    return group_members(vary, size, 1, (40,), (0, 50, 100), 7)


def raw(channels: dict[str, np.ndarray], half: bool = False, **attributes: str) -> bytes:
    """An EXR of any values, as other programs write them."""
    stored = {n: np.ascontiguousarray(v, np.float16 if half else np.float32) for n, v in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File(header | {f"unirender:{k}": v for k, v in attributes.items()}, stored).write(stream)
    return stream.getvalue()


def altered(name: str, change: Callable[[dict[str, np.ndarray]], object], half: bool = False, **attributes: str):
    """A group one of whose files has other values."""
    found = members()
    channels = {channel: value.copy() for channel, value in read_exr_bytes(found[name])[0].items()}
    change(channels)
    return found | {name: raw(channels, half, **attributes)}


def times(channel: str, factor: float, plus: float = 0.0) -> Callable[[dict[str, np.ndarray]], object]:
    return lambda channels: channels.update({channel: channels[channel] * factor + plus})


def one(channel: str, value: float) -> Callable[[dict[str, np.ndarray]], object]:
    return lambda channels: channels[channel].__setitem__((3, 5), value)


def as_colours(channels: dict[str, np.ndarray]) -> None:
    channels.update({name: 0.5 * v + 0.5 for name, v in channels.items() if name.startswith("normal")})


def shorter(channels: dict[str, np.ndarray]) -> None:
    channels.update({name: 0.5 * v for name, v in channels.items() if name.startswith("normal")})


def square(channels: dict[str, np.ndarray]) -> None:
    channels.update({name: v[:, :8] for name, v in channels.items()})


def described(**changes: object) -> Members:
    return members() | {"json": json.dumps({"vary": "basis"} | changes).encode()}


def without(name: str) -> Members:
    return {n: data for n, data in members().items() if n != name}


def named(old: str, new: str) -> Members:
    return {name.replace(old, new): data for name, data in members().items()}


CASES: dict[str, tuple[Callable[[], Members], str]] = {
    "albedo": (lambda: altered("shared.exr", times("albedo.R", 0, 3)), r"shared.exr: albedo: got values in \[0, 3\]"),
    "albedo below 0": (lambda: altered("shared.exr", times("albedo.G", -1)), r"expected \[0, 1\]"),
    "albedo nan": (lambda: altered("shared.exr", one("albedo.R", np.nan)), "shared.exr: albedo: 1 of 768 values"),
    "mask": (lambda: altered("shared.exr", times("mask.Y", 255)), r"shared.exr: mask: got values in \[0, 255\]"),
    "no mask": (lambda: altered("shared.exr", times("mask.Y", 0)), "shared.exr: mask: no pixel has coverage above 0.5"),
    "colours": (
        lambda: altered("shared.exr", as_colours),
        r"normal: .* map \[0, 1\] pictures with 2 x - 1",
    ),
    "short": (lambda: altered("shared.exr", shorter), r"have a length of 0\.500, expected 1; normalise"),
    "light nan": (lambda: altered("l0.environment.exr", one("R", np.inf)), "l0.environment.exr: environment: 1 of"),
    "light below 0": (lambda: altered("l0.environment.exr", times("R", -1)), "expected radiance >= 0"),
    "light square": (
        lambda: altered("l0.environment.exr", square),
        "is 8 x 8 texels, .* twice as wide as high",
    ),
    "picture": (lambda: altered(IMAGE, times("R", 1, -5)), rf"{IMAGE}: got a minimum of -5, expected radiance >= 0"),
    "background": (
        lambda: altered(IMAGE, times("R", 1, 0.1)),
        rf"{IMAGE}: shows its background \(median radiance 0.1 where the mask is 0\), .* multiply it by the coverage",
    ),
    "picture nan": (lambda: altered(IMAGE, one("R", np.nan)), rf"{IMAGE}: 1 of 768 values are NaN or infinite"),
    "picture size": (
        lambda: members() | {IMAGE: members(size=8)[IMAGE]},
        rf"{IMAGE}: is 8 x 8 pixels, expected 16 x 16, the size of shared.exr",
    ),
    "shared size": (
        lambda: members() | {"shared.exr": members(size=8)["shared.exr"]},
        "l0.diffuse.exr: is 16 x 16 pixels, expected 8 x 8, the size of shared.exr",
    ),
    "camera": (
        lambda: altered(IMAGE, times("R", 1), camera="fov_deg=90 principal=0.3,0.5"),
        rf"{IMAGE}: was taken by the camera fov_deg=90 principal=0.3,0.5, expected fov_deg=36 principal=0.5,0.5",
    ),
    "camera of the json": (
        lambda: described(camera={"fov_deg": 50, "principal": [0.5, 0.5]}),
        "json: was taken by the camera fov_deg=50",
    ),
    "roughness 3": (lambda: named("r040", "r300"), "r300.exr says 300 percent, expected 0 to 100"),
    "metallic 1.5": (lambda: named("m100", "m150"), "m150_r040.exr says 150 percent"),
    "typo": (lambda: described(vary="bsais"), "json: vary is 'bsais', expected one of basis, independent"),
    "vary null": (lambda: described(vary=None), "json: vary is None, expected one of"),
    "no vary": (lambda: members() | {"json": b"{}"}, "json: the entry vary is missing, expected one of basis"),
    "broken json": (lambda: members() | {"json": b"{not"}, "json: cannot be read as JSON"),
    "json list": (lambda: members() | {"json": b"[]"}, r"json: got \[\], expected an object"),
    "no pictures": (lambda: {n: members()[n] for n in ("shared.exr", "json")}, "has no picture, expected at least one"),
    "one picture twice": (
        lambda: members() | {"l0.m50_r40.exr": members()["l0.m050_r040.exr"]},
        "two members are the same picture, like m050_r030 and m50_r30",
    ),
    "no light": (lambda: without("l0.environment.exr"), r"l0.environment.exr is missing, which l0.m000_r040.exr needs"),
    "no s": (lambda: without("l0.r040.specular.exr"), r"l0.r040.specular.exr is missing, which l0.m000_r040.exr needs"),
    "no albedo": (
        lambda: altered("shared.exr", lambda channels: channels.pop("albedo.R")),
        "shared.exr: EXR channels albedo.R missing; the file has .* `Your own renders`",
    ),
    "basis of maps": (
        lambda: maps_members(16, 1, 0) | {"json": b'{"vary": "basis"}'},
        "vary is basis and the pictures have the object's own roughness and metallic maps, .* write vary independent",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_the_contract_does_not_allow_is_named(case: str) -> None:
    make, message = CASES[case]
    with pytest.raises(UnirenderError, match=message) as caught:
        Packer("some.tar").add("a_g0", make())
    assert str(caught.value).startswith("some.tar: group a_g0")


def test_own_roughness_out_of_range_is_named() -> None:
    found = maps_members(16, 1, 0)
    channels = dict(read_exr_bytes(found["shared.exr"])[0])
    times("roughness.Y", 255)(channels)
    with pytest.raises(UnirenderError, match=r"shared.exr: roughness: got values in \[0, 202\.4\]"):
        Packer("some.tar").add("a", found | {"shared.exr": raw(channels, half=True)})


@pytest.mark.parametrize(
    "make",
    [
        lambda: altered("shared.exr", times("mask.Y", 1.0004), half=True),
        lambda: altered("shared.exr", times("normal.Z", 1.0004), half=True),
        lambda: altered(IMAGE, times("R", 1, -5e-4)),
        lambda: altered(IMAGE, times("R", 1, -0.3), interpolated="from metallic 0 0.5 1"),
        lambda: altered(IMAGE, times("R", 1), camera="fov_deg=36.0 principal=0.50,0.5"),
        lambda: altered(IMAGE, times("R", 1), camera="Camera.001"),  # another program's
    ],
)
def test_rounding_and_the_noise_of_sweeps_are_taken(make: Callable[[], Members]) -> None:
    assert len(Packer("some.tar").add("a", make()).pairs) == 3


def test_noise_outside_the_mask_is_taken() -> None:
    Packer("some.tar").add("a_g0", altered(IMAGE, one("R", 5.0)))


def test_normals_of_a_silhouette_are_taken_at_length_one() -> None:
    """Averages of a pixel are shorter; what a shard of ours holds stays as it is, to the bit."""
    shared = read_exr_bytes(members()["shared.exr"])[0]
    row = np.flatnonzero(shared["mask.Y"][8])[0]

    def at_the_edge(channels: dict[str, np.ndarray]) -> None:
        for name in "XYZ":
            channels[f"normal.{name}"][8, row] *= 0.8

    packer = Packer("some.tar")
    for key, found in (("a", members()), ("b", altered("shared.exr", at_the_edge))):
        packer.add(key, found)
    own, mended = packer.arrays()["shared"][:, 3:6]
    np.testing.assert_allclose(np.linalg.norm(mended[:, 8, row]), 1, atol=1e-3)
    np.testing.assert_array_equal(own, np.stack([shared[f"normal.{name}"] for name in "XYZ"]).astype(np.float16))


def test_groups_with_and_without_maps_lie_in_one_shard(tmp_path: Path) -> None:
    mixed, alone = tmp_path / "mixed", tmp_path / "alone"
    for folder, groups in (
        (mixed, {"a": members(), "b": maps_members(16, 1, 5)}),
        (alone, {"b": maps_members(16, 1, 5)}),
    ):
        folder.mkdir()
        write_shard(folder / "shard-000000.tar", groups)
    data, other = GroupDataset(mixed), GroupDataset(alone)
    image, scalar = data.stored(0, data.pairs(0)[1])
    assert image.shape == (16, 16, 3)
    roughness, mask = scalar.require("roughness", "mask").values()
    assert np.unique(roughness[mask > 0]) == np.float32(0.4)
    np.testing.assert_array_equal(
        data.stored(1, data.pairs(1)[0])[1].require("metallic")["metallic"],
        other.stored(0, other.pairs(0)[0])[1].require("metallic")["metallic"],
    )


def test_other_sizes_are_named_with_both_groups(tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-000000.tar", {"a": members(), "b": members(size=8)})
    with pytest.raises(UnirenderError, match=r"group b\.shared.exr: is 8 x 8 pixels, expected 16 x 16, .* of group a"):
        GroupDataset(tmp_path)


def test_sizes_and_keys_of_several_shards_are_named_with_their_shards(tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-000000.tar", {"a": members()})
    write_shard(tmp_path / "shard-000001.tar", {"b": members(size=8)})
    with pytest.raises(UnirenderError, match=r"sizes 8 x 8 \(shard-000001.tar\), 16 x 16 \(shard-000000.tar\), exp"):
        GroupDataset(tmp_path)
    write_shard(tmp_path / "shard-000001.tar", {"a": members("independent")})
    twice = r"1 groups occur twice \(a in shard-000000.tar, shard-000001.tar\), expected each key once in a folder and"
    with pytest.raises(UnirenderError, match=twice):
        GroupDataset(tmp_path)


def test_meshes_of_one_name_in_two_parts_are_two_objects(tmp_path: Path) -> None:
    """`chair.glb` of one catalogue and of another, or one object of other materials; a copy of a part is none."""
    parts = {
        "one": members(),
        "other": group_members("basis", 16, 1, (40,), (0, 50, 100), 1),
        "rough": group_members("independent", 16, 1, (80,), (0,), 0),
        "smooth": group_members("independent", 16, 1, (40,), (0,), 0),
    }
    for part, group in parts.items():
        (tmp_path / part).mkdir()
        write_shard(tmp_path / part / "shard-000000.tar", {"chair-0123_g0": group})
    assert GroupDataset(tmp_path).keys == ("chair-0123_g0",) * 4
    shutil.copytree(tmp_path / "one", tmp_path / "copy")
    with pytest.raises(UnirenderError, match=r"twice \(chair-0123_g0 in copy/shard-.*, one/shard-.*no copies; take"):
        GroupDataset(tmp_path)


def test_members_that_do_not_stand_together_are_named(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "shard-000000.tar", "w") as tar:
        for name in ("a.shared.exr", "b.shared.exr", "a.json"):
            tar.addfile(tarfile.TarInfo(name), io.BytesIO())
    with pytest.raises(UnirenderError, match="group a occurs twice, or other members stand between its own"):
        list(read_groups(tmp_path / "shard-000000.tar"))


@pytest.mark.parametrize("end", ["emptied", "others", "gone", "cut", "without content", "of another kind"])
def test_a_damaged_cache_is_named(tmp_path: Path, end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    write_shard(tmp_path / "shard-000000.tar", {"a": members()})
    GroupDataset(tmp_path)
    (index,) = (tmp_path / "cache").rglob("index.json")
    if end == "emptied":
        index.write_text("")
    elif end == "others":
        index.write_text('[{"key": "a"}]')
    elif end == "gone":
        (index.parent / "pixels.npy").unlink()
    else:
        data = (index.parent / "pixels.npy").read_bytes()
        damaged = {"cut": data[:200], "without content": b"", "of another kind": data.replace(b"{", b"(", 1)}
        (index.parent / "pixels.npy").write_bytes(damaged[end])
    with pytest.raises(UnirenderError, match=r"packed/.*: this folder of the cache is damaged \(.*\); delete it"):
        GroupDataset(tmp_path)


def test_a_full_disk_has_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    write_shard(tmp_path / "shard-000000.tar", {"a": members()})
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # or it is cut off as well, and nothing imports it again
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, most))
    try:
        with pytest.raises(UnirenderError) as caught:
            GroupDataset(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))
    assert re.search(r"cannot be written \(\w.*\); free some space or set UNIRENDER_CACHE", str(caught.value))
    assert "(None)" not in str(caught.value)


@pytest.mark.parametrize("end", ["group", "member"])
def test_a_tar_that_was_cut_off_is_no_shorter_one(tmp_path: Path, end: str) -> None:
    shard = tmp_path / "shard-000000.tar"
    write_shard(shard, {"a": members("independent"), "b": members("independent")})
    whole = shard.read_bytes()
    cut = whole.index(b"b.shared.exr" if end == "group" else b"b.json")
    shard.write_bytes(whole[:cut])
    with pytest.raises(UnirenderError, match="without the two empty blocks that end a tar"):
        GroupDataset(tmp_path)
    shard.write_bytes(whole.rstrip(b"\0") + bytes(512 - len(whole.rstrip(b"\0")) % 512 + 1024))  # without more padding
    assert len(GroupDataset(tmp_path).keys) == 2


def test_a_light_without_pictures_is_no_other_lights(tmp_path: Path) -> None:
    found = group_members("independent", 16, 3, (40,), (50,), 3)
    lights = [read_exr_bytes(found[f"l{i}.environment.exr"])[0]["R"] for i in range(3)]
    unlit = {name: data for name, data in found.items() if not name.startswith("l0.") or "environment" in name}
    write_shard(tmp_path / "shard-000000.tar", {"a": found, "b": unlit})
    _derive(tmp_path / "shard-000000.tar", GroupDataset(tmp_path).shards[0])  # in this process: none to start
    data = GroupDataset(tmp_path, derived=True)
    for group, first in ((0, 0), (1, 1)):
        for number, pair in enumerate(data.pairs(group)):
            np.testing.assert_array_equal(data.whole_light(group, pair)[..., 0], lights[first + number])
    assert data.derived is not None
    a, b = (data.pairs(group)[-1] for group in (0, 1))
    derived = data.derived[0]
    np.testing.assert_array_equal(derived.of([a.diffuse], False), derived.of([b.diffuse], False))


def test_an_object_without_light_is_named(tmp_path: Path) -> None:
    dark = {name: np.zeros((16, 16), np.float32) for name in ("diffuse.R", "diffuse.G", "diffuse.B")}
    write_shard(tmp_path / "shard-000000.tar", {"a": members() | {"l0.diffuse.exr": raw(dark, half=True)}})
    with pytest.raises(UnirenderError, match=r"shard-000000.tar: group a: exposure: the white-diffuse level is 0"):
        make_batch(GroupDataset(tmp_path), 0, 1, 0, DEFAULT_AUGMENTATION)
