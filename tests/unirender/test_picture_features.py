"""A clean image also enters through frozen features of VGG-16; a noisy one does not."""

import dataclasses
import functools
from pathlib import Path

import pytest
import torch
from both_directions import OneBatch, assert_each_counts, decompose, render
from safetensors.torch import save_file
from tiny_models import SIZE, TRAIN, make_batch, make_model

from unirender.errors import UnirenderError
from unirender.models.build import build_model
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.picture_features import STAGES, PictureFeatures, read_vgg, statistics
from unirender.models.split_streams import SplitDualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.export import export_pipeline
from unirender.training.start import begin_with_network, load_features
from unirender.training.trainer import Trainer
from unirender_evaluation.lpips import LpipsNetwork

FEATURED = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, picture_features="vgg16"))
BOTH = pytest.mark.parametrize("unified", [True, False], ids=["unified", "split"])
WIDTH = 24  # of a time embedding
CPU = torch.device("cpu")


@functools.cache
def vgg() -> LpipsNetwork:
    """VGG-16 by other hands, with random weights whose activations neither vanish nor grow."""
    torch.manual_seed(3)
    network = LpipsNetwork("vgg")
    for conv in network.convs:
        assert isinstance(conv, torch.nn.Conv2d)
        torch.nn.init.kaiming_normal_(conv.weight)
    return network.requires_grad_(False)


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that LPIPS-VGG has in the user's cache."""
    path = tmp_path / "cache" / "lpips" / "lpips_vgg.safetensors"
    path.parent.mkdir(parents=True)
    save_file(vgg().state_dict(), path)
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    return path


def featured(unified: bool = True) -> tuple[DualStreamModel, Conditioning]:
    """A network with everything at random, the way of the features into it too."""
    model, conditioning = make_model(unified=unified, picture_features="vgg16")
    for part in model.modules():
        if isinstance(part, PictureFeatures):
            part.load_vgg(vgg().state_dict())
    return model, conditioning


def muted(parts: tuple[DualStreamModel, Conditioning]) -> tuple[DualStreamModel, Conditioning]:
    """The same network as it is when its features are new."""
    for name, parameter in parts[0].named_parameters():
        if "vgg." in name:
            torch.nn.init.zeros_(parameter)
    return parts


# --- the features


def test_stages_are_those_of_the_perceptual_metric() -> None:
    """Which was written after another source: unit length over channels there, root mean square 1 here."""
    features = PictureFeatures((8, 8, 8, 8), 1, WIDTH)
    features.load_vgg(vgg().state_dict())
    picture = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    ours, theirs = features.stages(2 * picture - 1), vgg().features(picture)
    for x, y, widths in zip(ours, theirs, STAGES, strict=False):
        torch.testing.assert_close(x, y * widths[-1] ** 0.5, rtol=0.02, atol=0.02)


@pytest.mark.parametrize(("patch", "levels", "sizes"), [(1, 4, [32, 16, 8, 4]), (2, 2, [16, 8]), (4, 4, [8, 4])])
def test_a_stage_goes_to_the_level_of_its_size(patch: int, levels: int, sizes: list[int]) -> None:
    features = PictureFeatures([8] * levels, patch, WIDTH)
    features.load_vgg(vgg().state_dict())
    added = features(torch.rand(1, 3, SIZE, SIZE), torch.tensor([True]))
    assert [x.shape[-1] for x in added.levels] == sizes


def test_missing_and_foreign_kernels_are_refused() -> None:
    features = PictureFeatures((8, 8), 2, WIDTH)
    with pytest.raises(ValueError, match="kernels of VGG-16 are missing"):
        features.stages(torch.zeros(1, 3, SIZE, SIZE))
    with pytest.raises(UnirenderError, match=r"got nothing as convs\.3\.bias, expected \(128,\)"):
        features.load_vgg({k: v for k, v in vgg().state_dict().items() if k != "convs.3.bias"})
    with pytest.raises(UnirenderError, match=r"got \(64, 3, 11, 11\) as convs\.0\.weight"):
        features.load_vgg(LpipsNetwork("alex").state_dict())


@pytest.mark.parametrize("patch", [3, 16])
def test_a_patch_that_no_stage_fits_is_refused(patch: int) -> None:
    with pytest.raises(ValueError, match="expected 1, 2, 4 or 8"):
        PictureFeatures((8, 8), patch, WIDTH)


def test_absent_weights_say_how_to_get_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path))
    with pytest.raises(UnirenderError, match="lpips_convert vgg"):
        read_vgg()


def test_a_damaged_file_of_weights_is_said_to_be_one(cached: Path) -> None:
    cached.write_bytes(cached.read_bytes()[:1000])
    with pytest.raises(UnirenderError, match=r"lpips_vgg\.safetensors cannot be read .*; delete it"):
        read_vgg()


# --- in the network


