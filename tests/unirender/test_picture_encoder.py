"""A picture encoder of the network's own: what it sees, where it enters, and how it is trained."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from both_directions import OneBatch, assert_each_counts, decompose, render
from tiny_models import SIZE, TRAIN, make_batch, make_model
from torch import Tensor

from unirender.errors import UnirenderError, UsageError
from unirender.models.added import Answers
from unirender.models.conditioning import coverage_of
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS, pack_image
from unirender.models.picture_encoder import (
    CELLS_WEIGHT,
    LIGHT_WEIGHT,
    PICTURES,
    PictureEncoder,
    answers_error,
    over_object,
    truth_of,
)
from unirender.models.unet import pyramid_channels, pyramid_strides
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.command import Train
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.config_check import check_config
from unirender.training.export import export_pipeline
from unirender.training.memory import training_bytes
from unirender.training.presets import PRESETS
from unirender.training.start import begin_with_network, read_start
from unirender.training.trained import encoder_of
from unirender.training.trainer import Trainer

ENCODED = dataclasses.replace(
    TRAIN,
    model=dataclasses.replace(TRAIN.model, picture_features="encoder"),
    loss=dataclasses.replace(TRAIN.loss, answers=1.0),
    p_render=0.0,
)
BOTH = pytest.mark.parametrize("unified", [True, False], ids=["unified", "split"])


def trainer(folder: Path, config: TrainConfig = ENCODED, steps: int = 3) -> Trainer:
    return Trainer(config, RunConfig(folder, steps=steps), torch.device("cpu"), torch.float32)


def encoder(model: DualStreamModel) -> PictureEncoder:
    found = encoder_of(model)
    assert found is not None
    return found


# --- what it sees


def test_mean_and_deviation_are_of_the_object_alone() -> None:
    x = torch.full((1, 2, 4, 4), 100.0)
    x[:, 0, :, :2], x[:, 1, :, :2] = 3.0, 0.0
    x[:, 1, :2, :2] = 1.0
    coverage = torch.zeros(1, 1, 8, 8)
    coverage[..., :4] = 1
    torch.testing.assert_close(over_object(x, coverage), torch.tensor([[3.0, 0.5, 0.0, 0.5]]), rtol=0, atol=2e-3)
    assert torch.isfinite(over_object(x, torch.zeros(1, 1, 8, 8))).all()


def test_the_truth_is_the_mean_over_the_object() -> None:
    _, conditioning = make_model()
    maps = make_batch(3)
    packing = conditioning.packing
    truth, covered = truth_of(packing.pack(maps), maps["mask"], packing.pack_light(maps["environment"]), (4, 4))
    inside = maps["mask"][0, 0] > 0
    for n in range(3):
        assert truth.whole[n, 0] == pytest.approx(2 * float(maps["metallic"][n, 0][inside].mean()) - 1, abs=1e-5)
        assert truth.whole[n, 1] == pytest.approx(2 * float(maps["roughness"][n, 0][inside].mean()) - 1, abs=1e-5)
        assert truth.whole[n, 2] == pytest.approx(1, abs=1e-5)  # the mask itself
    packed = packing.pack(maps)[:, 4, 8:16, 8:16].mean(dim=(1, 2))  # all of that cell is covered
    torch.testing.assert_close(truth.cells[:, 4, 1, 1], packed)
    assert covered[0, 0, 1, 1] == 1
    assert covered[0, 0, 0, 0] == 0.25


def test_the_error_counts_each_head_by_its_weight() -> None:
    truth = Answers(torch.zeros(2, PICTURES), torch.zeros(2, PICTURES, 2, 2), torch.zeros(2, 3, 4, 8))
    covered = torch.tensor([1.0, 0.0, 0.0, 0.0]).reshape(1, 1, 2, 2).expand(2, -1, -1, -1)

    def error(**changes: Tensor) -> float:
        return float(answers_error(dataclasses.replace(truth, **changes), truth, covered))

    metallic, mask = torch.zeros(2, PICTURES), torch.zeros(2, PICTURES)
    metallic[:, 0], mask[:, 2] = 0.5, 0.5
    assert error() == 0
    assert error(whole=metallic) == pytest.approx(0.25)
    assert error(whole=mask) == 0  # it is given
    outside = torch.zeros(2, PICTURES, 2, 2)
    outside[..., 1, 1] = 1.0
    assert error(cells=outside) == 0
    outside[:, 0, 0, 0] = 1.0
    assert error(cells=outside) == pytest.approx(CELLS_WEIGHT)
    assert error(light=torch.full_like(truth.light, 2.0)) == pytest.approx(4 * LIGHT_WEIGHT)


def test_the_mask_comes_with_the_extra_inputs() -> None:
    _, conditioning = make_model()
    mask = torch.rand(2, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    extras = conditioning.extras(mask, torch.zeros(2, len(TRIPLETS), dtype=torch.bool))
    assert torch.equal(coverage_of(extras.image, conditioning.codec.factor), mask)


# --- in the network


@pytest.mark.parametrize("features", ["encoder", "vgg16"])
def test_a_network_in_half_precision_sees_as_well(features: str) -> None:
    """`--dtype auto` may choose it, and then no autocast brings dtypes together."""
    maps = make_batch(2)
    model, conditioning = make_model(picture_features=features)
    if features == "vgg16":
        for name, kernel in model.named_buffers():
            if "kernel" in name:
                kernel.normal_(0, 0.05)
    exact = decompose((model, conditioning), maps)
    torch.nn.Module.to(model, torch.bfloat16)
    assert (decompose((model, conditioning), maps) - exact).abs().mean() < 0.03


def test_at_another_size_it_sees_the_whole_picture_at_its_own() -> None:
    """What it says is that of the same picture, averaged; its stages reach the decoder at the decoder's size."""
    model, conditioning = make_model(picture_features="encoder", resolution=64)
    maps = make_batch(1, size=64)
    large = {
        name: value if name == "environment" else value.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
        for name, value in maps.items()
    }
    look = encoder(model).look
    small, same = (look(pack_image(m["image"]), m["mask"])[2].whole for m in (maps, large))
    torch.testing.assert_close(small, same, rtol=0, atol=1e-5)
    assert decompose((model, conditioning), large).shape == (1, 3, 128, 128)


