"""Very small Stable Diffusion folders with random weights, written by diffusers and transformers themselves."""

import json
from pathlib import Path
from typing import Any, Literal

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel

TOKENS = 77
START, END = "<|startoftext|>", "<|endoftext|>"

# What the two versions differ in, at a tenth of their size.
VERSIONS: dict[int, dict[str, Any]] = {
    1: {"attention_head_dim": 8, "cross_attention_dim": 24, "use_linear_projection": False},
    2: {"attention_head_dim": (2, 4, 8, 8), "cross_attention_dim": 32, "use_linear_projection": True},
}


def tiny_unet(version: Literal[1, 2] = 1, **changes: Any) -> UNet2DConditionModel:
    """Four levels with the architecture of Stable Diffusion 1 or 2, which diffusers has as its default."""
    torch.manual_seed(version)
    settings: dict[str, Any] = {"block_out_channels": (32, 32, 64, 64), "norm_num_groups": 8, "sample_size": 8}
    return UNet2DConditionModel(**(settings | VERSIONS[version] | changes)).eval()


def tiny_vae(channels: int = 4) -> AutoencoderKL:
    """An autoencoder of 4 x 4 pixels a latent."""
    torch.manual_seed(7)
    settings: dict[str, Any] = {  # diffusers annotates these as tuples of one
        "down_block_types": ("DownEncoderBlock2D",) * 3,
        "up_block_types": ("UpDecoderBlock2D",) * 3,
        "block_out_channels": (8, 8, 16),
    }
    return AutoencoderKL(**settings, norm_num_groups=4, latent_channels=channels).eval()


def tiny_text_encoder(width: int) -> CLIPTextModel:
    torch.manual_seed(8)
    config = CLIPTextConfig(
        vocab_size=len(vocabulary()),
        hidden_size=width,
        intermediate_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        max_position_embeddings=TOKENS,
        bos_token_id=vocabulary()[START],
        eos_token_id=vocabulary()[END],
    )
    return CLIPTextModel(config).eval()


def vocabulary() -> dict[str, int]:
    """A few letters, alone and at a word's end, and CLIP's two marks."""
    letters = [letter + end for end in ("", "</w>") for letter in "abcdefg"]
    return {word: number for number, word in enumerate([*letters, START, END])}


def write_tokenizer(folder: Path) -> None:
    """The files of a `CLIPTokenizer` without any merge."""
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps(vocabulary()))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    marks = {"bos_token": START, "eos_token": END, "unk_token": END, "pad_token": END}
    settings = {"tokenizer_class": "CLIPTokenizer", "model_max_length": TOKENS, **marks}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings))
    (folder / "special_tokens_map.json").write_text(json.dumps(marks))


def write_stable_diffusion(folder: Path, version: Literal[1, 2] = 1) -> Path:
    """A folder as Stable Diffusion's are, as far as it is read."""
    unet = tiny_unet(version)
    unet.save_pretrained(folder / "unet")
    tiny_vae().save_pretrained(folder / "vae")
    tiny_text_encoder(unet.config["cross_attention_dim"]).save_pretrained(folder / "text_encoder")
    write_tokenizer(folder / "tokenizer")
    return folder
