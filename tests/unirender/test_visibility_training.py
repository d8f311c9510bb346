"""What the network of shadows learns from, and its training: sorted rays, other views of them, resumed runs."""

import dataclasses
import io
import json
import logging
import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from seen_shapes import CAMERA, ball, gutter
from synthetic_shards import write_shard

from unirender import cli
from unirender.errors import UnirenderError, UsageError
from unirender.exr import exr_bytes, intrinsics_channels
from unirender.intrinsics import Intrinsics
from unirender.light.lobes import texel_directions
from unirender.models.visibility import CLASSES, VisibilityNet, bin_weights
from unirender.system.whole_files import file_sha256
from unirender.training.loop import checkpoint
from unirender.training.loop.checkpoint import load_state
from unirender.training.shadows.command import TrainVisibility, rate, split, train_visibility
from unirender.training.shadows.loss import terms
from unirender.training.shadows.rays import DIRECTIONS, STEPS, VisibilityItem, _prepare, look_at, read_items

SIZE = 32


def rays_of(normal: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """As if each pixel saw all above its own surface but what lies to the right below 45 degrees."""
    directions = texel_directions(DIRECTIONS)
    n = normal[mask[..., 0] >= 0.5]
    wall = (directions[0] > 0.3) & (directions[2] < directions[0])
    return (n @ directions > 0) & ~wall


def item(kind: str = "gutter") -> VisibilityItem:
    normal, mask, _ = (ball if kind == "ball" else gutter)(SIZE)
    found = look_at(normal, mask, CAMERA, rays_of(normal, mask))
    assert found is not None
    return found


def write_rays(folder: Path, kinds: str = "ball gutter gutter ball") -> Path:
    groups = {}
    for number, kind in enumerate(kinds.split()):
        normal, mask, _ = (ball if kind == "ball" else gutter)(SIZE)
        stored = io.BytesIO()
        np.save(stored, np.packbits(rays_of(normal, mask), axis=1))
        channels = intrinsics_channels(Intrinsics(albedo=0 * normal, normal=normal, mask=mask))
        groups[f"{kind}{number}"] = {
            "shared.exr": exr_bytes(channels),
            "visible.npy": stored.getvalue(),
            "json": json.dumps({"vary": "visibility"}).encode(),
        }
    folder.mkdir(parents=True, exist_ok=True)
    write_shard(folder / "shard-000000.tar", groups)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rays(tmp_path_factory.mktemp("rays"))


def test_rays_are_sorted_by_class_and_bin() -> None:
    found = item()
    assert found.weight.shape == found.hidden.shape == (SIZE * SIZE, len(CLASSES), 48)
    assert (found.hidden <= found.weight).all()
    directions = texel_directions(DIRECTIONS)
    n = found.normal[found.surface].astype(np.float32)
    cosine = np.maximum(n @ directions, 0)
    every = np.zeros(cosine.shape, np.int64)
    hidden = bin_weights(np.where(rays_of(n[None], np.ones((1, len(n), 1))), 0, cosine), every, directions)[:, 0]
    assert np.abs(found.hidden.sum(axis=1) / STEPS - hidden).max() < 0.2  # of texels; rounded
    assert found.hidden.sum() > 0.1 * found.weight.sum()


def test_another_view_of_rays_is_the_view_of_other_rays() -> None:
    """Turned and mirrored, the bins are those of directions that were turned and mirrored."""
    found, directions = item(), texel_directions((64, 128))
    for turns, mirror in ((1, False), (0, True), (3, True)):
        seen = found.turned(turns, mirror)
        n = seen.normal[seen.surface]
        classes = np.zeros((len(n), directions.shape[1]), np.int64)
        expected = bin_weights(np.maximum(n @ directions, 0), classes, directions)[:, 0]
        own = seen.weight.sum(axis=1) / STEPS
        error = np.abs(own / own.sum(axis=1, keepdims=True) - expected / expected.sum(axis=1, keepdims=True)).mean()
        assert error < 0.004
        assert seen.hidden.sum() == found.hidden.sum()
    for seen in (found.turned(4, False), found.turned(2, True).turned(2, True)):
        np.testing.assert_array_equal(seen.hidden, found.hidden)
        np.testing.assert_array_equal(seen.normal, found.normal)
    # what is hidden lies to the right, and after a quarter turn above
    right, above = (found.turned(turns, False).hidden.sum(axis=(0, 1)).reshape(6, 8).sum(axis=0) for turns in (0, 1))
    assert right.argmax() in (0, 7)
    assert above.argmax() in (1, 2)


def test_at_half_the_size_there_are_the_same_rays() -> None:
    found = item("ball")
    half = found.halved()
    assert half.surface.shape == (SIZE // 2, SIZE // 2)
    assert half.surface.sum() == pytest.approx(found.surface.sum() / 4, rel=0.15)
    assert len(half.weight) == half.surface.sum()
    np.testing.assert_allclose(np.linalg.norm(half.normal[half.surface], axis=1), 1, rtol=1e-5)
    per_pixel = [part.hidden.sum(axis=(1, 2)).mean() for part in (half, found)]
    assert per_pixel[0] == pytest.approx(per_pixel[1], rel=0.1)


def test_a_folder_is_looked_at_once(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        items, shards = read_items(folder)
        assert [one.object for one in items] == ["ball0", "gutter1", "gutter2", "ball3"]
        assert list(shards) == ["shard-000000.tar"]
        again, _ = read_items(folder)
    assert sum("looking at the objects" in record.message for record in caplog.records) <= 1
    for one, other in zip(items, again, strict=True):
        np.testing.assert_array_equal(one.weight, other.weight)
    own = item()  # with normals that were not stored in half precision
    assert np.abs(items[1].hidden.astype(int) - own.hidden).mean() < 0.05 < own.hidden.mean()


def test_a_shard_of_pictures_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "shard-000000.tar"
    write_shard(path, {"a": {"shared.exr": b"", "json": b"{}"}})
    with pytest.raises(UnirenderError, match="--vary visibility"):
        _prepare(path, file_sha256(path))  # in this process: none to start


def test_a_damaged_shard_of_rays_is_refused(tmp_path: Path, folder: Path) -> None:
    path = tmp_path / "shard-000000.tar"
    whole = (folder / path.name).read_bytes()
    path.write_bytes(whole.replace(b"NUMPY\x01", b"NUMPY\x09", 1))
    with pytest.raises(UnirenderError, match=r"shard-000000\.tar: sha256 is .*, the manifest says"):
        _prepare(path, file_sha256(folder / path.name))
    with pytest.raises(UnirenderError, match=r"group ball0\.visible\.npy: cannot be read .*; remake the shard"):
        _prepare(path, file_sha256(path))


@pytest.mark.parametrize("kept", [0, 300])
def test_damaged_rays_of_the_cache_are_named(tmp_path: Path, kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    path = write_rays(tmp_path / "rays", "ball") / "shard-000000.tar"
    _prepare(path, file_sha256(path))
    (stored,) = (tmp_path / "cache").rglob("items.npz")
    stored.write_bytes(stored.read_bytes()[:kept])
    with pytest.raises(UnirenderError, match=r"this folder of the cache is damaged \(.*\); delete it"):
        read_items(path.parent)


def test_the_loss_is_that_of_the_equations() -> None:
    """At the network's first answer, the same for all pixels, by a loop; and no network is better than the truth."""
    net, found = VisibilityNet(), item()
    bce, error = terms(net, found, torch.Generator().manual_seed(0))
    p = np.array([0.75, 0.45, 0.06])[None, :, None]
    w, h = found.weight / 1.0, found.hidden / 1.0
    assert bce.item() == pytest.approx(-(h * np.log(p) + (w - h) * np.log(1 - p)).sum() / w.sum(), rel=1e-4)
    exact = VisibilityItem(found.normal, found.surface, found.depth, found.weight, (w * p).astype(np.float32))
    _, least = terms(net, exact, torch.Generator().manual_seed(0))
    assert least.item() == pytest.approx(np.log(1e-4), abs=0.01)
    assert error.item() > least.item() + 1


def test_it_learns_what_is_hidden(tmp_path: Path, folder: Path) -> None:
    out = tmp_path / "run"
    weights = train_visibility(TrainVisibility(folder, out, steps=30, batch_size=2, halved=0.0))
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 30
    net = VisibilityNet()
    before, _ = terms(net, item(), torch.Generator().manual_seed(0))
    net.load_state_dict({name: value.float() for name, value in load_file(weights).items()})
    after, _ = terms(net, item(), torch.Generator().manual_seed(0))
    assert after.item() < before.item() - 0.02


def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"steps": 4, "batch_size": 2}
    whole = train_visibility(TrainVisibility(folder, tmp_path / "whole", **options))
    from unirender.training.shadows import command as visibility

    calls, write = [], checkpoint.save_state

    def killed_at_the_end(folder: Path, state: dict[str, Any]) -> Path:
        path = write(folder, state)
        if state["step"] == options["steps"]:
            raise KeyboardInterrupt
        return path

    def asked_after_two(*arguments: object) -> float:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return rate(*arguments)  # pyright: ignore[reportArgumentType] - as it is called

    monkeypatch.setattr(visibility, "SAVE_SECONDS", 0.0)
    monkeypatch.setattr(visibility, "rate", asked_after_two)
    with pytest.raises(KeyboardInterrupt):
        train_visibility(TrainVisibility(folder, tmp_path / "stopped", **options))
    monkeypatch.setattr(visibility, "rate", rate)
    monkeypatch.setattr(checkpoint, "save_state", killed_at_the_end)
    with pytest.raises(KeyboardInterrupt):
        train_visibility(TrainVisibility(folder, tmp_path / "stopped", **options))
    stopped = train_visibility(TrainVisibility(folder, tmp_path / "stopped", **options))
    assert stopped.read_bytes() == whole.read_bytes()
    assert {path.name for path in stopped.parent.iterdir()} == {path.name for path in whole.parent.iterdir()}
    steps = [json.loads(line)["step"] for line in (tmp_path / "stopped" / "log.jsonl").read_text().splitlines()]
    assert steps == [0, 1, 2, 3, 4]
    stopped.unlink()  # as if the disk had been full after the last state
    assert train_visibility(TrainVisibility(folder, tmp_path / "stopped", **options)).read_bytes() == whole.read_bytes()
    with pytest.raises(UnirenderError, match="a run with batch_size 2 instead of 3; repeat the options"):
        train_visibility(TrainVisibility(folder, tmp_path / "stopped", steps=4, batch_size=3))


def test_asked_to_stop_it_saves_and_the_status_tells_by_what(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from unirender.training.shadows import command as visibility

    def asked(*arguments: object) -> float:
        os.kill(os.getpid(), signal.SIGTERM)
        return rate(*arguments)  # pyright: ignore[reportArgumentType] - as it is called

    monkeypatch.setattr(visibility, "rate", asked)
    with pytest.raises(SystemExit) as stopped:
        cli.main(["train-visibility", "--data", str(folder), "--out", str(tmp_path / "run"), "--batch-size", "1"])
    assert stopped.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err.endswith("unirender: interrupted; run the same command again to go on\n")
    assert load_state(tmp_path / "run")["step"] == 1  # pyright: ignore[reportOptionalSubscript] - it was saved


def test_a_gradient_that_is_not_finite_ends_the_run(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(UnirenderError, match=r"the gradient at step \d is (nan|inf); begin anew with a lower"):
        train_visibility(TrainVisibility(folder, tmp_path, steps=8, batch_size=1, learning_rate=1e30))


def test_options_are_checked(tmp_path: Path) -> None:
    wrong = ({"steps": 0}, "--steps 0"), ({"halved": 1.5}, "--halved 1.5"), ({"batch_size": -1}, "--batch-size -1")
    wrong += ({"learning_rate": math.inf}, "--learning-rate inf"), ({"seed": -1}, "--seed -1")
    for change, named in wrong:
        with pytest.raises(UsageError, match=named):
            TrainVisibility(tmp_path, tmp_path, **change).run()  # pyright: ignore[reportArgumentType] - from tests
    with pytest.raises(UnirenderError, match="no such data folder"):
        TrainVisibility(tmp_path / "none", tmp_path).run()


def test_objects_are_held_out() -> None:
    items = [item("ball")] * 60
    own = [VisibilityItem(*vars(one).values()) for one in items]
    learned, held_out = split(own)
    assert (len(learned), len(held_out)) == (58, 2)
    views = [dataclasses.replace(one, object=f"mesh{number // 2}") for number, one in enumerate(own)]
    learned, held_out = split(views)
    assert [one.object for one in held_out] == ["mesh24", "mesh24"]  # seen from two sides, and learned from neither
    assert {one.object for one in learned} == {f"mesh{number}" for number in range(30)} - {"mesh24"}
    alone = own[:1]
    assert split(alone) == (alone, alone)
