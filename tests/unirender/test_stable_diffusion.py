"""Stable Diffusion's weights in a dual-stream network: from tiny folders with the real architecture to a training."""

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion import StableDiffusionPipeline
from safetensors.torch import load_file, save_file
from synthetic_shards import write_dataset
from tiny_models import TRAIN, make_batch
from tiny_stable_diffusion import TOKENS, tiny_text_encoder, tiny_unet, tiny_vae, vocabulary, write_stable_diffusion
from torch import Tensor, nn
from transformers import CLIPTextModel, CLIPTokenizer

from unirender import cli
from unirender.errors import UnirenderError, UsageError
from unirender.models.build import build_model
from unirender.models.config import ModelConfig
from unirender.models.dual_stream import DualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.command import Train
from unirender.training.config import LossConfig, RunConfig, TrainConfig
from unirender.training.loop.trainer import Trainer
from unirender.training.optim.memory import readable, training_bytes
from unirender.training.presets import PRESETS
from unirender.training.start.stable_diffusion import StableDiffusion, load_stable_diffusion
from unirender.training.start.weights import begin_with_diffusion

UNET, VAE, TEXT = ("unet", "vae", "text_encoder")
WEIGHTS = {
    UNET: "diffusion_pytorch_model.safetensors",
    VAE: "diffusion_pytorch_model.safetensors",
    TEXT: "model.safetensors",
}


