"""A user's own folder as a pool: its division, its draws, its broken files; and which maps show one place."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from environments import smooth_environment
from PIL import Image

from unirender.errors import UnirenderError
from unirender.exr import write_environment
from unirender.light.resampling import resample_environment
from unirender_reference import lights
from unirender_reference.lights.draw import SHARES
from unirender_reference.lights.pool import TRIES, divide
from unirender_reference.lights.twins import SAME_PLACE, likeness, most_alike


def write_photograph(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    blocks = np.random.default_rng(seed).integers(20, 236, (6, 9, 3), np.uint8)
    Image.fromarray(blocks.repeat(8, 0).repeat(8, 1)).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """20 places: 18 photographs in two folders, and two maps, one of them at two sizes with a preview."""
    for number in range(18):
        write_photograph(tmp_path / "pool" / ("b" if number % 2 else "a") / f"photo {number:02}.jpg", number)
    for name in ("hall_1k.exr", "hall_4k.exr", "street.exr"):
        write_environment(tmp_path / "pool" / name, smooth_environment(16, 32))
    write_photograph(tmp_path / "pool" / "hall.png", 99)
    (tmp_path / "pool" / "readme.txt").write_text("no light")
    (tmp_path / "pool" / ".hidden.png").write_bytes(b"")
    return tmp_path / "pool"


@pytest.mark.parametrize("holdout", [2, 4, 8])
def test_every_nth_place_is_for_test_and_none_is_on_both_sides(folder: Path, holdout: int) -> None:
    sides = divide(folder, holdout)
    names = [*sides["train"], *sides["test"]]
    assert len(names) == len(set(names)) == 22  # files: 18 + 3 + 1
    places = {side: {"hall" if "hall" in name else name for name in names} for side, names in sides.items()}
    assert not places["train"] & places["test"]
    assert len(places["test"]) == 20 // holdout
    assert sides == divide(str(folder), holdout)


def test_the_order_is_by_folder_and_name(folder: Path) -> None:
    in_a = [f"a/photo {number:02}.jpg" for number in range(0, 18, 2)]
    in_b = [f"b/photo {number:02}.jpg" for number in range(1, 18, 2)]
    assert divide(folder, 2) == {
        "train": ("hall.png", "hall_1k.exr", "hall_4k.exr", *in_a[::2], *in_b[1::2]),
        "test": ("street.exr", *in_a[1::2], *in_b[::2]),
    }


def test_draws_repeat_and_come_from_their_own_side(folder: Path) -> None:
    drawn = {}
    for split in ("train", "test"):
        pool = lights.light_pool(folder, split, holdout=4)
        made = [lights.make_light(seed, split, pool) for seed in range(60)]
        again = [lights.make_light(seed, split, pickle.loads(pickle.dumps(pool))) for seed in range(60)]
        for light, same in zip(made, again, strict=True):
            np.testing.assert_array_equal(light.environment, same.environment)
            assert light.environment.shape == (64, 128, 3)
        own = [light for light in made if light.provenance["kind"] == "pool"]
        assert 18 <= len(own) <= 42  # half of 60; sigma 3.9
        assert all(light.name.startswith(f"{split}-0000") for light in own)
        drawn[split] = {light.provenance["file"] for light in own}
        assert drawn[split] <= set(pool.names)
    assert not drawn["train"] & drawn["test"]


def test_the_other_seeds_give_what_they_give_without_a_pool(folder: Path) -> None:
    pool = lights.light_pool(folder, "train", share=0.3)
    kinds = []
    for seed in range(40):
        light, plain = lights.make_light(seed, "train", pool), lights.make_light(seed, "train")
        kinds.append(light.provenance["kind"])
        if kinds[-1] in SHARES:
            np.testing.assert_array_equal(light.environment, plain.environment)
            assert (light.name, light.provenance) == (plain.name, plain.provenance)
        else:
            assert not np.array_equal(light.environment, plain.environment)
    assert 4 <= kinds.count("pool") <= 20  # 0.3 of 40; sigma 2.9
    everything = lights.light_pool(folder, "train", share=1)
    assert {lights.make_light(seed, "train", everything).provenance["kind"] for seed in range(20)} == {"pool"}


def test_one_file_comes_turned_and_mirrored(tmp_path: Path) -> None:
    write_photograph(tmp_path / "photo.png", 3)
    pool = lights.light_pool(tmp_path, "train", share=1)
    made = [lights.make_light(seed, "train", pool).environment for seed in range(6)]
    assert len({environment.tobytes() for environment in made}) == 6
    assert min(likeness(made[0], other) for other in made[1:]) > SAME_PLACE - 0.2  # tilted ones are alike, less


def test_a_broken_file_is_passed_over_named_and_does_not_move_other_draws(folder: Path) -> None:
    pool = lights.light_pool(folder, "train", share=1)
    before = {seed: lights.make_light(seed, "train", pool) for seed in range(40)}
    broken = before[0].provenance["file"]
    (folder / broken).write_bytes(b"hello")
    for seed, light in before.items():
        now = lights.make_light(seed, "train", pool)
        if light.provenance["file"] == broken:
            assert now.provenance["file"] != broken
            assert now.provenance["skipped"].startswith(f"{broken}: not a readable")
            assert str(folder) not in now.provenance["skipped"]
            assert "not a readable" in now.provenance["skipped"]
        else:
            np.testing.assert_array_equal(now.environment, light.environment)
            assert "skipped" not in now.provenance
    checked = dict(pool.check())
    assert [name for name, light in checked.items() if isinstance(light, UnirenderError)] == [broken]
    assert set(checked) == set(pool.names)


def test_a_pool_of_broken_files_is_an_error(tmp_path: Path) -> None:
    for number in range(TRIES + 5):
        (tmp_path / f"{number:02}.png").write_bytes(b"hello")
    pool = lights.light_pool(tmp_path, "train", share=1)
    with pytest.raises(UnirenderError, match=f"none of {TRIES} train files drawn is a light.*the first: .*readable"):
        lights.make_light(0, "train", pool)


def test_the_digest_follows_what_draws_depend_on(folder: Path) -> None:
    digests = {lights.light_pool(folder, "train").digest, lights.light_pool(folder, "test").digest}
    digests |= {lights.light_pool(folder, "train", share=0.4).digest, lights.light_pool(folder, "train", 4).digest}
    assert lights.light_pool(folder, "train").digest in digests
    write_photograph(folder / "zz.png", 7)
    digests.add(lights.light_pool(folder, "train").digest)
    assert len(digests) == 5


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: lights.light_pool(folder / "absent", "train"), "no such folder"),
        (lambda folder: lights.light_pool(folder, "train", holdout=1), "expected at least 2"),
        (lambda folder: lights.light_pool(folder, "train", share=0), "more than 0 and at most 1"),
        (lambda folder: lights.light_pool(folder, "test", holdout=50), "expected at least 50"),
        (lambda folder: lights.make_light(0, "test", lights.light_pool(folder, "train")), "got a train pool"),
    ],
)
def test_errors_say_what_was_expected(folder: Path, make: Callable[[Path], object], words: str) -> None:
    with pytest.raises(UnirenderError, match=words):
        make(folder)


def leaks(train: list[lights.Light], test: list[lights.Light]) -> list[str]:
    """Test lights that show a place of the train side, by their content."""
    return [pair.first for pair in most_alike(test, train) if pair.value >= SAME_PLACE]


def test_no_bundled_place_is_on_both_sides_by_content() -> None:
    assert leaks(lights.bundled_lights("train"), lights.bundled_lights("test")) == []


def test_twin_a_turned_and_mirrored_copy_on_the_other_side_is_found() -> None:
    train, test = lights.bundled_lights("train"), lights.bundled_lights("test")
    for number in (0, 7, 13):
        copy = np.roll(train[number].environment, 37 + number, axis=1)[:, ::-1].copy()
        smaller = resample_environment(copy, (48, 96))
        assert leaks(train, [*test, lights.Light("copy", copy), lights.Light("smaller", smaller)]) == [
            "copy",
            "smaller",
        ]


def test_twin_the_same_capture_of_another_package_is_found() -> None:
    """`sunrise` is in both packages: it would leak if its two maps were on two sides."""
    train = [light for light in lights.bundled_lights("train") if light.name != "blender-sunrise"]
    assert leaks(train, [lights.bundled_light("blender-sunrise")]) == ["blender-sunrise"]


def test_likeness_is_one_for_a_copy_and_none_for_even_light() -> None:
    forest, studio = (lights.bundled_light(f"pmndrs-{name}").environment for name in ("forest", "studio"))
    assert likeness(forest, np.roll(forest, 20, axis=1)) == pytest.approx(1, abs=1e-6)
    assert likeness(forest, 3 * forest[:, ::-1]) == pytest.approx(1, abs=1e-4)
    assert abs(likeness(forest, studio)) < 0.2
    assert likeness(np.ones((64, 128, 3), np.float32), forest) == 0