@pytest.mark.parametrize(("resolution", "stages"), [(64, (0, 1, 2, 3)), (128, (None, 0, 1, 2))])
def test_a_stage_goes_where_the_decoder_has_its_size(resolution: int, stages: tuple[int | None, ...]) -> None:
    model = DualStreamModel(
        sample_size=resolution // 2, block_out_channels=(32, 32, 64, 64), picture_features="encoder"
    )
    strides = pyramid_strides(model.attribute_unet, 2)
    assert len(strides) == len(pyramid_channels(model.attribute_unet))
    by_stride = dict(zip(strides, encoder(model).stage_of, strict=True))
    assert tuple(by_stride[2 << level] for level in range(4)) == stages
    extra = torch.zeros(1, 12, resolution // 2, resolution // 2)  # nothing is added where nothing has been learned
    added = model.features_of(torch.zeros_like(extra), torch.zeros(1, dtype=torch.long), extra)
    assert added is not None
    assert all(skip is None or not skip.any() for skip in added.skips)


@BOTH
def test_a_new_encoder_changes_nothing(unified: bool) -> None:
    maps = make_batch(2)
    with_it, without = make_model(unified=unified, picture_features="encoder"), make_model(unified=unified)
    for part in (encoder(with_it[0]).adapters, encoder(with_it[0]).summary):
        for parameter in part.parameters():
            torch.nn.init.zeros_(parameter)
    without[0].load_state_dict({k: v for k, v in with_it[0].state_dict().items() if "encoder." not in k})
    assert torch.equal(decompose(with_it, maps), decompose(without, maps))


@BOTH
def test_it_informs_the_decomposition_and_not_the_render(unified: bool) -> None:
    maps, parts = make_batch(2), make_model(unified=unified, picture_features="encoder")
    before = decompose(parts, maps), render(parts, maps)
    for parameter in encoder(parts[0]).parameters():
        torch.nn.init.zeros_(parameter)
    assert (decompose(parts, maps) - before[0]).abs().max() > 1e-3
    assert torch.equal(render(parts, maps), before[1])


def test_each_way_into_the_decoder_counts() -> None:
    parts = make_model(picture_features="encoder")
    assert_each_counts(parts, (encoder(parts[0]).summary, *encoder(parts[0]).adapters.values()))


def test_the_mask_is_looked_at() -> None:
    """A dark object is told from what is around it by the mask alone."""
    model, _ = make_model(picture_features="encoder")
    maps = make_batch(1)
    picture = pack_image(maps["image"])
    whole = [encoder(model).look(picture, mask)[2].whole for mask in (maps["mask"], torch.ones_like(maps["mask"]))]
    assert (whole[0] - whole[1]).abs().max() > 1e-4


def test_rows_keep_to_themselves() -> None:
    """Of a batch with clean and noisy images each row is as if it were alone."""
    model, _ = make_model(picture_features="encoder")
    maps = make_batch(3)
    picture, mask = pack_image(maps["image"]), maps["mask"]
    together = encoder(model)(picture, mask, torch.tensor([True, False, True]))
    assert not together.summary[1].any()
    assert not together.answers.whole[1].any()
    for row in (0, 2):
        alone = encoder(model)(picture[row : row + 1], mask[row : row + 1], torch.tensor([True]))
        torch.testing.assert_close(together.summary[row : row + 1], alone.summary)
        torch.testing.assert_close(together.answers.whole[row : row + 1], alone.answers.whole)
        for x, y in zip(together.skips, alone.skips, strict=True):
            assert (x is None) == (y is None)
            if x is not None:
                torch.testing.assert_close(x[row : row + 1], y)


def test_several_steps_look_once() -> None:
    parts = make_model(picture_features="encoder")
    looks: list[int] = []
    encoder(parts[0]).stem.register_forward_hook(lambda *_: looks.append(1))
    decompose(parts, make_batch(2), steps=4)
    assert len(looks) == 1


# --- in training


@pytest.mark.parametrize("trains", ["encoder", "inverse"])
def test_a_run_moves_what_it_trains_and_nothing_that_renders(trains: Any, tmp_path: Path) -> None:
    run = trainer(tmp_path / "run", dataclasses.replace(ENCODED, trains=trains))
    begin_with_network(run, make_model(picture_features="encoder")[0])
    before = {name: value.clone() for name, value in run.model.state_dict().items()}
    maps = make_batch(2)
    image = render((run.model, run.loss.conditioning), maps)
    run.fit(OneBatch())
    moved = {name for name, value in run.model.state_dict().items() if not torch.equal(value, before[name])}
    heads = {"encoder"} if trains == "encoder" else {"encoder", "attribute_unet", "image_to_attributes"}
    assert {name.split(".")[0] for name in moved} == heads
    assert not [name for name in moved if "down_blocks" in name or "mid_block" in name]
    assert torch.equal(render((run.model, run.loss.conditioning), maps), image)


def test_frozen_weights_are_held_without_gradient_and_moments(tmp_path: Path) -> None:
    whole = training_bytes(trainer(tmp_path / "a").model)
    alone = trainer(tmp_path / "b", dataclasses.replace(ENCODED, trains="encoder")).model
    held, own = training_bytes(alone), sum(p.nbytes for p in encoder(alone).parameters())
    assert (held.weights, held.gradients, held.moments) == (whole.weights, own, 2 * own)


def test_the_encoder_learns_a_batch_by_itself(tmp_path: Path) -> None:
    run = trainer(tmp_path / "run", dataclasses.replace(ENCODED, trains="encoder"), steps=40)
    batch = make_batch(4)
    errors = [run.train_step(dict(batch)) for _ in range(40)]
    assert set(errors[0]) == {"answers", "grad_norm", "lr"}
    assert errors[-1]["answers"] < 0.2 * errors[0]["answers"]


def test_heads_are_compared_in_a_whole_training_too(tmp_path: Path) -> None:
    run = trainer(tmp_path / "run", dataclasses.replace(ENCODED, p_render=0.5))
    terms = run.train_step(make_batch(4))
    assert terms["answers"] > 0
    assert "image" in terms
    silent = dataclasses.replace(ENCODED, loss=dataclasses.replace(ENCODED.loss, answers=0.0))
    assert "answers" not in trainer(tmp_path / "silent", silent).train_step(make_batch(4))


def test_a_network_without_an_encoder_is_given_one_and_keeps_it(tmp_path: Path) -> None:
    plain, run = trainer(tmp_path / "a", TRAIN), trainer(tmp_path / "b")
    begin_with_network(run, plain.model)
    for name, value in plain.model.state_dict().items():
        assert torch.equal(run.model.state_dict()[name], value)
    third = trainer(tmp_path / "c")
    begin_with_network(third, run.model)
    assert torch.equal(encoder(third.model).stem.weight, encoder(run.model).stem.weight)


def test_a_pipeline_keeps_its_encoder(tmp_path: Path) -> None:
    run = trainer(tmp_path / "run")
    run.fit(OneBatch())
    folder = export_pipeline(run, tmp_path / "pipeline")
    pipeline = UniRenderPipeline.from_pretrained(folder)
    network = pipeline.dual_stream
    assert network.config["picture_features"] == "encoder"
    assert encoder(network).summary.weight.any()
    torch.testing.assert_close(
        encoder(network).stem.weight, dict(run.ema.average)["encoder.stem.weight"], rtol=2e-3, atol=1e-4
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trains": "encoder", "model": TRAIN.model}, "expected picture_features 'encoder' and loss.answers above 0"),
        ({"trains": "encoder", "loss": TRAIN.loss}, "expected picture_features 'encoder' and loss.answers above 0"),
        ({"trains": "inverse", "p_render": 0.3}, "renders nothing; expected p_render 0"),
        ({"trains": "inverse", "timestep_rule": "algorithm1"}, "conditional rule"),
        ({"model": dataclasses.replace(ENCODED.model, resolution=96)}, "pictures of 96 pixels, expected one of 32, 64"),
        ({"model": dataclasses.replace(ENCODED.model, resolution=192)}, "pictures of 192 pixels"),
    ],
)
def test_stages_that_fit_nothing_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(UnirenderError, match=message):
        check_config(dataclasses.replace(ENCODED, **changes))