@pytest.fixture(scope="module", params=[1, 2], ids=["version 1", "version 2"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_stable_diffusion(tmp_path_factory.mktemp("sd") / f"sd{request.param}", request.param)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_stable_diffusion(tmp_path_factory.mktemp("sd") / "first", 1)


def network(diffusion: StableDiffusion, **changes: Any) -> DualStreamModel:
    """A network of the shape of Stable Diffusion that has its weights."""
    torch.manual_seed(0)
    settings: dict[str, Any] = diffusion.shape | {"resolution": 32, "physics_prior": "none"} | changes
    model, _ = build_model(ModelConfig(**settings), diffusion.vae)
    diffusion.initialise(model)
    return model.eval()


@torch.no_grad()
def first_pass(model: DualStreamModel, latents: Tensor, t_attributes: Tensor, t_image: Tensor) -> tuple[Tensor, Tensor]:
    """Both streams' output for six identical latents and whatever extra inputs."""
    b, _, h, w = latents.shape
    extras = [torch.randn(b, model.config[f"{name}_extra_channels"], h, w) for name in ("attribute", "image")]
    out = model(latents.repeat(1, 6, 1, 1), latents, t_attributes, t_image, *extras)
    return out.attributes, out.image


@torch.no_grad()
def original(diffusion: StableDiffusion, unet: UNet2DConditionModel, latents: Tensor, t: Tensor) -> Tensor:
    return unet(latents, t, diffusion.prompt_embedding.expand(len(latents), -1, -1)).sample


def test_first_pass_of_each_stream_is_the_originals(folder: Path) -> None:
    diffusion = load_stable_diffusion(folder)
    unet = tiny_unet(1 if folder.name == "sd1" else 2)  # as it was before it was written
    model = network(diffusion)
    latents = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    t_attributes, t_image = torch.tensor([0, 700]), torch.tensor([999, 30])
    expected_a = original(diffusion, unet, latents, t_attributes).repeat(1, 6, 1, 1)
    expected_i = original(diffusion, unet, latents, t_image)
    attributes, image = first_pass(model, latents, t_attributes, t_image)
    torch.testing.assert_close(attributes, expected_a, rtol=0, atol=1e-5)
    torch.testing.assert_close(image, expected_i, rtol=0, atol=1e-5)
    assert expected_i.std() > 0.1

    def far(change: Callable[[], object]) -> tuple[bool, bool]:
        """Whether each stream's output is no longer the original's; the weights are then as before again."""
        kept = {name: value.clone() for name, value in model.state_dict().items()}
        with torch.no_grad():
            change()
        a, i = first_pass(model, latents, t_attributes, t_image)
        model.load_state_dict(kept)
        return bool((a - expected_a).abs().max() > 1e-3), bool((i - expected_i).abs().max() > 1e-3)

    bridge = model.attributes_to_image[3]
    assert isinstance(bridge, nn.Conv2d)
    assert far(lambda: None) == (False, False)
    assert far(lambda: model.attribute_unet.conv_in.weight.mul_(6)) == (True, False)  # without the division by six
    assert far(lambda: model.prompt_embedding.fill_(1)) == (True, True)  # a prompt of one's own
    assert far(lambda: nn.init.constant_(bridge.weight, 0.1)) == (False, True)


def test_prompt_is_what_diffusers_pipeline_makes_of_no_text(folder: Path) -> None:
    parts: dict[str, Any] = {
        "unet": UNet2DConditionModel.from_pretrained(folder / UNET),
        "vae": AutoencoderKL.from_pretrained(folder / VAE),
        "text_encoder": CLIPTextModel.from_pretrained(folder / TEXT),
        "tokenizer": CLIPTokenizer.from_pretrained(folder / "tokenizer"),
        "scheduler": None,
        "safety_checker": None,
        "feature_extractor": None,
    }
    pipeline = StableDiffusionPipeline(**parts, requires_safety_checker=False)
    device = torch.device("cpu")
    expected, _ = pipeline.encode_prompt("", device, 1, do_classifier_free_guidance=False)
    other, _ = pipeline.encode_prompt("a bad cafe", device, 1, do_classifier_free_guidance=False)
    found = load_stable_diffusion(folder).prompt_embedding
    assert found.shape[1] == TOKENS
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    assert not torch.allclose(found, other, rtol=0, atol=1e-2)


def test_names_of_weights_that_older_files_have(first: Path, tmp_path: Path) -> None:
    """Stable Diffusion's own files were written before diffusers and transformers renamed their layers."""
    old = copy(first, tmp_path)
    names = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}

    def renamed(name: str) -> str:
        for new, before in names.items():
            name = name.replace(new, before)
        return name

    rewrite(old, VAE, lambda weights: {renamed(name): value for name, value in weights.items()})
    rewrite(old, TEXT, lambda weights: {f"text_model.{name}": value for name, value in weights.items()})
    a, b = load_stable_diffusion(first), load_stable_diffusion(old)
    assert torch.equal(a.prompt_embedding, b.prompt_embedding)
    theirs = b.vae.state_dict()
    assert all(torch.equal(value, theirs[name]) for name, value in a.vae.state_dict().items())


def copy(folder: Path, to: Path) -> Path:
    return shutil.copytree(folder, to / "broken")


def rewrite(folder: Path, part: str, change: Callable[[dict[str, Tensor]], dict[str, Tensor]]) -> None:
    path = folder / part / WEIGHTS[part]
    save_file(change(load_file(path)), path, metadata={"format": "pt"})


def config(part: str, **changes: Any) -> Callable[[Path], None]:
    """Changes entries of a part's config."""

    def change(folder: Path) -> None:
        path = folder / part / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def removed(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def written(name: str, text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_text(text)

    return change


def cut(part: str) -> Callable[[Path], None]:
    """A file whose download ended early."""

    def change(folder: Path) -> None:
        path = folder / part / WEIGHTS[part]
        path.write_bytes(path.read_bytes()[:-1000])

    return change


def one_weight_less(part: str) -> Callable[[Path], None]:
    return lambda folder: rewrite(folder, part, lambda weights: dict(list(weights.items())[1:]))


def another_autoencoder(folder: Path) -> None:
    tiny_vae(channels=16).save_pretrained(folder / VAE)


def another_text_encoder(folder: Path) -> None:
    tiny_text_encoder(40).save_pretrained(folder / TEXT)


def pickled(folder: Path) -> None:
    path = folder / UNET / WEIGHTS[UNET]
    torch.save(load_file(path), path.with_name("diffusion_pytorch_model.bin"))
    path.unlink()


SDXL = {
    "block_out_channels": [32, 64, 64],
    "down_block_types": ["DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"],
    "up_block_types": ["CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"],
    "attention_head_dim": [5, 10, 20],
    "transformer_layers_per_block": [1, 2, 10],
    "addition_embed_type": "text_time",
}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (removed("."), "no such folder, expected Stable Diffusion 1 or 2 in diffusers format"),
        (
            removed(UNET),
            r"unet/config.json: is missing, expected the config of a part UNet2DConditionModel; pass a Stable",
        ),
        (removed(TEXT), r"text_encoder/config.json: is missing"),
        (removed("tokenizer/merges.txt"), "tokenizer: no tokenizer, expected the files vocab.json and merges.txt"),
        (written("tokenizer/vocab.json", "{"), "tokenizer: cannot be read as a tokenizer"),
        (
            written("tokenizer/vocab.json", json.dumps({word: 9 + n for word, n in vocabulary().items()})),
            "tokenizer: gives word 24, expected less than the text encoder's 16",
        ),
        (written("unet/config.json", "{"), "unet/config.json: cannot be read as JSON"),
        (written("unet/config.json", "7"), "unet/config.json: cannot be read as JSON"),
        (pickled, "unet: cannot be read as UNet2DConditionModel with weights as safetensors"),
        (cut(UNET), "unet: cannot be read as UNet2DConditionModel"),
        (cut(TEXT), "text_encoder: cannot be read as CLIPTextModel"),
        (one_weight_less(UNET), r"unet: 1 weights are missing \(first: conv_in.bias\), expected all of UNet2D"),
        (one_weight_less(TEXT), r"text_encoder: 1 weights are missing \(first: .*position_embedding"),
        (config(UNET, block_out_channels=[32, 32, 64, 96]), "unet: cannot be read as UNet2DConditionModel"),
        (
            config(UNET, _class_name="UNet2DModel"),
            "unet/config.json: got _class_name 'UNet2DModel', expected 'UNet2DConditionModel'",
        ),
        (
            config(TEXT, architectures=["CLIPTextModelWithProjection"]),
            "text_encoder/config.json: got architectures .*, expected 'CLIPTextModel'",
        ),
        (
            config(UNET, in_channels=9),
            r"unet: got 9 input channels \(an inpainting model\), expected .* \(4\); use the",
        ),
        (config(UNET, **SDXL), "is no U-Net of Stable Diffusion 1 or 2: .*text_time.* others, such as SDXL's, are not"),
        (config(UNET, block_out_channels=7), "unet: got block_out_channels 7, expected positive numbers, one for each"),
        (
            config(UNET, layers_per_block=[2, 1, 1, 1]),
            r"unet: got layers_per_block \(2, 1, 1, 1\), expected a positive",
        ),
        (config(UNET, attention_head_dim="8"), "unet: got attention_head_dim '8', expected positive numbers"),
        (config(VAE, scaling_factor=None), "vae: got scaling_factor None, expected that of its latents"),
        (config(UNET, act_fn="gelu"), "it has act_fn 'gelu' instead of 'silu'"),
        (another_autoencoder, "the autoencoder has 16 latent channels, expected the U-Net's 4; use the parts of one"),
        (another_text_encoder, "the text encoder gives 40 channels, expected the U-Net's 24; use the parts of one"),
    ],
)
def test_broken_folders_are_told_in_one_line(
    spoil: Callable[[Path], None], message: str, first: Path, tmp_path: Path
) -> None:
    broken = copy(first, tmp_path)
    spoil(broken)
    with pytest.raises(UnirenderError, match=message) as raised:
        load_stable_diffusion(broken)
    assert "\n" not in str(raised.value)


def test_transformers_is_an_extra(first: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(UnirenderError, match=r"transformers, which is not installed; pip install 'unirender\[sd\]'"):
        load_stable_diffusion(first)


def test_another_shape_is_refused_with_the_preset_that_fits(first: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    diffusion = load_stable_diffusion(first)
    with pytest.raises(UnirenderError, match=r"block_out_channels \(32, 32, 64, 64\) instead of \(320, .* PRESETS$"):
        diffusion.check(dataclasses.asdict(PRESETS["sd15"].model))
    monkeypatch.setitem(PRESETS, "tiny_sd", preset(diffusion))
    with pytest.raises(UnirenderError, match=r"choose --preset tiny_sd$"):
        diffusion.check(dataclasses.asdict(PRESETS["sd15"].model))
    with pytest.raises(UnirenderError, match=r"needs a network with layers_per_block 2 instead of 1; choose"):
        network(diffusion, layers_per_block=1)
    with pytest.raises(UnirenderError, match=r"needs a network with unified True instead of False; choose"):
        diffusion.check(dataclasses.asdict(dataclasses.replace(PRESETS["tiny_sd"].model, unified=False)))


def test_with_a_physics_prior_the_first_render_is_the_prior(first: Path) -> None:
    diffusion = load_stable_diffusion(first)
    model = network(diffusion, physics_prior="composite")
    assert not model.image_unet.conv_out.weight.any()
    weights = diffusion.unet.state_dict()
    assert torch.equal(model.image_unet.conv_in.weight, weights["conv_in.weight"])
    assert torch.equal(model.attribute_unet.conv_out.weight[-4:], weights["conv_out.weight"])


@pytest.mark.parametrize(
    ("name", "unet", "weights"),
    [
        ("sd15", {"cross_attention_dim": 768}, 859_520_964),  # the number that is stated for Stable Diffusion 1.5
        (
            "sd21",
            {"cross_attention_dim": 1024, "attention_head_dim": (5, 10, 20, 20), "use_linear_projection": True},
            865_910_724,  # and for 2.1
        ),
    ],
)
def test_presets_have_the_size_of_the_published_models(name: str, unet: dict[str, Any], weights: int) -> None:
    """Without memory for a single weight: torch's meta device keeps shapes only."""
    with torch.device("meta"):
        published = UNet2DConditionModel(**unet)
        model, _ = build_model(PRESETS[name].model, full_size_vae())
    shapes = {key: value.shape for key, value in published.state_dict().items()}
    assert {key: value.shape for key, value in model.image_unet.state_dict().items()} == shapes
    assert published.num_parameters() == model.image_unet.num_parameters() == weights
    other = {key for key, value in model.attribute_unet.state_dict().items() if value.shape != shapes[key]}
    assert other == {"conv_in.weight", "conv_out.weight", "conv_out.bias"}
    assert model.attribute_unet.conv_in.weight.shape == (320, 24, 3, 3)
    held = training_bytes(model)
    assert held.weights == 4 * model.num_parameters()
    assert held.total == 20 * model.num_parameters()
    assert readable(held.total) in ("32.5 GiB", "32.7 GiB")


def full_size_vae() -> AutoencoderKL:
    settings: dict[str, Any] = {
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "up_block_types": ("UpDecoderBlock2D",) * 4,
        "block_out_channels": (128, 256, 512, 512),
    }
    return AutoencoderKL(**settings, layers_per_block=2)


def test_bytes_of_a_training_are_those_that_it_holds(tmp_path: Path) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    trainer.train_step(make_batch())

    def size(tensors: Any) -> int:
        return sum(t.numel() * t.element_size() for t in tensors)

    parameters, held = list(trainer.model.parameters()), training_bytes(trainer.model)
    moments = [state[name] for state in trainer.optimizer.state.values() for name in ("exp_avg", "exp_avg_sq")]
    assert held.weights == size(parameters)
    assert held.gradients == size(p.grad for p in parameters if p.grad is not None)
    assert held.moments == size(moments)
    assert held.average == size(trainer.ema.average.values())
    assert str(held).startswith(f"{readable(held.total)} besides activations: weights {readable(held.weights)}, ")


def preset(diffusion: StableDiffusion) -> TrainConfig:
    """`paper` for a Stable Diffusion of this size; half a batch is rendered again."""
    loss = dataclasses.replace(PRESETS["paper"].loss, cycle_share=1.0)
    model = dataclasses.replace(PRESETS["paper"].model, **diffusion.shape)
    return dataclasses.replace(PRESETS["paper"], model=model, loss=loss)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "sd15"}, "--preset sd15: its network works on latents of Stable Diffusion's autoencoder, which it"),
        ({"preset": "paper"}, "--preset paper: .* pass --init-from with a Stable Diffusion folder"),
        ({"init_from": Path("sd")}, "--preset tiny: its network works on pixels and cannot begin with Stable"),
        ({"preset": "sd15", "init_from": Path("sd"), "init": Path("run")}, "--init and --init-from: both say"),
        ({"resolution": 48}, "--resolution 48: expected a multiple of 32, so that the network's latents"),
        ({"resolution": 0}, "--resolution 0: expected a multiple of 32"),
        ({"resolution": -32}, "--resolution -32: expected a multiple of 32"),
    ],
)
def test_options_that_contradict_each_other(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message):
        Train(data=tmp_path, **options).check()