@BOTH
def test_new_features_change_nothing(unified: bool) -> None:
    maps = make_batch(2)
    with_them, without = muted(featured(unified)), make_model(unified=unified)
    shared = {k: v for k, v in with_them[0].state_dict().items() if "vgg." not in k}
    without[0].load_state_dict(shared)
    assert torch.equal(decompose(with_them, maps), decompose(without, maps))


@BOTH
def test_features_inform_the_decomposition_and_not_the_render(unified: bool) -> None:
    """The renderer's image is noise, of which nothing can be seen."""
    maps = make_batch(2)
    before = decompose(featured(unified), maps), render(featured(unified), maps)
    after = decompose(muted(featured(unified)), maps), render(muted(featured(unified)), maps)
    assert (before[0] - after[0]).abs().max() > 1e-3
    assert torch.equal(before[1], after[1])


def test_rows_keep_to_themselves() -> None:
    """Of a batch with clean and noisy images each row is as if it were alone."""
    network, _ = featured()
    features = network.vgg
    assert features is not None
    picture = torch.rand(3, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    known = torch.tensor([True, False, True])
    together = features(picture, known)
    for x in (*together.levels, together.summary):
        assert not x[1].any()
    for row in (0, 2):
        alone = features(picture[row : row + 1], torch.tensor([True]))
        for x, y in zip((*together.levels, together.summary), (*alone.levels, alone.summary), strict=True):
            torch.testing.assert_close(x[row : row + 1], y)


def test_the_summary_is_of_the_object_alone() -> None:
    """Two stages of known values: their mean and deviation where the picture is not black."""
    picture = torch.full((1, 3, 8, 8), -1.0)
    picture[..., :4] = 0.2
    stage = torch.zeros(1, 2, 4, 4)
    stage[:, 0, :, :2] = 3.0
    stage[:, 1, :2, :2] = 1.0
    stage[..., 2:] = 100.0  # beside the object
    coarse = torch.full((1, 1, 2, 2), 5.0)
    found = statistics([stage, coarse], picture)
    torch.testing.assert_close(found, torch.tensor([[3.0, 0.5, 0.0, 0.5, 5.0, 0.0]]))
    assert torch.isfinite(statistics([stage], torch.full_like(picture, -1.0))).all()


def test_each_way_of_the_features_counts() -> None:
    parts = featured()
    features = parts[0].vgg
    assert features is not None
    assert_each_counts(parts, (features.summary, *features.adapters))


def test_a_split_network_has_them_where_images_are_clean() -> None:
    model, _ = build_model(dataclasses.replace(FEATURED.model, unified=False))
    assert isinstance(model, SplitDualStreamModel)
    assert model.vgg is None
    assert model.inverse.vgg is not None


@pytest.mark.parametrize(("features", "codec"), [("vgg19", "pixel"), ("vgg16", "kl"), ("encoder", "kl")])
def test_features_that_a_network_cannot_have_are_refused(features: str, codec: str) -> None:
    with pytest.raises(ValueError, match="expected one of none, vgg16, encoder, and 'none' where"):
        DualStreamModel(picture_features=features, codec=codec)


# --- in training


def trainer(folder: Path, config: TrainConfig = FEATURED) -> Trainer:
    return Trainer(config, RunConfig(folder, steps=3), CPU, torch.float32)


def test_training_moves_the_way_of_the_features_and_not_them(cached: Path, tmp_path: Path) -> None:
    run = trainer(tmp_path / "run")
    load_features(run.model)
    run.fit(OneBatch())
    again = UniRenderPipeline.from_pretrained(export_pipeline(run, tmp_path / "pipeline")).dual_stream
    assert again.config["picture_features"] == "vgg16"
    features = again.vgg
    assert features is not None
    kernel, original = features.get_buffer("kernel_4"), vgg().state_dict()["convs.4.weight"]
    torch.testing.assert_close(kernel, original, rtol=1e-3, atol=1e-4)  # stored in half
    assert all(parameter.any() for parameter in features.parameters())
    assert not [name for name in run.ema.average if "kernel" in name]


def test_a_network_without_features_is_given_them(cached: Path, tmp_path: Path) -> None:
    plain, run = trainer(tmp_path / "a", TRAIN), trainer(tmp_path / "b")
    begin_with_network(run, plain.model)
    for name, value in plain.model.state_dict().items():
        assert torch.equal(run.model.state_dict()[name], value)
    features = run.model.vgg
    assert features is not None
    assert torch.equal(features.get_buffer("kernel_0"), vgg().state_dict()["convs.0.weight"])
    assert not any(parameter.any() for parameter in features.parameters())
    cached.unlink()  # from a network that has them no file is needed
    third = trainer(tmp_path / "c")
    begin_with_network(third, run.model)
    assert third.model.vgg is not None
    assert torch.equal(third.model.vgg.get_buffer("kernel_0"), features.get_buffer("kernel_0"))


def test_a_network_with_features_does_not_become_one_without(cached: Path, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="expected the same network"):
        begin_with_network(trainer(tmp_path / "a", TRAIN), trainer(tmp_path / "b").model)