def test_another_prior_is_refused_where_nothing_could_learn_it(tmp_path: Path) -> None:
    """It would start the image's last convolution anew, and leave it there."""
    other = trainer(
        tmp_path / "a", dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, physics_prior="composite"))
    )
    with pytest.raises(UnirenderError, match="their physics prior is composite, expected split_sum"):
        begin_with_network(trainer(tmp_path / "b", dataclasses.replace(ENCODED, trains="inverse")), other.model)
    begin_with_network(trainer(tmp_path / "c"), other.model)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "tiny_encoder"}, "expected --init with a trained one"),
        ({"preset": "tiny_inverse"}, "expected --init with a trained one"),
        ({"preset": "tiny_encoder", "init": Path("tiny"), "validate": 4}, "--validate 4: nothing that is scored"),
        ({"preset": "tiny_encoder", "init": Path("tiny"), "resolution": 96}, "expected one of 32, 64, 128"),
    ],
)
def test_options_that_make_no_sense_for_a_part_are_refused(options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Train(Path("data"), **options).check()


def test_a_shipped_checkpoint_begins_a_run_of_its_encoder(tmp_path: Path) -> None:
    config = PRESETS["tiny_encoder"]
    run = trainer(tmp_path / "run", dataclasses.replace(config, batch_size=2), steps=1)
    read_start(config.model, Path("tiny")).apply(run)
    assert torch.equal(
        run.model.image_unet.conv_in.weight,
        UniRenderPipeline.from_pretrained("tiny").dual_stream.image_unet.conv_in.weight,
    )
    assert [part["preset"] for part in run.continues if "preset" in part]


@pytest.mark.long
def test_a_resumed_run_of_a_part_ends_as_one_that_was_not_stopped(tmp_path: Path) -> None:
    config, source = dataclasses.replace(ENCODED, trains="inverse"), OneBatch()
    whole, stopped = trainer(tmp_path / "whole", config, steps=4), trainer(tmp_path / "stopped", config, steps=4)
    for run in (whole, stopped):
        begin_with_network(run, make_model(picture_features="encoder")[0])
    whole.fit(source)
    for _ in range(2):
        stopped.train_step(source.next())
    stopped.save(source)
    again = trainer(tmp_path / "stopped", config, steps=4)
    again.fit(source)
    assert again.step == 4
    for name, value in whole.model.state_dict().items():
        assert torch.equal(again.model.state_dict()[name], value), name
        if name in stopped.ema.average:
            assert torch.equal(again.ema.average[name], whole.ema.average[name]), name
    ends = [run.model.state_dict()["image_to_attributes.0.weight"] for run in (stopped, whole)]
    assert not torch.equal(*ends)  # the twin: where it was stopped it was not there yet


def test_the_presets_go_together() -> None:
    """The weights of each stage are those that the next one begins with."""
    assert PRESETS["tiny_encoder"].model == PRESETS["tiny_inverse"].model
    assert PRESETS["tiny_encoder"].trains == "encoder"
    assert PRESETS["tiny_inverse"].trains == "inverse"