def test_resolution_is_that_of_the_network() -> None:
    assert Train(data=Path("data"), resolution=96).check().model.resolution == 96
    kept = Train(data=Path("data"), preset="sd15", init_from=Path("sd")).check()
    assert kept.model.resolution == 512


def train(capsys: pytest.CaptureFixture[str], *options: str | Path) -> str:
    """What `unirender train` prints."""
    fixed = ["--device", "cpu", "--dtype", "float32", "--parallel", "1", "--batch-size", "2", "--log-every", "1"]
    with pytest.raises(SystemExit) as stopped:
        cli.main(["train", "--preset", "tiny_sd", "--resolution", "32", *fixed, *map(str, options)])
    assert stopped.value.code == 0
    return capsys.readouterr().out


@pytest.mark.long
def test_training_from_the_folder_to_a_pipeline_that_decomposes(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    diffusion = load_stable_diffusion(first)
    monkeypatch.setitem(PRESETS, "tiny_sd", preset(diffusion))
    data, run = write_dataset(tmp_path / "data", size=32), tmp_path / "run"
    begin = ("--data", data, "--init-from", first, "--out", run)
    printed = train(capsys, *begin, "--steps", "2", "--gradient-checkpointing")
    model = network(diffusion)
    assert f"memory: {training_bytes(model)}" in printed
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log] == [1, 2]
    assert all(np.isfinite(line["grad_norm"]) for line in log)
    assert any("cycle" in line for line in log)  # through the autoencoder and back

    pipeline = UniRenderPipeline.from_pretrained(run / "pipeline")
    assert isinstance(pipeline.vae, AutoencoderKL)
    kept = pipeline.vae.state_dict()
    assert all(torch.equal(value, kept[name]) for name, value in diffusion.vae.state_dict().items())
    trained = pipeline.dual_stream
    torch.testing.assert_close(trained.prompt_embedding, diffusion.prompt_embedding, rtol=2e-3, atol=1e-6)  # float16
    away = {n: (p - q).abs().max() for (n, p), q in zip(trained.named_parameters(), model.parameters(), strict=True)}
    assert max(away.values()) < 2e-3  # two steps of 1e-5, and float16, from Stable Diffusion's weights
    assert away["image_to_attributes.0.weight"] > 1e-6  # what began at zero has moved
    facts = json.loads((run / "pipeline" / "training.json").read_text())
    assert facts["continues"] == [{"stable_diffusion": "first"}]
    assert "Stable Diffusion's weights, `first`" in (run / "pipeline" / "README.md").read_text()
    assert facts["train"]["model"]["resolution"] == pipeline.size == 32
    picture = np.random.default_rng(0).uniform(0, 1, (40, 30, 3)).astype(np.float32)
    found = pipeline.decompose(picture).intrinsics
    assert found.require("albedo")["albedo"].shape == (40, 30, 3)
    assert pipeline.render(found).shape == (40, 30, 3)

    train(capsys, *begin, "--steps", "3")  # the same run, one step longer, without the option that changes no result
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log] == [1, 2, 3]

    second = tmp_path / "second"  # another run goes on with the pipeline's weights and its autoencoder
    train(capsys, "--data", data, "--init", run / "pipeline", "--out", second, "--steps", "1")
    facts = json.loads((second / "pipeline" / "training.json").read_text())
    assert [entry.get("steps") for entry in facts["continues"]] == [None, 3]
    assert (second / "pipeline" / "vae" / WEIGHTS[VAE]).is_file()
    with pytest.raises(UnirenderError, match="its network has the codec kl, expected pixel; choose the preset"):
        Train(data=data, preset="tiny", init=run / "pipeline", out=tmp_path / "third").run(no_validation, tuple)


def no_validation(suite: str, scenes: int) -> Any:
    raise AssertionError(f"{suite}, {scenes}: nothing is validated here")


def test_gradients_are_the_same_with_checkpointing(first: Path, tmp_path: Path) -> None:
    """In the trainer, with the autoencoder and the cycle; side by side as on a CPU."""
    diffusion = load_stable_diffusion(first)
    loss = LossConfig(cycle_share=1.0, cycle_warmup=0.0)
    model = dataclasses.replace(TRAIN.model, physics_prior="none", **diffusion.shape)
    both = []
    for checkpointing in (False, True):
        config = dataclasses.replace(TRAIN, model=model, loss=loss)
        run = RunConfig(tmp_path, steps=1, parallel=2)
        trainer = Trainer(config, run, torch.device("cpu"), torch.float32, vae=diffusion.vae)
        begin_with_diffusion(trainer, diffusion)
        if checkpointing:
            trainer.model.enable_gradient_checkpointing()
        terms = trainer.train_step(make_batch())
        both.append((terms, [p.grad for p in trainer.model.parameters() if p.grad is not None]))
    (terms, plain), (terms_again, again) = both
    assert terms == pytest.approx(terms_again, rel=1e-5)
    assert len(plain) == len(again) > 0
    for g, h in zip(plain, again, strict=True):
        torch.testing.assert_close(g, h, rtol=1e-4, atol=1e-6)
    assert not any(p.requires_grad for p in diffusion.vae.parameters())
